"""How well a simulation ranks controllers: correlation, rank violations and regret, with intervals.

With S the costs in simulation and R those on the hardware, one for each of n contenders:

    SRCC    Pearson's correlation of S and R (sim-vs-real correlation coefficient), interval by Fisher's z
    MMRV    mean_i max_j |R_i - R_j| [(S_i > S_j) != (R_i > R_j)]: what the worst wrong comparison of each costs
    regret  R of the simulation's pick, less the least R

Source: Kadian et al., Sim2Real Predictivity, IEEE RA-L 5(4), 2020 (SRCC); Li et al., SIMPLER, CoRL 2024, section 3
(MMRV).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import permutations
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import Interval, mean_interval, student_tail
from pendulum_bags.ranking.contender import (
    PARTS,
    Contender,
    compared_runs,
    error_of_difference,
    refuse_no_number,
    with_noise_of_their_own,
)
from pendulum_bags.ranking.regret import regret_share
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import without_nan

__all__ = ["Ranking", "WrongPair", "mmrv", "rank"]

_REPLICATES = 2000
_LEAST = 3
_MANY = 9
"""Contenders from which on chance is not named."""


@dataclass(frozen=True)
class WrongPair:
    """Two contenders that the simulation puts in the wrong order.

    Attributes:
        picked: Better in simulation.
        better: Better on the hardware.
        sim: By how much ``picked`` is better in simulation (cost); infinity where ``better`` fails there.
        hw: By how much it is worse on the hardware (cost); infinity where it fails there.
        sure: Whether the difference on the hardware is larger than its runs scatter: in a ranking, 5 % of the sure
            pairs are in the right order at most in the mean.
        reason: As text.
    """

    picked: str
    better: str
    sim: float
    hw: float
    sure: bool
    reason: str


@dataclass(frozen=True)
class Ranking:
    """A simulation's ranking of a set of contenders, judged by the hardware's.

    Attributes:
        names: Contenders, best on the hardware first.
        sim, hw: Mean costs in that order; infinity for a failure.
        srcc: Pearson's correlation of those that succeed on both sides.
        spearman: Correlation of the ranks of all, failures last.
        mmrv: Mean maximum rank violation, in units of the cost; a failure costs as much as the worst that succeeds.
        regret: Of the simulation's pick, in units of the cost; infinity where it fails on the hardware. Its ends are
            NaN where no run was repeated, or where the best costs nothing.
        regret_share: The same as a share of the best's cost; infinity also where the best costs nothing.
        pick: The simulation's best.
        best: The hardware's best.
        wrong: Pairs in the wrong order, dearest first.
        pairs: Number of pairs.
        failures: Contenders that fail on one side only.
        pick_failed: How many of the pick's runs on the hardware failed.
        pick_runs: How many there were.
        no_interval: Why the regret has no interval, as text; empty where it has one.
        spearman_ends: 95 % interval of the rank correlation over the runs; NaN where none was repeated.
        means: Of each contender on the hardware, with its 95 % interval over the runs.
        of_scores: Whether costs are scores, of which more is better.
        unknown_seeds: Whether runs do not state which seed their disturbance had.
    """

    names: Sequence[str]
    sim: Sequence[float]
    hw: Sequence[float]
    srcc: Interval
    spearman: float
    mmrv: Interval
    regret: Interval
    regret_share: Interval
    pick: str
    best: str
    wrong: Sequence[WrongPair]
    pairs: int
    failures: Sequence[str]
    pick_failed: int = 0
    pick_runs: int = 0
    no_interval: str = ""
    spearman_ends: tuple[float, float] = (math.nan, math.nan)
    means: Sequence[Interval] = ()
    of_scores: bool = False
    unknown_seeds: bool = False

    @property
    def chance(self) -> float:
        """Share of all orders whose rank correlation is as large or larger; NaN of many contenders."""
        n = len(self.names)
        if n >= _MANY or not math.isfinite(self.spearman):
            return math.nan
        ranks = np.arange(n)
        apart = np.sum((np.array(list(permutations(ranks))) - ranks) ** 2, axis=1)
        return float(np.mean(1.0 - 6.0 * apart / (n * (n * n - 1.0)) >= self.spearman - 1e-9))

    @property
    def few(self) -> str:
        """What so few contenders show by chance, as a sentence; empty of many."""
        n = len(self.names)
        if not math.isfinite(self.chance):
            return ""
        return (
            f"{n} controllers are few: by chance the best of them is picked in 1 of {n} cases, and a rank "
            f"correlation of {self.spearman:.2f} or more arises in {100.0 * self.chance:.0f} %."
        )

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values; infinities and what does not exist as None."""
        return without_nan(asdict(self))


def mmrv(sim: Array, hw: Array) -> float:
    """Return the mean maximum rank violation of costs, shape (n,) each."""
    return float(_mmrv(sim[None], hw[None])[0])


def _mmrv(sim: Array, hw: Array) -> Array:
    """Return the mean maximum rank violation of each row, shape (rows,), of costs, shape (rows, n)."""
    wrong = (sim[:, :, None] > sim[:, None, :]) != (hw[:, :, None] > hw[:, None, :])
    return np.asarray(np.mean(np.max(np.abs(hw[:, :, None] - hw[:, None, :]) * wrong, axis=2), axis=1))


def rank(
    contenders: Sequence[Contender], generator: np.random.Generator | None = None, *, of_scores: bool = False
) -> Ranking:
    """Return a simulation's ranking of at least three contenders, judged by the hardware's.

    ``of_scores``: costs are negatives of scores. A DataError if there are too few, under two succeed on both sides,
    or a cost is no finite number.
    """
    if len(contenders) < _LEAST:
        raise DataError(f"got {len(contenders)} controllers with runs on both sides; expected at least {_LEAST}")
    refuse_no_number(contenders)
    generator = generator or np.random.default_rng(0)
    contenders, favoured = with_noise_of_their_own(contenders)
    raw = {side: np.array([one.cost(side) for one in contenders]) for side in ("sim", "hw")}
    able = np.isfinite(raw["sim"]) & np.isfinite(raw["hw"])
    if able.sum() < 2:
        raise DataError("fewer than two controllers succeed on both sides; expected runs in which most do")
    sim, hw = (_capped(raw[side]) for side in ("sim", "hw"))
    order = np.argsort(hw, kind="stable")
    pick = int(np.argmin(sim))
    sure = _sure_pairs(contenders, sim)
    wrong = [
        _pair(contenders[i], contenders[j], sim[j] - sim[i], hw[i] - hw[j], sure=(i, j) in sure, of_scores=of_scores)
        for i, j in permutations(range(len(contenders)), 2)
        if sim[i] < sim[j] and hw[i] > hw[j]
    ]
    low, high = np.percentile(_violations(contenders, generator), [2.5, 97.5])
    chosen = contenders[pick]
    share, no_interval = regret_share(contenders, pick, of_scores=of_scores, favoured=favoured)
    least = float(hw.min())
    regret = Interval(float(raw["hw"][pick]) - least, *(abs(least) * end for end in (share.low, share.high)))
    sign = -1.0 if of_scores else 1.0
    means = [mean_interval(sign * contenders[i].hw.sum(axis=1)) for i in order]
    return Ranking(
        [contenders[i].name for i in order],
        [sign * float(raw["sim"][i]) for i in order],
        [sign * float(raw["hw"][i]) for i in order],
        _pearson(raw["sim"][able], raw["hw"][able]),
        float(scipy.stats.spearmanr(sim, hw).statistic),
        Interval(mmrv(sim, hw), float(low), float(high)),
        regret,
        share,
        chosen.name,
        contenders[int(order[0])].name,
        sorted(wrong, key=lambda pair: (not pair.sure, -pair.hw)),
        len(contenders) * (len(contenders) - 1) // 2,
        [one.name for one, s, h in zip(contenders, raw["sim"], raw["hw"], strict=True) if np.isinf(s) != np.isinf(h)],
        chosen.hw_failed,
        chosen.hw_failed + len(chosen.hw),
        no_interval,
        _ends_of_ranks(contenders, generator),
        [Interval(*one) for one in means],
        of_scores,
        any(seed < 0 for one in contenders for seed in (*one.sim_seeds, *one.hw_seeds)),
    )


def _capped(costs: Array) -> Array:
    """Return costs, shape (..., n), in which a failure is a little dearer than the dearest success of the n."""
    able = np.isfinite(costs)
    top = np.max(costs, axis=-1, keepdims=True, where=able, initial=-np.inf)
    return np.where(able, costs, np.where(np.isfinite(top), top + 0.001 * np.abs(top), 1.001))


def _pearson(sim: Array, hw: Array) -> Interval:
    if sim.size < 4 or np.ptp(sim) == 0.0 or np.ptp(hw) == 0.0:
        value = float(np.corrcoef(sim, hw)[0, 1]) if sim.size > 1 and np.ptp(sim) and np.ptp(hw) else float("nan")
        return Interval(value, float("nan"), float("nan"))
    found = scipy.stats.pearsonr(sim, hw)
    low, high = found.confidence_interval(0.95)
    return Interval(float(found.statistic), float(low), float(high))


def _ends_of_ranks(contenders: Sequence[Contender], generator: np.random.Generator) -> tuple[float, float]:
    """Return the 95 % interval of Spearman's correlation over the runs; NaN where neither side has repeated ones.

    The mean cost of each contender is drawn as Student's t of its runs allows it; of a single run it stays.
    """
    drawn = {}
    for side in ("sim", "hw"):
        columns = []
        for one in contenders:
            costs = (one.sim if side == "sim" else one.hw).sum(axis=1)
            fails, n = not np.isfinite(one.cost(side)), costs.size
            error = 0.0 if fails or n < 2 else float(costs.std(ddof=1)) / math.sqrt(n)
            mean = np.inf if fails else float(costs.mean())
            columns.append(mean + error * generator.standard_t(max(n - 1, 1), _REPLICATES))
        drawn[side] = scipy.stats.rankdata(_capped(np.stack(columns, axis=1)), axis=1)
    if all(np.all(one == one[0]) for one in drawn.values()) and not any(len(one.hw) > 1 for one in contenders):
        return math.nan, math.nan
    a, b = (one - one.mean(axis=1, keepdims=True) for one in drawn.values())
    found = np.sum(a * b, axis=1) / np.maximum(np.sqrt(np.sum(a * a, axis=1) * np.sum(b * b, axis=1)), 1e-300)
    low, high = np.percentile(found, [2.5, 97.5])
    return float(low), float(high)


def _violations(contenders: Sequence[Contender], generator: np.random.Generator) -> Array:
    """Return the MMRV of many resamplings, shape (replicates,).

    Seeds are drawn again, the same for all contenders that ran under the same, since they share their disturbances,
    and the contenders too: another set of them would give another.
    """
    costs = {}
    draws: dict[tuple[int, tuple[int, ...]], NDArray[np.int64]] = {}
    for side in ("sim", "hw"):
        columns = []
        for one in contenders:
            rows, seeds = (one.sim, one.sim_seeds) if side == "sim" else (one.hw, one.hw_seeds)
            rows = rows.sum(axis=1)
            if not np.isfinite(one.cost(side)):
                rows = np.array([np.inf])
            key = rows.size, seeds
            if key not in draws:
                draws[key] = generator.integers(rows.size, size=(_REPLICATES, rows.size))
            columns.append(rows[draws[key]].mean(axis=1))
        costs[side] = _capped(np.stack(columns, axis=1))
    chosen = generator.integers(len(contenders), size=costs["sim"].shape)
    return _mmrv(*(np.take_along_axis(costs[side], chosen, axis=1) for side in ("sim", "hw")))


def _sure_pairs(contenders: Sequence[Contender], sim: Array) -> set[tuple[int, int]]:
    """Return the pairs, cheaper in simulation first, of which the second is surely cheaper on the hardware.

    All pairs are tested, so that a few are far apart by chance: the share of false ones is controlled.

    Source:
        Benjamini and Hochberg, Journal of the Royal Statistical Society B 57, 1995.
    """
    found = {}
    for i, j in permutations(range(len(contenders)), 2):
        a, b, paired = compared_runs(contenders[i], contenders[j])
        if sim[i] < sim[j] and min(a.size, b.size) > 1:
            dearer, (error, freedom) = float(a.mean() - b.mean()), error_of_difference(a, b, paired=paired)
            # Runs without scatter show their order.
            found[i, j] = float(student_tail(dearer / error, freedom) if error > 0.0 else dearer <= 0.0)
    falsely = scipy.stats.false_discovery_control(list(found.values())) if found else []
    return {pair for pair, share in zip(found, falsely, strict=True) if share < 0.05}


def _pair(picked: Contender, better: Contender, sim: float, hw: float, *, sure: bool, of_scores: bool) -> WrongPair:
    if not np.isfinite(picked.cost("hw")):
        return WrongPair(picked.name, better.name, sim, math.inf, True, f"{picked.name} fails on the hardware")
    if not np.isfinite(better.cost("sim")):
        return WrongPair(picked.name, better.name, math.inf, hw, True, f"{better.name} fails in simulation")
    change = (picked.parts("hw") - better.parts("hw")) - (picked.parts("sim") - better.parts("sim"))
    part = int(np.argmax(change))
    on_sim, on_hw = picked.parts("sim")[part], picked.parts("hw")[part]
    other_sim, other_hw = better.parts("sim")[part], better.parts("hw")[part]
    if change.size == 1:
        word, sign = ("scores", -1.0) if of_scores else ("costs", 1.0)
        reason = (
            f"{picked.name} {word} {sign * on_sim:.3g} in simulation and {sign * on_hw:.3g} on the hardware, "
            f"{better.name} {sign * other_sim:.3g} and {sign * other_hw:.3g}"
        )
    else:
        words = {"angle": "angle error", "velocity": "velocity", "torque": "torque"}[PARTS[part]]
        reason = (
            f"the {words} of {picked.name} costs {on_sim:.3g} in simulation and {on_hw:.3g} on the hardware, that of "
            f"{better.name} {other_sim:.3g} and {other_hw:.3g}"
        )
    if not sure:
        reason += "; the difference on the hardware is within the scatter of its runs"
    return WrongPair(picked.name, better.name, sim, hw, sure, reason)
