"""Folders that cannot be written and memory that is too small: said in a sentence, and what was sealed is kept."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.orchestrator_node import Orchestrator, RecorderClient
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.ros import qos
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.outcome import Outcome, Trial

__all__ = ["RESOURCE_TRIALS", "recorder_cannot_begin", "recorder_runs_out_of_memory"]

_TOPIC = "/sim/joint_states"
_NOISE_TOPIC = "/sim/noise"
_TIMEOUT = 60.0
_SHORT_OF_MEMORY = ("memory is exhausted", "is limited to", "bad_alloc", "Resource temporarily unavailable")
"""What a program says that is short of memory: ours, the C++ library, the middleware that ends its process."""
_ENOUGH = 100
"""States in a bag before the fault comes."""


def why_not_read_only() -> str:
    """Return why no folder can be made read-only here, empty where one can."""
    if os.geteuid() != 0:
        return ""
    done = subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False)
    return "this machine does not permit mounting" if done.returncode else ""


@contextmanager
def _read_only(folder: Path) -> Iterator[Path]:
    """Make a folder that nobody can write to; root needs a mount for that."""
    folder.mkdir()
    root = os.geteuid() == 0
    if root:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", str(folder)], check=True)
    else:
        folder.chmod(0o555)
    try:
        yield folder
    finally:
        if root:
            subprocess.run(["umount", "-l", str(folder)], check=True)
        else:
            folder.chmod(0o755)


@contextmanager
def _frozen(folder: Path) -> Iterator[None]:
    """Let nothing be made, renamed or removed in a folder; files that are open stay writable."""
    root = os.geteuid() == 0
    thaw: Callable[[], object]
    if root:
        subprocess.run(["chattr", "+i", str(folder)], check=True)
        thaw = lambda: subprocess.run(["chattr", "-i", str(folder)], check=True)  # noqa: E731
    else:
        folder.chmod(0o555)
        thaw = lambda: folder.chmod(0o755)  # noqa: E731
    try:
        yield
    finally:
        thaw()


def why_not_frozen() -> str:
    """Return why no folder can be frozen here, empty where one can."""
    if os.geteuid() != 0:
        return ""
    probe = Path(f"/tmp/pendulum_frozen_{os.getpid()}")
    probe.mkdir()
    try:
        done = subprocess.run(["chattr", "+i", str(probe)], capture_output=True, check=False)
        subprocess.run(["chattr", "-i", str(probe)], capture_output=True, check=False)
        return "this file system has no immutable folders" if done.returncode else ""
    finally:
        probe.rmdir()


def _demand_sentence(outcome: Outcome, what: str, code: int | None, words: str, *expected: str) -> None:
    outcome.demand(code not in (0, None), f"{what} ended with code {code}")
    outcome.demand("Traceback" not in words, f"{what} printed a traceback: {words[-300:]}")
    flat = "".join(words.split()).lower()
    found = any("".join(text.split()).lower() in flat for text in expected)
    outcome.demand(found, f"{what} said {words[-300:]!r}; expected {' or '.join(expected)}")


def _run(*arguments: str, memory: int | None = None) -> tuple[int | None, str]:
    """Run a program of pendulum_bags, with a limit on its address space if wanted [bytes]."""

    def limit() -> None:
        if memory is not None:
            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))

    try:
        done = subprocess.run(
            [sys.executable, "-m", "pendulum_bags", *arguments],
            capture_output=True,
            text=True,
            timeout=2 * _TIMEOUT,
            check=False,
            preexec_fn=limit,
        )
    except subprocess.TimeoutExpired:
        return None, "nothing: it did not end"
    return done.returncode, done.stdout + done.stderr


def recorder_cannot_begin(folder: Path) -> Outcome:
    """Start a recorder and experiments into a folder that is read-only."""
    outcome = Outcome()
    with _read_only(folder / "locked") as locked:
        for what, arguments in (
            ("recorder", ("record", "-o", str(locked / "bag"))),
            ("experiment lockstep", ("experiment", "lockstep", "--bag", str(locked / "bag"), "--duration", "1")),
            ("experiment thesis", ("experiment", "thesis", "--out", str(locked / "run"))),
        ):
            code, words = _run(*arguments)
            _demand_sentence(outcome, what, code, words, "read-only file system", "permission denied")
            outcome.demand(str(locked) in words.replace("\n", ""), f"{what} does not name the folder: {words[-200:]}")
    return outcome


@contextmanager
def _recording(folder: Path) -> Iterator[tuple[Orchestrator, ProcessSet, Child, Path]]:
    """Run a recorder in a domain of its own, with nobody else."""
    logs, bag = folder / "logs", folder / "bag"
    write_json(folder / "metadata.json", {"pendulum.run": {"experiment": "faults"}})
    with (
        reserve_domain() as domain,
        ProcessSet(logs, ros_environment(domain, logs)) as processes,
        Orchestrator(domain) as orchestrator,
    ):
        child = start_recorder(processes, bag, "/sim", folder / "metadata.json", "mcap")
        yield orchestrator, processes, child, bag


def _record_some(orchestrator: Orchestrator, bag: Path) -> tuple[Publisher, int]:
    """Publish states until some are in the bag; return the publisher, and how many are sealed."""
    publisher = orchestrator.node.create_publisher(JointState, _TOPIC, qos.STATE)
    recorder = RecorderClient(orchestrator, "/sim")
    recorder.wait_until_heard([_TOPIC], _TIMEOUT)
    deadline = time.monotonic() + _TIMEOUT
    while (sealed := _states_in(bag)) < _ENOUGH and time.monotonic() < deadline:
        for _ in range(50):
            _publish_state(orchestrator, publisher)
    return publisher, sealed


def _publish_state(orchestrator: Orchestrator, publisher: Publisher) -> None:
    publisher.publish(encode_joint_state(time.time_ns(), position=3.1, velocity=0.0, effort=0.1))
    orchestrator.listen(0.002)


def _states_in(bag: Path) -> int:
    with read_bag(bag) as opened:
        return opened.topics[_TOPIC].count if _TOPIC in opened else 0


def recorder_loses_its_folder(folder: Path) -> Outcome:
    """Take the right to write to its folder from a recorder that runs, and end it."""
    outcome = Outcome(lost=0.0)
    with _recording(folder) as (orchestrator, processes, child, bag):
        publisher, sealed = _record_some(orchestrator, bag)
        with _frozen(bag):
            deadline = time.monotonic() + 5.0
            while child.process.poll() is None and time.monotonic() < deadline:
                _publish_state(orchestrator, publisher)
            # A recorder that had no reason to look at its folder finds out at its end.
            code = processes.finish(child, _TIMEOUT)
        _demand_sentence(outcome, "recorder", code, child.last_words(6), "operation not permitted", "permission denied")
        kept = _states_in(bag)
        outcome.demand(kept >= sealed >= _ENOUGH, f"{kept} states in the bag, {sealed} were sealed")
        outcome.detail = outcome.detail or child.last_words(1)[-80:]
    return outcome


def recorder_runs_out_of_memory(folder: Path, headroom: int = 48 << 20) -> Outcome:
    """Give a running recorder little more memory than it has, and much to record.

    Args:
        folder: For logs and the bag.
        headroom: What it may take beyond what it has [bytes].
    """
    outcome = Outcome(lost=0.0)
    with _recording(folder) as (orchestrator, _, child, bag):
        _, sealed = _record_some(orchestrator, bag)
        pages = int(Path(f"/proc/{child.process.pid}/statm").read_text(encoding="ascii").split()[0])
        limit = pages * os.sysconf("SC_PAGE_SIZE") + headroom
        resource.prlimit(child.process.pid, resource.RLIMIT_AS, (limit, limit))
        publisher = orchestrator.node.create_publisher(String, _NOISE_TOPIC, qos.DIAGNOSTICS)
        message = String(data="x" * (8 << 20))
        deadline = time.monotonic() + _TIMEOUT
        while child.process.poll() is None and time.monotonic() < deadline:
            publisher.publish(message)
            orchestrator.listen(0.002)
        _demand_sentence(outcome, "recorder", child.process.poll(), child.log.read_text(), *_SHORT_OF_MEMORY)
        kept = _states_in(bag)
        outcome.demand(kept >= sealed >= _ENOUGH, f"{kept} states in the bag, {sealed} were sealed")
        outcome.detail = outcome.detail or f"ended by itself; {kept} states in the bag, {sealed} were sealed"
    return outcome


def experiment_has_little_memory(folder: Path) -> Outcome:
    """Start an experiment with too little memory for its libraries, and with too little for its programs."""
    outcome = Outcome()
    for megabytes in (100, 250, 400):
        bag = folder / f"run_{megabytes}"
        code, words = _run("experiment", "lockstep", "--bag", str(bag), "--duration", "1", memory=megabytes << 20)
        _demand_sentence(outcome, f"experiment in {megabytes} MB", code, words, *_SHORT_OF_MEMORY)
    return outcome


RESOURCE_TRIALS: tuple[Trial, ...] = (
    Trial("recorder, experiments: read-only folder", lambda f, _: recorder_cannot_begin(f), why_not_read_only),
    Trial("recorder: folder becomes read-only", lambda f, _: recorder_loses_its_folder(f), why_not_frozen),
    Trial("recorder: memory limit", lambda folder, _: recorder_runs_out_of_memory(folder)),
    Trial("experiment: memory limit", lambda folder, _: experiment_has_little_memory(folder)),
)
