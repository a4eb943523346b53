"""The compiled elimination of the windows' states, against the whole system solved by numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pendulum_bags.identification.arrowhead import eliminate, find_states

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
    reduced, gradient, inverses = eliminate(h_pp, h_px, h_xx, g_p, g_x, damping)
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
