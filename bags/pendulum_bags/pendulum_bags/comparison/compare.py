"""Comparison of simulation and hardware: the thesis's analysis, the paired one, and a verdict."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

from pendulum_bags.comparison.band import common_band
from pendulum_bags.comparison.equivalence import Outcome, Verdict, conclude
from pendulum_bags.comparison.independence import check_clocks, check_pairs
from pendulum_bags.comparison.long_run import Disturbance
from pendulum_bags.comparison.margins import MarginArgument, Margins
from pendulum_bags.comparison.metrics import episode_of, summarise_metrics
from pendulum_bags.comparison.operating_band import Band
from pendulum_bags.comparison.pairs import Difference, Pair, distribution_tests, interpolated_difference
from pendulum_bags.comparison.same_run import Looks, paired_tests, unpaired_tests
from pendulum_bags.runs.cached_bags import CachedBags
from pendulum_bags.runs.run_data import (
    OpenBag,
    RunData,
    is_emulated,
    is_in_lockstep,
    noise_hold_time,
    plant_summary,
    read_run,
)
from pendulum_bags.runs.run_folder import pair_folders, read_looks, read_stalls
from pendulum_bags.runs.run_record import DIFFERENCE, SURROGATE, run_record
from pendulum_msgs_py.errors import BagError, DataError
from pendulum_msgs_py.json_values import without_nan
from pendulum_rosbag.reader import read_bag

__all__ = ["Comparison", "PathArgument", "compare", "compare_folders", "compare_joints", "read_own"]

PathArgument: TypeAlias = "str | os.PathLike[str]"


@dataclass(frozen=True)
class Comparison:
    """The result of comparing simulation and hardware, of one run or several.

    Args:
        own: Simulations under the thesis's own protocol (noise of their own), else those of the pairs.
        verdict: Verdict on the paired comparison, or on the unpaired one where the disturbances differ.
        tested: Runs that the verdicts use; the others are only shown.
        shared: Signal that brought both to one clock: ``disturbance``, or of files ``reference``, ``input``,
            ``motion``.
        advice: Next step where files do not allow a verdict; empty where the tests name one.
    """

    pairs: Sequence[Pair]
    own: Sequence[RunData]
    thesis: Difference
    verdict: Verdict
    unpaired_verdict: Verdict
    tested: Sequence[Pair]
    looks: Looks = Looks()  # noqa: RUF009 - frozen
    left_out: Sequence[str] = ()
    unproved: Sequence[str] = ()
    stalls: Sequence[Mapping[str, str]] = ()
    shared: str = "disturbance"
    advice: str = ""
    operating: Band | None = None

    @property
    def notes(self) -> list[str]:
        """Remarks on the figures: simulations that differ from their equation, and ``left_out``."""
        notes = []
        for run in (self.pairs[0].simulation, self.pairs[0].hardware):
            record = run_record(run.metadata)
            simulation = record.get("simulation") if run.label == "simulation" or SURROGATE in record else None
            if isinstance(simulation, Mapping) and (difference := simulation.get(DIFFERENCE)):
                notes.append(f"The {run.label}, {simulation.get('name')}, {difference}.")
            if run.is_whole and not self.left_out:
                notes.append(f"The {run.label} has neither a disturbance nor events: all of its recording is compared.")
        return [*dict.fromkeys(notes), *self.unproved, *self.left_out]

    @property
    def of_files(self) -> bool:
        """Whether a side is a recording without the record of an experiment."""
        return any(run.of_file or run.is_whole for pair in self.pairs for run in (pair.simulation, pair.hardware))

    @property
    def is_emulated(self) -> bool:
        """Whether the hardware was emulated in all runs."""
        return all(is_emulated(pair.hardware) for pair in self.pairs)

    @property
    def what_of(self) -> str:
        """Runs that the intervals refer to, as text, where runs may differ by more than their seeds; else empty."""
        if not _may_differ([pair.hardware for pair in self.tested]):
            return ""
        if len(self.tested) == 1:
            return "The intervals are of this run only, with the phase that its loops happened to have. "
        return (
            "The intervals are of the mean over runs, by Student's t of what the runs show, since each has a phase; "
            "those of distances with the delay left in are of these runs only. "
        )

    @property
    def hardware_name(self) -> str:
        """Name of the other side, as text."""
        return "emulated hardware" if self.is_emulated else "hardware"

    @property
    def delay(self) -> float:
        """Delay of the hardware's response [s], from the test or the velocities' correlation; NaN without a peak."""
        tested = next((test for test in self.verdict.tests if test.quantity == "delay"), None)
        if tested is None:
            return self.pairs[0].delay
        return tested.interval.estimate * (1e-3 if tested.unit == "ms" else 1.0)

    @property
    def is_paired(self) -> bool:
        """Whether all runs had one disturbance on both plants."""
        return all(pair.is_paired for pair in self.pairs)

    @property
    def is_tested_in_pairs(self) -> bool:
        """Whether the verdict's tests compare both motions at the same times, under one disturbance."""
        return self.is_paired and not self.unlike_references

    @cached_property
    def band(self) -> float:
        """Frequency up to which the tests compare spreads and distances [Hz]."""
        if self.is_tested_in_pairs:
            series = [one for pair in self.tested for one in pair.motions]
        else:
            series = [run.window for run in (*self.own, *(pair.hardware for pair in self.tested))]
        return common_band(self.verdict.margins.band.si, *series)

    @property
    def seen(self) -> str:
        """Samples that the spreads and distances of the tests use, as text."""
        times = "at the slower plant's sampling times and " if self.is_tested_in_pairs else ""
        return f"{times}below {self.band:.3g} Hz"

    @property
    def unlike_references(self) -> str:
        """Why the moving references of a pair differ, see :attr:`Pair.unlike_references`; empty where they agree."""
        return next((pair.unlike_references for pair in self.pairs if pair.unlike_references), "")

    @cached_property
    def plants(self) -> dict[str, dict[str, Any]]:
        """Figures of each plant over all samples of its runs, weighted by their number as in the tests."""
        groups = {
            "sim": [pair.simulation for pair in self.pairs],
            "hw": [pair.hardware for pair in self.pairs],
        }
        if any(all(run is not pair.simulation for pair in self.pairs) for run in self.own):
            groups["sim_500hz"] = list(self.own)
        return {name: _pool([plant_summary(run) for run in runs]) for name, runs in groups.items()}

    @property
    def paired(self) -> dict[str, Any]:
        """Statistics of the paired difference; only a reason where the disturbances differ."""
        first = self.pairs[0]
        if not self.is_paired:
            return {"reason": next(pair.why_not_paired for pair in self.pairs if not pair.is_paired)}
        result = first.as_dict()
        if len(self.pairs) > 1:
            result["runs"] = [pair.as_dict() for pair in self.pairs]
        return result

    @cached_property
    def unpaired(self) -> dict[str, Any]:
        """Statistics of the thesis's difference and of both distributions."""
        hold = {"sim": noise_hold_time(self.own[0]), "hw": noise_hold_time(self.pairs[0].hardware)}
        return {
            **self.thesis.statistics(),
            "noise_hold_time": hold,
            "same_noise": any(run is pair.simulation for run in self.own for pair in self.pairs) and self.is_paired,
            "distributions": distribution_tests(self.own[0].window, self.pairs[0].hardware.window),
            "verdict": self.unpaired_verdict.sentence,
            "tests": [test.as_dict() for test in self.unpaired_verdict.tests],
        }

    @property
    def metrics(self) -> list[dict[str, Any]]:
        """Metrics of the regulation, one row each, simulation and hardware of the first run side by side."""
        pair = self.pairs[0]
        return summarise_metrics({"sim": episode_of(pair.simulation.window), "hw": episode_of(pair.hardware.window)})

    def to_json(self) -> dict[str, Any]:
        """Return everything for other programs; undefined numbers are None."""
        record = run_record(self.pairs[0].hardware.metadata)
        content = {
            "seed": record.get("seed"),
            "strategy": record.get("strategy"),
            "versions": record.get("versions", {}),
            "git_revision": record.get("git_revision"),
            "runs": len(self.pairs),
            "emulated": self.is_emulated,
            "looks": self.looks.number,
            "left_out": list(self.left_out),
            "notes": list(self.notes),
            "stalls": [dict(stall) for stall in self.stalls],
            "plants": self.plants,
            "paired": self.paired,
            "unpaired": self.unpaired,
            "metrics": self.metrics,
            "verdict": self.verdict.as_dict(),
        }
        if self.operating is not None:
            content["operating_band"] = {"coverage": self.operating.coverage, "own_coverage": self.operating.own}
        return without_nan(content)


def compare(
    pairs: Sequence[tuple[RunData, RunData]],
    *,
    own: Sequence[RunData] = (),
    margin: MarginArgument = None,
    looks: Looks = Looks(),  # noqa: B008 - frozen
    shown: Sequence[int] = (),
    on_one_clock: bool = False,
) -> Comparison:
    """Compare runs that are in memory.

    Args:
        pairs: (simulation, hardware) of each run, at least one.
        margin: Acceptable difference; see :meth:`Margins.parse`.
        looks: Number of interim analyses, where data are added until they decide.
        shown: Indices of pairs that are shown and not tested; some other run is tested.
        on_one_clock: As :meth:`Pair.of` takes it.

    Raises:
        DataError: There is nothing to compare, or the runs must not be pooled.
    """
    if not pairs:
        raise DataError("nothing to compare: 0 runs; expected at least 1 run with simulation and hardware")
    check_pairs(pairs)
    margins = Margins.parse(margin)
    compared = [Pair.of(*pair, on_one_clock=on_one_clock) for pair in pairs]
    tested = [pair for index, pair in enumerate(compared) if index not in shown]
    simulations = list(own) or [pair.simulation for pair in tested]
    hardware_runs = [pair.hardware for pair in tested]
    check_clocks(hardware_runs)
    differ = _may_differ(hardware_runs)
    names = "simulation", "emulated hardware" if all(map(is_emulated, hardware_runs)) else "hardware"
    ones, others = ([run.window for run in runs] for runs in (simulations, hardware_runs))
    noises = [_noise(run) for run in simulations], [_noise(run) for run in hardware_runs]
    unpaired = conclude(
        unpaired_tests(ones, others, margins, noises=noises, looks=looks, runs_differ=differ), margins, *names
    )
    verdict = unpaired
    unlike = next((pair.unlike_references for pair in compared if pair.unlike_references), "")
    if not unlike and all(pair.is_paired for pair in tested):
        motions = [pair.motions for pair in tested]
        shared = [_noise(pair.simulation) for pair in tested]
        tests = paired_tests(motions, margins, noises=shared, looks=looks, runs_differ=differ)
        verdict = conclude(tests, margins, *names)
    elif unlike := unlike or next((pair.unlike_noise for pair in compared if pair.unlike_noise), ""):
        sentence = f"Undecided: {unlike}, so the plants cannot be compared."
        verdict = Verdict(Outcome.UNDECIDED, sentence, unpaired.tests, margins, None)
    thesis = interpolated_difference(simulations[0].window, compared[0].hardware.window)
    return Comparison(compared, simulations, thesis, verdict, unpaired, tested, looks)


def _may_differ(hardware_runs: Sequence[RunData]) -> bool:
    """Return whether runs may differ by more than their seeds, as on a machine or in real time."""
    return not all(is_emulated(run) and is_in_lockstep(run) for run in hardware_runs)


def _noise(run: RunData) -> Disturbance | None:
    return Disturbance.of(run.disturbance, noise_hold_time(run))


def compare_joints(
    folders: Sequence[PathArgument],
    joints: Sequence[str],
    *,
    margin: MarginArgument = None,
    looks: Looks | None = None,
) -> dict[str, Comparison]:
    """Compare run folders joint by joint; ``joints`` holds one empty name for plants of one joint."""
    with CachedBags() as bags:
        more: dict[str, Any] = {"margin": margin, "looks": looks, **({"open_bag": bags} if any(joints) else {})}
        return {joint: compare_folders(folders, joint=joint or None, **more) for joint in joints}


def compare_folders(
    folders: Sequence[PathArgument],
    *,
    margin: MarginArgument = None,
    looks: Looks | None = None,
    joint: str | None = None,
    open_bag: OpenBag = read_bag,
) -> Comparison:
    """Compare and pool run folders, each with ``sim``, ``hw``, and perhaps ``sim_500hz`` and repeats of the run.

    Repeats in lockstep, where there are any, are tested alone: in real time the loops of plant and controller have a
    random phase in each run. Runs that a busy computer disturbed are left out.

    Args:
        margin: Acceptable difference; see :meth:`Margins.parse`.
        looks: Number of interim analyses; by default that of the folders.

    Raises:
        BagError: A folder lacks one of its bags.
        DataError: The runs must not be pooled.
    """
    margins = Margins.parse(margin)
    pairs: list[tuple[RunData, RunData]] = []
    own: list[RunData] = []
    left_out: list[str] = []
    stalls: list[dict[str, str]] = []
    shown: list[int] = []
    for folder in map(Path, folders):
        if broken := read_stalls(folder):
            stalls += [{"run": folder.resolve().name, **stall} for stall in broken]
            left_out.append(_in_words(broken))
        places = pair_folders(folder)
        for place in places:
            pair = _read_pair(place, joint, open_bag)
            busy = [
                f"{'emulated ' * is_emulated(run)}{run.label} missed {run.missed_deadlines} states"
                for run in pair
                if run.is_disturbed
            ]
            if place == folder and busy and len(places) > 1:
                left_out.append(
                    f"The run in real time does not count, because states are missing ({', '.join(busy)}). "
                    "It was repeated in lockstep, which does not depend on the computer's speed."
                )
            else:
                if place == folder and len(places) > 1 and is_emulated(pair[1]):
                    shown.append(len(pairs))
                    left_out.append(_PHASE)
                pairs.append(pair)
        if (folder / "sim_500hz").is_dir():
            own.append(read_own(folder / "sim_500hz", joint, open_bag))
    looked = looks or Looks(max(read_looks(Path(folder)) for folder in folders) if folders else 0)
    return replace(
        compare(pairs, own=own, margin=margins, looks=looked, shown=shown), left_out=tuple(left_out), stalls=stalls
    )


_PHASE = (
    "The run in real time is shown and not tested: its loops have a phase of their own. The tests rest on its repeats "
    "in lockstep, where the phase is fixed."
)


def _in_words(stalls: Sequence[Mapping[str, str]]) -> str:
    reasons = "; ".join(stall["reason"] + (f" (logs: {stall['logs']})" if stall["logs"] else "") for stall in stalls)
    runs, does, what = ("run", "does", "a standstill") if len(stalls) == 1 else ("runs", "do", "standstills")
    return (
        f"{len(stalls)} {runs} aborted before this one and {does} not count, taken for {what} of this machine: "
        f"{reasons}."
    )


def read_own(bag: PathArgument, joint: str | None, open_bag: OpenBag) -> RunData:
    """Return a simulation with noise of its own."""
    return read_run(bag, label="simulation, own noise", joint=joint, open_bag=open_bag)


def _read_pair(folder: Path, joint: str | None, open_bag: OpenBag) -> tuple[RunData, RunData]:
    for name in ("sim", "hw"):
        if not (folder / name).is_dir():
            raise BagError(f"run folder {folder} has no bag {name}; expected the folders sim and hw")
    return (
        read_run(folder / "sim", label="simulation", joint=joint, open_bag=open_bag),
        read_run(folder / "hw", label="hardware", joint=joint, open_bag=open_bag),
    )


_SUMS = ("missed_deadlines", "samples", "effective_samples", "duration_s", "damage")
_ROOTS_OF_SQUARES = ("rms_u", "rms_tracking_error")


def _pool(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    if len(rows) == 1:
        return dict(rows[0])
    counts = [row["samples"] for row in rows]
    pooled: dict[str, Any] = {}
    for key in dict.fromkeys(key for row in rows for key in row):
        values: list[Any] = [row.get(key) for row in rows]
        if None in values:
            pooled[key] = None
        elif key in _SUMS:
            pooled[key] = sum(values, type(values[0])())
        elif key == "max_abs_u":
            pooled[key] = max(values)
        elif key in _ROOTS_OF_SQUARES:
            pooled[key] = math.sqrt(_mean([one**2 for one in values], counts))
        elif key.startswith("std_"):
            pooled[key] = _pooled_std(values, [row[key.replace("std_", "mean_")] for row in rows], counts)
        elif key == "rate_hz":
            pooled[key] = _mean(values, [row["duration_s"] for row in rows])
        else:
            pooled[key] = _mean(values, counts)
    return pooled


def _mean(values: Sequence[float], weights: Sequence[float]) -> float:
    return math.fsum(value * weight for value, weight in zip(values, weights, strict=True)) / math.fsum(weights)


def _pooled_std(spreads: Sequence[float], means: Sequence[float], counts: Sequence[int]) -> float:
    """Return the standard deviation of all samples about their common mean."""
    middle = _mean(means, counts)
    squares = math.fsum(
        (count - 1) * spread**2 + count * (mean - middle) ** 2
        for spread, mean, count in zip(spreads, means, counts, strict=True)
    )
    return math.sqrt(squares / (sum(counts) - 1))
