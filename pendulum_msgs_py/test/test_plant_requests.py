"""What a plant makes of requests and trajectories, on a real node; the graph and the clock are the test's."""

from __future__ import annotations

import math
import select
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract.names import EFFORT_COMMAND
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import DriveKind, Mode, PlantLimits
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_to_message, trajectory_to_message
from pendulum_msgs_py.ros.plant_interface import TRAJECTORY_AGE_LIMIT, PlantInterface, _came_before
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_testing.trajectories import from_points

NOW = 100 * NANOSECONDS
_MS = NANOSECONDS // 1000


def _system_time(steady_ns: float) -> int:
    """Return the system time of an instant of the steady clock, right to some microseconds [ns]."""
    return time.time_ns() - round(time.monotonic_ns() - steady_ns)


class Plant:
    """The interface of a plant that rests at its zero."""

    def __init__(self, domain: int, **limits: Any) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = PollingNode("plant", context=self.context)
        self.supervisor = SharedSupervisor(PlantLimits(effort=(5.0,), **limits))
        self.interface = PlantInterface(self.node, self.supervisor, lambda: NOW, polled=True)
        self.node.poll_services(timer=False)
        self.interface.sample = JointSample.of_one(NOW, 0.0, 0.0)
        self.said: list[str] = []
        self.interface.publish_diagnostics = lambda: self.said.append("diagnostics")  # type: ignore[method-assign]
        self.interface.publish_event = lambda name, **details: self.said.append(f"{name}: {details}")  # type: ignore[method-assign]
        logger = self.node.get_logger()
        for level in ("info", "warning", "error"):
            setattr(logger, level, lambda text, level=level, **_: self.said.append(f"{level}: {text}"))

    def arm(self, wanted: bool = True) -> str:
        answer = self.interface._on_arm(SetBool.Request(data=wanted), SetBool.Response())
        return "" if answer.success else str(answer.message)

    def follow(self, stamped_after: float = 0.0, arrived_ns: int = 0) -> bool:
        """Let a trajectory come; return whether the plant follows it."""
        message: JointTrajectory = trajectory_to_message(from_points([0.0, 1.0], [0.0, 0.1], [0.0, 0.0]))
        message.header.stamp = stamp_to_message(NOW + round(stamped_after * NANOSECONDS))
        self.interface._on_trajectory(serialize_message(message), arrived_ns)
        return self.supervisor.mode is Mode.POSITION

    def close(self) -> None:
        self.interface.close()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def plant(domain_id: int) -> Iterator[Plant]:
    made = Plant(domain_id)
    yield made
    made.close()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_trajectory_from_the_future_moves_nothing_just_as_one_of_the_past(plant: Plant, side: float) -> None:
    assert plant.arm() == ""
    assert not plant.follow(side * (TRAJECTORY_AGE_LIMIT + 0.01))
    assert plant.interface.refused_trajectories == {"invalid": 1}
    assert plant.follow(side * (TRAJECTORY_AGE_LIMIT - 0.01))


def test_a_trajectory_that_came_before_the_plant_was_armed_was_not_meant_for_an_armed_one(plant: Plant) -> None:
    came_ns = time.time_ns()
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.arm() == ""
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.arm() == ""  # once more changes nothing
    assert not plant.follow(arrived_ns=came_ns)
    assert plant.follow(arrived_ns=time.time_ns())


@pytest.mark.parametrize(
    ("waited", "followed"), [(-_MS, True), (_MS, False), (60 * NANOSECONDS, False), (3600 * NANOSECONDS, False)]
)
def test_a_trajectory_waited_if_it_came_before_arming_however_long_the_process_stood_still(
    plant: Plant, waited: int, followed: bool
) -> None:
    assert plant.arm() == ""
    assert plant.follow(arrived_ns=_system_time(plant.interface._armed_at) - waited) is followed
    told = "info: following a trajectory" if followed else "error: joint_trajectory refused: it came before the plant"
    assert plant.said[1].startswith(told)
    assert followed or plant.said[2].startswith("trajectory_refused: {'reason': 'it came before the plant was armed")


@pytest.mark.parametrize("stamped_after", [-TRAJECTORY_AGE_LIMIT, TRAJECTORY_AGE_LIMIT, -NOW / NANOSECONDS])
def test_a_trajectory_as_old_as_the_limit_and_one_without_a_stamp_are_followed(
    plant: Plant, stamped_after: float
) -> None:
    assert plant.arm() == ""
    assert plant.follow(stamped_after)


def test_a_trajectory_that_the_rules_refuse_is_counted_with_its_reason(plant: Plant) -> None:
    assert plant.arm() == ""
    plant.interface.sample = None
    assert not plant.follow()
    plant.interface.sample = JointSample.of_one(NOW, 3.0, 0.0)
    assert not plant.follow()
    assert plant.interface.refused_trajectories == {"invalid": 2}
    assert "no measurement yet" in plant.said[1]
    assert "trajectory starts at" in plant.said[3]


def test_each_request_is_answered_with_the_mode_and_shown_in_diagnostics_and_what_waited_is_read(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[object] = []
    monkeypatch.setattr(plant.interface._trajectories, "take", read.append)
    for wanted, mode in ((True, "armed_effort"), (True, "armed_effort"), (False, "disarmed")):
        answer = plant.interface._on_arm(SetBool.Request(data=wanted), SetBool.Response())
        assert (answer.success, answer.message) == (True, mode)
    # By the first, which made it ready; each of the others found it so, or ended it.
    assert read == [plant.interface._on_trajectory]
    plant.interface.e_stop("pressed")
    answer = plant.interface._on_e_stop_reset(Trigger.Request(), Trigger.Response())
    assert (answer.success, answer.message) == (True, "disarmed")
    assert plant.said == ["diagnostics"] * 4


def test_arming_looks_for_two_commanders_itself_and_does_not_wait_for_the_next_look(plant: Plant) -> None:
    twins = [rclpy.create_node("twin", context=plant.context, start_parameter_services=False) for _ in range(2)]
    for twin in twins:
        twin.create_publisher(JointState, EFFORT_COMMAND, qos.COMMAND)
    deadline = time.monotonic() + 30.0
    topic = plant.node.resolve_topic_name(EFFORT_COMMAND)
    while [info.node_name for info in plant.node.get_publishers_info_by_topic(topic)] != ["twin", "twin"]:
        assert time.monotonic() < deadline, "twins were not discovered"
        time.sleep(0.005)
    assert "2 commanders named /twin" in plant.arm()
    assert plant.supervisor.mode is Mode.DISARMED
    for twin in twins:
        twin.destroy_node()


def test_a_press_ends_what_compiled_code_does_though_it_sees_nothing_but_its_counters(plant: Plant) -> None:
    called = plant.interface.calls[0]
    plant.node._requests.came()  # type: ignore[union-attr]
    assert not select.select([called], [], [], 0.0)[0]
    plant.interface.e_stop("pressed")
    assert select.select([called], [], [], 0.0)[0]
    assert (plant.supervisor.mode, plant.supervisor.reason) == (Mode.E_STOP, "pressed")
    assert plant.interface._pressed.is_set()


@pytest.mark.parametrize("waited", [-_MS, _MS, 60 * NANOSECONDS, 3600 * NANOSECONDS])
def test_a_request_counts_for_nothing_that_waited_while_the_e_stop_was_pressed_for_however_long(
    plant: Plant, waited: int
) -> None:
    outdated = waited > 0
    before = time.monotonic_ns()
    plant.interface.e_stop("pressed")
    assert before <= plant.interface._pressed_at <= time.monotonic_ns()
    time.sleep(2 * _MS / NANOSECONDS)
    plant.node.request_ns = _system_time(plant.interface._pressed_at) - waited
    answer = plant.interface._on_e_stop_reset(Trigger.Request(), Trigger.Response())
    assert answer.success is not outdated
    assert ("before the e-stop was pressed" in answer.message) is outdated
    plant.supervisor.e_stop_reset(NOW)
    assert ("before the e-stop was pressed" in plant.arm()) is outdated
    # To disarm is never outdated, nor is what is not known to have waited.
    assert plant.arm(wanted=False) == ""
    plant.node.request_ns = 0
    assert plant.arm() == ""


def test_requests_are_outdated_before_the_e_stop_is_latched_and_could_be_reset(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.node.request_ns = time.time_ns()
    latch, outdated = plant.supervisor.e_stop, []

    def press(now_ns: int, reason: str) -> None:
        outdated.append(plant.interface._is_outdated())
        latch(now_ns, reason)

    monkeypatch.setattr(plant.supervisor, "e_stop", press)
    plant.interface.e_stop("pressed")
    assert outdated == [True]


def test_a_press_that_was_counted_is_read_once_and_makes_earlier_requests_outdated(plant: Plant) -> None:
    plant.node.request_ns = time.time_ns()
    assert plant.interface._unread_press() is None
    assert plant.arm() == ""
    assert plant.arm(wanted=False) == ""
    plant.interface._e_stop.arrivals.wake()
    before = time.monotonic_ns()
    assert plant.interface._unread_press() == (NOW, "e-stop pressed")
    assert before <= plant.interface._pressed_at <= time.monotonic_ns()
    assert plant.interface._unread_press() is None
    assert "before the e-stop was pressed" in plant.arm()


@pytest.mark.parametrize(("set_by", "waited", "before"), [(0, 5, False), (0, 6, True), (-3600, 4, False), (1, 5, True)])
def test_what_came_before_is_reported_by_how_long_ago_whatever_the_system_clock_was_set_to(
    monkeypatch: pytest.MonkeyPatch, set_by: int, waited: int, before: bool
) -> None:
    # It happened 5 ns ago by the steady clock; of the system clock only what passed since the arrival counts.
    system_ns = 10**18 + set_by * NANOSECONDS
    monkeypatch.setattr(time, "time_ns", lambda: system_ns)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 1005)
    arrived_ns = system_ns - waited if set_by <= 0 else 10**18 - waited
    assert _came_before(arrived_ns, 1000) is before
    assert not _came_before(0, 1000)
    assert not _came_before(arrived_ns, -math.inf)


class Switch:
    """A hold-to-run switch, and the plant that hears it; it speaks every 100 ms."""

    def __init__(self, domain: int) -> None:
        self.plant = Plant(domain, enable_timeout=0.5)
        self.ahead_ns = 0
        self.sent_ns = time.time_ns()
        self.node = rclpy.create_node("switch", context=self.plant.context, start_parameter_services=False)
        assert self.plant.interface._enable is not None
        self.heard = self.plant.interface._enable.subscription
        self.publisher = self.another(1)

    def another(self, count: int) -> Publisher:
        """Return a publisher, once the plant has discovered so many."""
        made = self.node.create_publisher(Bool, "enable_input", 10)
        deadline = time.monotonic() + 30.0
        while self.heard.get_publisher_count() != count:
            assert time.monotonic() < deadline, "the switch was not discovered"
            time.sleep(0.005)
        return made

    def close(self) -> None:
        self.node.destroy_node()
        self.plant.close()

    def send(self, *, held: bool) -> None:
        """Send a message; return once it has reached the plant."""
        self.publisher.publish(Bool(data=held))
        assert select.select([self.plant.interface._enable.descriptor], [], [], 30.0)[0]  # type: ignore[union-attr]

    def say(
        self,
        monkeypatch: pytest.MonkeyPatch,
        late: int = 0,
        *,
        held: bool = True,
        known: bool = True,
        after: int = 100 * _MS,
    ) -> None:
        """Let what it sends after some time be heard so much later than usual [ns]."""
        self.sent_ns += after
        monkeypatch.setattr(time, "time_ns", lambda: self.sent_ns + late)
        stamps = {"source_timestamp": (self.sent_ns + self.ahead_ns) * known, "received_timestamp": self.sent_ns}
        self.plant.interface._on_enable(serialize_message(Bool(data=held)), stamps)
        monkeypatch.undo()


@pytest.fixture
def switch(domain_id: int) -> Iterator[Switch]:
    made = Switch(domain_id)
    yield made
    made.close()


@pytest.mark.parametrize("ahead", [0, -3600 * NANOSECONDS, 3600 * NANOSECONDS])
@pytest.mark.parametrize("known", [True, False])
def test_a_switch_holds_as_of_when_it_spoke_whatever_its_clock_and_what_waited_is_old(
    switch: Switch, monkeypatch: pytest.MonkeyPatch, ahead: int, known: bool
) -> None:
    plant, switch.ahead_ns = switch.plant, ahead
    # The process stood still for 10 s; the switch died 4 s before its end.
    for late in [0, 0, *(range(10_000, 4_000, -100))]:
        switch.say(monkeypatch, late * _MS, known=known)
        assert plant.arm().startswith("enable switch is silent") is (late > 0)
        assert plant.arm(wanted=False) == ""
    # It speaks again; of 61 messages each was allowed a millisecond.
    switch.say(monkeypatch, 200 * _MS, known=known)
    assert plant.arm() == ""
    assert plant.supervisor._held_ns == NOW - 139 * _MS
    switch.say(monkeypatch, 200 * _MS, held=False, known=known)
    assert plant.supervisor.mode is Mode.DISARMED


def test_a_switch_whose_clock_drifts_is_heard_for_hours_and_one_whose_clock_is_set_after_a_moment(
    switch: Switch, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = switch.plant
    for second in range(1000):
        switch.say(monkeypatch, second * _MS)
    assert plant.arm() == ""
    assert plant.supervisor._held_ns == NOW
    plant.arm(wanted=False)
    # Set once, it is late each time.
    switch.say(monkeypatch, 2500 * _MS)
    assert plant.arm().startswith("enable switch is silent for 1500 ms")
    switch.say(monkeypatch, 2499 * _MS)
    assert plant.arm().startswith("enable switch is silent for 1498 ms")
    switch.say(monkeypatch, 2499 * _MS)
    assert plant.arm() == ""
    # What is late by no more than the timeout is old by as much, and no message makes up for it.
    for late, old in ((3000, 500), (3001, 500), (3002, 500)):
        switch.say(monkeypatch, late * _MS)
        assert plant.supervisor._held_ns == NOW - old * _MS


@pytest.mark.parametrize("after", [_MS, 10 * _MS])
def test_a_fast_switch_hides_no_delay_that_grows(switch: Switch, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    plant = switch.plant
    switch.say(monkeypatch)
    assert plant.arm() == ""
    # A link that passes half of what it is given; several messages are heard at each decision.
    for late in range(0, 1000, 10):
        for each in range(10):
            switch.say(monkeypatch, (late + each) * _MS, after=after)
        plant.interface.decide()
    assert plant.supervisor.mode is Mode.DISARMED
    assert plant.supervisor.reason.startswith("disarmed: enable switch is silent for 50")


def test_a_switch_that_was_silent_for_long_may_not_be_late(switch: Switch, monkeypatch: pytest.MonkeyPatch) -> None:
    switch.say(monkeypatch)
    switch.say(monkeypatch, 900 * _MS, after=100 * NANOSECONDS)
    assert switch.plant.arm().startswith("enable switch is silent for 895 ms")


def test_a_flood_on_the_switch_keeps_no_decision_waiting(switch: Switch, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = switch.plant
    heard: list[int] = []

    def flood() -> Iterator[tuple[bytes, dict[str, int]]]:
        while len(heard) < 1000:
            heard.append(time.time_ns())
            yield serialize_message(Bool(data=True)), {"source_timestamp": heard[-1]}

    monkeypatch.setattr(plant.interface._enable, "messages", flood)
    switch.send(held=True)
    plant.interface.decide()
    # As many as the input keeps.
    assert len(heard) == 10


@pytest.mark.parametrize("data", [b"\x00\x01\x00\x00\x02", b"\x00\x01\x00\x00\xff", b"\x00\x01\x00\x00", b""])
def test_a_message_that_is_not_true_holds_nothing(switch: Switch, data: bytes) -> None:
    plant, stamps = switch.plant, {"source_timestamp": time.time_ns(), "received_timestamp": 0}
    plant.interface._on_enable(serialize_message(Bool(data=True)), stamps)
    assert plant.arm() == ""
    plant.interface._on_enable(data, stamps)
    assert plant.supervisor.mode is Mode.DISARMED


def test_two_switches_hold_nothing(switch: Switch, monkeypatch: pytest.MonkeyPatch) -> None:
    switch.say(monkeypatch)
    assert switch.plant.arm() == ""
    switch.another(2)
    switch.say(monkeypatch)
    assert switch.plant.supervisor.mode is Mode.DISARMED
    assert switch.plant.arm().startswith("enable switch is not held")


def test_what_a_switch_said_while_the_plant_was_prepared_is_heard_before_it_is_armed(switch: Switch) -> None:
    plant, now_ns = switch.plant, NOW
    plant.interface.clock = lambda: now_ns
    plant.interface._on_enable(serialize_message(Bool(data=True)), {"source_timestamp": time.time_ns()})

    def prepare() -> str:
        nonlocal now_ns
        switch.send(held=True)
        now_ns += NANOSECONDS
        plant.interface.sample = JointSample.of_one(now_ns, 0.0, 0.0)
        return ""

    plant.supervisor._prepare = prepare
    plant.supervisor._measure = plant.interface.measured
    assert plant.arm() == ""


def test_a_switch_is_heard_by_one_thread_at_a_time(switch: Switch) -> None:
    hearing = threading.Thread(target=switch.plant.interface.measured)
    with switch.plant.supervisor.alone():
        hearing.start()
        hearing.join(0.2)
        assert hearing.is_alive()
    hearing.join(30.0)
    assert not hearing.is_alive()


def test_a_decision_that_differs_from_the_one_before_is_logged_and_published_once(plant: Plant) -> None:
    for _ in range(2):
        assert plant.interface.decide().kind is DriveKind.OFF
    assert plant.arm() == ""
    for _ in range(2):
        assert plant.interface.decide().starved
    disarmed, armed = "disarmed: not armed yet", "armed_effort: no fresh command: zero torque"
    assert [text for text in plant.said if text.startswith(("info", "warning"))] == [
        f"info: {disarmed}",
        f"warning: {armed}",
    ]
    assert len([text for text in plant.said if text.startswith("plant_mode")]) == 2


def test_a_release_is_heard_by_the_very_next_decision(switch: Switch) -> None:
    plant = switch.plant
    switch.send(held=True)
    assert plant.interface.decide().kind is DriveKind.OFF
    assert plant.arm() == ""
    assert plant.interface.decide().kind is DriveKind.EFFORT
    switch.send(held=False)
    assert plant.interface.decide().kind is DriveKind.OFF
    assert plant.supervisor.reason.startswith("disarmed: enable switch is not held")
