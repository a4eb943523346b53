"""What the simulation's pick costs more on the hardware than the best, as a share of the best's cost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import Interval, student_quantile
from pendulum_bags.ranking.contender import Contender, compared_runs, error_of_difference

__all__ = ["regret_share"]

_NAMED = 3
_TAIL, _FAVOURED = 0.025, 0.0025
"""Error above the upper limit, and the one that it is taken at where simulation and hardware shared their noise: the
pick is then one that this noise favours, and on the margin 7 % of picks passed by the first."""


def regret_share(
    contenders: Sequence[Contender], pick: int, *, of_scores: bool = False, favoured: bool = False
) -> tuple[Interval, str]:
    """Return the regret of a pick as a share of the best's cost with its 95 % interval, and why there is none.

    The regret is the largest of the pick's shares over all others. Its upper limit is the largest of their upper
    limits by Student's t over the runs: the true best is among them, so that no correction is due. The lower limit is
    the largest of the lower ones, corrected for their number (Bonferroni). Resampling runs would not do: three runs
    that all happen to be low carry no information on higher values.

    A pick that fails on the hardware has an infinite regret, and so has one that costs something where another costs
    nothing. The ends are NaN, with a reason, where neither the pick nor another was repeated.

    Args:
        contenders: All, one more than the pick at least without a failure on the hardware.
        pick: Index of the simulation's pick.
        of_scores: Whether costs are the negatives of scores; the share is that of the best score which is lost.
        favoured: Whether the simulated runs that made the pick shared their noise with those on the hardware.
    """
    chosen = contenders[pick]
    if not math.isfinite(chosen.cost("hw")):
        return Interval(math.inf, math.inf, math.inf), ""
    others = [one for i, one in enumerate(contenders) if i != pick and math.isfinite(one.cost("hw"))]
    own, least = chosen.cost("hw"), min(one.cost("hw") for one in others)
    if of_scores:
        return _lost_share(chosen, others, favoured=favoured)
    if own <= 0.0:
        # Runs scatter by shares: of nothing there is none. One run is one run all the same.
        end = 0.0 if len(chosen.hw) > 1 else math.nan
        return Interval(0.0, end, end), "" if end == 0.0 else f"{chosen.name} ran once on the hardware"
    if least <= 0.0:
        return Interval(math.inf, math.inf, math.inf), ""
    value = max(0.0, own / least - 1.0)
    limits = np.array([_limits(chosen, one, len(others), favoured=favoured) for one in others])
    if np.isnan(limits).any():
        return Interval(value, math.nan, math.nan), _ran_once(chosen, others)
    low, high = np.maximum(np.expm1(limits.max(axis=0)), 0.0)
    # Where some runs have no partner under their seed, the means of all and those of the pairs differ.
    return Interval(value, float(min(low, value)), float(max(high, value))), ""


def _lost_share(chosen: Contender, others: Sequence[Contender], *, favoured: bool) -> tuple[Interval, str]:
    """Return which share of the best score a pick loses, with the limits of :func:`regret_share`."""
    own, best = -chosen.cost("hw"), max(-one.cost("hw") for one in others)
    if best <= max(own, 0.0) and own <= 0.0:
        return Interval(math.nan, math.nan, math.nan), "no controller has a score above 0 on the hardware"
    value = max(0.0, 1.0 - own / best) if best > 0.0 else 0.0
    if len(chosen.hw) < 2 and all(len(one.hw) < 2 for one in others):
        return Interval(value, math.nan, math.nan), _ran_once(chosen, others)
    rivals = [one for one in others if one.cost("hw") < 0.0]
    if not rivals:
        return Interval(0.0, 0.0, 0.0), ""
    limits = np.array([_lost_limits(chosen, one, len(rivals), favoured=favoured) for one in rivals])
    if np.isnan(limits).any():
        return Interval(value, math.nan, math.nan), _ran_once(chosen, others)
    low, high = np.maximum(limits.max(axis=0) / best, 0.0)
    return Interval(value, float(min(low, value)), float(max(high, value))), ""


def _lost_limits(chosen: Contender, rival: Contender, comparisons: int, *, favoured: bool) -> tuple[float, float]:
    """Return the limits of a rival's mean score less the pick's, as :func:`_limits`: some scores are 0."""
    own, other, paired = compared_runs(chosen, rival)
    if own.size == other.size == 1:
        return math.nan, math.nan
    error, freedom = _error(own, other, paired=paired)
    tails = _TAIL / comparisons, 1.0 - (_FAVOURED if favoured else _TAIL)
    low, high = (float(own.mean() - other.mean() + error * student_quantile(tail, freedom)) for tail in tails)
    return low, high


def _error(own: Array, other: Array, *, paired: bool) -> tuple[float, float]:
    """Return :func:`error_of_difference`; one that ran once is taken to scatter like the other."""
    if min(own.size, other.size) > 1:
        return error_of_difference(own, other, paired=paired)
    repeated = max(own, other, key=len)
    return float(np.std(repeated, ddof=1)) * math.sqrt(1.0 + 1.0 / repeated.size), repeated.size - 1.0


def _ran_once(chosen: Contender, others: Sequence[Contender]) -> str:
    once = [one.name for one in others if np.ptp(one.hw.sum(axis=1)) == 0.0]
    if len(once) == len(others) and all(len(one.hw) == 1 for one in (chosen, *others)):
        return "each controller ran once on the hardware"
    named = ", ".join(once[:_NAMED]) + (f" and {len(once) - _NAMED} more" if len(once) > _NAMED else "")
    ran = "ran once" if len(chosen.hw) == 1 else "had one and the same cost in all runs"
    return f"{chosen.name}, the pick, {ran} on the hardware, and so did {named}"


def _limits(chosen: Contender, another: Contender, comparisons: int, *, favoured: bool = False) -> tuple[float, float]:
    """Return the limits of the logarithm of two mean costs' ratio, the lower corrected for comparisons; NaN of one run.

    The logarithm of the ratio of means is taken as linear in the deviations of the runs from them: runs scatter by
    shares.
    """
    own, other, paired = compared_runs(chosen, another)
    if paired and not (own.mean() > 0.0 and other.mean() > 0.0):
        own, other, paired = chosen.hw.sum(axis=1), another.hw.sum(axis=1), False
    if own.size == other.size == 1:
        return math.nan, math.nan
    ratio = float(np.log(own.mean() / other.mean()))
    deviation, freedom = _error(own / own.mean(), other / other.mean(), paired=paired)
    tails = _TAIL / comparisons, _FAVOURED if favoured else _TAIL
    low, high = (-float(student_quantile(tail, freedom)) for tail in tails)
    return ratio - low * deviation, ratio + high * deviation
