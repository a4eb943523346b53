"""Plans from any state to upright by iterative LQR on random guesses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of
from pendulum_lqr.swing_up.ilqr import IlqrPlan, IlqrProblem, IlqrWeights
from pendulum_msgs_py.contract.joints import Vector

__all__ = ["PlanSearch", "PlanSettings"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlanSettings:
    """Settings of a search; ``step`` is the distance of the plan's nodes [s], ``iterations`` their largest number."""

    weights: IlqrWeights
    step: float
    nodes: int
    guesses: int
    iterations: int


class PlanSearch:
    """Searches plans for the plant of a catch, to end in its region."""

    def __init__(self, catch: MechanismCatch, settings: PlanSettings) -> None:
        self.catch, self.settings = catch, settings
        self._problem = IlqrProblem(catch.plant, settings.step, settings.weights, catch.terminal)
        self.reset()

    def reset(self) -> None:
        """Draw the same guesses again."""
        self._rng = np.random.default_rng(0)

    def solve(
        self, x: Vector, before: Vector, guess: Array, iterations: int, around: IlqrPlan | None = None
    ) -> IlqrPlan:
        """Return the result of iterations on a guess of efforts, shape (nodes, m), from the state x = [q, v].

        ``before`` has the m efforts until then; ``around`` is a plan whose feedback follows the guess.
        """
        n = len(x) // 2
        return self._problem.solve(x[:n], x[n:], before, guess, iterations, around)

    def guessed(self, x: Vector, before: Vector, count: int) -> list[IlqrPlan]:
        """Return plans from new guesses, the first with zero effort."""
        return [self.solve(x, before, guess, self.settings.iterations) for guess in self._guesses(count)]

    def arrives(self, plan: IlqrPlan) -> bool:
        """Return whether a plan ends where the LQR catches."""
        coordinates = self.catch.plant.coordinates
        end = tuple(float(value) for value in plan.states[-1, : 2 * len(coordinates.names)])
        return self.catch.share(deviation_of(coordinates, end)) <= 1.0

    def _guesses(self, count: int) -> Sequence[Array]:
        limits = np.array(self.catch.plant.effort_limits)
        nodes, m = self.settings.nodes, len(limits)
        t = np.arange(nodes) * self.settings.step
        guesses = [np.zeros((nodes, m))]
        for index in range(count - 1):
            if index % 2:
                # Full effort one way, then another, for fast plans.
                switches = np.cumsum(self._rng.uniform(0.05, 0.5, 6))
                levels = limits * self._rng.uniform(-0.8, 0.8, (7, m))
                levels[3:] *= 0.2
                guesses.append(levels[np.searchsorted(switches, t)])
                continue
            phase, period = self._rng.random(m), self._rng.uniform(0.3, 1.6, m)
            height = 0.7 * limits * self._rng.random(m)
            # Decaying, because pumping to the end would spin.
            fade = np.exp(-2.0 * t / t[-1])[:, None]
            guesses.append(fade * height * np.sin(2.0 * math.pi * (t[:, None] / period + phase)))
        return guesses
