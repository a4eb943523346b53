"""The emulated hardware's recordings in lockstep, made one after the other by one program in the background."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from pendulum_bags.experiments.deadline import NEVER, Deadline
from pendulum_bags.experiments.host_pool import open_pool
from pendulum_bags.experiments.lockstep import longest_run
from pendulum_bags.experiments.processes import Child, ProcessSet
from pendulum_bags.experiments.repeats import record_spec
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import FaultError, PlantStoppedError

__all__ = ["Machine", "MachineRun", "record_listed"]

_ENDED = "ended: "
"""Start of the program's line at the end of a run: its bag, and why it failed, as JSON."""
_HOLD, _BUSY = "hold", "busy"
"""Files that ask the program not to begin a run, and that exist while it records one."""
_POLL = 0.05
_ENDING = 25.0
"""Time for the program to end its own, in two waves [s]."""


class MachineRun(NamedTuple):
    """One recording: its bag and its run."""

    bag: Path
    spec: RunSpec


class Machine:
    """The recordings of a machine, in the order in which they are needed; leaving the context ends their program."""

    def __init__(self, folder: Path, runs: Sequence[MachineRun]) -> None:
        self.runs = runs
        self._processes = ProcessSet(folder / "logs" / "machine", {})
        self._child: Child | None = None
        self._interrupted = False
        self._hold, self._busy = (folder / "logs" / "machine" / name for name in (_HOLD, _BUSY))
        self._read, self._ends = 0, dict[str, tuple[bool, str]]()

    def __enter__(self) -> Machine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.interrupt()
        if kind is KeyboardInterrupt and self._child is not None:
            # No hardware moves: a second interrupt ends it at once.
            with suppress(ProcessLookupError):
                os.killpg(self._child.process.pid, signal.SIGKILL)
        if self._child is not None:
            # A kill would leave its own programs.
            with suppress(FaultError):
                self._processes.wait(self._child, _ENDING)
        self._processes.stop()

    def interrupt(self) -> None:
        """Ask the program to end; leaving the context waits for that."""
        if self._child is not None and not self._interrupted:
            self._interrupted = True
            self._child.process.send_signal(signal.SIGINT)

    def start(self) -> None:
        """Start to record at the lowest priority."""
        if not self.runs:
            return
        self._processes.__enter__()
        listed = self._processes.log_folder / "runs.json"
        self._busy.unlink(missing_ok=True)
        write_json(listed, [{"bag": str(run.bag.resolve()), "spec": run.spec.to_json()} for run in self.runs])
        command = [sys.executable, "-m", "pendulum_bags", "experiment", "run", str(listed)]
        self._child = self._processes.start(
            "machine", command, ends_by_itself=True, niceness=5, environment={"ROS_DOMAIN_ID": ""}
        )

    def discard(self) -> None:
        """End the program, and remove its recordings."""
        self._processes.stop()
        self._child, self._read = None, 0
        self._ends.clear()
        for run in self.runs:
            shutil.rmtree(run.bag, ignore_errors=True)

    def rests(self) -> bool:
        """Let no run begin before :meth:`resume`; return whether none is being recorded."""
        if self._child is None or self._child.process.poll() is not None:
            return True
        self._hold.touch()
        return not self._busy.exists()

    def resume(self) -> None:
        """Record the remaining runs, or start if nothing was started."""
        if self._child is None:
            self.start()
        self._hold.unlink(missing_ok=True)

    def wait(self, bag: Path, deadline: Deadline = NEVER) -> None:
        """Wait until a bag of the runs is recorded.

        Raises:
            BudgetSpentError: It is not recorded by the deadline.
            PlantStoppedError: The plant stopped under its controller.
            FaultError: It could not be recorded, or not in time.
        """
        (run,) = (run for run in self.runs if run.bag == bag)
        latest = time.monotonic() + longest_run(sum(one.spec.duration for one in self.runs))
        while (ended := self._ended(run.bag)) is None:
            if self._child is None or time.monotonic() > latest:
                raise FaultError(f"bag {bag} was not recorded in time")
            if (code := self._child.process.poll()) is not None and self._ended(run.bag) is None:
                words = self._child.last_words(1)
                output = "" if words.startswith(_ENDED) or not words else f"; its last output: {words}"
                raise FaultError(f"bag {bag} was not recorded: its program ended with code {code}{output}")
            deadline.require()
            time.sleep(_POLL)
        stopped, reason = ended
        if stopped:
            raise PlantStoppedError(run.spec.namespace, "fault", reason)
        if reason:
            raise FaultError(reason)

    def _ended(self, bag: Path) -> tuple[bool, str] | None:
        if self._child is not None:
            with self._child.log.open("rb") as log:
                log.seek(self._read)
                *lines, rest = log.read().split(b"\n")
                self._read = log.tell() - len(rest)
            for line in (one.decode(errors="replace") for one in lines):
                if line.startswith(_ENDED):
                    name, stopped, reason = json.loads(line.removeprefix(_ENDED))
                    self._ends[name] = bool(stopped), str(reason)
        return self._ends.get(str(bag.resolve()))


def record_listed(listed: Path) -> None:
    """Record the runs of a JSON list (bag and run of each) one after the other, and print how each ended."""
    hold, busy = (listed.with_name(name) for name in (_HOLD, _BUSY))
    with open_pool() as hosts:
        for entry in json.loads(listed.read_text(encoding="utf-8")):
            # Each side writes its own file before it reads the other's: no run begins while it is held.
            busy.touch()
            while hold.exists():
                busy.unlink(missing_ok=True)
                time.sleep(_POLL)
                busy.touch()
            stopped, reason = False, ""
            try:
                record_spec(Path(entry["bag"]), RunSpec.from_json(entry["spec"]), hosts=hosts)
            except FaultError as error:
                stopped, reason = isinstance(error, PlantStoppedError), str(error)
            print(_ENDED + json.dumps([entry["bag"], stopped, reason]), flush=True)
            busy.unlink(missing_ok=True)
