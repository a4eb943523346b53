"""A controller that answers compiled and one that does not: the same answers, the same counts, over real DDS."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract.cdr import encode_joint_state, encode_joints
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_to_message
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup

STATE: dict[str, Any] = {"position": math.pi + 0.01, "velocity": 0.1, "effort": 0.0}
SECOND = 1_000_000_000
COUNTS = ("answered", "restarts", "effort", "measured_period")


class Twins(GraphPeer):
    """Sends the same states to two controllers, and keeps what each answers."""

    def __init__(self) -> None:
        super().__init__("plant")
        self.states: list[Any] = []
        self.answers: tuple[list[bytes], list[bytes]] = ([], [])
        self.said: list[dict[str, str]] = [{}, {}]
        for index, space in enumerate(("/a", "/b")):
            self.states.append(self.node.create_publisher(JointState, f"{space}/joint_states", qos.STATE))
            self.node.create_subscription(
                JointState, f"{space}/effort_command", self.answers[index].append, qos.COMMAND, raw=True
            )
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.DIAGNOSTICS)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("controller: controller"):
                values = {pair.key: pair.value for pair in status.values}
                self.said["/b" in status.name] = values

    def send(self, data: bytes, *, answered: bool = True) -> None:
        """Send one state to both; they keep the newest alone, so the next has to wait until both are done with it."""
        counts = [len(each) + answered for each in self.answers]
        for each in self.states:
            each.publish(data)
        if answered:
            self.until(lambda: [len(each) for each in self.answers] >= counts, "answers of both")
        else:
            self.spin(0.15)
            # Nor may one that stood still meanwhile find the next in its place.
            for space in ("/a", "/b"):
                self.call(
                    GetParameters, f"{space}/controller/get_parameters", GetParameters.Request(names=["compiled"])
                )
        assert [len(each) for each in self.answers] == counts

    def counted(self) -> list[dict[str, str]]:
        """Return what each counted so far."""
        self.said = [{}, {}]
        self.until(lambda: all(self.said), "diagnostics of both")
        self.said = [{}, {}]
        self.until(lambda: all(self.said), "diagnostics of both")
        return [
            {key: text for key, text in each.items() if key in COUNTS or key.startswith("refused")}
            for each in self.said
        ]


@pytest.fixture
def twins(domain_id: int) -> Iterator[Twins]:
    peer = Twins()
    yield peer
    peer.close()


def start(twins: Twins, processes: ProcessGroup, *parameters: str) -> None:
    given = [word for parameter in parameters for word in ("-p", parameter)]
    programs = [
        processes.start(
            "pendulum_lqr", "controller", *f"--ros-args -r __ns:={space} -p compiled:={how}".split(), *given
        )
        for space, how in (("/a", "true"), ("/b", "false"))
    ]
    for program in programs:
        program.wait_for_output("ready", 120)
    twins.until(lambda: all(each.get_subscription_count() for each in twins.states), "both controllers")
    twins.until(lambda: all(twins.said), "diagnostics of both")
    assert [each["loop"] for each in twins.said] == ["compiled", "interpreted: compiled is false"]


def in_rclpys_layout(stamp_ns: int) -> bytes:
    message = JointState(name=["other", "pendulum_joint"], position=[1.0, 3.0], velocity=[0.0, 0.5])
    message.header.stamp = stamp_to_message(stamp_ns)
    return bytes(serialize_message(message))


def check(twins: Twins) -> None:
    a, b = ([data.replace(space, b"/x/controller") for data in answers]
            for space, answers in zip((b"/a/controller", b"/b/controller"), twins.answers, strict=True))  # fmt: skip
    assert a == b
    counted = twins.counted()
    assert counted[0] == counted[1]


def test_in_real_time_both_answer_and_refuse_alike(twins: Twins, processes: ProcessGroup) -> None:
    start(twins, processes, "state_timeout:=2.0")
    # Whoever's reader is not matched yet misses the first.
    twins.until(lambda: [each.publish(encode_joint_state(time.time_ns(), **STATE)) for each in twins.states]
                and all(twins.answers), "the first answers")  # fmt: skip
    twins.spin(0.5)
    for answers in twins.answers:
        answers.clear()
    before = twins.counted()
    for count in range(20):
        twins.send(encode_joint_state(time.time_ns(), **(STATE | {"velocity": 0.01 * count})))
    newest = time.time_ns()
    twins.send(encode_joint_state(newest, **STATE))
    for data in (
        encode_joint_state(newest, **STATE),
        encode_joint_state(newest - 1_000_000, **STATE),
        encode_joint_state(time.time_ns(), **(STATE | {"position": math.nan})),
        encode_joint_state(time.time_ns(), **(STATE | {"velocity": -math.inf})),
        encode_joint_state(time.time_ns() - 10 * SECOND, **STATE),
        encode_joint_state(time.time_ns() + 10 * SECOND, **STATE),
        encode_joint_state(time.time_ns(), joint="other", **STATE),
        b"\x00\x01\x00\x00" + b"\x07" * 40,
    ):
        # An interval that goes back is a plant that began anew: what was measured is measured again.
        twins.send(data, answered=False)
    made: tuple[Callable[[int], bytes], ...] = (
        lambda now: encode_joint_state(now, **(STATE | {"position": 1e300})),
        lambda now: encode_joint_state(now, **(STATE | {"position": -0.0, "velocity": -0.0})),
        lambda now: encode_joint_state(now, **(STATE | {"effort": math.nan})),
        lambda now: encode_joint_state(now, position=3.1, velocity=5e-324),
        lambda now: encode_joint_state(now, **STATE),
        lambda now: encode_joint_state(now, frame_id="somebody", **STATE),
        lambda now: encode_joint_state(now, **STATE) + b"\x01\x02\x03",
        lambda now: encode_joints(now, "", ("x", JOINT), (1.0, 3.0), (0.0, 0.5), (0.0, 0.0)),
        in_rclpys_layout,
        lambda now: encode_joint_state(now, frame_id="x" * 1_000_000, **STATE),
        lambda now: encode_joint_state(now, **(STATE | {"position": 2.0})),
    )
    for make in made:
        twins.send(make(time.time_ns()))
        twins.send(make(time.time_ns()))
    for _ in range(30):
        twins.send(encode_joint_state(time.time_ns(), **STATE))
    a, b = ([data.replace(space, b"/x/controller") for data in answers]
            for space, answers in zip((b"/a/controller", b"/b/controller"), twins.answers, strict=True))  # fmt: skip
    assert a == b
    after = twins.counted()
    assert {key: text for key, text in after[0].items() if key != "answered"} == {
        key: text for key, text in after[1].items() if key != "answered"
    }
    assert len({int(each["answered"]) - int(first["answered"]) for first, each in zip(before, after, strict=True)}) == 1


def begin_anew(twins: Twins) -> None:
    """Send three runs, each from the same stamp on, with states that come twice."""
    for run in range(3):
        for step in range(40):
            data = encode_joint_state(SECOND + step * 2_000_000, **(STATE | {"velocity": 0.001 * step + run}))
            twins.send(data)
            if step % 9 == 8:
                twins.send(data)
        # Another period, another state under the stamp of the newest.
        twins.send(encode_joint_state(2 * SECOND, **STATE))
        twins.send(encode_joint_state(2 * SECOND, **(STATE | {"velocity": 1.0 + run})))


_REDESIGNS: dict[str, tuple[dict[str, Any], ...]] = {
    # More torques on their way than before, fewer, none.
    "discrete_lqr": ({"delay": 0.02}, {"delay": 0.2}, {"delay": 0.004}, {"delay": 0.0, "effort_limit": 2.0}),
    "pid": ({"set_point": 0.1}, {"effort_limit": 2.0}),
}


@pytest.mark.parametrize("name", _REDESIGNS)
def test_in_simulated_time_a_law_that_remembers_answers_alike_in_new_runs_and_when_it_is_designed_anew(
    twins: Twins, processes: ProcessGroup, name: str
) -> None:
    start(twins, processes, "use_sim_time:=true", f"controller:={name}", "period:=0.002")
    begin_anew(twins)
    generator, stamp_ns = random.Random(3), SECOND
    for values in ({}, *_REDESIGNS[name]):
        change = SetParametersAtomically.Request(
            parameters=[Parameter(key, value=value).to_parameter_msg() for key, value in values.items()]
        )
        for space in ("/a", "/b") if values else ():
            done = twins.call(SetParametersAtomically, f"{space}/controller/set_parameters_atomically", change)
            assert done.result.successful, done.result.reason
        for number in range(15):
            spread = 1.0 if number % 5 else 20.0
            position, velocity = math.pi + spread * generator.gauss(0.0, 0.05), spread * generator.gauss(0.0, 0.3)
            twins.send(encode_joint_state(stamp_ns, position=position, velocity=velocity, effort=0.0))
            stamp_ns += SECOND // 500
    check(twins)
    assert [each["loop"] for each in twins.said] == ["compiled", "interpreted: compiled is false"]
