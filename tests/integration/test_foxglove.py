"""What viewers get: a public client of the protocol reads, sets and stops real plants in processes of their own."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

import psutil
import pytest

from pendulum_console.live.handshake import as_asked, parse, refusal, to_server
from pendulum_msgs_py.errors import FaultError
from pendulum_testing.fixtures import wait_for
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.foxglove_client import FoxgloveClient, foxglove_client


def head(path: str = "/", **headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", *(f"{name.replace('_', '-')}: {value}" for name, value in headers.items())]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


@pytest.mark.parametrize(
    ("origin", "path", "token", "allowed", "expected"),
    [
        (None, "/", "", (), ""),
        ("http://localhost:8080", "/", "", (), ""),
        ("http://127.0.0.1:8080", "/", "", (), ""),
        ("file://", "/", "", (), ""),
        ("https://app.foxglove.dev", "/", "", (), ""),
        ("https://evil.example", "/", "", (), "--origin https://evil.example lets it in"),
        ("https://app.foxglove.dev.evil.example", "/", "", (), "is none of this machine"),
        ("http://localhost.evil.example", "/", "", (), "is none of this machine"),
        ("null", "/", "", (), "is none of this machine"),
        ("https://lab.example", "/", "", ("https://lab.example",), ""),
        ("https://evil.example", "/?token=secret", "secret", (), ""),
        (None, "/", "secret", (), "token is missing or wrong"),
        ("http://localhost:8080", "/?token=guess", "secret", (), "token is missing or wrong"),
    ],
)
def test_viewers_of_this_machine_named_pages_and_bearers_of_the_token_are_let_in(
    origin: str | None, path: str, token: str, allowed: tuple[str, ...], expected: str
) -> None:
    request = parse(head(path, **({} if origin is None else {"Origin": origin})))
    reason = refusal(request, token, allowed)
    assert expected in reason
    assert bool(reason) is bool(expected)


def test_a_client_that_asks_by_the_older_name_of_the_protocol_is_answered_by_it() -> None:
    asked = head(Upgrade="websocket", Sec_WebSocket_Protocol="foxglove.websocket.v1")
    assert b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n" in to_server(asked)
    answer = b"HTTP/1.1 101 Switching Protocols\r\nsec-websocket-protocol: foxglove.sdk.v1\r\n\r\n"
    assert as_asked(answer, parse(asked)) == answer.replace(b"sdk", b"websocket")
    both = head(Upgrade="websocket", Sec_WebSocket_Protocol="foxglove.websocket.v1, foxglove.sdk.v1")
    assert as_asked(answer, parse(both)) == answer
    with pytest.raises(FaultError, match="no request of HTTP"):
        parse(b"\x16\x03\x01\r\n\r\n")


@pytest.fixture
def peer(domain_id: int) -> Iterator[PlantPeer]:
    """Watch the plant itself."""
    with closing(PlantPeer("/sim")) as peer:
        yield peer


@pytest.fixture
def simulator(processes: ProcessGroup, domain_id: int) -> RunningProgram:
    at = ["--ros-args", "-r", "__ns:=/sim"]
    processes.start("pendulum_lqr", "controller", *at, "-p", "period:=0.01")
    return processes.start("pendulum_sim", "simulator", *at, "-p", "start:=top", "-p", "rate_hz:=100.0")


def start(processes: ProcessGroup, *options: str) -> tuple[RunningProgram, int]:
    """Start the server on a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program = processes.start("pendulum_console", "foxglove", "--port", str(port), *options)
    program.wait_for_output(r"^foxglove at ws://", 60)
    return program, port


@pytest.fixture
def server(processes: ProcessGroup, domain_id: int) -> tuple[RunningProgram, int]:
    return start(processes)


@pytest.fixture
def client(server: tuple[RunningProgram, int], simulator: RunningProgram) -> Iterator[FoxgloveClient]:
    server[0].wait_for_output(r"^plant /sim/simulator$", 60)
    with foxglove_client(f"ws://localhost:{server[1]}/") as client:
        yield client


def test_a_viewer_reads_sets_and_stops_a_plant_by_the_rules_of_all(
    client: FoxgloveClient, peer: PlantPeer, simulator: RunningProgram, server: tuple[RunningProgram, int]
) -> None:
    topics = ("/sim/joint_states", "/sim/effort_command", "/sim/events", "/diagnostics")
    wait_for(lambda: set(topics) <= set(client.ask("seen")["topics"]), 30, "the topics")
    assert client.ask("seen")["topics"]["/sim/joint_states"] == "sensor_msgs/msg/JointState"
    client.subscribe(*topics)
    # What is kept for latecomers comes, too.
    wait_for(lambda: client.ask("taken")["/sim/events"]["count"] > 0, 20, "the event of before")
    wait_for(lambda: client.ask("taken")["/sim/joint_states"]["count"] > 100, 20, "states")
    newest = client.ask("taken")["/sim/joint_states"]["newest"]
    assert newest["name"] == ["pendulum_joint"]
    assert newest["position"][0] == pytest.approx(3.14159, abs=0.3)
    assert client.ask("taken")["/sim/effort_command"]["newest"]["header"]["frame_id"]

    # Parameters: read, set as the node takes them, refused in the node's words.
    limit = "/sim/simulator.effort_limit"  # 0: that of the plant file
    wait_for(lambda: "/sim/controller.r" in client.parameters(), 20, "the parameters of the controller")
    assert client.parameters(limit) == {limit: 0.0}
    assert client.set("/sim/controller.r", 1) == {"/sim/controller.r": 1.0}
    assert client.set("/sim/controller.r", -1) == {"/sim/controller.r": 1.0}
    wait_for(lambda: any("refuses r = -1" in text for text in client.ask("seen")["statuses"]), 10, "the reason")

    # The e-stop: latched, seen on the plant, and not armed again by the way.
    assert client.call("/sim/simulator/e_stop")["response"]["success"]
    peer.until(lambda: peer.diagnostics.get("mode") == "e_stop", "the e-stop")
    refused = client.call("/sim/simulator/arm", data=True)["response"]
    assert not refused["success"]
    assert "e-stop" in refused["message"]
    assert client.call("/sim/simulator/e_stop_reset")["response"]["success"]
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "the reset, which arms nothing")
    assert client.call("/sim/simulator/arm", data=True)["response"]["success"]
    peer.until(lambda: peer.diagnostics.get("mode") == "armed_effort", "the plant armed")

    # A frozen plant does not answer, and the viewer hears so.
    simulator.send_signal(signal.SIGSTOP)
    try:
        wait_for(lambda: psutil.Process(simulator.pid).status() == psutil.STATUS_STOPPED, 10, "the plant to be frozen")
        failure = client.call("/sim/simulator/e_stop")["failure"]
    finally:
        simulator.send_signal(signal.SIGCONT)
    assert "/sim/simulator/e_stop does not respond within 3 s" in failure
    simulator.interrupt()
    assert simulator.wait(20) == 0
    wait_for(lambda: "/sim/joint_states" not in client.ask("seen")["topics"], 30, "the plant to be gone")
    wait_for(lambda: "/sim/simulator/e_stop" not in client.ask("seen")["services"], 30, "its services to be gone")
    server[0].interrupt()
    assert server[0].wait(20) == 0
    assert client.line() == {"closed": True}
    assert re.search(r"^handed on \d{3,} messages; \d+ were lost", server[0].output, re.MULTILINE)


def ask(port: int, request: bytes) -> str:
    """Return what the server answers."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall(request)
        return connection.recv(4096).decode("latin-1")


UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Protocol": "foxglove.sdk.v1",
}


def test_who_is_refused_hears_why_and_so_does_the_terminal(processes: ProcessGroup, domain_id: int) -> None:
    program, port = start(processes)
    assert ask(port, head(**UPGRADE)).startswith("HTTP/1.1 101 ")
    assert "403 Forbidden" in ask(port, head(**UPGRADE, Origin="https://evil.example"))
    program.wait_for_output(r"is refused: the page of https://evil\.example is none of this machine", 10)
    assert "Open a connection to ws://localhost" in ask(port, head(Host=f"localhost:{port}"))
    assert "400 Bad Request" in ask(port, b"\x16\x03\x01\r\n\r\n")
    # Nothing runs on this domain, which is said, and is no reason to end.
    program.wait_for_output(rf"^no plant on ROS domain {domain_id}; start one", 20)

    command = [sys.executable, "-m", "pendulum_console", "foxglove", "--port", str(port)]
    second = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert second.returncode == 2
    said = f"port is {port}, which another program listens on; expected a free one: --port PORT"
    assert f"error: {said}\n" in second.stderr
    program.interrupt()
    assert program.wait(20) == 0


def test_opened_beyond_this_machine_it_wants_the_token_that_it_prints(processes: ProcessGroup, domain_id: int) -> None:
    program, port = start(processes, "--host", "0.0.0.0")
    found = re.search(rf"ws://0\.0\.0\.0:{port}/\?token=(\S+)", program.output)
    assert found
    assert "403 Forbidden" in ask(port, head(**UPGRADE))
    assert ask(port, head(f"/?token={found[1]}", **UPGRADE)).startswith("HTTP/1.1 101 ")
