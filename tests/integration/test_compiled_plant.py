"""A plant in lockstep does the same, message by message, whether ordinary steps are compiled or interpreted."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joints
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.ros import qos
from pendulum_testing.fixtures import own_domain
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup

_STEPS = 240
_PERIOD_NS = 2_000_000
_SECOND = 1_000_000_000
_ME = "/peer"

_COUNTED = (
    "mode",
    "reason",
    "commander",
    "refused_commander",
    "starved_periods",
    "saturated_periods",
    "lockstep_steps",
)


def _command(stamp: int, effort: float, source: str = _ME, joints: tuple[str, ...] = (JOINT,)) -> bytes:
    return encode_joints(stamp, source, joints, (), (), (effort,))


def _as_others_write_it(stamp: int, effort: float) -> bytes:
    message = deserialize_message(_command(stamp, effort), JointState)
    return bytes(serialize_message(message))


def _before_the_answer(k: int, stamp: int) -> Iterator[bytes]:
    """What somebody sends before the answer to state k: each kind of message that is no ordinary command."""
    kinds = {
        11: lambda: _command(stamp, math.nan),
        17: lambda: _command(stamp, math.inf),
        23: lambda: _command(stamp, 1.0, joints=("elbow",)),
        31: lambda: _command(stamp, 1.0, source="/somebody"),
        37: lambda: _command(stamp - _PERIOD_NS, 9.0),
        43: lambda: _command(stamp - 2 * _PERIOD_NS, 9.0),
        47: lambda: _command(stamp + _SECOND, 9.0),
        53: lambda: _command(max(0, stamp - _SECOND), 9.0),
        59: lambda: b"\x00\x01\x00\x00" + bytes(40),
        61: lambda: encode_joints(stamp, _ME, (JOINT,), (1.0,), (2.0,), (3.0,))[:-4],
        67: lambda: _command(stamp, 1.0, source="x" * 2_000),
        71: lambda: encode_joints(stamp, _ME, (JOINT, "elbow"), (), (), (1.0, 2.0)),
        # It passes, though it answers no state of this plant.
        73: lambda: _command(stamp - 1_000, 0.25),
    }
    for every, make in kinds.items():
        if k % every == every // 2:
            yield make()


def _answer(k: int, stamp: int) -> bytes:
    torque = 4.0 * math.sin(0.3 * k) + (40.0 if k % 29 == 3 else 0.0)
    return _as_others_write_it(stamp, torque) if k % 41 == 7 else _command(stamp, torque)


def _run(folder: Path, *, compiled: bool, **parameters: Any) -> tuple[list[bytes], list[bytes], dict[str, str]]:
    """Answer each state as the script says; return all states, all efforts that were applied, and the counters."""
    states: list[bytes] = []
    applied: list[bytes] = []
    answered: dict[int, int] = {}
    with own_domain(folder):
        group = ProcessGroup(folder / "processes", cwd=Path(__file__).parents[2])
        peer = PlantPeer(namespace="/sim")
        commands, disturbances = peer._commands, peer.node.create_publisher(JointState, names.DISTURBANCE, qos.COMMAND)

        def on_state(data: bytes) -> None:
            fields = decode_joint_state(data)
            assert fields is not None
            stamp = fields.stamp_ns
            k = answered.setdefault(stamp, len(answered))
            if k >= _STEPS or len(states) > k:
                return
            states.append(data)
            for odd in _before_the_answer(k, stamp):
                commands.publish(odd)
            # After a while without a disturbance one comes, and with one that is odd at times.
            if k == 150:
                disturbances.publish(_command(stamp, math.nan))
            disturbances.publish(_command(stamp, 0.5 * math.cos(k), source="/noise"))
            commands.publish(_answer(k, stamp))

        peer.node.create_subscription(JointState, names.JOINT_STATES, on_state, qos.STATE, raw=True)
        peer.node.create_subscription(JointState, names.APPLIED_EFFORT, applied.append, qos.STATE, raw=True)
        try:
            plant = graph.simulator(
                "/sim",
                clock="lockstep",
                initial_theta=3.0,
                start_effort_limit=0.0,
                lockstep_inputs=["effort_command", "disturbance"],
                lockstep_subscribers=2,
                compiled=compiled,
                **parameters,
            )
            program = group.start(plant.package, plant.executable, *plant.ros_arguments())
            program.wait_for_output("ready", 120.0)
            peer.until(lambda: len(applied) >= _STEPS or program.returncode is not None, f"{_STEPS} steps")
            assert program.returncode is None, program.output
            peer.until(lambda: peer.diagnostics.get("lockstep_steps") == str(_STEPS), "the last diagnostics")
            loop = peer.diagnostics["loop"]
            assert loop == ("compiled" if compiled else "interpreted: compiled is false")
            assert ("periods_compiled" in peer.diagnostics) is compiled
            # Most of them: a step after which somebody sent what is not ordinary is Python's, and so is the last.
            assert _STEPS // 2 < int(peer.diagnostics.get("periods_compiled", _STEPS)) <= _STEPS
            counters = {
                key: value
                for key, value in peer.diagnostics.items()
                if key in _COUNTED or key.startswith(("effort_command.", "disturbance."))
            }
            # It still listens to everything else.
            assert peer.call(SetBool, "simulator/pause", SetBool.Request(data=True)).message == "paused"
            return states, applied[:_STEPS], counters
        finally:
            peer.close()
            assert not group.close()


@pytest.mark.parametrize(
    "parameters",
    [{}, {"plant": "dfki"}, {"method": "euler", "substeps": 3, "effort_slew_limit": 200.0, "velocity_limit": 100.0}],
    ids=["thesis", "dry friction", "substeps, slew"],
)
def test_a_run_is_the_same_compiled_and_interpreted(tmp_path: Path, parameters: dict[str, Any]) -> None:
    interpreted = _run(tmp_path / "interpreted", compiled=False, **parameters)
    compiled = _run(tmp_path / "compiled", compiled=True, **parameters)
    assert len(compiled[0]) == _STEPS
    for k, (ours, theirs) in enumerate(zip(compiled[0], interpreted[0], strict=True)):
        assert ours == theirs, f"state {k}: {decode_joint_state(ours)} and {decode_joint_state(theirs)}"
    assert compiled[1] == interpreted[1]
    assert compiled[2] == interpreted[2]
    assert int(compiled[2]["effort_command.refused.second_commander"]) > 0
    assert int(compiled[2]["saturated_periods"]) > 0


def test_in_real_time_it_runs_compiled_and_answers_whoever_calls(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    plant = graph.simulator("/sim", rate_hz=250.0, initial_theta=3.0, start_effort_limit=0.0)
    with closing(PlantPeer("/sim", torque=0.5)) as peer:
        program = processes.start(plant.package, plant.executable, *plant.ros_arguments())
        peer.until(lambda: int(peer.diagnostics.get("periods_compiled", 0)) > 200, "compiled periods", 120.0)
        # Neither the compiler nor what it is made of is in a program that runs what it has compiled.
        mapped = Path(f"/proc/{program.pid}/maps").read_text(encoding="utf-8")
        assert "rclpy" in mapped
        assert "llvmlite" not in mapped
        assert "numba" not in mapped
        first = last = peer.diagnostics

        def is_ordinary() -> bool:
            """Tell whether most periods of half a second or more were compiled, and most states answered in time."""
            nonlocal first, last
            first, last = last, peer.diagnostics
            cycles, compiled, accepted = (
                int(last[key]) - int(first[key]) for key in ("cycles", "periods_compiled", "effort_command.accepted")
            )
            return compiled > 0.5 * cycles > 0.0 and accepted > 0.5 * cycles

        # A period that a busy machine lets begin late is Python's.
        peer.until(lambda: peer.diagnostics is not last and is_ordinary(), "compiled periods, and answers to them")
        assert float(last["command_latency_p50_us"]) > 0.0
        # A service has its turn at once, in the middle of a slice.
        begun = time.monotonic()
        assert peer.call(SetBool, "simulator/pause", SetBool.Request(data=True)).success
        assert time.monotonic() - begun < 2.0
        assert peer.call(SetBool, "simulator/pause", SetBool.Request(data=False)).success
        # So have silence and a stop.
        peer.until(lambda: int(peer.diagnostics["periods_compiled"]) > int(last["periods_compiled"]) + 100, "going on")
        peer.torque = None
        peer.until(lambda: peer.diagnostics["reason"] == "no fresh command: zero torque", "zero torque")
        peer.torque = 0.5
        peer.until(lambda: peer.diagnostics["reason"] == "commanded by peer", "torque again")
        assert peer.ask("e_stop").success
        peer.until(lambda: peer.diagnostics["mode"] == "e_stop", "the stop")
        stopped = peer.diagnostics["periods_compiled"]
        peer.spin(0.3)
        assert peer.diagnostics["periods_compiled"] == stopped
        program.interrupt()
        assert program.wait(20.0) == 0


def test_in_lockstep_it_waits_at_rest_while_somebody_asks_and_stops_at_once(
    processes: ProcessGroup, domain_id: int
) -> None:
    plant = graph.simulator("/sim", clock="lockstep", initial_theta=3.0, start_effort_limit=0.0)
    with closing(PlantPeer("/sim", torque=0.5)) as peer:
        program = processes.start(plant.package, plant.executable, *plant.ros_arguments())
        peer.until(lambda: int(peer.diagnostics.get("periods_compiled", 0)) > 100, "compiled steps", 120.0)
        # Nobody answers any more: there is nothing to do but to answer who asks, which a request waits 10 ms for.
        peer.torque = None
        peer.spin(0.5)
        asked = peer.node.create_client(GetParameters, "simulator/get_parameters")
        peer.until(asked.service_is_ready, "the service")
        used, begun, answers = psutil.Process(program.pid).cpu_times(), time.monotonic(), 0
        while time.monotonic() - begun < 1.0:
            future = asked.call_async(GetParameters.Request(names=["rate_hz"]))
            peer.until(future.done, "an answer")
            answers += 1
        busy = psutil.Process(program.pid).cpu_times().user - used.user
        # A request costs less than a millisecond.
        assert busy < 0.25 + 0.002 * answers, f"{busy:.2f} s of the processor for {answers} answers"
        pressed = peer.node.create_client(Trigger, "simulator/e_stop")
        peer.until(pressed.service_is_ready, "the e-stop")
        waited = []
        for _ in range(5):
            # It goes on, and waits again: in compiled code, which has the supervisor.
            peer.torque = 0.5
            peer._on_state(peer.states[-1])
            peer.spin(0.1)
            peer.torque = None
            peer.spin(0.13)
            begun = time.monotonic()
            future = pressed.call_async(Trigger.Request())
            peer.until(future.done, "the e-stop's answer")
            waited.append(time.monotonic() - begun)
            assert peer.ask("e_stop_reset").success
            assert peer.arm().success
        # A busy machine may keep an answer waiting; compiled code would keep most of them for a tenth of a second.
        assert sorted(waited)[1] < 0.03, waited
        program.interrupt()
        assert program.wait(20.0) == 0
