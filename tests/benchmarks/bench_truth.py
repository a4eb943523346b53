"""How often intervals and answers err, counted by plants that share no code with the estimators."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pendulum_bags.comparison import Looks, Margins, Outcome
from pendulum_bags.comparison.equivalence import EquivalenceTest, conclude
from pendulum_bags.comparison.long_run import Disturbance
from pendulum_bags.comparison.same_run import paired_tests, unpaired_tests
from pendulum_bags.identification.identify import identify_joints
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.ranking.present import REGRET_MARGIN
from pendulum_bags.runs.series import Series, Signal
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_testing.balanced_machine import PRESETS, run_balanced
from tests.benchmarks import Row, counted
from tests.truth_loops import FAMILIES, certificates, choice, distance
from tests.truth_plants import COLOURED, HOLD, OTHER, PAIRS, POWER, REAL_TIME, PlantPair

DURATIONS = (5.0, 25.0, 125.0)
"""Lengths of the runs [s]."""
TRIALS = 200
INTERIM = (5.0, 10.0, 20.0)
"""Lengths of the runs behind each interim analysis of a machine on the margin [s]."""
DEFAULT = (25.0, 40.0, 60.0)
"""The same of a default run."""
MACHINES = range(500, 520)
"""Seeds of the machines of several joints that are identified."""
_AT_ONCE = 10
"""Trials of one task."""
_APART = 10**6
"""Between the seeds of the runs of one trial."""
_SIDES = ("below", "above")
LESS = " less the delay"


@dataclass(frozen=True)
class Setting:
    """What is counted: a pair of plants, its recordings, and what the product knows of them.

    Args:
        pair: The plants.
        duration: Of each run [s].
        runs: Runs of each trial.
        known: Whether the noise was recorded.
        apart: Whether the sides had noise of their own.
    """

    pair: PlantPair
    duration: float
    runs: int = 1
    known: bool = True
    apart: bool = False

    def tests(self, seeds: range, margins: Margins, looks: Looks) -> list[list[EquivalenceTest]]:
        """Return the tests of each trial."""
        runs = [recordings(self, range(seeds.start + k, seeds.stop + k)) for k in range(0, self.runs * _APART, _APART)]
        return [self.tests_of(trial, margins, looks) for trial in zip(*runs, strict=True)]

    def tests_of(self, trial: tuple[Recording, ...], margins: Margins, looks: Looks) -> list[EquivalenceTest]:
        """Return the tests of some recordings."""
        differ = self.pair.is_random
        if not self.apart:
            noises = [one.noises[0] for one in trial]
            return paired_tests([one.motions for one in trial], margins, noises=noises, looks=looks, runs_differ=differ)
        first, second = zip(*(one.motions for one in trial), strict=True)
        ones, others = zip(*(one.noises for one in trial), strict=True)
        return unpaired_tests(first, second, margins, noises=(ones, others), looks=looks, runs_differ=differ)


@dataclass(frozen=True)
class Recording:
    """Motions of simulation and hardware as the product reads them, and the noise of each side."""

    motions: tuple[Series, Series]
    noises: tuple[Disturbance | None, Disturbance | None]


def recordings(setting: Setting, seeds: range) -> list[Recording]:
    """Return one recording for each seed."""
    found = []
    pair = setting.pair
    both = pair.runs(seeds, setting.duration, apart=setting.apart)
    for seed, motions in zip(seeds, zip(*both, strict=True), strict=True):
        series = [
            Series(np.arange(len(one)) / plant.rate, np.pi + one[:, 0], one[:, 1], one[:, 2])
            for one, plant in zip(motions, (pair.simulation, pair.hardware), strict=True)
        ]
        noises = []
        for own in (seed, OTHER + seed if setting.apart else seed):
            values = pair.noise(own, setting.duration)
            signal = Signal(HOLD * np.arange(values.size, dtype=np.float64), values)
            noises.append(Disturbance.of(signal, HOLD) if setting.known else None)
        found.append(Recording((series[0], series[1]), (noises[0], noises[1])))
    return found


def misses(seeds: range, setting: Setting, truth: Mapping[str, float]) -> Counter[tuple[str, str]]:
    """Count, by quantity and side, how often the truth lies outside the 95 % interval."""
    count: Counter[tuple[str, str]] = Counter()
    for tests in setting.tests(seeds, Margins.parse(), Looks(alpha=0.025)):
        for test in (one for one in tests if one.quantity in truth):
            count[test.quantity, "below"] += truth[test.quantity] < test.interval.low
            count[test.quantity, "above"] += truth[test.quantity] > test.interval.high
    return count


def margins_on(truth: Mapping[str, float], note: str = "") -> dict[str, str]:
    """Return margins on which the long-run spreads, the delay and the distances lie exactly.

    Args:
        truth: Of the pair.
        note: `` less the delay`` for distances with the delay taken out.
    """
    stated = {"mean_angle": "5 deg", "delay": f"{max(abs(truth['delay']), 0.01)} ms"}
    for name in SPREADS:
        ratio = truth[f"spread of {name} (ratio)"]
        stated[f"spread_{name}"] = f"{100.0 * (max(ratio, 1.0 / ratio) - 1.0)} %"
    for name, plural in (("angle", "angles"), ("velocity", "velocities")):
        stated[f"path_{name}"] = f"{truth[f'distance of {plural}{note}']} %"
    return stated


SPREADS = ("angle", "velocity", "torque")


def on_the_margin(
    seeds: range, pair: PlantPair, stated: Mapping[str, str], lengths: tuple[float, ...] = INTERIM
) -> Counter[str]:
    """Count what each test says first within some interim analyses, and what they all say together."""
    count: Counter[str] = Counter()
    parts = [
        recordings(Setting(pair, duration), range(seeds.start + _APART * k, seeds.stop + _APART * k))
        for k, duration in enumerate(lengths)
    ]
    setting, margins = Setting(pair, lengths[0]), Margins.parse(stated)
    for trial in zip(*parts, strict=True):
        first: dict[str, Outcome] = {}
        whole = Outcome.UNDECIDED
        for look in range(1, len(trial) + 1):
            tests = setting.tests_of(trial[:look], margins, Looks(look))
            for test in tests:
                if first.get(test.quantity, Outcome.UNDECIDED) is Outcome.UNDECIDED:
                    first[test.quantity] = test.outcome
            if whole is Outcome.UNDECIDED:
                whole = conclude(tests, margins, "one", "other").outcome
        for quantity, outcome in first.items():
            count[f"{quantity} {outcome.value}"] += 1
        count["any different"] += Outcome.DIFFERENT in first.values()
        count[whole.value] += 1
    return count


def certificate_rows(pool: Executor) -> Iterator[Row]:
    """Yield the certified controllers that fall on the machine, and the share of robust ones that are certified."""
    for name in FAMILIES:
        hard = "," in name
        total: Counter[str] = Counter()
        for count in pool.map(partial(certificates, name, cases=20), range(60 if hard else 20)):
            total.update(count)
        note = ", ".join(f"{number} {what}" for what, number in total.items())
        yield counted(
            f"{name}: certified, but unstable on the machine",
            total["failing"],
            total["certified"],
            at_most=0.0,
            note=note,
        )
        yield counted(
            f"{name}: certified, of those with 6 dB and 30 degrees",
            total["robust certified"],
            total["robust"],
            at_least=None if hard else 50.0,
        )


def layer_rows(pool: Executor) -> Iterator[Row]:
    """Yield the misses of the intervals of nu-gap and regret, and the wrong yes of the simulation's choice."""
    for name in FAMILIES:
        gaps = [one for one in pool.map(partial(distance, name), range(60)) if one is not None]
        for side, missed in (
            ("below", sum(true < gap.low for gap, true in gaps)),
            ("above", sum(true > gap.high for gap, true in gaps)),
        ):
            yield counted(f"{name}: truth {side} the 95 % interval, nu-gap", missed, len(gaps), at_most=5.0)
    for runs, shared in ((3, False), (5, False), (3, True), (5, True)):
        found = pool.map(partial(choice, runs=runs, shared=shared), range(2000), chunksize=20)
        chosen = [one for one in found if one is not None]
        what = f"{runs} seeds, the simulation has {'the same' if shared else 'others'}"
        below, above = (sum(one) for one in zip(*((t < r.low, t > r.high) for r, t in chosen), strict=True))
        yield counted(f"{what}: truth below the 95 % interval, regret", below, len(chosen), at_most=5.0)
        yield counted(f"{what}: truth above the 95 % interval, regret", above, len(chosen), at_most=5.0)
        # Picks that cost far more are no matter of the interval.
        wrong = [r.high <= REGRET_MARGIN for r, true in chosen if REGRET_MARGIN < true < 3.0 * REGRET_MARGIN]
        yield counted(f"{what}: yes, of picks that cost 10 to 30 % more", sum(wrong), len(wrong), at_most=5.0)


def identified(seed: int, preset: str) -> tuple[int, int]:
    """Return how many intervals of a machine held upright miss its values, and their number; (0, 0) if refused."""
    run = run_balanced(preset, seed)
    time = 0.002 * np.arange(len(run.position), dtype=np.float64)
    recording = JointRecording("run", time, run.position, run.effort, ("zero", "zero"), velocity=run.velocity)
    result = identify_joints(load_mechanism(preset), [recording])
    held = [] if result.refused else [i.low <= run.truth.get(n, 0.0) <= i.high for n, i in result.intervals.items()]
    return len(held) - sum(held), len(held)


def identification_rows(pool: Executor) -> Iterator[Row]:
    """Yield the misses of the intervals of each preset of several joints."""
    for preset in PRESETS:
        pairs = np.array(list(pool.map(partial(identified, preset=preset), MACHINES)))
        missed, intervals = (int(number) for number in pairs.sum(axis=0))
        yield counted(
            f"{preset} held upright for 20 s: values outside 95 % intervals",
            missed,
            max(intervals, 1),
            at_most=10.0,
            note=f"{np.sum(pairs[:, 1] == 0)} of {len(pairs)} runs refused",
        )


def settings() -> Iterator[tuple[str, Setting]]:
    """Yield what is counted, with a name."""
    for name, pair in {**PAIRS, **COLOURED}.items():
        for duration in DURATIONS:
            yield f"{name}, {duration:g} s", Setting(pair, duration)
    for name in list(PAIRS)[::2]:
        pair = PAIRS[name]
        for duration in DURATIONS:
            yield f"{name}, noise not recorded, {duration:g} s", Setting(pair, duration, known=False)
            yield f"{name}, unpaired, {duration:g} s", Setting(pair, duration, apart=True)
            yield f"{name}, unpaired, noise not recorded, {duration:g} s", Setting(pair, duration, 1, False, True)
        yield f"{name}, 5 runs of 5 s", Setting(pair, 5.0, 5)
    for name, pair in REAL_TIME.items():
        for runs, duration in ((2, 5.0), (3, 5.0), (5, 5.0), (3, 25.0)):
            yield f"{name}, {runs} runs of {duration:g} s", Setting(pair, duration, runs)


def rows() -> Iterator[Row]:
    """Yield the misses of each side of each interval, the false answers on the margin, and the power."""
    blocks = [range(first, first + _AT_ONCE) for first in range(0, TRIALS, _AT_ONCE)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        yield from certificate_rows(pool)
        yield from layer_rows(pool)
        yield from identification_rows(pool)
        wanted = list(settings())
        keys = list(dict.fromkeys((setting.pair, setting.apart) for _, setting in wanted))
        truths = dict(zip(keys, pool.map(_truth, keys), strict=True))
        # The longest first, so that no process is left with one of those at the end.
        counts = {
            name: [pool.submit(misses, block, setting, truths[setting.pair, setting.apart]) for block in blocks]
            for name, setting in sorted(wanted, key=lambda one: -one[1].duration * one[1].runs)
        }
        edges = {
            (name, note): [
                pool.submit(on_the_margin, block, pair, margins_on(truths[pair, False], note)) for block in blocks
            ]
            for name, pair in PAIRS.items()
            for note in ("", LESS)
        }
        powers = {
            name: [pool.submit(on_the_margin, block, pair, {}, DEFAULT) for block in blocks[: len(blocks) // 2]]
            for name, pair in POWER.items()
        }
        for name, setting in wanted:
            missed = _sum(counts[name])
            for quantity in truths[setting.pair, setting.apart]:
                for side in _SIDES:
                    what = f"{name}: truth {side} the 95 % interval, {quantity}"
                    yield counted(what, missed[quantity, side], TRIALS, at_most=5.0)
        for (name, note), parts in edges.items():
            said = _sum(parts)
            for quantity in on_margin(note):
                what = f"{name}, on the margin: \u201cequivalent\u201d within 3 analyses, {quantity}"
                yield counted(what, said[f"{quantity} equivalent"], TRIALS, at_most=5.0)
            if not note:
                what = f"{name}, on the margin: \u201cnot equivalent\u201d within 3 analyses"
                yield counted(what, said["any different"], TRIALS, at_most=5.0)
        for name, parts in powers.items():
            right = Outcome.EQUIVALENT if name in PAIRS else Outcome.DIFFERENT
            what = f"default run, {name}: \u201c{right.value}\u201d"
            yield counted(what, _sum(parts)[right.value], _AT_ONCE * len(parts), at_least=95.0)


def on_margin(note: str) -> tuple[str, ...]:
    """Return the tests whose truth lies on the margins of :func:`margins_on`."""
    distances = tuple(f"distance of {what}{note}" for what in ("angles", "velocities"))
    return distances if note else (*(f"spread of {name} (ratio)" for name in SPREADS), "delay", *distances)


def _sum(parts: Sequence[Future[Counter[Any]]]) -> Counter[Any]:
    total: Counter[Any] = Counter()
    for part in parts:
        total.update(part.result())
    return total


def _truth(key: tuple[PlantPair, bool]) -> dict[str, float]:
    pair, apart = key
    return pair.truth(apart=apart)
