"""Carry out a study: runs in parallel, each in a ROS domain of its own; resumed where it stopped."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.processes import Child, ProcessSet
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.results import read_record, write_outcome
from pendulum_bags.studies.study_file import Study, StudyRun
from pendulum_msgs_py.errors import BagError

__all__ = ["StudyProgress", "default_workers", "open_study_folder", "run_study"]

_POLL = 0.05
_LONGEST_FACTOR = 20.0
_LONGEST_EXTRA = 120.0
"""A run is given up after its expected time this often, and this much longer [s]."""


@dataclass
class StudyProgress:
    """Progress of a study; ``remaining`` is the expected time until its end [s]."""

    total: int
    done: int = 0
    failed: int = 0
    skipped: int = 0
    remaining: float = 0.0
    running: list[str] = field(default_factory=list)


def default_workers(study: Study) -> int:
    """Return how many runs to carry out at once: one in real time, else one more than cores, since nodes wait."""
    return 1 if study.realtime or any(run.lab for run in study.runs) else 1 + (os.cpu_count() or 1)


def open_study_folder(folder: Path, study: Study) -> Study:
    """Make the folder of a study, or check that an existing one holds this study, or a part of it.

    A study may grow by seeds, repeats, plants or other entries of its file; finished runs keep their numbers.

    Returns:
        The study, with the numbers of its runs in the folder.

    Raises:
        BagError: The folder holds something else, or runs that this study does not have.
    """
    stored = folder / "study.yaml"
    if not stored.is_file():
        if folder.exists() and any(folder.iterdir()):
            raise BagError(f"folder {folder} is not empty and holds no study; expected a new one")
        folder.mkdir(parents=True, exist_ok=True)
        _write_study(folder, study)
        return study
    known: dict[str, str] = json.loads((folder / "matrix.json").read_text(encoding="utf-8"))
    found = replace(study, runs=_renumbered(study.runs, known, folder))
    if _matrix(found) != known:
        _write_study(folder, found)
    return found


def _write_study(folder: Path, study: Study) -> None:
    write_json(folder / "matrix.json", _matrix(study))
    (folder / "study.yaml").write_text(study.text, encoding="utf-8")


def _renumbered(runs: Sequence[StudyRun], known: Mapping[str, str], folder: Path) -> tuple[StudyRun, ...]:
    """Give runs their numbers in a folder, by name, parts and order of repeats; new runs get the next ones."""
    numbers: dict[tuple[str, str], list[int]] = {}
    for name, fingerprint in sorted(known.items()):
        number, _, rest = name.partition("_")
        numbers.setdefault((rest, fingerprint), []).append(int(number))
    following = itertools.count(1 + max((number for group in numbers.values() for number in group), default=0))
    found = []
    for run in runs:
        before = numbers.get((run.name.partition("_")[2], run.fingerprint()), [])
        found.append(replace(run, number=before.pop(0) if before else next(following)))
    left = [(number, rest) for (rest, _), group in numbers.items() for number in group]
    if left:
        first, rest = min(left)
        raise BagError(
            f"folder {folder} holds runs of another study, or of another version of this one: run {first} ({rest}) is "
            "not in it as it was carried out (the files that it names included); expected the same, more runs, or a "
            "new folder"
        )
    return tuple(found)


def run_study(
    folder: Path,
    study: Study,
    *,
    workers: int,
    retry_failed: bool = False,
    on_progress: Callable[[StudyProgress], None] = lambda _: None,
    before_machine: Callable[[StudyRun], None] = lambda _: None,
) -> StudyProgress:
    """Carry out the remaining runs of a study in a folder of :func:`open_study_folder`; return the final progress.

    Args:
        retry_failed: Carry out failed runs again.
        before_machine: Called before each run that moves a real machine; what it raises ends the study, which resumes
            from there when restarted.
    """
    progress = StudyProgress(len(study.runs))
    waiting: list[StudyRun] = []
    for run in study.runs:
        record = read_record(folder, run)
        if record is None or (record["status"] == "failed" and retry_failed):
            waiting.append(run)
            continue
        progress.done += 1
        progress.skipped += 1
        progress.failed += record["status"] == "failed"
    pace = _Pace(waiting, workers)
    running: list[_Running] = []
    with (
        HostPool() as hosts,
        ProcessSet(folder / "logs", {}, hosts) as processes,
        ThreadPoolExecutor(1) as threads,
    ):
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    if waiting[0].lab:
                        before_machine(waiting[0])
                    running.append(_start(folder, waiting.pop(0), processes, threads))
                time.sleep(_POLL)
                for item in list(running):
                    outcome = item.outcome(processes)
                    if outcome is None:
                        continue
                    running.remove(item)
                    progress.done += 1
                    pace.learn(item.run, time.monotonic() - item.started)
                    progress.failed += bool(_record(item, outcome))
                progress.running = [item.run.name for item in running]
                progress.remaining = pace.remaining(waiting, [(item.run, item.started) for item in running])
                on_progress(progress)
        except BaseException:
            threads.shutdown(wait=False, cancel_futures=True)
            raise
    return progress


@dataclass
class _Running:
    run: StudyRun
    folder: Path
    started: float
    attempts: int
    child: Child | None = None
    job: Future[None] | None = None

    def outcome(self, processes: ProcessSet) -> str | None:
        """Return None while it runs, an empty string when it went well, else why it failed."""
        if self.job is not None:
            if not self.job.done():
                return None
            error = self.job.exception()
            return "" if error is None else f"{error}" or type(error).__name__
        assert self.child is not None
        code = self.child.process.poll()
        if code is None:
            allowed = _LONGEST_EXTRA + _LONGEST_FACTOR * self.run.seconds
            if time.monotonic() - self.started < allowed:
                return None
            processes.finish(self.child, 20.0)
            return f"did not end within {allowed:.0f} s: {self.child.last_words()}"
        if self.child in processes.children:
            processes.children.remove(self.child)
        return "" if code == 0 else self.child.last_words() or f"ended with code {code}"


def _start(folder: Path, run: StudyRun, processes: ProcessSet, threads: ThreadPoolExecutor) -> _Running:
    place = folder / "runs" / run.name
    before = read_record(folder, run)
    # Half a run, or a failed one to be retried.
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    item = _Running(run, place, time.monotonic(), 1 + (before or {}).get("attempts", 0))
    if run.spec is not None:
        write_json(place / "spec.json", run.spec.to_json())
    if run.engine == "process":
        item.job = threads.submit(_simulate, run, place)
        return item
    command = [sys.executable, "-m", "pendulum_bags", "experiment"]
    if run.spec is None:
        command += [*run.arguments, "--out", str(place / "run")]
        # Confirmed before: this process has no terminal.
        command += ["--yes"] if run.lab else []
    else:
        command += ["run", str(place / "spec.json"), "--bag", str(place / "bag")]
    # Each run finds a free domain of its own.
    environment = {"ROS_DOMAIN_ID": ""}
    # A machine, or an experiment of several runs, gets new processes.
    alone = run.spec is None or not run.spec.simulated_time
    item.child = processes.start(run.name, command, ends_by_itself=True, environment=environment, alone=alone)
    return item


def _simulate(run: StudyRun, place: Path) -> None:
    import numpy as np

    from pendulum_bags.experiments.in_process import simulate

    assert run.spec is not None
    arrays = simulate(run.spec)
    np.savez_compressed(place / "run.npz", **vars(arrays))


def _record(item: _Running, failure: str) -> str:
    """Store the outcome of a run; return the reason of a failure, also one of reading, or an empty string."""
    run = item.run
    return write_outcome(
        item.folder,
        run.spec,
        run.labels,
        failure,
        number=run.number,
        fingerprint=run.fingerprint(),
        engine=run.engine,
        attempts=item.attempts,
        wall_s=round(time.monotonic() - item.started, 3),
        simulated_s=run.spec.duration if run.spec else None,
    )


class _Pace:
    """Expected remaining time, corrected by measured durations."""

    def __init__(self, runs: list[StudyRun], workers: int) -> None:
        self._workers = max(1, min(workers, len(runs) or 1))
        self._expected = self._taken = 0.0

    def learn(self, run: StudyRun, seconds: float) -> None:
        self._expected += run.seconds
        self._taken += seconds

    def remaining(self, waiting: list[StudyRun], running: list[tuple[StudyRun, float]]) -> float:
        factor = self._taken / self._expected if self._expected else 1.0
        now = time.monotonic()
        left = factor * sum(run.seconds for run in waiting)
        left += sum(max(0.0, factor * run.seconds - (now - started)) for run, started in running)
        return left / self._workers


def _matrix(study: Study) -> dict[str, str]:
    return {run.name: run.fingerprint() for run in study.runs}
