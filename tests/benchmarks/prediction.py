"""How well predicted scores order what was measured: rank correlation and rank violation, with bootstrap intervals.

With S the predicted and R the measured scores of n designs::

    SRCC   Spearman's correlation of the ranks of S and R
    MMRV   mean_i max_j |R_i - R_j| [(S_i > S_j) != (R_i > R_j)]

The designs are drawn again with replacement: another set of them would give other numbers. Draws in which all designs
score the same on a side have no correlation, and count for the violation alone. Where the order is perfect, it is so in
every draw, and the interval has no width: then it says nothing of other designs, which the answer says. How often
designs in no relation would be ordered as well is told beside, by permutations: of three designs, one time in six.

Sources: Li et al., Evaluating real-world robot manipulation policies in simulation (SIMPLER), CoRL 2024, section 3;
Efron and Tibshirani, An introduction to the bootstrap, 1993, section 13.3 (percentiles).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.distributions import Interval
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
        chance: Share of all orders in which predicted scores would correlate with the measured ones at least as well;
            NaN where there is no correlation [-].
    """

    spearman: Interval
    mmrv: Interval
    designs: int
    chance: float

    @property
    def note(self) -> str:
        """What an interval without width means, as a sentence; empty where it has one."""
        if not abs(self.spearman.value) > 1.0 - 1e-9:
            return ""
        same = self.spearman.value > 0.0
        told = (
            f"Simulation orders all {self.designs} designs {'as' if same else 'against the way'} the machine does, and "
            "so in each draw of them: the interval has no width and says nothing of other designs"
        )
        return f"{told}; by chance they are ordered so one time in {1.0 / self.chance:.3g}." if same else f"{told}."


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
    correlations = _spearman(sim[draws], hw[draws])
    violations = np.array([mmrv(sim[draw], hw[draw]) for draw in draws])
    return Prediction(
        _interval(float(_spearman(sim[None], hw[None])[0]), correlations[np.isfinite(correlations)]),
        _interval(mmrv(sim, hw), violations),
        int(sim.size),
        _chance(sim, hw, generator, replicates),
    )


def _chance(sim: Array, hw: Array, generator: np.random.Generator, replicates: int) -> float:
    """Return the share of orders that correlate as well: of all of them where they are no more than the replicates."""
    if np.ptp(sim) == 0.0 or np.ptp(hw) == 0.0:
        return float("nan")
    # The correlation of ranks grows with the product of the ranks.
    against = scipy.stats.rankdata(hw)
    found = scipy.stats.permutation_test(
        (scipy.stats.rankdata(sim),),
        lambda ranks, axis: np.sum(ranks * against, axis=axis),
        permutation_type="pairings",
        alternative="greater",
        n_resamples=replicates,
        random_state=generator,
    )
    return float(found.pvalue)


def _spearman(sim: Array, hw: Array) -> Array:
    """Return the correlation of the ranks in each row; NaN where one side is all the same."""
    one, other = (ranks - ranks.mean(axis=1, keepdims=True) for ranks in (_ranks(sim), _ranks(hw)))
    lengths = np.sqrt(np.sum(one**2, axis=1) * np.sum(other**2, axis=1))
    told: Array = np.divide(np.sum(one * other, axis=1), lengths, out=np.full(len(sim), np.nan), where=lengths > 0.0)
    return told


def _ranks(rows: Array) -> Array:
    return np.asarray(scipy.stats.rankdata(rows, axis=1), dtype=np.float64)


def _interval(value: float, found: Array) -> Interval:
    low, high = np.percentile(found, [2.5, 97.5]) if found.size else (float("nan"), float("nan"))
    return Interval(value, float(low), float(high))
