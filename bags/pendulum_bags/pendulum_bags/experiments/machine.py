"""The emulated hardware's recordings in lockstep: one program makes them, one after the other, while others compute."""

from __future__ import annotations

import json
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from pendulum_bags.experiments.host_pool import open_pool
from pendulum_bags.experiments.lockstep import longest_run
from pendulum_bags.experiments.processes import Child, ProcessSet
from pendulum_bags.experiments.repeats import record_spec
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import FaultError, PlantStoppedError

__all__ = ["Machine", "MachineRun", "record_listed"]

_ENDED = "ended: "
"""Begins the line that the program prints when a run has ended: its bag, and why it failed, as JSON."""
_POLL = 0.05
_ENDING = 25.0
"""Time that the program has to end its own, in two waves [s]."""


class MachineRun(NamedTuple):
    """One recording: where it goes, and what it is of."""

    bag: Path
    spec: RunSpec


class Machine:
    """The recordings of a machine, in the order in which they are needed; leaving the context ends their program.

    Args:
        folder: The run's folder.
        runs: The recordings.
    """

    def __init__(self, folder: Path, runs: Sequence[MachineRun]) -> None:
        self.runs = runs
        self._processes = ProcessSet(folder / "logs" / "machine", {})
        self._child: Child | None = None
        self._interrupted = False

    def __enter__(self) -> Machine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.interrupt()
        if self._child is not None:
            # It ends programs of its own, which a kill would leave behind.
            with suppress(FaultError):
                self._processes.wait(self._child, _ENDING)
        self._processes.stop()

    def interrupt(self) -> None:
        """Ask the program to end; leaving the context waits for that."""
        # Once: a second signal would interrupt its end.
        if self._child is not None and not self._interrupted:
            self._interrupted = True
            self._child.process.send_signal(signal.SIGINT)

    def start(self) -> None:
        """Start to record, behind all other programs of this computer."""
        if not self.runs:
            return
        self._processes.__enter__()
        listed = self._processes.log_folder / "runs.json"
        write_json(listed, [{"bag": str(run.bag.resolve()), "spec": run.spec.to_json()} for run in self.runs])
        command = [sys.executable, "-m", "pendulum_bags", "experiment", "run", str(listed)]
        # In a domain of its own, whichever the experiment has.
        self._child = self._processes.start(
            "machine", command, ends_by_itself=True, niceness=5, environment={"ROS_DOMAIN_ID": ""}
        )

    def discard(self) -> None:
        """End the program, and remove what it has recorded."""
        self._processes.stop()
        for run in self.runs:
            shutil.rmtree(run.bag, ignore_errors=True)

    def wait(self, bag: Path) -> None:
        """Wait until a bag is recorded.

        Raises:
            PlantStoppedError: The plant stopped, because its controller lost it.
            FaultError: It could not be recorded, or not in time.
        """
        (run,) = (run for run in self.runs if run.bag == bag)
        deadline = time.monotonic() + longest_run(sum(one.spec.duration for one in self.runs))
        while (ended := self._ended(run.bag)) is None:
            if self._child is None or time.monotonic() > deadline:
                raise FaultError(f"bag {bag} was not recorded in time")
            if (code := self._child.process.poll()) is not None and self._ended(run.bag) is None:
                words = self._child.last_words(1)
                output = "" if words.startswith(_ENDED) or not words else f"; its last output: {words}"
                raise FaultError(f"bag {bag} was not recorded: its program ended with code {code}{output}")
            time.sleep(_POLL)
        stopped, reason = ended
        if stopped:
            raise PlantStoppedError(run.spec.namespace, "fault", reason)
        if reason:
            raise FaultError(reason)

    def _ended(self, bag: Path) -> tuple[bool, str] | None:
        """Return whether the plant stopped and why, with no reason for a bag that is whole; None for none yet."""
        if self._child is None:
            return None
        for line in self._child.log.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
            if line.startswith(_ENDED) and line.endswith("\n"):
                name, stopped, reason = json.loads(line.removeprefix(_ENDED))
                if name == str(bag.resolve()):
                    return bool(stopped), str(reason)
        return None


def record_listed(listed: Path) -> None:
    """Record the runs of a list one after the other, and print how each has ended.

    Args:
        listed: JSON file with the bag and the run of each.
    """
    with open_pool() as hosts:
        for entry in json.loads(listed.read_text(encoding="utf-8")):
            stopped, reason = False, ""
            try:
                record_spec(Path(entry["bag"]), RunSpec.from_json(entry["spec"]), hosts=hosts)
            except FaultError as error:
                stopped, reason = isinstance(error, PlantStoppedError), str(error)
            print(_ENDED + json.dumps([entry["bag"], stopped, reason]), flush=True)
