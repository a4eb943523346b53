"""Nonlinear MPC for any mechanism by warm-started iterative LQR, with new guesses where the plan fails."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import within_limits
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of
from pendulum_lqr.swing_up.ilqr import IlqrPlan, IlqrWeights
from pendulum_lqr.swing_up.search import PlanSearch, PlanSettings
from pendulum_msgs_py.contract.joints import Vector

__all__ = ["ITERATIONS", "PATIENCE", "PLAN", "RETRIES", "MechanismMpc"]

Array = NDArray[np.float64]
_HURRY = IlqrWeights(1.0, 0.0, 0.004, 2e-5, 5e-3, 10.0)
PLAN = PlanSettings(_HURRY, step=0.02, nodes=70, guesses=32, iterations=20)
"""Settings of plans and of initial guesses; the step is also the replanning period."""
ITERATIONS = 3
"""Iterations of iterative LQR per replanning."""
PATIENCE, RETRIES = 8, 2
"""Plans after which some guesses are tried again where the plan does not end upright, and how many."""


class MechanismMpc(Controller):
    """Follows the first interval of a plan, replans from the state, and hands over to the LQR near upright."""

    def __init__(self, period: float, catch: MechanismCatch) -> None:
        super().__init__(catch.plant.effort_limits)
        self.plant, self.period, self.catch = catch.plant, period, catch
        self.search = PlanSearch(catch, PLAN)
        self.reset()

    def reset(self) -> None:
        """Forget the plan."""
        self.catch.active = False
        self.search.reset()
        self._plan: IlqrPlan | None = None
        self._planned = 0.0
        self._age = 0
        self._before = (0.0,) * len(self.effort_limits)

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the efforts [N m or N]."""
        x = position + velocity
        step = PLAN.step
        deviation = deviation_of(self.plant.coordinates, x)
        if self.catch.holds(deviation):
            self._plan = None
            self._before = self.catch.command(deviation)
            return self._before
        if self._plan is None:
            self._plan = self._best(x, None, PLAN.guesses)
            self._planned, self._age = t, 0
        elif t - self._planned > 2.0 * step:
            # A plan that was not followed for a while starts elsewhere. In real time its search was too late to be
            # applied: it is a better start than none, and another search would be as late.
            late = self.search.solve(x, self._before, self._plan.efforts, PLAN.iterations)
            self._plan = self._best(x, late, RETRIES)
            self._planned, self._age = t, 0
        elif t - self._planned >= step - 0.5 * self.period:
            self._plan_again(t, x)
        plan = self._plan
        if not math.isfinite(plan.cost):
            # Far beyond a machine's speeds every plan diverges: there is none to follow.
            self._plan, self._before = None, (0.0,) * len(self.effort_limits)
            return self._before
        share = min(1.0, (t + 0.5 * self.period - self._planned) / step)
        n = len(self.plant.joints)
        first = plan.states[0, 2 * n :]
        self._before = within_limits(first + share * (plan.efforts[0] - first), self.effort_limits)
        return self._before

    def _plan_again(self, t: float, x: Vector) -> None:
        assert self._plan is not None
        self._before = tuple(float(u) for u in self._plan.efforts[0])
        guess, around = _shifted(self._plan)
        plan = self.search.solve(x, self._before, guess, ITERATIONS, around)
        self._age += 1
        if self._age % PATIENCE == 0 and not self.search.arrives(plan):
            plan = self._best(x, plan, RETRIES)
        if math.isfinite(plan.cost):
            self._plan, self._planned = plan, t
        # Else it is a single wild state, such as an encoder glitch: the previous plan is better.

    def _best(self, x: Vector, plan: IlqrPlan | None, count: int) -> IlqrPlan:
        """Return the cheapest of a plan and optimised new guesses."""
        found = self.search.guessed(x, self._before, count)
        return min(found if plan is None else [plan, *found], key=lambda each: each.cost)


def _shifted(plan: IlqrPlan) -> tuple[Array, IlqrPlan]:
    """Return the efforts of a plan one interval later, with zero at the end, and the plan that its feedback follows."""
    states = np.vstack([plan.states[1:], plan.states[-1:]])
    efforts = np.vstack([plan.efforts[1:], np.zeros((1, plan.efforts.shape[1]))])
    gains = np.concatenate([plan.gains[1:], np.zeros((1, *plan.gains.shape[1:]))])
    return efforts, plan._replace(states=states, efforts=efforts, gains=gains)
