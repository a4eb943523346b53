"""Iterative LQR as a controller: plan, follow the plan, hand over to the LQR about upright."""

from __future__ import annotations

import math

import numpy as np

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of
from pendulum_lqr.swing_up.ilqr import IlqrPlan, IlqrWeights
from pendulum_lqr.swing_up.search import PlanSearch, PlanSettings
from pendulum_lqr.swing_up.trajectory import trajectory_of
from pendulum_lqr.swing_up.tvlqr import MechanismTvlqr, whole_turns
from pendulum_msgs_py.contract.joints import Vector

__all__ = ["PlannedSwingUp"]

_SPRINT = IlqrWeights(1.0, 0.0, 0.0005, 2e-6, 1e-4, 3.0)
"""Hardly any cost except the time away from upright."""
_PLAN = PlanSettings(_SPRINT, step=0.01, nodes=100, guesses=200, iterations=40)
_REFINED = 100
"""Largest number of iterations on the chosen plan."""
_TUBE = 10.0
"""Width of the tube about a plan, as a multiple of the caught region's level; outside, it replans."""


class PlannedSwingUp(Controller):
    """Plans to the end, follows the plan by time-varying LQR, and replans only where tracking fails.

    A search takes about a second: simulated time waits for it, a real plant does not. Plans neglect dry friction.
    """

    def __init__(self, period: float, catch: MechanismCatch, settings: PlanSettings = _PLAN) -> None:
        super().__init__(catch.plant.effort_limits)
        self.plant, self.period, self.catch = catch.plant, period, catch
        self.search = PlanSearch(catch, settings)
        self.reset()

    def reset(self) -> None:
        """Forget the plan."""
        self.catch.active = False
        self.search.reset()
        self._followed: MechanismTvlqr | None = None
        self._before = (0.0,) * len(self.effort_limits)

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the efforts [N m or N]."""
        x = position + velocity
        deviation = deviation_of(self.plant.coordinates, x)
        if self.catch.holds(deviation):
            self._followed = None
            self._before = self.catch.command(deviation)
            return self._before
        effort = None if self._followed is None else self._followed.followed(t, x)
        if effort is None:
            plan = self._plan(x)
            # Far beyond a machine's speeds every plan diverges: there is none to follow.
            self._followed = self._follow(plan) if math.isfinite(plan.cost) else None
            effort = None if self._followed is None else self._followed.followed(t, x)
        self._before = (0.0,) * len(self._before) if effort is None else effort
        return self._before

    def _plan(self, x: Vector) -> IlqrPlan:
        """Return the cheapest plan that ends where the LQR catches, or else the cheapest."""
        start = tuple(float(value) for value in np.array(x) - whole_turns(self.plant, x))
        found = self.search.guessed(start, self._before, self.search.settings.guesses)
        best = min(found, key=self._rank)
        refined = self.search.solve(start, self._before, best.efforts, _REFINED)
        return min(refined, best, key=self._rank)

    def _rank(self, plan: IlqrPlan) -> tuple[bool, float]:
        return not self.search.arrives(plan), plan.cost

    def _follow(self, plan: IlqrPlan) -> MechanismTvlqr:
        trajectory = trajectory_of(self.plant, plan, self.search.settings.step)
        q, r = self.plant.weights
        return MechanismTvlqr(self.period, trajectory, self.catch, q=q, r=r, tube=_TUBE)
