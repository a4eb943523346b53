"""How well predicted scores order what was measured: rank correlation and rank violation, with bootstrap intervals.

With S the predicted and R the measured scores of n designs::

    SRCC   Spearman's correlation of the ranks of S and R
    MMRV   mean_i max_j |R_i - R_j| [(S_i > S_j) != (R_i > R_j)]

The designs are drawn again with replacement: another set of them would give other numbers. Draws in which all designs
score the same on a side have no correlation, and count for the violation alone.

Sources: Li et al., Evaluating real-world robot manipulation policies in simulation (SIMPLER), CoRL 2024, section 3;
Efron and Tibshirani, An introduction to the bootstrap, 1993, section 13.3 (percentiles).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.ranking.contender import Interval
from pendulum_bags.ranking.ranking import mmrv
from pendulum_msgs_py.errors import DataError

__all__ = ["Prediction", "judge_prediction"]

Array = NDArray[np.float64]

_LEAST = 3


@dataclass(frozen=True)
class Prediction:
    """What predicted scores are worth.

    Attributes:
        spearman: Correlation of the ranks; NaN where all designs score the same on a side [-].
        mmrv: What the worst wrong comparison of each design costs, in the mean, in units of the score.
        designs: Number of designs.
    """

    spearman: Interval
    mmrv: Interval
    designs: int


def judge_prediction(
    predicted: Sequence[float], measured: Sequence[float], generator: np.random.Generator, replicates: int = 2000
) -> Prediction:
    """Return how well predicted scores order the measured ones, with 95 % intervals.

    Args:
        predicted: Score of each design in simulation.
        measured: Score of each on the machine, in the same order.
        generator: Of the bootstrap.
        replicates: Sets of designs that are drawn.

    Raises:
        DataError: There are too few designs, not as many of both scores, or one is no finite number.
    """
    sim, hw = np.asarray(predicted, dtype=np.float64), np.asarray(measured, dtype=np.float64)
    if sim.shape != hw.shape or sim.ndim != 1 or sim.size < _LEAST:
        raise DataError(
            f"predicted and measured scores have the shapes {sim.shape} and {hw.shape}; expected one of each for "
            f"{_LEAST} designs or more"
        )
    if not (np.isfinite(sim).all() and np.isfinite(hw).all()):
        raise DataError("a score is no finite number; expected 0 for a design that fails")
    draws = generator.integers(sim.size, size=(replicates, sim.size))
    correlations = np.array([_spearman(sim[draw], hw[draw]) for draw in draws])
    violations = np.array([mmrv(sim[draw], hw[draw]) for draw in draws])
    return Prediction(
        _interval(_spearman(sim, hw), correlations[np.isfinite(correlations)]),
        _interval(mmrv(sim, hw), violations),
        int(sim.size),
    )


def _spearman(sim: Array, hw: Array) -> float:
    if np.ptp(sim) == 0.0 or np.ptp(hw) == 0.0:
        return float("nan")
    return float(scipy.stats.spearmanr(sim, hw).statistic)


def _interval(value: float, found: Array) -> Interval:
    low, high = np.percentile(found, [2.5, 97.5]) if found.size else (float("nan"), float("nan"))
    return Interval(value, float(low), float(high))
