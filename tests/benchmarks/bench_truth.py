"""How often intervals and answers err, counted by plants that share no code with the estimators."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial

import numpy as np

from pendulum_bags.comparison import Looks, Margins, Outcome
from pendulum_bags.comparison.equivalence import EquivalenceTest
from pendulum_bags.comparison.long_run import Disturbance
from pendulum_bags.comparison.same_run import paired_tests
from pendulum_bags.runs.series import Series, Signal
from tests.benchmarks import Row, counted
from tests.truth_loops import FAMILIES, certificates
from tests.truth_plants import HOLD, PAIRS, PlantPair

DURATIONS = (5.0, 25.0, 125.0)
"""Lengths of the runs [s]."""
TRIALS = 200
LOOKS = (5.0, 10.0, 20.0)
"""Lengths of the runs behind each look at a machine on the margin [s]."""
_AT_ONCE = 20
"""Trials of one process."""


def run_pairs(pair: PlantPair, seeds: range, duration: float) -> list[tuple[tuple[Series, Series], Disturbance | None]]:
    """Return the motions of some trials as the product reads them, each with its noise."""
    found = []
    for seed, motions in zip(seeds, zip(*pair.runs(seeds, duration), strict=True), strict=True):
        values = pair.noise(seed, duration)
        noise = Disturbance.of(Signal(HOLD * np.arange(values.size), values), HOLD)
        series = [
            Series(np.arange(len(one)) / plant.rate, np.pi + one[:, 0], one[:, 1], one[:, 2])
            for one, plant in zip(motions, (pair.simulation, pair.hardware), strict=True)
        ]
        found.append(((series[0], series[1]), noise))
    return found


def misses(seeds: range, pair: PlantPair, duration: float, truth: dict[str, float]) -> Counter[tuple[str, str]]:
    """Count, by quantity and side, how often the truth lies outside the 95 % interval."""
    count: Counter[tuple[str, str]] = Counter()
    for motions, noise in run_pairs(pair, seeds, duration):
        looks = Looks(alpha=0.025)
        for test in paired_tests([motions], Margins.parse(), noises=[noise], looks=looks, runs_differ=False):
            if test.quantity in truth:
                count[test.quantity, "below"] += truth[test.quantity] < test.interval.low
                count[test.quantity, "above"] += truth[test.quantity] > test.interval.high
    return count


def margins_on(truth: dict[str, float]) -> dict[str, str]:
    """Return margins on which the long-run spreads lie exactly; all others are far away."""
    ratios = {
        name: max(truth[f"spread of {name} (ratio)"], 1.0 / truth[f"spread of {name} (ratio)"]) for name in _SPREADS
    }
    spreads = {f"spread_{name}": f"{100.0 * (ratio - 1.0)} %" for name, ratio in ratios.items()}
    return {**spreads, "mean_angle": "5 deg", "delay": "50 ms", "path_angle": "300 %", "path_velocity": "300 %"}


_SPREADS = ("angle", "velocity", "torque")


def on_the_margin(seeds: range, pair: PlantPair, stated: dict[str, str]) -> Counter[str]:
    """Count how often a spread that lies on its margin is called equivalent, or different, within three looks."""
    count: Counter[str] = Counter()
    parts = [run_pairs(pair, range(10_000 * k + seeds[0], 10_000 * k + seeds[-1] + 1), t) for k, t in enumerate(LOOKS)]
    for trial in zip(*parts, strict=True):
        outcomes: dict[str, Outcome] = {}
        for look in range(1, len(trial) + 1):
            pairs, noises = zip(*trial[:look], strict=True)
            tests: list[EquivalenceTest] = paired_tests(
                pairs, Margins.parse(stated), noises=noises, looks=Looks(look), runs_differ=False
            )
            for test in tests:
                if outcomes.get(test.quantity, Outcome.UNDECIDED) is Outcome.UNDECIDED:
                    outcomes[test.quantity] = test.outcome
        for name in _SPREADS:
            count[f"{name} {outcomes[f'spread of {name} (ratio)'].value}"] += 1
        count["any different"] += Outcome.DIFFERENT in outcomes.values()
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


def rows() -> Iterator[Row]:
    """Yield the misses of each side of each interval, and the false answers on the margin."""
    blocks = [range(first, first + _AT_ONCE) for first in range(0, TRIALS, _AT_ONCE)]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        yield from certificate_rows(pool)
        for name, pair in PAIRS.items():
            truth = pair.truth()
            for duration in DURATIONS:
                found: Counter[tuple[str, str]] = Counter()
                for part in pool.map(partial(misses, pair=pair, duration=duration, truth=truth), blocks):
                    found.update(part)
                for (quantity, side), number in sorted(found.items()):
                    yield counted(
                        f"{name}, {duration:g} s: truth {side} the 95 % interval, {quantity}",
                        number,
                        TRIALS,
                        at_most=5.0,
                    )
            total: Counter[str] = Counter()
            for count in pool.map(partial(on_the_margin, pair=pair, stated=margins_on(truth)), blocks):
                total.update(count)
            for quantity in _SPREADS:
                yield counted(
                    f"{name}: \u201cequivalent\u201d within 3 looks although on the margin, spread of {quantity}",
                    total[f"{quantity} {Outcome.EQUIVALENT.value}"],
                    TRIALS,
                    at_most=5.0,
                )
            yield counted(
                f"{name}: \u201cnot equivalent\u201d within 3 looks although on the margin",
                total["any different"],
                TRIALS,
                at_most=5.0,
            )
