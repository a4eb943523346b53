"""Comparison of recordings without the record of an experiment: the signals that they share decide what is tested.

A signal that both recorded brings two runs to one clock: the disturbance, the reference, or the input; for two free
swings the motion itself. Then:

- a shared signal that acts throughout, on stationary motions, has the statistics of an experiment;
- repeated runs of a machine are independent: each quantity comes from each run, with Student's t of the runs;
- a single run of each under a transient input is described and not judged: the machine's own scatter is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.arrays import Array, Complex
from pendulum_bags.comparison.compare import Comparison, PathArgument, compare, read_own
from pendulum_bags.comparison.equivalence import EquivalenceTest, Outcome, Verdict, conclude, equivalence_test
from pendulum_bags.comparison.margins import Margin, MarginArgument, Margins
from pendulum_bags.comparison.operating_band import Band
from pendulum_bags.comparison.pairs import Pair, interpolated_difference
from pendulum_bags.comparison.same_run import Looks
from pendulum_bags.comparison.same_signal import AMPLITUDE, compare_signals
from pendulum_bags.comparison.statistics import Interval, exponential, rms
from pendulum_bags.distributions import student_quantile
from pendulum_bags.runs.run_data import OpenBag, RunData, read_run
from pendulum_bags.runs.series import Series, Signal, uniform_times
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import read_bag

__all__ = ["Shared", "compare_recordings", "compare_runs", "find_shared"]

_ALIKE = 0.95
"""Correlation from which on two inputs are one: loops of a good simulation and its machine have like commands, too."""
_LEAST_LIKE = 0.5
"""Correlation of two motions below which no shift of one is better than another."""
_LEAST_OVERLAP = 0.5
_MOST_SAMPLES = 200_000
_PARTS = 5
_ROWS = 50
"""Rows by which a part of a recording is found in it."""
_NEAR_DEGREES = 0.3
"""Largest logarithm of the ratio of spreads to 180 / pi that is taken for degrees."""
_NEAR_HALF_TURN = 0.3
"""Largest distance of two mean angles from half a turn that is taken for another zero [rad]."""
_OPPOSITE = 0.7
"""Least correlation of one motion with the negative of another that is taken for another sign."""
_DISTURBANCE, _REFERENCE, _INPUT, _MOTION = "disturbance", "reference", "input", "motion"
_SIGNALS: dict[str, Callable[[RunData], Signal | None]] = {
    _DISTURBANCE: lambda run: run.disturbance,
    _REFERENCE: lambda run: run.followed,
    _INPUT: lambda run: run.applied,
}


@dataclass(frozen=True)
class Shared:
    """What two recordings have in common.

    Attributes:
        kind: ``disturbance``, ``reference``, ``input`` or ``motion``; empty for nothing.
        shift: Shift of the second to later times [s].
        why: Why there is no shared signal, as text; else empty.
        signals: The signal of each, on the clock of the first; of joints without one, too.
    """

    kind: str
    shift: float
    correlation: float
    why: str = ""
    signals: tuple[Signal | None, Signal | None] = (None, None)


def compare_runs(
    simulation: PathArgument,
    *hardware: PathArgument,
    sim_prefix: str | None = None,
    hw_prefix: str | None = None,
    own_protocol: PathArgument | None = None,
    margin: MarginArgument = None,
    joint: str | None = None,
    joints: Mapping[str, str | None] | None = None,
    open_bag: OpenBag = read_bag,
) -> Comparison:
    """Compare the recording of a simulation with that of hardware, of an experiment during its noise.

    Args:
        simulation: Recording of the simulation: a bag, or any other as a ``Reading``.
        hardware: Recording of the hardware; several of a run that was repeated.
        sim_prefix: Namespace of the simulation's topics; None for that of the bag's only plant.
        margin: Acceptable difference; see :meth:`Margins.parse`.
        joints: All joints, and their names in the hardware's recordings where those differ.

    Raises:
        BagError: A bag cannot be read.
        DataError: A recording lacks states.
    """
    margins = Margins.parse(margin)

    def side(path: PathArgument, prefix: str | None, label: str | None, one: str | None) -> RunData:
        return read_run(path, prefix=prefix, label=label, joint=one, or_all=True, open_bag=open_bag)

    label = "hardware" if len(hardware) == 1 else None
    joints = dict(joints or ({} if joint is None else {joint: None}))
    ours = side(simulation, sim_prefix, "simulation", joint)
    theirs = [side(path, hw_prefix, label, joints.get(joint or "") or joint) for path in hardware]
    if len(theirs) == 1 and not any(run.of_file or run.is_whole for run in (ours, *theirs)):
        own = [] if own_protocol is None else [read_own(own_protocol, joint, open_bag)]
        return compare([(ours, theirs[0])], own=own, margin=margins)
    # The input of one joint brings all of them to one clock.
    every = [side(simulation, sim_prefix, "simulation", one) for one in joints] or [ours]
    shared = [
        find_shared(every, [side(path, hw_prefix, label, other or one) for one, other in joints.items()] or [run])
        for path, run in zip(hardware, theirs, strict=True)
    ]
    return compare_recordings(ours, theirs, shared, margins)


def compare_recordings(
    simulation: RunData,
    hardware: Sequence[RunData],
    shared: Sequence[Shared] | None = None,
    margins: Margins | None = None,
) -> Comparison:
    """Compare a simulation with at least one run of a machine; ``shared`` is found by default."""
    margins = margins or Margins.parse()
    if not hardware:
        raise DataError(f"{simulation.source} has nothing to be compared with; expected a recording of the machine")
    _refuse_copies((simulation, *hardware))
    shared = shared or [find_shared([simulation], [run]) for run in hardware]
    kinds = {one.kind for one in shared}
    if len(kinds) > 1:
        found = ", ".join(f"{run.label} {one.kind or 'nothing'}" for run, one in zip(hardware, shared, strict=True))
        raise DataError(
            f"the runs of the machine do not share one thing with {simulation.label} ({found}); expected repeated runs "
            "under one input: compare them one at a time"
        )
    kind = kinds.pop()
    pairs = [_on_one_clock(simulation, run, one) for run, one in zip(hardware, shared, strict=True)]
    notes = [_note(run, one) for run, one in zip(hardware, shared, strict=True)]
    steady = kind in _SIGNALS and all(_goes_on(ours, theirs) for ours, theirs in pairs)
    if len(pairs) == 1 and steady:
        result = replace(compare(pairs, margin=margins, on_one_clock=True), shared=kind)
    else:
        result = _described(pairs, kind, shared[0], margins)
    if not all(_has_one_input(simulation, run) for run in hardware):
        units = ", ".join(
            f"{run.label}: {run.window.effort_unit if run.applied else 'none'}" for run in (simulation, *hardware)
        )
        notes.append(f"The inputs are not compared, for they are not in one unit ({units}).")
    return replace(result, left_out=(*result.left_out, *dict.fromkeys(notes)))


def _described(pairs: Sequence[tuple[RunData, RunData]], kind: str, shared: Shared, margins: Margins) -> Comparison:
    compared = [Pair.of(*pair, on_one_clock=kind in _SIGNALS) for pair in pairs]
    first = compared[0]
    thesis = interpolated_difference(first.simulation.window, first.hardware.window)
    operating, advice = None, ""
    if len(pairs) > 1 and kind in _SIGNALS:
        operating = Band.of(first.simulation.window, [pair.hardware.window for pair in compared])
        verdict = conclude(_tests_of_runs(compared, margins), margins, "simulation", "hardware")
    else:
        apart = rms(first.difference.position)
        size = apart / max(float(first.difference.hardware.position.std()), 1e-300)
        unit = first.hardware.window.unit
        far = f"the motions are {apart:.3g} {unit} apart (rms, {size:.0%} of the hardware's spread)"
        varies = "how much the machine varies from run to run is not in the files"
        if kind in _SIGNALS:
            sentence = f"Undecided: both recordings have one {kind}, and {far}; {varies}."
        elif kind:
            sentence = f"Undecided: {shared.why}, and aligned by themselves {far}; {varies}."
        else:
            sentence = f"Undecided: {shared.why}, so the plants cannot be compared."
        verdict, advice = Verdict(Outcome.UNDECIDED, sentence, (), margins, None), _ADVICE[kind]
    return Comparison(
        compared,
        [first.simulation],
        thesis,
        verdict,
        verdict,
        compared,
        shared=kind or "nothing",
        advice=advice,
        operating=operating,
    )


_DIGITS = 2e-9
"""Rounding of a text file, by the range of the motion."""
_AGAIN = "Record the machine's run again, three times or more, and give all files: compare SIMULATION RUN1 RUN2 RUN3"
_ADVICE = {
    _DISTURBANCE: f"{_AGAIN}.",
    _REFERENCE: f"{_AGAIN}.",
    _INPUT: f"{_AGAIN}; or record both under an input that acts throughout, as noise or a multisine does.",
    _MOTION: "Record what drives both plants as a column of both files (--topic input=COLUMN names it).",
    "": "Record both under one input, reference or disturbance, and write it as a column of both files.",
}


# -- what is shared ----------------------------------------------------------------------------------------------


def find_shared(simulation: Sequence[RunData], hardware: Sequence[RunData]) -> Shared:
    """Return what two recordings have in common, and the shift of the second that aligns them."""
    reasons = []
    joints = list(zip(simulation, hardware, strict=True))
    for kind, signal in _SIGNALS.items():
        for ours, theirs in joints:
            one, other = signal(ours), signal(theirs)
            at = f" at {ours.joint}" if len(joints) > 1 else ""
            if one is None or other is None or not np.any(one.value) or not np.any(other.value):
                continue
            shift, correlation = _best_shift([(one, other)], ours, theirs)
            moved = Signal(other.t + shift, other.value, other.name)
            period = min(ours.window.period, theirs.window.period)
            if not (reason := _unlike(f"{kind}s of both{at}", kind, one, moved, correlation, period)):
                return Shared(kind, shift, correlation, signals=(one, moved))
            turned = Signal(other.t, -other.value, other.name)
            if (opposite := _best_shift([(one, turned)], ours, theirs)[1]) > _ALIKE:
                reason = (
                    f"the {kind}s of both{at} have opposite signs (correlation {-opposite:.2f}): where that is a "
                    f"matter of the column, write the guess with --write-mapping, set `sign: -1` for the {kind} of "
                    "one, and give it as --mapping"
                )
            reasons.append(reason)
    free = not any(run.applied is not None and np.any(run.applied.value) for run in (*simulation, *hardware))
    if free or not reasons:
        moving = [
            (
                Signal(ours.window.t, ours.window.velocity, ours.label),
                Signal(theirs.window.t, theirs.window.velocity, theirs.label),
            )
            for ours, theirs in joints
            if np.ptp(ours.window.velocity) > 0.0 and np.ptp(theirs.window.velocity) > 0.0
        ]
        shift, correlation = _best_shift(moving, *joints[0])
        missing = "neither has an input" if free else "no input, reference or disturbance is in both"
        if correlation < _LEAST_LIKE:
            return Shared(
                "", 0.0, correlation, f"{missing}, and the motions fit nowhere (correlation {correlation:.2f})"
            )
        return Shared(_MOTION, shift, correlation, missing)
    return Shared("", 0.0, 0.0, "; ".join(dict.fromkeys(reasons)))


def _unlike(what: str, kind: str, ours: Signal, theirs: Signal, correlation: float, period: float) -> str:
    """Return why two signals on one clock differ, as text; empty where they agree."""
    if kind == _DISTURBANCE:
        found = compare_signals(ours, theirs, period)
        return "the disturbances are too short to be compared" if found is None else found.reason
    if correlation <= _ALIKE:
        return f"the {what} differ: their correlation is {correlation:.2f} at best, expected above {_ALIKE:g}"
    start, stop = max(ours.t[0], theirs.t[0]), min(ours.t[-1], theirs.t[-1])
    at = np.linspace(start, stop, 2000) if stop > start else np.array([start])
    size = rms(theirs.held_at(at)) / max(rms(ours.held_at(at)), 1e-300)
    if not 1.0 / AMPLITUDE <= size <= AMPLITUDE:
        return (
            f"the {what} differ in size: the hardware's is {size:.3g} times the simulation's, expected "
            f"{1.0 / AMPLITUDE:.2f} to {AMPLITUDE:.2f}"
        )
    return ""


def _best_shift(signals: Sequence[tuple[Signal, Signal]], ours: RunData, theirs: RunData) -> tuple[float, float]:
    """Return the shift [s] of the second ones with the largest mean correlation, and that correlation."""
    period = max(
        min(ours.window.period, theirs.window.period),
        ours.window.duration / _MOST_SAMPLES,
        theirs.window.duration / _MOST_SAMPLES,
    )
    times = [uniform_times(float(run.window.t[0]), float(run.window.t[-1]), period) for run in (ours, theirs)]
    reach = np.arange(-(times[1].size - 1), times[0].size)  # sample of the first on which the second begins
    curves, overlap = [], np.ones(reach.size)
    for first, second in signals:
        curve, overlap = _correlations(first.held_at(times[0]), second.held_at(times[1]), reach)
        curves.append(curve)
    curve = np.mean(curves, axis=0) if curves else np.zeros(reach.size)
    curve[overlap < _LEAST_OVERLAP * min(times[0].size, times[1].size)] = -1.0
    good = np.flatnonzero(curve > curve.max() - 1e-3)
    longest = good[overlap[good] > 0.98 * overlap[good].max()]
    top = int(longest[np.argmax(curve[longest])])
    offset = 0.0
    if 0 < top < curve.size - 1:
        left, middle, right = curve[top - 1 : top + 2]
        bend = left - 2.0 * middle + right
        offset = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
    return float(times[0][0] - times[1][0]) + period * (float(reach[top]) + offset), float(curve[top])


def _correlations(a: Array, b: Array, reach: NDArray[np.int64]) -> tuple[Array, Array]:
    count = scipy.fft.next_fast_len(a.size + b.size)
    a, b = a - a.mean(), b - b.mean()
    ones = [np.fft.rfft(values, count) for values in (a, a * a, np.ones_like(a))]
    others = [np.conj(np.fft.rfft(values, count)) for values in (b, b * b, np.ones_like(b))]

    def summed(one: Complex, other: Complex) -> Array:
        return np.fft.irfft(one * other, count)[reach % count]

    n = np.maximum(np.round(summed(ones[2], others[2])), 1.0)
    sum_a, sum_b = summed(ones[0], others[2]), summed(ones[2], others[0])
    covariance = summed(ones[0], others[0]) - sum_a * sum_b / n
    spread_a = np.maximum(summed(ones[1], others[2]) - sum_a**2 / n, 0.0)
    spread_b = np.maximum(summed(ones[2], others[1]) - sum_b**2 / n, 0.0)
    seen = (spread_a > 0.02 * float(a @ a)) & (spread_b > 0.02 * float(b @ b))
    curve = np.asarray(covariance / np.sqrt(np.maximum(spread_a * spread_b, 1e-300)), dtype=float)
    return np.where(seen, curve, 0.0), n


def _on_one_clock(simulation: RunData, hardware: RunData, shared: Shared) -> tuple[RunData, RunData]:
    """Return both with the shared signal as their disturbance, over the time that they have in common."""
    hardware = hardware.moved(shared.shift)
    start = max(float(simulation.window.t[0]), float(hardware.window.t[0]))
    stop = min(float(simulation.window.t[-1]), float(hardware.window.t[-1]))
    signals = shared.signals
    if shared.kind in _SIGNALS:
        own = _SIGNALS[shared.kind](simulation), _SIGNALS[shared.kind](hardware)
        signals = own if all(one is not None and np.any(one.value) for one in own) else signals
    found = [
        replace(run.between(start, stop + 1e-9), disturbance=signal)
        for run, signal in zip((simulation, hardware), signals, strict=True)
    ]
    ours, theirs = (run.moved(-start) for run in found)
    _check_guesses(ours, theirs, shared)
    if not _has_one_input(ours, theirs):
        ours, theirs = (
            replace(run, window=replace(run.window, effort=0.0 * run.window.effort)) for run in (ours, theirs)
        )
    return replace(ours, label="simulation"), replace(theirs, label="hardware")


def _has_one_input(*runs: RunData) -> bool:
    """Return whether all runs have an input, in one unit: else their torques are not tested."""
    has = all(run.applied is not None or np.any(run.window.effort) for run in runs)
    return has and len({run.window.effort_unit for run in runs}) == 1


def _refuse_copies(runs: Sequence[RunData]) -> None:
    """Refuse a recording that is given twice, in whatever format: it has no variance."""
    for index, run in enumerate(runs):
        for other in runs[:index]:
            if _is_copy(other.whole, run.whole):
                raise DataError(
                    f"{other.source} and {run.source} hold one and the same recording; expected one of each plant, and "
                    "independent runs of the machine"
                )


def _is_copy(one: Series, other: Series) -> bool:
    """Return whether two recordings are one: the same rows, some of them, or points on the lines between them.

    Another zero, start of the clock or cut is no other recording; two accurate simulations differ by more. A copy that
    was filtered, rounded or resampled by splines is not detected, nor one resampled and cut at both ends.
    """
    if one.t.size == other.t.size and _same(one.position, other.position):
        return True
    for a, b in ((one, other), (other, one)):
        for shift in (a.t[0] - b.t[0], a.t[-1] - b.t[-1], *_shifts_of_rows(a, b)):
            at = b.t + shift
            inside = (at >= a.t[0]) & (at <= a.t[-1])
            # A later motion after the same input is another recording.
            if 2 * int(inside.sum()) >= b.t.size and all(
                _same(np.interp(at[inside], a.t, x), y[inside])
                for x, y in ((a.position, b.position), (a.effort, b.effort))
                if x is a.position or np.ptp(y) > 0.0
            ):
                return True
    return False


def _shifts_of_rows(a: Series, b: Series) -> Array:
    """Return the shifts of b's clock at which its rows of the fastest motion are rows within a."""
    steps, own = np.diff(a.position), np.diff(b.position)
    first = min(int(np.argmax(np.abs(own))), max(own.size - _ROWS, 0))
    own, error = own[first : first + _ROWS], _DIGITS * float(np.ptp(b.position))
    at = np.flatnonzero(np.abs(steps[: max(steps.size - own.size + 1, 0)] - own[0]) <= error)
    for row, step in enumerate(own):
        at = at[np.abs(steps[at + row] - step) <= error]
    shift = a.t[at[:1]] - b.t[first]
    return np.asarray(shift[(b.t[0] + shift > a.t[0]) & (b.t[-1] + shift < a.t[-1])])


def _same(one: Array, other: Array) -> bool:
    return 0.0 != float(np.ptp(other)) * _DIGITS >= float(np.ptp(one - other))


def _check_guesses(simulation: RunData, hardware: RunData, shared: Shared) -> None:
    """Refuse a guessed unit, zero or sign that exchanges the sides: it alone would decide the verdict."""
    a, b = simulation.window, hardware.window
    if not (simulation.guessed or hardware.guessed) or a.slides or b.slides:
        return
    how = "write the guess with --write-mapping, correct"
    angle = f"angle of {hardware.joint} in" if hardware.joint else "angle of"
    ends = f"and give it as --mapping; unchanged, where {Path(hardware.source).name} is really so"
    ratio = float(b.position.std()) / max(float(a.position.std()), 1e-300)
    for factor, degrees in ((180.0 / math.pi, hardware), (math.pi / 180.0, simulation)):
        if abs(math.log(max(ratio, 1e-300) / factor)) < _NEAR_DEGREES:
            raise DataError(
                f"the hardware's {angle} {hardware.source} moves {ratio:.3g} times as much as the simulation's of "
                f"{simulation.source}, as degrees taken for radians would; expected one unit: {how} the units of "
                f"{Path(degrees.source).name} to deg and deg/s, {ends}"
            )
    apart = float(b.position.mean() - a.position.mean())
    if shared.kind and math.cos(apart) < -math.cos(_NEAR_HALF_TURN):
        raise DataError(
            f"the hardware's mean {angle} {hardware.source} is {apart:.4g} rad from the simulation's of "
            f"{simulation.source}, as an angle that is 0 upright on one side would be; expected one zero: {how} the "
            f"offset of one position to 3.14159 (180 in deg), {ends}"
        )
    if shared.kind in _SIGNALS:
        motions = interpolated_difference(a, b)
        like = float(np.corrcoef(motions.simulation.velocity, motions.hardware.velocity)[0, 1])
        if like < -_OPPOSITE:
            raise DataError(
                f"the hardware's {angle} {hardware.source} moves against the simulation's of {simulation.source} "
                f"(correlation {like:.2f}), as one of the opposite sign would; expected one sign: {how} the sign of "
                f"one position and its velocity to -1, {ends}"
            )


def _note(run: RunData, shared: Shared) -> str:
    if not shared.kind:
        return f"{run.label}: {shared.why}."
    what = f"the {shared.kind}s of both" if shared.kind in _SIGNALS else f"{shared.why}: the motions"
    return (
        f"{run.label} is moved by {shared.shift:.3f} s, where {what} are most alike (correlation "
        f"{shared.correlation:.3f})."
    )


def _goes_on(ours: RunData, theirs: RunData) -> bool:
    """Return whether a signal acts throughout on stationary motions: no transient, no drift."""
    for run in (ours, theirs):
        signal, window = run.disturbance, run.window
        assert signal is not None
        edges = np.linspace(window.t[0], window.t[-1], _PARTS + 1)
        parts = [signal.held_at(np.linspace(a, b, 400)) for a, b in pairwise(edges)]
        whole = np.concatenate(parts)
        if any(np.var(part) < 0.2 * np.var(whole) or np.count_nonzero(np.diff(part)) < 3 for part in parts):
            return False
        pieces = np.array_split(window.position, _PARTS)
        spread = float(window.position.std())
        if float(np.std([piece.mean() for piece in pieces])) > 0.7 * spread:
            return False
    return True


# -- repeated runs -----------------------------------------------------------------------------------------------


def _tests_of_runs(pairs: Sequence[Pair], margins: Margins) -> list[EquivalenceTest]:
    """Test repeated runs: each quantity from each run, with Student's t of the runs."""
    slides = pairs[0].hardware.window.slides
    what, mean = ("position", margins.mean_position) if slides else ("angle", margins.mean_angle)
    tests = [
        _of_runs(f"mean {what} difference", mean, [float(pair.difference.position.mean()) for pair in pairs]),
        _of_runs("delay", margins.delay, [pair.delay for pair in pairs]),
    ]
    for name, margin in ((what, margins.spread_angle), ("velocity", margins.spread_velocity)):
        key = "velocity" if name == "velocity" else "position"
        if margin.is_share:
            logs = [
                math.log(max(float(getattr(pair.difference.hardware, key).std()), 1e-300))
                - math.log(max(float(getattr(pair.difference.simulation, key).std()), 1e-300))
                for pair in pairs
            ]
            tests.append(_of_runs(f"spread of {name} (ratio)", margin, logs, ratio=True))
    for name, margin in ((what, margins.path_angle), ("velocity", margins.path_velocity)):
        key = "velocity" if name == "velocity" else "position"
        plural = {"angle": "angles", "position": "positions", "velocity": "velocities"}[name]
        distances = [
            rms(getattr(pair.difference, key))
            / (float(getattr(pair.difference.hardware, key).std()) if margin.is_share else 1.0)
            for pair in pairs
        ]
        tests.append(_of_runs(f"distance of {plural}", margin, distances, one_sided=True))
    return tests


def _of_runs(
    name: str, margin: Margin, values: Sequence[float], *, ratio: bool = False, one_sided: bool = False
) -> EquivalenceTest:
    looks = Looks()
    runs = np.array(values)
    error = float(runs.std(ddof=1)) / math.sqrt(runs.size)
    scale: Callable[[float], float] = exponential if ratio else lambda value: value * margin.per_si

    def interval(level: float) -> Interval:
        reach = float(student_quantile(0.5 + 0.5 * level, runs.size - 1)) * error
        mean = float(runs.mean())
        return Interval(scale(mean), scale(mean - reach), scale(mean + reach), level, error, runs.size)

    inside, outside = interval(looks.level), interval(looks.level_of_each)
    if ratio:
        top = 1.0 + margin.si
        return equivalence_test(name, "-", inside, 1.0 / top, top, outside=outside, runs=runs.size, ratio=True)
    low = -math.inf if one_sided else -margin.value
    return equivalence_test(name, margin.unit, inside, low, margin.value, outside=outside, runs=runs.size)
