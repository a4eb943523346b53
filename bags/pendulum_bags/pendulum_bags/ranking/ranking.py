"""How well a simulation ranks controllers: correlation, rank violations and regret, with intervals.

With S the costs in simulation and R those on the hardware, one for each of n contenders:

    SRCC    Pearson's correlation of S and R (sim-vs-real correlation coefficient), interval by Fisher's z
    MMRV    mean_i max_j |R_i - R_j| [(S_i > S_j) != (R_i > R_j)]: what the worst wrong comparison of each costs
    regret  R of the simulation's pick, less the least R

Source: Kadian et al., Sim2Real Predictivity, IEEE RA-L 5(4), 2020 (SRCC); Li et al., SIMPLER, CoRL 2024, section 3
(MMRV).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pendulum_msgs_py.errors import DataError

__all__ = ["PARTS", "Contender", "Interval", "Ranking", "WrongPair", "contenders_of", "mmrv", "rank"]

Array = NDArray[np.float64]

PARTS = ("angle", "velocity", "torque")
"""Parts of the cost: q11 e^2, q22 v^2 and r u^2, each a mean over the run."""
_REPLICATES = 2000
_LEAST = 3


@dataclass(frozen=True)
class Contender:
    """One controller with one set of parameters.

    Attributes:
        name: Its name.
        sim, hw: Parts of the cost, one row for each run (by seed), shape (runs, 3); no rows for a side that failed.
        sim_failed, hw_failed: How many runs failed on each side.
        sim_seeds, hw_seeds: Seeds of the rows; none where they are not known.
        emulated: Whether an emulator stood in for the hardware, in all runs.
    """

    name: str
    sim: Array
    hw: Array
    sim_failed: int = 0
    hw_failed: int = 0
    sim_seeds: tuple[int, ...] = ()
    hw_seeds: tuple[int, ...] = ()
    emulated: bool = True

    def cost(self, side: str) -> float:
        """Return the mean cost on a side; infinity where a run failed there."""
        rows, failed = (self.sim, self.sim_failed) if side == "sim" else (self.hw, self.hw_failed)
        return float("inf") if failed or not rows.size else float(rows.sum(axis=1).mean())

    def parts(self, side: str) -> Array:
        """Return the mean parts on a side, shape (3,)."""
        rows = self.sim if side == "sim" else self.hw
        return np.asarray(rows.mean(axis=0), dtype=np.float64)


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class WrongPair:
    """Two contenders that the simulation puts in the wrong order.

    Attributes:
        picked: Better in simulation.
        better: Better on the hardware.
        sim: By how much ``picked`` is better in simulation (cost).
        hw: By how much it is worse on the hardware (cost).
        sure: Whether the difference on the hardware is larger than its runs scatter (95 %).
        reason: In words.
    """

    picked: str
    better: str
    sim: float
    hw: float
    sure: bool
    reason: str


@dataclass(frozen=True)
class Ranking:
    """What a set of contenders says about a simulation.

    Attributes:
        names: Contenders, best on the hardware first.
        sim, hw: Mean costs in that order; infinity for a failure.
        srcc: Pearson's correlation of those that succeed on both sides.
        spearman: Correlation of the ranks of all, failures last.
        mmrv: Mean maximum rank violation, in units of the cost; a failure costs as much as the worst that succeeds.
        regret: Of the simulation's pick, in units of the cost; its ends are NaN where no run was repeated.
        regret_share: The same as a share of the best's cost.
        pick: The simulation's best.
        best: The hardware's best.
        wrong: Pairs in the wrong order, dearest first.
        pairs: Number of pairs.
        failures: Contenders that fail on one side only.
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

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values; infinities and what does not exist as None."""
        return _finite(asdict(self))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def mmrv(sim: Array, hw: Array) -> float:
    """Return the mean maximum rank violation of costs, shape (n,) each."""
    return float(_mmrv(sim[None], hw[None])[0])


def _mmrv(sim: Array, hw: Array) -> Array:
    """Return the mean maximum rank violation of each row, shape (rows,), of costs, shape (rows, n)."""
    wrong = (sim[:, :, None] > sim[:, None, :]) != (hw[:, :, None] > hw[:, None, :])
    return np.asarray(np.mean(np.max(np.abs(hw[:, :, None] - hw[:, None, :]) * wrong, axis=2), axis=1))


def rank(contenders: Sequence[Contender], generator: np.random.Generator | None = None) -> Ranking:
    """Return what contenders say about a simulation.

    Args:
        contenders: At least three, with runs on both sides.
        generator: Of the bootstrap.

    Raises:
        DataError: There are too few, or none succeeds on both sides.
    """
    if len(contenders) < _LEAST:
        raise DataError(f"got {len(contenders)} controllers with runs on both sides; expected at least {_LEAST}")
    generator = generator or np.random.default_rng(0)
    raw = {side: np.array([one.cost(side) for one in contenders]) for side in ("sim", "hw")}
    able = np.isfinite(raw["sim"]) & np.isfinite(raw["hw"])
    if able.sum() < 2:
        raise DataError("fewer than two controllers succeed on both sides; expected runs in which most do")
    sim, hw = (_capped(raw[side]) for side in ("sim", "hw"))
    order = np.argsort(hw, kind="stable")
    pick = int(np.argmin(sim))
    wrong = [
        _pair(contenders[i], contenders[j], sim[j] - sim[i], hw[i] - hw[j])
        for i in range(len(contenders))
        for j in range(len(contenders))
        if sim[i] < sim[j] and hw[i] > hw[j]
    ]
    low, high = np.percentile(_violations(contenders, generator), [2.5, 97.5])
    share = _regret(contenders, pick, hw)
    regret = Interval(float(hw[pick] - hw.min()), *(float(hw.min()) * end for end in (share.low, share.high)))
    return Ranking(
        [contenders[i].name for i in order],
        [float(raw["sim"][i]) for i in order],
        [float(raw["hw"][i]) for i in order],
        _pearson(raw["sim"][able], raw["hw"][able]),
        float(stats.spearmanr(sim, hw).statistic),
        Interval(mmrv(sim, hw), float(low), float(high)),
        regret,
        share,
        contenders[pick].name,
        contenders[int(order[0])].name,
        sorted(wrong, key=lambda pair: (not pair.sure, -pair.hw)),
        len(contenders) * (len(contenders) - 1) // 2,
        [one.name for one, s, h in zip(contenders, raw["sim"], raw["hw"], strict=True) if np.isinf(s) != np.isinf(h)],
    )


def _capped(costs: Array) -> Array:
    """Return costs in which a failure is as dear as the dearest success, and a little more so that it ranks last."""
    finite = costs[np.isfinite(costs)]
    top = float(finite.max()) if finite.size else 1.0
    return np.where(np.isfinite(costs), costs, 1.001 * top)


def _pearson(sim: Array, hw: Array) -> Interval:
    if sim.size < 4 or np.ptp(sim) == 0.0 or np.ptp(hw) == 0.0:
        value = float(np.corrcoef(sim, hw)[0, 1]) if sim.size > 1 and np.ptp(sim) and np.ptp(hw) else float("nan")
        return Interval(value, float("nan"), float("nan"))
    found = stats.pearsonr(sim, hw)
    low, high = found.confidence_interval(0.95)
    return Interval(float(found.statistic), float(low), float(high))


def _regret(contenders: Sequence[Contender], pick: int, hw: Array) -> Interval:
    """Return the regret of a pick as a share of the best's cost, with its 95 % interval.

    The regret is the largest of the pick's shares over all others. Its upper limit is the largest of their upper
    limits by Student's t over the runs: the true best is among them, so that no correction is due. The lower limit is
    the largest of the lower ones, corrected for their number (Bonferroni). Resampled runs would not do: three of which
    all lie low know nothing of what lies higher.
    """
    chosen = contenders[pick]
    value = float(hw[pick] / hw.min()) - 1.0 if hw.min() > 0.0 else 0.0
    others = [one.hw.sum(axis=1) for i, one in enumerate(contenders) if i != pick and np.isfinite(one.cost("hw"))]
    if not np.isfinite(chosen.cost("hw")) or not others:
        return Interval(value, value, value)
    own = chosen.hw.sum(axis=1)
    # The logarithm of the ratio of means, linear in the deviations of the runs from them: runs scatter by shares.
    ratio = np.array([np.log(own.mean() / other.mean()) for other in others])
    limits = np.array([_limits(own / own.mean(), other / other.mean(), len(others)) for other in others])
    low, high = np.maximum(np.expm1((ratio[:, None] + limits).max(axis=0)), 0.0)
    return Interval(value, float(low), float(high))


def _limits(own: Array, other: Array, comparisons: int) -> tuple[float, float]:
    """Return by how much a difference of means may be lower (corrected for comparisons), and higher; NaN of one."""
    repeated = [one for one in (own, other) if one.size > 1]
    if not repeated:
        return float("nan"), float("nan")
    if own.size == other.size:
        # Runs under one seed share their disturbance.
        deviation, freedom = float(np.std(own - other, ddof=1)) / np.sqrt(own.size), own.size - 1.0
    elif len(repeated) == 1:
        # The one that ran once is taken to scatter like the other.
        deviation = float(np.std(repeated[0], ddof=1)) * np.sqrt(1.0 + 1.0 / repeated[0].size)
        freedom = repeated[0].size - 1.0
    else:
        parts = np.array([np.var(own, ddof=1) / own.size, np.var(other, ddof=1) / other.size])
        deviation = float(np.sqrt(parts.sum()))
        # Welch and Satterthwaite.
        freedom = float(parts.sum() ** 2 / max(1e-300, np.sum(parts**2 / (np.array([own.size, other.size]) - 1.0))))
    low, high = (float(stats.t.isf(tail, freedom)) for tail in (0.025 / comparisons, 0.025))
    return -low * deviation, high * deviation


def _violations(contenders: Sequence[Contender], generator: np.random.Generator) -> Array:
    """Return the MMRV of many resamplings, shape (replicates,).

    Seeds are drawn again, the same for all contenders that ran under as many, since they share their disturbances, and
    the contenders too: another set of them would give another.
    """
    costs = {}
    draws: dict[int, NDArray[np.int64]] = {}
    for side in ("sim", "hw"):
        columns = []
        for one in contenders:
            rows = (one.sim if side == "sim" else one.hw).sum(axis=1)
            if not np.isfinite(one.cost(side)):
                rows = np.array([np.inf])
            if rows.size not in draws:
                draws[rows.size] = generator.integers(rows.size, size=(_REPLICATES, rows.size))
            columns.append(rows[draws[rows.size]].mean(axis=1))
        costs[side] = np.array([_capped(row) for row in np.stack(columns, axis=1)])
    chosen = generator.integers(len(contenders), size=costs["sim"].shape)
    return _mmrv(*(np.take_along_axis(costs[side], chosen, axis=1) for side in ("sim", "hw")))


def _pair(picked: Contender, better: Contender, sim: float, hw: float) -> WrongPair:
    if not np.isfinite(picked.cost("hw")):
        return WrongPair(picked.name, better.name, sim, hw, True, f"{picked.name} fails on the hardware")
    if not np.isfinite(better.cost("sim")):
        return WrongPair(picked.name, better.name, sim, hw, True, f"{better.name} fails in simulation")
    a, b = picked.hw.sum(axis=1), better.hw.sum(axis=1)
    sure = False
    if a.size > 1 and b.size > 1:
        # Runs under one seed share their disturbance: where both have as many, they are pairs.
        test = stats.ttest_rel(a, b) if a.size == b.size else stats.ttest_ind(a, b, equal_var=False)
        sure = bool(test.pvalue < 0.05)
    change = (picked.parts("hw") - better.parts("hw")) - (picked.parts("sim") - better.parts("sim"))
    part = int(np.argmax(change))
    on_sim, on_hw = picked.parts("sim")[part], picked.parts("hw")[part]
    other_sim, other_hw = better.parts("sim")[part], better.parts("hw")[part]
    words = {"angle": "angle error", "velocity": "velocity", "torque": "torque"}[PARTS[part]]
    reason = (
        f"the {words} of {picked.name} costs {on_sim:.3g} in simulation and {on_hw:.3g} on the hardware, that of "
        f"{better.name} {other_sim:.3g} and {other_hw:.3g}"
    )
    if not sure:
        reason += "; the difference on the hardware is within the scatter of its runs"
    return WrongPair(picked.name, better.name, sim, hw, sure, reason)


def contenders_of(
    costs: Mapping[str, Mapping[str, Sequence[tuple[int, Array | None]]]], real: Collection[str] = ()
) -> list[Contender]:
    """Return the contenders that have runs on both sides.

    Args:
        costs: Name -> side (``sim``, ``hw``) -> (seed, parts of the cost, or None for a run that failed).
        real: Names that have runs on real hardware.
    """
    found = []
    for name, sides in costs.items():
        if not (sides.get("sim") and sides.get("hw")):
            continue
        rows: dict[str, Array] = {}
        failed: dict[str, int] = {}
        seeds: dict[str, tuple[int, ...]] = {}
        for side in ("sim", "hw"):
            runs = sorted(sides[side], key=lambda run: run[0])
            kept = [parts for _, parts in runs if parts is not None]
            rows[side] = np.array(kept, dtype=np.float64).reshape(-1, len(PARTS))
            failed[side] = len(runs) - len(kept)
            seeds[side] = tuple(seed for seed, parts in runs if parts is not None)
        found.append(
            Contender(
                name, rows["sim"], rows["hw"], failed["sim"], failed["hw"], seeds["sim"], seeds["hw"], name not in real
            )
        )
    return found
