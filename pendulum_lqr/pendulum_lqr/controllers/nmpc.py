"""Nonlinear MPC: optimises the torque over a horizon at every state, with CasADi."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.catch import CatchingController
from pendulum_lqr.controllers.specs import CATCH_Q, CATCH_R
from pendulum_lqr.swing_up.trajectory_optimisation import rigid_flow
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["NonlinearMpc"]

Array = NDArray[np.float64]


class NonlinearMpc(CatchingController):
    """Multiple shooting with RK4 over N steps, warm-started from the last plan; LQR takes over near upright.

    Minimises the sum of h (q0 2 (1 - cos e) + q1 theta_dot^2 + r (u - u*)^2) and a terminal cost of the same form; 2 (1
    - cos e) is e^2 near upright and periodic over turns.
    """

    SUMMARY = "nonlinear MPC by multiple shooting, swings up and balances"
    PARAMETERS = (
        ParameterSpec("q", [10.0, 0.1], "1/rad^2, s^2/rad^2", "Weights of angle and velocity.", minimum=0.0),
        ParameterSpec("r", 0.1, "1/(N m)^2", "Weight of torque.", minimum=0.0, exclusive_minimum=True),
        ParameterSpec("terminal", 20.0, "s", "Terminal weights as a multiple of q.", minimum=0.0),
        ParameterSpec("steps", 40, "-", "Length of the horizon in steps.", minimum=5, maximum=200),
        ParameterSpec("step", 0.05, "s", "Step of the horizon.", minimum=0.0, exclusive_minimum=True, maximum=1.0),
        ParameterSpec("iterations", 60, "-", "Largest number of solver iterations per answer.", minimum=1),
        CATCH_Q,
        CATCH_R,
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        super().__init__(plant, period, p)
        self.period = period
        self.step = float(p["step"])
        self.steps = int(p["steps"])
        self._solver, self._lower, self._upper = _problem(plant, p, self.catch.hold)
        self._plan: Array | None = None
        self._failures = 0

    def reset(self) -> None:
        """Forget the plan."""
        super().reset()
        self._plan = None

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the first torque of the plan, or that of the last plan without a solution [N m]."""
        if self.catch.holds(x[0], x[1]):
            self._plan = None
            return self.catch.command(x[0], x[1])
        guess = self._first_guess(x) if self._plan is None else self._shifted(self._plan, x)
        solution = self._solver(x0=guess, lbg=self._lower, ubg=self._upper, p=[x[0], x[1]])
        plan = np.asarray(solution["x"], dtype=np.float64).ravel()
        if np.all(np.isfinite(plan)) and float(np.max(np.abs(plan[2::3]))) <= 1.01 * self.effort_limit:
            self._plan = plan
        else:
            # The last plan, shifted to now, is better than no command.
            self._failures += 1
            self.notice = f"no plan for {self._failures} states: the last plan answered"
            self._plan = guess
        return self.clamp(float(self._plan[2]))

    def describe(self) -> str:
        """Return horizon and catch."""
        return f"horizon {self.steps} x {self.step:g} s, catch {self.catch.describe()}"

    def _first_guess(self, x: Sequence[float]) -> Array:
        """Return the constant state, with torque along the motion."""
        guess = np.zeros(3 * self.steps + 2)
        guess[0::3], guess[1::3] = x[0], 0.0
        guess[2::3] = 0.5 * self.effort_limit * (1.0 if x[1] >= 0.0 else -1.0)
        return guess

    def _shifted(self, plan: Array, x: Sequence[float]) -> Array:
        """Return the plan one sampling period later, with angles on the measured turn."""
        shift = self.period / self.step
        guess = np.empty_like(plan)
        for offset, count in ((0, self.steps + 1), (1, self.steps + 1), (2, self.steps)):
            values = plan[offset::3]
            guess[offset::3] = np.interp(np.arange(count) + shift, np.arange(count), values)
        guess[0::3] += 2.0 * math.pi * round((x[0] - guess[0]) / (2.0 * math.pi))
        return guess


def _problem(plant: PlantParameters, p: Mapping[str, Any], hold: float) -> tuple[Any, Array, Array]:
    """Return (solver, lower, upper) of the optimisation over [x0, u0, x1, u1, ..., xN]."""
    steps, step, limit = int(p["steps"]), float(p["step"]), float(p["effort_limit"])
    x, u = casadi.MX.sym("x", 2), casadi.MX.sym("u")

    # RK4 is stable up to 2.7 times the fastest time constant.
    substeps = max(2, math.ceil(step * plant.damping / plant.inertia))
    h = step / substeps
    end = x
    for _ in range(substeps):
        k1 = rigid_flow(plant, end, u)
        k2 = rigid_flow(plant, end + h / 2 * k1, u)
        k3 = rigid_flow(plant, end + h / 2 * k2, u)
        k4 = rigid_flow(plant, end + h * k3, u)
        end = end + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    advance = casadi.Function("advance", [x, u], [end])
    measured = casadi.MX.sym("measured", 2)
    X = [casadi.MX.sym(f"x{k}", 2) for k in range(steps + 1)]
    U = [casadi.MX.sym(f"u{k}") for k in range(steps)]
    q0, q1 = p["q"]

    def state_cost(state: Any) -> Any:
        return 2.0 * q0 * (1.0 - casadi.cos(state[0] - p["set_point"])) + q1 * state[1] ** 2

    cost = p["terminal"] * state_cost(X[steps])
    variables: list[Any] = []
    constraints: list[Any] = []
    lower: list[float] = []
    upper: list[float] = []
    for k in range(steps):
        variables += [X[k], U[k]]
        cost += step * (state_cost(X[k]) + p["r"] * (U[k] - hold) ** 2)
        constraints.append(X[k + 1] - advance(X[k], U[k]))
        if k == 0:
            constraints.append(X[0] - measured)
        constraints.append(U[k])
        zeros = [0.0] * (4 if k == 0 else 2)
        lower += [*zeros, -limit]
        upper += [*zeros, limit]
    variables.append(X[steps])
    problem = {
        "x": casadi.vertcat(*variables),
        "f": cost,
        "g": casadi.vertcat(*constraints),
        "p": measured,
    }
    bounds = np.array(lower), np.array(upper)
    if casadi.has_nlpsol("fatrop"):
        # Exploits the stage structure: half the time of IPOPT on the same iterations.
        options: dict[str, Any] = {
            "expand": True,
            "print_time": False,
            "error_on_fail": False,
            "structure_detection": "auto",
            "equality": [a == b for a, b in zip(lower, upper, strict=True)],
            "fatrop": {"print_level": 0, "max_iter": p["iterations"]},
        }
        return casadi.nlpsol("nmpc", "fatrop", problem, options), *bounds
    options = {
        "expand": True,
        "print_time": False,
        "error_on_fail": False,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": p["iterations"]},
    }
    return casadi.nlpsol("nmpc", "ipopt", problem, options), *bounds
