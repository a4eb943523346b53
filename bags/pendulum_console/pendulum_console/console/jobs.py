"""Programs that the console starts, and that end with it: a recorder, an experiment, a controller."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pendulum_bags.experiments.bound_process import start_bound_process
from pendulum_msgs_py.errors import FaultError

__all__ = ["Job", "Jobs", "NewestPage"]

_PATIENCE = 10.0


@dataclass
class Job:
    """One started program: times in [s of the monotonic clock], ``ended`` None while it runs."""

    kind: str
    folder: Path
    process: subprocess.Popen[bytes]
    log: Path
    started: float
    ended: float | None = None

    @property
    def running(self) -> bool:
        """Whether it still runs."""
        return self.process.poll() is None

    def describe(self) -> str:
        """Return its status: state, time, size of its files, its last line."""
        running = self.running
        if not running and self.ended is None:
            self.ended = time.monotonic()
        seconds = (self.ended or time.monotonic()) - self.started
        files = [path for path in self.folder.rglob("*") if path.is_file()] if self.folder.is_dir() else []
        size = sum(path.stat().st_size for path in files) / 1e6
        code = self.process.returncode
        state = "running" if running else "ended" if code == 0 else f"ended with code {code}"
        wrote = f" · {size:.1f} MB in {self.folder.name}" if files else ""
        line = self.last_line()
        return f"{state} · {seconds:.0f} s{wrote}" + (f" · {line}" if line else "")

    def last_line(self) -> str:
        """Return the last line of its output."""
        text = self.log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return lines[-1] if lines else ""


class Jobs:
    """At most one program of each kind at a time, each with a folder of its own in ``runs``."""

    def __init__(self, runs: Path) -> None:
        self.runs = runs
        self._jobs: dict[str, Job] = {}

    def __getitem__(self, kind: str) -> Job | None:
        """Return the newest program of a kind."""
        return self._jobs.get(kind)

    def newest(self, page: str) -> Path | None:
        """Return the run folder with the newest page of a name; None if there is none."""
        found = [path for path in self.runs.glob(f"*/{page}") if path.is_file()]
        return max(found, key=lambda path: path.stat().st_mtime).parent if found else None

    def record(self) -> Job:
        """Record all plants and their nodes into one bag."""
        arguments = ["record", "--exclude", "^/(parameter_events|rosout)$"]
        return self._start("record", arguments, "-o", os.environ)

    def experiment(self, seed: int) -> Job:
        """Run the thesis's experiment in a ROS domain of its own; its folder gets a report."""
        # Another domain: plants have the same names.
        environment = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
        return self._start("experiment", ["experiment", "thesis", "--seed", str(seed)], "--out", environment)

    def move(self, namespace: str, goal: str) -> Job:
        """Bring the plant of a namespace ``upright`` or ``down``."""
        return self._start(f"move{namespace}", ["move", goal, "--namespace", namespace], "", os.environ)

    def control(self, namespace: str, kind: str, plant: str) -> Job:
        """Start a plant's controller, inactive, for a preset or plant file (empty for the controller's default)."""
        given = {"controller": kind, **({"plant": plant} if plant else {}), "autoactivate": "false"}
        arguments = ["controller", "--ros-args", "-r", f"__ns:={namespace or '/'}"]
        arguments += [item for name, value in given.items() for item in ("-p", f"{name}:={value}")]
        return self._start(f"control{namespace}", arguments, "", os.environ, package="pendulum_lqr")

    def disturb(self, namespace: str) -> Job:
        """Start a plant's disturbance node, inactive."""
        arguments = ["disturbance", "--ros-args", "-r", f"__ns:={namespace or '/'}"]
        return self._start(f"disturb{namespace}", arguments, "", os.environ, package="pendulum_lqr")

    def _start(
        self,
        kind: str,
        arguments: list[str],
        option: str,
        environment: os._Environ[str] | dict[str, str],
        package: str = "pendulum_bags",
    ) -> Job:
        job = self._jobs.get(kind)
        if job is not None and job.running:
            raise FaultError(f"{kind} runs already, into {job.folder}; expected it to end first")
        self.runs.mkdir(parents=True, exist_ok=True)
        folder = self.runs / f"{time.strftime('%Y-%m-%dT%H-%M-%SZ', time.gmtime())}_console_{kind.replace('/', '_')}"
        log = folder.with_suffix(".log")
        command = [sys.executable, "-m", package, *arguments, *([option, str(folder)] if option else [])]
        with log.open("wb") as sink:
            process = start_bound_process(command, environment=environment, output=sink)
        self._jobs[kind] = Job(kind, folder, process, log, time.monotonic())
        return self._jobs[kind]

    def stop(self, kind: str) -> str:
        """End a program as Ctrl-C does and return its last line."""
        job = self._jobs.get(kind)
        if job is None:
            return f"no {kind} was started here"
        if job.running:
            job.process.send_signal(signal.SIGINT)
            try:
                job.process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                job.process.kill()
                job.process.wait()
        return job.last_line()

    def close(self) -> None:
        """End all programs."""
        for kind in list(self._jobs):
            self.stop(kind)


class NewestPage:
    """The newest page of a name; ``folder`` is its run folder or None, ``written`` the system time of writing [s]."""

    def __init__(self, jobs: Jobs, page: str) -> None:
        self._jobs = jobs
        self._page = page
        self.folder: Path | None = None
        self.written = 0.0

    def changed(self) -> bool:
        """Poll the folder; return whether the page changed since the last poll."""
        before = self.folder, self.written
        self.folder = self._jobs.newest(self._page)
        self.written = (self.folder / self._page).stat().st_mtime if self.folder is not None else 0.0
        return before != (self.folder, self.written)
