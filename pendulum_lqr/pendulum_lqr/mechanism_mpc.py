"""Nonlinear MPC for any mechanism by iterative LQR, warm-started, with fresh guesses where the plan leads nowhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.mechanism_catch import MechanismCatch, deviation_of
from pendulum_lqr.mechanism_controller import within_limits
from pendulum_lqr.mechanism_ilqr import IlqrPlan, IlqrProblem, IlqrWeights
from pendulum_msgs_py.joints import Vector
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["MechanismMpc", "MpcSettings"]

Array = NDArray[np.float64]
_HURRY = IlqrWeights(1.0, 0.0, 0.004, 2e-5, 5e-3, 10.0)


@dataclass(frozen=True)
class MpcSettings:
    """Settings of the controller.

    Attributes:
        weights: Of the cost; dominated by being away from upright, so that it hurries.
        step: Distance of the plan's nodes, and time from plan to plan [s].
        nodes: Intervals of the horizon.
        iterations: Of iterative LQR from plan to plan.
        guesses: Fresh guesses where there is no plan, or where the plan does not end upright.
        guess_iterations: Largest number of iterations for each of them.
        patience: Plans after which some guesses are tried again.
        retries: How many.
    """

    weights: IlqrWeights = _HURRY
    step: float = 0.02
    nodes: int = 70
    iterations: int = 3
    guesses: int = 32
    guess_iterations: int = 20
    patience: int = 8
    retries: int = 2


class MechanismMpc:
    """Follows the first interval of a plan, plans anew from where it is, and hands over to the LQR near upright.

    Args:
        plant: The plant.
        period: Sampling period [s].
        catch: LQR with its region.
        settings: Horizon, weights, guesses.
        seed: Of the guesses.
    """

    def __init__(
        self,
        plant: MechanismParameters,
        period: float,
        catch: MechanismCatch,
        settings: MpcSettings | None = None,
        seed: int = 0,
    ) -> None:
        self.plant, self.period, self.catch, self.seed = plant, period, catch, seed
        self.settings = settings or MpcSettings()
        self._problem = IlqrProblem(plant, self.settings.step, self.settings.weights, catch.terminal)
        self._limits = plant.effort_limits
        self.reset()

    def reset(self) -> None:
        """Forget the plan."""
        self.catch.active = False
        self._rng = np.random.default_rng(self.seed)
        self._plan: IlqrPlan | None = None
        self._planned = 0.0
        self._age = 0
        self._before = (0.0,) * len(self._limits)

    def command(self, t: float, x: Vector) -> Vector:
        """Return the efforts [N m or N]."""
        deviation = deviation_of(self.plant.coordinates, x)
        if self.catch.holds(deviation):
            self._plan = None
            self._before = self.catch.command(deviation)
            return self._before
        if self._plan is None:
            self._plan = self._best(x, None, self.settings.guesses)
            self._planned, self._age = t, 0
        elif t - self._planned > 2.0 * self.settings.step:
            # A plan that nobody followed for a while begins elsewhere. In real time that is one whose search took too
            # long for its answer to be applied: it is a better start than none, and another search would be as late.
            late = self._solve(x, self._plan.efforts, None, self.settings.guess_iterations)
            self._plan = self._best(x, late, self.settings.retries)
            self._planned, self._age = t, 0
        elif t - self._planned >= self.settings.step - 0.5 * self.period:
            self._plan_again(t, x)
        plan = self._plan
        share = min(1.0, (t + 0.5 * self.period - self._planned) / self.settings.step)
        n = len(self.plant.joints)
        first = plan.states[0, 2 * n :]
        self._before = within_limits(first + share * (plan.efforts[0] - first), self._limits)
        return self._before

    def _plan_again(self, t: float, x: Vector) -> None:
        assert self._plan is not None
        self._before = tuple(float(u) for u in self._plan.efforts[0])
        plan = self._solve(x, *_shifted(self._plan), self.settings.iterations)
        self._age += 1
        if self._age % self.settings.patience == 0 and not self._arrives(plan):
            plan = self._best(x, plan, self.settings.retries)
        self._plan, self._planned = plan, t

    def _best(self, x: Vector, plan: IlqrPlan | None, count: int) -> IlqrPlan:
        """Return the cheapest of a plan and what fresh guesses become."""
        best = plan
        for guess in self._guesses(count):
            found = self._solve(x, guess, None, self.settings.guess_iterations)
            if best is None or found.cost < best.cost:
                best = found
        assert best is not None
        return best

    def _guesses(self, count: int) -> Sequence[Array]:
        nodes, m = self.settings.nodes, len(self._limits)
        t = np.arange(nodes) * self.settings.step
        guesses = [np.zeros((nodes, m))]
        for index in range(count - 1):
            if index % 2:
                # Full effort one way, then another: what hurries.
                switches = np.cumsum(self._rng.uniform(0.05, 0.5, 6))
                levels = np.array(self._limits) * self._rng.uniform(-0.8, 0.8, (7, m))
                levels[3:] *= 0.2
                guesses.append(levels[np.searchsorted(switches, t)])
                continue
            phase, period = self._rng.random(m), self._rng.uniform(0.3, 1.6, m)
            height = 0.7 * np.array(self._limits) * self._rng.random(m)
            # It dies away: what is pumped to the end spins.
            fade = np.exp(-2.0 * t / t[-1])[:, None]
            guesses.append(fade * height * np.sin(2.0 * math.pi * (t[:, None] / period + phase)))
        return guesses

    def _arrives(self, plan: IlqrPlan) -> bool:
        n = len(self.plant.joints)
        return self.catch.share(deviation_of(self.plant.coordinates, tuple(plan.states[-1, : 2 * n]))) <= 1.0

    def _solve(self, x: Vector, guess: Array, around: IlqrPlan | None, iterations: int) -> IlqrPlan:
        n = len(self.plant.joints)
        return self._problem.solve(x[:n], x[n:], self._before, guess, iterations, around)


def _shifted(plan: IlqrPlan) -> tuple[Array, IlqrPlan]:
    """Return the efforts of a plan one interval later, ended by none, and the plan that its feedback follows there."""
    states = np.vstack([plan.states[1:], plan.states[-1:]])
    efforts = np.vstack([plan.efforts[1:], np.zeros((1, plan.efforts.shape[1]))])
    gains = np.concatenate([plan.gains[1:], np.zeros((1, *plan.gains.shape[1:]))])
    return efforts, plan._replace(states=states, efforts=efforts, gains=gains)
