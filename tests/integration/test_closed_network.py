"""Who is let in: this machine alone, unless somebody opens the network."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import psutil
import pytest

from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.ros import middleware
from pendulum_msgs_py.ros.middleware import check_closed, middleware_defaults, participant_number
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.tools.faults.network import PLANT_ADDRESS, two_machines, why_not

_FAST = "rmw_fastrtps_cpp"
_ROS_VARIABLES = (
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
)


@pytest.mark.parametrize("asked", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, {"ROS_LOCALHOST_ONLY": "1"}])
def test_a_network_that_nobody_opened_is_closed(asked: dict[str, str]) -> None:
    added = middleware_defaults(asked, _FAST)
    assert Path(added["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()
    assert added["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    assert added.get("ROS_LOCALHOST_ONLY", "0") == "0"
    # A program that we start has both in its environment, and stays closed.
    child = {**asked, **added}
    assert child == {**child, **middleware_defaults(child, _FAST)}
    # Unless it is told to open itself.
    opened = middleware_defaults({**child, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, _FAST)
    assert opened["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SUBNET"
    assert opened["FASTRTPS_DEFAULT_PROFILES_FILE"] == ""
    # And what an open one starts can be closed again.
    closed = middleware_defaults({**child, **opened, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, _FAST)
    assert closed.items() <= added.items()
    assert closed["FASTRTPS_DEFAULT_PROFILES_FILE"]


@pytest.mark.parametrize(
    ("asked", "range_"),
    [
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "192.0.2.1"}, "LOCALHOST"),
        ({"FASTRTPS_DEFAULT_PROFILES_FILE": "/mine.xml"}, "LOCALHOST"),
    ],
)
def test_what_the_user_asked_for_is_left_alone(asked: dict[str, str], range_: str) -> None:
    added = middleware_defaults(asked, _FAST)
    assert added["ROS_AUTOMATIC_DISCOVERY_RANGE"] == range_
    assert not added.get("FASTRTPS_DEFAULT_PROFILES_FILE")


def test_other_middleware_gets_no_range_that_would_open_it() -> None:
    assert middleware_defaults({}, "rmw_cyclonedds_cpp") == {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def test_a_profile_that_is_missing_ends_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middleware, "_LOOPBACK", Path("/nowhere/loopback.xml"))
    with pytest.raises(FaultError, match=r"/nowhere/loopback\.xml is missing"):
        middleware_defaults({}, _FAST)


def test_both_generations_of_fast_dds_get_one_profile() -> None:
    """A profile with the name that the other generation has is not read at all, and the node is refused."""
    trees = []
    for name in ("loopback.xml", "loopback_3.xml"):
        text = Path(middleware.__file__).with_name(name).read_text(encoding="utf-8")
        trees.append(ElementTree.canonicalize(text, strip_text=True, with_comments=False))
    assert trees[0].replace("heartbeatPeriod", "heartbeat_period") == trees[1]
    assert trees[0] != trees[1]


@pytest.fixture
def simulator(
    domain_id: int, processes: ProcessGroup, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> RunningProgram:
    for name in _ROS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    program = processes.start("pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim", env=request.param)
    program.wait_for_output("ready", 30.0)
    return program


def _listening(program: RunningProgram) -> set[str]:
    return {connection.laddr.ip for connection in psutil.Process(program.pid).net_connections("udp4")}


# Who asks for LOCALHOST gets the same profile: see above.
@pytest.mark.parametrize("simulator", [{}], indirect=True)
def test_every_socket_of_a_node_is_bound_to_the_loopback_address(simulator: RunningProgram) -> None:
    assert _listening(simulator) == {"127.0.0.1"}


@pytest.mark.parametrize("simulator", [{"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}], indirect=True)
def test_a_network_that_was_opened_is_open(simulator: RunningProgram) -> None:
    assert "0.0.0.0" in _listening(simulator)


def test_a_profile_that_is_not_heeded_ends_the_program(
    domain_id: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in _ROS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    everywhere = tmp_path / "loopback.xml"
    lines = Path(middleware.__file__).with_name("loopback.xml").read_text().splitlines()
    everywhere.write_text("\n".join(line for line in lines if "interfaceWhiteList" not in line))
    code = f"""
import sys
from pathlib import Path
from pendulum_msgs_py.ros import middleware
middleware._LOOPBACK = Path({str(everywhere)!r})
from pendulum_sim.simulator.simulator_node import main
sys.exit(main(["--ros-args", "-r", "__ns:=/sim"]))
"""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, cwd=PROJECT
    )
    assert ended.returncode != 0
    assert "listens on UDP port" in ended.stderr
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET" in ended.stderr


@pytest.mark.parametrize(("opened", "refused"), [("", True), ("/mine.xml", False)])
def test_the_check_is_for_networks_that_nobody_opened(
    monkeypatch: pytest.MonkeyPatch, domain_id: int, opened: str, refused: bool
) -> None:
    port = 7400 + 250 * domain_id + 10
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", opened or str(middleware._LOOPBACK))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as everywhere:
        everywhere.bind(("0.0.0.0", port))
        if refused:
            with pytest.raises(FaultError, match=f"listens on UDP port {port} of every network"):
                check_closed(domain_id)
        else:
            check_closed(domain_id)


def _occupy(domain: int, count: int) -> list[socket.socket]:
    """Take the ports of so many participants, as they would."""
    taken = []
    for offset in range(10, 10 + 2 * count):
        taken.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        taken[-1].bind(("127.0.0.1", 7400 + 250 * domain + offset))
    return taken


@pytest.mark.parametrize(("others", "code"), [(31, 0), (32, 1)])
def test_a_program_that_would_find_nobody_says_so_and_ends(
    domain_id: int, processes: ProcessGroup, monkeypatch: pytest.MonkeyPatch, others: int, code: int
) -> None:
    for name in _ROS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    taken = _occupy(domain_id, others)
    try:
        program = processes.start("pendulum_lqr", "disturbance", "--ros-args", "-r", "__ns:=/sim")
        if code == 0:
            program.wait_for_output("ready", 30.0)
            program.interrupt()
        assert (program.wait(30.0) == 0) == (code == 0)
    finally:
        for each in taken:
            each.close()
    if code:
        assert f"program is number 33 of ROS domain {domain_id} on this machine; expected at most 32" in program.output
        assert "ROS_DOMAIN_ID" in program.output


def test_participants_are_numbered_by_their_ports() -> None:
    first = 7400 + 250 * 7
    # Multicast, then pairs.
    assert participant_number([first, first + 1], 7) == 0
    assert participant_number([first + 10, first + 11], 7) == 1
    assert participant_number([first, first + 72, first + 73], 7) == 32
    assert participant_number([first + 74], 7) == 33


_LOOK = """
import time
import rclpy
rclpy.init()
node = rclpy.create_node("stranger")
end = time.monotonic() + float({patience!r})
while time.monotonic() < end and not node.count_publishers("/sim/joint_states"):
    time.sleep(0.05)
print("found" if node.count_publishers("/sim/joint_states") else "nobody")
"""


def _look(processes: ProcessGroup, namespace: str, patience: float, **variables: str) -> RunningProgram:
    command = ["ip", "netns", "exec", namespace, sys.executable, "-c", _LOOK.format(patience=patience)]
    return processes.start_command(command, name="look", env=variables)


def _seen(look: RunningProgram) -> str:
    assert look.wait(60.0) == 0
    return look.output.strip()


def test_a_host_that_names_ours_as_its_peer_is_not_let_in(
    processes: ProcessGroup, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    reason = why_not()
    if reason:
        pytest.skip(reason)
    for name in _ROS_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    peers = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": PLANT_ADDRESS}
    with two_machines() as (plant, stranger, _):
        node = [sys.executable, "-m", "pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim"]
        program = processes.start_command(["ip", "netns", "exec", plant, *node], name="simulator")
        program.wait_for_output("ready", 30.0)
        # Tools of this machine find it whatever their range, and this shows that there is something to be found.
        assert _seen(_look(processes, plant, 10.0)) == "found"
        looks = [
            _look(processes, stranger, 4.0, **peers),
            _look(processes, stranger, 2.0, ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET"),
        ]
        assert [_seen(look) for look in looks] == ["nobody", "nobody"]
        program.interrupt()
        assert program.wait(10.0) == 0
