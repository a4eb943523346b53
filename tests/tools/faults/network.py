"""A plant and its controller on two machines, as far as the network can tell, and a cable that is pulled."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pendulum_bags.experiments.processes import ProcessSet, ros_environment, start_recorder
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import FaultError, PendulumError
from pendulum_msgs_py.programs import graph
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.bag_property import COMMAND_LIFE
from tests.tools.faults.slow_cable import DEVICE, SlowCable

__all__ = [
    "PEER_ADDRESS",
    "PLANT_ADDRESS",
    "CutReport",
    "Inside",
    "cable_environment",
    "cut_cable",
    "two_machines",
    "wait_for_torque",
    "why_not",
]

_EFFORT_LIMIT = 5.0
_START_TIMEOUT = 60.0
_PLANT, _PEER = "plant", "peer"
_SUBNET = "10.213.7"
PLANT_ADDRESS, PEER_ADDRESS = f"{_SUBNET}.1", f"{_SUBNET}.2"


@dataclass(frozen=True)
class CutReport:
    """What a cut of the network did.

    Attributes:
        duration: How long the cable was out [s].
        time_to_zero: From the last command to the last torque that was not zero [s].
        time_to_return: From plugging it in again to torque [s].
        largest: Largest torque [N m].
    """

    duration: float
    time_to_zero: float
    time_to_return: float
    largest: float


def why_not() -> str:
    """Return why no network can be made here, empty where one can."""
    if os.geteuid() != 0:
        return "making network namespaces needs root"
    if shutil.which("ip") is None:
        return "making network namespaces needs iproute2"
    probe = f"pendulum_probe_{os.getpid()}"
    if _ip("netns", "add", probe, check=False):
        return "this machine does not permit network namespaces"
    _ip("netns", "del", probe, check=False)
    return ""


def _ip(*arguments: str, check: bool = True) -> int:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if check and done.returncode:
        raise FaultError(f"ip {' '.join(arguments)} failed: {done.stderr.strip()}")
    return done.returncode


@contextmanager
def two_machines(*, slow: bool = False) -> Iterator[tuple[str, str, SlowCable | None]]:
    """Make two network namespaces joined by one cable; yields their names and the cable, where it can be slow.

    Args:
        slow: Make it a cable that delays and loses frames when told to.
    """
    names = (f"pendulum_{_PLANT}_{os.getpid()}", f"pendulum_{_PEER}_{os.getpid()}")
    with ExitStack() as stack:
        for name in names:
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "del", name, check=False)
        cable = None
        if slow:
            cable = stack.enter_context(SlowCable(names))
        else:
            _ip("link", "add", DEVICE, "netns", names[0], "type", "veth", "peer", "name", DEVICE, "netns", names[1])
        for number, name in enumerate(names, start=1):
            _ip("-n", name, "address", "add", f"{_SUBNET}.{number}/24", "dev", DEVICE)
            for device in ("lo", DEVICE):
                _ip("-n", name, "link", "set", device, "up")
            # Discovery is by multicast, which wants a route.
            _ip("-n", name, "route", "add", "224.0.0.0/4", "dev", DEVICE)
        yield names[0], names[1], cable


def _inside(namespace: str, command: Sequence[str]) -> list[str]:
    return ["ip", "netns", "exec", namespace, *command]


class Inside(ProcessSet):
    """Programs that start in a network namespace."""

    namespace = ""

    def start(self, name, command, **options):
        return super().start(name, _inside(self.namespace, command), **options)


def cable_environment(logs: Path, static_peer: str = "") -> dict[str, str]:
    """Return the environment of nodes that meet over a cable and nothing else.

    Args:
        logs: Folder of the logs.
        static_peer: Address of the other machine, for discovery without multicast that is closed to all others; empty
            for the whole subnet.
    """
    discovery = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    if static_peer:
        discovery = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": static_peer}
    return {**ros_environment(1, logs), **discovery}


def cut_cable(folder: Path, durations: Sequence[float]) -> list[CutReport]:
    """Regulate upright over the cable, pull it for each duration, and report from the plant's own bag.

    Args:
        folder: For logs and the bag.
        durations: How long the cable is out [s].

    Raises:
        FaultError: The network cannot be made, or torque does not come (back).
    """
    logs = folder / "logs"
    bag = folder / "bag"
    write_json(folder / "metadata.json", {"pendulum.run": {"experiment": "network"}})
    cuts = []
    processes = Inside(logs, cable_environment(logs))
    with two_machines() as (plant, peer, _), processes:
        processes.namespace = plant
        start_recorder(processes, bag, "/sim", folder / "metadata.json", "mcap")
        processes.start_node(
            graph.simulator("/sim", initial_theta=math.pi, effort_limit=_EFFORT_LIMIT, start_effort_limit=0.0)
        )
        processes.namespace = peer
        for program in (graph.controller("/sim"), graph.disturbance("/sim", autostart=True, hold_time=0.01)):
            processes.start_node(program)
        wait_for_torque(bag, processes, time.time_ns())
        for duration in durations:
            time.sleep(1.0)
            pulled_ns = time.time_ns()
            _ip("-n", plant, "link", "set", DEVICE, "down")
            time.sleep(duration)
            plugged_ns = time.time_ns()
            _ip("-n", plant, "link", "set", DEVICE, "up")
            _ip("-n", plant, "route", "add", "224.0.0.0/4", "dev", DEVICE)
            wait_for_torque(bag, processes, plugged_ns)
            cuts.append((duration, pulled_ns, plugged_ns))
    return [_report(bag, *cut) for cut in cuts]


def wait_for_torque(bag: Path, processes: ProcessSet, since_ns: int) -> None:
    """Wait until a command and a torque that is not zero are in the bag, both after a time."""
    deadline = time.monotonic() + _START_TIMEOUT
    while time.monotonic() < deadline:
        processes.check()
        try:
            with read_bag(bag, ["/sim/applied_effort", "/sim/effort_command"]) as opened:
                applied, commands = opened.array("/sim/applied_effort"), opened.log_times("/sim/effort_command")
        except PendulumError:  # not yet there
            pass
        else:
            driven = applied["log_time_ns"][applied["effort"] != 0.0]
            if min(np.max(driven, initial=0), np.max(commands, initial=0)) > since_ns:
                return
        time.sleep(0.5)
    raise FaultError(f"no torque within {_START_TIMEOUT} s; see {processes.log_folder}")


def _report(bag: Path, duration: float, pulled_ns: int, plugged_ns: int) -> CutReport:
    with read_bag(bag) as opened:
        applied = opened.array("/sim/applied_effort")
        commands = opened.array("/sim/effort_command")
    # By the plant's own clock, on which a command has the stamp of the state that it answers: a recorder that is kept
    # waiting adds nothing.
    times, efforts = applied["stamp_ns"], applied["effort"]
    last = int(commands["stamp_ns"][commands["log_time_ns"] < plugged_ns][-1])
    during = (times > max(last, pulled_ns)) & (times < plugged_ns) & (efforts != 0.0)
    back = times[(times > plugged_ns) & (efforts != 0.0)]
    return CutReport(
        duration=duration,
        time_to_zero=float((times[during][-1] - last) * 1e-9) if during.any() else 0.0,
        time_to_return=float((back[0] - plugged_ns) * 1e-9),
        largest=float(np.max(np.abs(efforts))),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Cut the cable for 1 s and for 30 s: ``python -m tests.tools.faults.network [SECONDS ...]``."""
    import tempfile

    given = list(sys.argv[1:] if argv is None else argv)
    reason = why_not()
    if reason:
        sys.stdout.write(f"not tried: {reason}\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="pendulum_network_") as folder:
        reports = cut_cable(Path(folder), [float(text) for text in given] or [1.0, 30.0])
    for report in reports:
        sys.stdout.write(
            f"cable out for {report.duration:g} s: zero torque {report.time_to_zero * 1e3:.0f} ms after the last "
            f"command (at most {COMMAND_LIFE * 1e3:.0f} ms), torque again after {report.time_to_return:.2f} s, "
            f"at most {report.largest:.2f} N m\n"
        )
    sound = all(report.time_to_zero <= COMMAND_LIFE and report.largest <= _EFFORT_LIMIT for report in reports)
    return 0 if sound else 1


if __name__ == "__main__":
    raise SystemExit(main())
