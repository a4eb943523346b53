"""How often the answer errs, on plants whose difference is known: what ``make experiment`` may promise."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, NamedTuple

from pendulum_bags.comparison import Looks, Margins, Outcome
from pendulum_bags.comparison.equivalence import EquivalenceTest
from pendulum_bags.comparison.same_run import paired_tests
from pendulum_bags.runs.series import Series
from pendulum_testing.plant_pairs import SIMULATED, pair
from tests.benchmarks import Row, counted

AT_MARGIN = 300
"""Trials of a machine that lies on every margin at once: 15 false answers of 300 are 5 %."""
TRIALS = 100
"""Trials of each difference that must be found, and of none."""
FIRST_LOOKS = (5.0, 10.0, 20.0)
"""Lengths of the runs behind each further look, short so that the intervals rest on little [s]."""
DEFAULT_LOOKS = (25.0, 40.0, 60.0)
"""The same of ``make experiment``: the run and the repeat that the first look has, and two repeats [s]."""

FRICTION = SIMULATED.with_values(damping=2.0 * SIMULATED.damping)
DRY = dict.fromkeys(("coulomb_friction", "static_friction"), 0.3)
DIFFERENCES: dict[str, dict[str, Any]] = {
    "10 ms of delay": {"late": 0.010},
    "20 % more gain": {"gain": 1.2},
    "20 % less gain": {"gain": 0.8},
    "twice the friction": {"plant": FRICTION},
    "an X5-9's dry friction, 0.3 N m, not simulated": {"plant": SIMULATED.with_values(**DRY)},
}
ON_THE_MARGIN: dict[str, Any] = {
    "late": 0.004,
    "gain": 1.1,
    "plant": SIMULATED.with_values(torque_offset=0.05, coulomb_friction=0.05, static_friction=0.05),
}
"""A machine that differs a little in everything; the margins are set to just that much."""

LESS_DELAY = " less the delay"


class Trial(NamedTuple):
    """What each test said first, by quantity, and after how much noise the whole was decided [s]."""

    outcomes: dict[str, Outcome]
    whole: Outcome
    seconds: float


def run_trial(
    seed: int,
    hardware: dict[str, Any],
    stated: dict[str, str],
    lengths: Sequence[float],
    *,
    each: bool = False,
) -> Trial:
    """Carry out one experiment: look, and record more while it is undecided.

    Args:
        seed: Makes all noise.
        hardware: In what the machine differs.
        stated: Margins.
        lengths: Of the runs behind each look [s].
        each: Go on until each test is decided, not only the answer.
    """
    margins = Margins.parse(stated)
    pairs: list[tuple[Series, Series]] = []
    first: dict[str, Outcome] = {}
    whole = Outcome.UNDECIDED
    seconds = 0.0
    for look, length in enumerate(lengths, start=1):
        simulation, machine = pair(1000 * seed + look, length, **hardware)
        pairs.append((simulation.window, machine.window))
        seconds += length
        tests = paired_tests(pairs, margins, looks=Looks(look), runs_differ=False)
        for test in tests:
            if first.get(test.quantity, Outcome.UNDECIDED) is Outcome.UNDECIDED:
                first[test.quantity] = test.outcome
        whole = outcome_of(tests)
        if Outcome.UNDECIDED not in first.values() or (whole is not Outcome.UNDECIDED and not each):
            break
    return Trial(first, whole, seconds)


def outcome_of(tests: Sequence[EquivalenceTest]) -> Outcome:
    """Return the outcome of all tests together."""
    outcomes = {test.outcome for test in tests}
    if Outcome.DIFFERENT in outcomes:
        return Outcome.DIFFERENT
    return Outcome.UNDECIDED if Outcome.UNDECIDED in outcomes else Outcome.EQUIVALENT


def margins_at(hardware: dict[str, Any], duration: float = 600.0, *, less_delay: bool = False) -> dict[str, str]:
    """Return margins on which a machine lies exactly, from one long run.

    Args:
        hardware: In what the machine differs.
        duration: Of the run [s].
        less_delay: Whether the distances are those with the delay taken out, which have the same margins.
    """
    less = LESS_DELAY if less_delay else ""
    simulation, machine = pair(7, duration, **hardware)
    tests = paired_tests([(simulation.window, machine.window)], Margins.parse())
    found = {test.quantity: test.interval.estimate for test in tests}
    stated = {
        f"spread_{what}": f"{100.0 * (max(found[name], 1.0 / found[name]) - 1.0)} %"
        for what in ("angle", "velocity", "torque")
        for name in [f"spread of {what} (ratio)"]
    }
    stated["mean_angle"] = f"{abs(found['mean angle difference'])} deg"
    stated["delay"] = f"{abs(found['delay'])} ms"
    stated["path_angle"] = f"{found['distance of angles' + less]} %"
    stated["path_velocity"] = f"{found['distance of velocities' + less]} %"
    return stated


def repeat(function: Callable[[int], Trial], trials: int) -> list[Trial]:
    """Carry out trials with seeds 1, 2, ... on all cores."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(function, range(1, trials + 1), chunksize=4))


def rows() -> Iterator[Row]:
    """Yield false answers at each margin, and how often differences are found and equal plants are told equal."""
    stated = margins_at(ON_THE_MARGIN)
    trials = repeat(
        partial(run_trial, hardware=ON_THE_MARGIN, stated=stated, lengths=FIRST_LOOKS, each=True),
        AT_MARGIN,
    )
    # Distances less the delay have the margins of those with it, far within which they lie: they need margins of their
    # own, beyond which the others lie.
    closer = repeat(
        partial(
            run_trial,
            hardware=ON_THE_MARGIN,
            stated=margins_at(ON_THE_MARGIN, less_delay=True),
            lengths=FIRST_LOOKS,
            each=True,
        ),
        AT_MARGIN,
    )
    for quantity in trials[0].outcomes:
        at_margin = closer if quantity.endswith(LESS_DELAY) else trials
        yield counted(
            f"same run: “equivalent” within 3 looks although on the margin, {quantity}",
            sum(trial.outcomes[quantity] is Outcome.EQUIVALENT for trial in at_margin),
            AT_MARGIN,
            at_most=5.0,
        )
    yield counted(
        "same run: “yes” for a machine on the margins",
        sum(trial.whole is Outcome.EQUIVALENT for trial in trials),
        AT_MARGIN,
        at_most=5.0,
    )
    for what, hardware in DIFFERENCES.items():
        found = repeat(partial(run_trial, hardware=hardware, stated={}, lengths=DEFAULT_LOOKS), TRIALS)
        yield counted(
            f"same run: “no” for {what}, default runs",
            sum(trial.whole is Outcome.DIFFERENT for trial in found),
            TRIALS,
            at_least=95.0,
            note=_noise(found),
        )
    found = repeat(partial(run_trial, hardware={}, stated={}, lengths=DEFAULT_LOOKS), TRIALS)
    yield counted(
        "same run: “yes” for the same plant at 100 Hz with an actuator's sensors, default runs",
        sum(trial.whole is Outcome.EQUIVALENT for trial in found),
        TRIALS,
        at_least=95.0,
        note=_noise(found),
    )


def _noise(trials: Sequence[Trial]) -> str:
    return f"after {sum(trial.seconds for trial in trials) / len(trials):.0f} s of noise in the mean"
