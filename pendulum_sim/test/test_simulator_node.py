"""The simulator as a process over real DDS: reset, pause, single steps, lockstep that repeats itself."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.refusals import Refused, not_refused


class Peer(GraphPeer):
    """Controller, listener and client of one simulator, in this process."""

    def __init__(self) -> None:
        super().__init__("peer")
        self.states: list[JointState] = []
        self.applied: list[JointState] = []
        self.diagnostics: dict[str, str] = {}
        self.answer: Callable[[JointState], float | None] = lambda state: None
        self.commands = self.node.create_publisher(JointState, names.EFFORT_COMMAND, qos.COMMAND)
        self.set_state = self.node.create_publisher(JointState, "simulator/set_state", qos.TRAJECTORY)
        self.node.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.STATE)
        self.node.create_subscription(JointState, names.APPLIED_EFFORT, self.applied.append, qos.STATE)
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, 10)

    def _on_state(self, message: JointState) -> None:
        self.states.append(message)
        effort = self.answer(message)
        if effort is not None:
            answer = JointState(name=[names.JOINT], effort=[effort])
            answer.header.stamp, answer.header.frame_id = message.header.stamp, "peer"
            self.commands.publish(answer)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics = {pair.key: pair.value for pair in status.values}

    def ask(self, service: str, request: object = None) -> object:
        kind = SetBool if isinstance(request, SetBool.Request) else Trigger
        return self.call(kind, f"simulator/{service}", request or Trigger.Request())


@pytest.fixture
def peer(domain_id: int) -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.close()


def _start(processes, *parameters: str):
    arguments = [item for parameter in parameters for item in ("-p", parameter)]
    return processes.start("pendulum_sim", "simulator", "--ros-args", *arguments)


def test_pause_step_reset_and_set_state(peer: Peer, processes) -> None:
    program = _start(processes, "rate_hz:=100.0", "initial_theta:=2.0", "method:=rk4", "start:=given")
    peer.until(lambda: len(peer.states) > 5, "states")
    assert peer.ask("pause", SetBool.Request(data=True)).success
    peer.executor.spin_once(timeout_sec=0.2)
    count = len(peer.states)
    assert peer.ask("step").success
    peer.until(lambda: len(peer.states) > count, "the state of a single step")

    assert peer.ask("reset").message == "theta 2.000000 rad, theta_dot 0.000000 rad/s"
    twin = RigidPlant(load_plant("thesis"), 0.01, method="rk4")
    twin.reset(2.0)
    for _ in range(3):
        peer.ask("step")
        step = twin.step(0.0)
        expected = (step.theta, step.theta_dot)
        # Behind states of before that a busy machine delivers late.
        peer.until(
            lambda expected=expected: (peer.states[-1].position[0], peer.states[-1].velocity[0]) == expected,
            "the state of a single step, as the plant has it",
        )

    peer.set_state.publish(JointState(name=[names.JOINT], position=[0.5], velocity=[0.1]))
    peer.until(
        lambda: (peer.ask("step"), peer.states)[1] and abs(peer.states[-1].position[0] - 0.5) < 0.05,
        "the state set",
    )
    assert peer.ask("pause", SetBool.Request(data=False)).success
    assert not peer.ask("step").success
    program.send_signal(signal.SIGINT)
    assert program.wait(60.0) == 0


def test_realtime_states_are_one_period_apart_and_diagnostics_tell_the_rate(peer: Peer, processes) -> None:
    peer.answer = lambda state: 0.3
    _start(processes, "rate_hz:=200.0")
    peer.until(lambda: len(peer.states) > 400, "two seconds of states")
    stamps = [stamp_from_message(state.header.stamp) for state in peer.states]
    gaps = {after - before for before, after in pairwise(stamps)}
    assert all(gap % 5_000_000 == 0 for gap in gaps)
    peer.until(lambda: "command_latency_p50_us" in peer.diagnostics, "diagnostics")
    peer.until(lambda: peer.diagnostics["command_latency_p50_us"] != "nan", "a measured latency")
    for key in ("rate_hz", "overruns", "jitter_p50_us", "jitter_p99_us", "command_latency_p99_us"):
        assert math.isfinite(float(peer.diagnostics[key])), key
    # From a state to its answer, and no answer is applied that is older than 50 ms.
    assert 0.0 < float(peer.diagnostics["command_latency_p50_us"]) < 5e4


def test_two_lockstep_runs_with_one_seed_give_the_same_messages(peer: Peer, processes) -> None:
    peer.answer = lambda state: -8.0 * (state.position[0] - math.pi) - 0.5 * state.velocity[0]
    runs = []
    for _ in range(2):
        peer.states.clear()
        program = _start(
            processes, "clock:=lockstep", "lockstep_duration:=0.4", "initial_theta:=3.0", "seed:=9",
            "sensor.position_noise:=0.001", "sensor.velocity_step:=0.01", "sensor.drop_rate:=0.05",
        )  # fmt: skip
        peer.until(lambda: "1.4" in f"{_newest(peer):.3f}", "the end of the run")
        states = ((stamp_from_message(s.header.stamp), s.position[0], s.velocity[0], s.effort[0]) for s in peer.states)
        # One whose answer a busy machine keeps for a second is sent again, as it was.
        runs.append([state for state, _ in groupby(states)])
        assert len(peer.states) - len(runs[-1]) < 20
        program.send_signal(signal.SIGINT)
        assert program.wait(60.0) == 0
        time.sleep(0.5)
    assert len(runs[0]) > 150
    assert runs[0] == runs[1]


def test_bad_parameters_end_with_one_sentence(domain_id: int) -> None:
    simulator = ("pendulum_sim", "simulator")
    refused: list[Refused] = [
        (simulator, ["plant:=thesiss"], "plant is 'thesiss'; expected one of the presets"),
        (simulator, ["rate_hz:=3.0"], "rate_hz is 3.0 Hz; expected 50 to 2000"),
        (simulator, ["sensor.drop_rate:=2.0"], "sensor.drop_rate is 2.0; expected 0 to 1"),
    ]
    assert not_refused(refused) == []


def test_the_viewer_writes_picture_and_animation_without_a_screen(processes, domain_id: int, tmp_path: Path) -> None:
    from PIL import Image

    _start(processes, "rate_hz:=100.0", "initial_position:=[2.0]")
    viewer = processes.start(
        "pendulum_sim", "viewer", "--ros-args", "-p", "window:=true", "-p", "duration:=2.0", "-p", "width:=240",
        "-p", "height:=240", "-p", f"png:={tmp_path / 'view.png'}", "-p", f"gif:={tmp_path / 'view.gif'}",
        env={**os.environ, "SDL_VIDEODRIVER": "dummy"},
    )  # fmt: skip
    assert viewer.wait(60.0) == 0
    with Image.open(tmp_path / "view.png") as picture:
        assert picture.size == (240, 240)
    with Image.open(tmp_path / "view.gif") as animation:
        assert animation.n_frames > 1


def _newest(peer: Peer) -> float:
    return stamp_from_message(peer.states[-1].header.stamp) / 1e9 if peer.states else 0.0
