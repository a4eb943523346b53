"""The elimination of the windows' states against the whole system solved by numpy, and the search with a kink."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from pendulum_bags.identification.arrowhead import Model, eliminate, find_states, minimise

PARAMETERS = 3


def arrowhead(windows: int, width: int, seed: int) -> tuple[Any, Any, Any, Any, Any]:
    """Return the blocks of J'J and J'r of a random least-squares problem whose windows share no states."""
    generator = np.random.default_rng(seed)
    h_pp, g_p = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    h_px, h_xx = np.zeros((windows, PARAMETERS, width)), np.zeros((windows, width, width))
    g_x = np.zeros((windows, width))
    for n in range(windows):
        by_parameter, by_state = generator.normal(size=(12, PARAMETERS)), generator.normal(size=(12, width))
        # States that act alike make the off-diagonal terms as large as those on the diagonal.
        by_state[:, 1] += 1.5 * by_state[:, 0]
        residual = generator.normal(size=12)
        h_pp += by_parameter.T @ by_parameter
        g_p += by_parameter.T @ residual
        h_px[n], h_xx[n], g_x[n] = by_parameter.T @ by_state, by_state.T @ by_state, by_state.T @ residual
    return h_pp, h_px, h_xx, g_p, g_x


def whole(h_pp: Any, h_px: Any, h_xx: Any) -> Any:
    """Return the matrix of parameters and all states, shape (k + w x, k + w x)."""
    k, (w, x) = len(h_pp), h_xx.shape[:2]
    matrix = np.zeros((k + w * x, k + w * x))
    matrix[:k, :k] = h_pp
    for n in range(w):
        place = slice(k + n * x, k + n * x + x)
        matrix[:k, place], matrix[place, :k], matrix[place, place] = h_px[n], h_px[n].T, h_xx[n]
    return matrix


@pytest.mark.parametrize("windows", [1, 4])
@pytest.mark.parametrize("width", [2, 4])
@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_the_step_and_its_decrease_are_those_of_the_whole_system(windows: int, width: int, damping: float) -> None:
    h_pp, h_px, h_xx, g_p, g_x = arrowhead(windows, width, seed=windows)
    reduced, gradient, inverses = eliminate(h_pp, h_px, h_xx, g_p, g_x, np.full(windows, damping))
    d_p = -np.linalg.solve(reduced, gradient)
    steps, decrease = find_states(h_px, h_xx, g_x, inverses, d_p)

    # Only the states' blocks are damped here; the parameters' is the caller's.
    damped = h_xx + damping * np.array([np.diag(np.diag(block) + 1e-12) for block in h_xx])
    g = np.concatenate((g_p, g_x.ravel()))
    step = -np.linalg.solve(whole(h_pp, h_px, damped), g)
    assert d_p == pytest.approx(step[:PARAMETERS], rel=1e-9)
    assert steps.ravel() == pytest.approx(step[PARAMETERS:], rel=1e-9)

    # The decrease of |r|^2 that the undamped model predicts, less what the parameters' own block accounts for.
    predicted = -2.0 * g @ step - step @ whole(h_pp, h_px, h_xx) @ step
    of_parameters = -2.0 * g_p @ d_p - d_p @ h_pp @ d_p
    assert decrease == pytest.approx(predicted - of_parameters, rel=1e-9)


@dataclass(frozen=True)
class Slope(Model):
    """One parameter that is free everywhere."""

    vector: Any

    def __getitem__(self, name: str) -> float:
        return float(self.vector[0])

    def index(self, names: Sequence[str]) -> list[int]:
        return [0] * len(names)

    def with_vector(self, vector: Any) -> Slope:
        return Slope(vector)

    def bounds(self, name: str) -> tuple[float, float]:
        return -math.inf, math.inf

    def size(self, name: str) -> float:
        return 1.0


class Lines:
    """Windows of e = p t + x - y, one of them with 10 + 1000 |x| for x: there the loss has a kink at its minimum."""

    scale = math.inf
    time = np.linspace(-1.0, 1.0, 9)
    kinked = 2

    def errors(self, model: Slope, states: Any) -> Any:
        shifts = states[:, 0].copy()
        shifts[self.kinked] = 10.0 + 1000.0 * abs(shifts[self.kinked])
        return np.ravel((model["p"] - 3.0) * self.time + shifts[:, None])

    def sensitivities(self, model: Slope, states: Any, names: Sequence[str]) -> tuple[Any, Any, list[int]]:
        rise = np.ones(len(states))
        rise[self.kinked] = 1000.0 if states[self.kinked, 0] >= 0.0 else -1000.0
        columns = np.stack((np.tile(self.time, len(states)), np.repeat(rise, self.time.size)), axis=1)
        return columns, self.errors(model, states), [self.time.size * n for n in range(len(states) + 1)]


def test_a_window_with_a_kink_in_its_loss_does_not_stop_the_search_of_the_others() -> None:
    # At rest a joint sticks: a window's loss then has a kink in its state, and each full step crosses it.
    states = np.ones((8, 1))
    states[Lines.kinked] = 1e-6
    found = minimise(Slope(np.zeros(1)), [Lines()], [states], ["p"], max_iterations=100, tolerance=1e-6)
    assert found.converged
    assert found.model["p"] == pytest.approx(3.0, abs=1e-3)
    assert np.delete(found.states[0], Lines.kinked) == pytest.approx(np.zeros(7), abs=1e-3)
