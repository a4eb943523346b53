"""The threads of the e-stop and of its button: no error, clock or quick release takes them away."""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.client import Client
from rclpy.clock import ClockType
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from pendulum_hw_bridge.nodes.e_stop_input_node import EStopInputServer
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Mode, PlantLimits
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.programs.realtime import NO_REALTIME, may_run_in_real_time, thread_numbers
from pendulum_msgs_py.ros.answers import answer_who_listens
from pendulum_msgs_py.ros.e_stop import EStopServer
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.polled import PollingNode

DEADLINE = 20.0


class Desk:
    """A plant's node, a person's node, and what was latched."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.owner = Node("plant", context=self.context)
        self.person = Node("person", context=self.context)
        self.reasons: list[str] = []
        self.broken = False
        self.servers: list[EStopServer | EStopInputServer] = []
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.person)

    def press(self, reason: str) -> None:
        if self.broken:
            self.broken = False
            raise RuntimeError("a middleware that fails once")
        self.reasons.append(reason)

    def until(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < deadline, f"no {what}"
            self._executor.spin_once(timeout_sec=0.01)

    def close(self) -> None:
        for server in self.servers:
            server.close()
        self._executor.shutdown()
        self.person.destroy_node()
        self.owner.destroy_node()
        rclpy.shutdown(context=self.context)


@pytest.fixture
def desk(domain_id: int) -> Iterator[Desk]:
    made = Desk(domain_id)
    yield made
    made.close()


def test_an_error_in_the_e_stop_is_a_press_and_the_next_press_is_answered(desk: Desk) -> None:
    desk.servers.append(EStopServer(desk.owner, desk.press))
    client = desk.person.create_client(Trigger, "plant/e_stop")
    desk.until(client.service_is_ready, "e-stop")
    desk.broken = True
    client.call_async(Trigger.Request())
    desk.until(lambda: desk.reasons, "press of an e-stop that failed")
    assert desk.reasons == ["e-stop itself failed: RuntimeError: a middleware that fails once"]
    answer = client.call_async(Trigger.Request())
    desk.until(answer.done, "answer of the e-stop after an error")
    assert answer.result().success
    assert desk.reasons[1:] == ["e-stop pressed"]


def test_a_plant_stops_and_compiled_code_ends_though_the_thread_of_the_e_stop_does_not_run(desk: Desk) -> None:
    plant = PollingNode("polled", context=desk.context)
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    interface = PlantInterface(plant, supervisor, time.monotonic_ns, polled=True)
    plant.poll_services(timer=False)
    desk.servers.append(interface._e_stop)
    held, entered = threading.Lock(), threading.Event()

    def kept_waiting(_reason: str) -> None:
        entered.set()
        with held:
            pass

    interface._e_stop._press = kept_waiting
    client = desk.person.create_client(Trigger, "polled/e_stop")
    desk.until(client.service_is_ready, "e-stop")
    called = interface.calls[0]
    assert supervisor.arm(interface.clock(), JointSample.of_one(interface.clock(), 0.0, 0.0)) == ""
    with held:
        first = client.call_async(Trigger.Request())
        desk.until(entered.is_set, "thread of the e-stop that waits")
        assert not select.select([called], [], [], 0.0)[0]
        assert supervisor.mode is Mode.EFFORT
        second = client.call_async(Trigger.Request())
        desk.until(lambda: select.select([called], [], [], 0.0)[0], "end of a slice of compiled code")
        supervisor.decide(interface.clock(), JointSample.of_one(interface.clock(), 0.0, 0.0))
        assert (supervisor.mode, supervisor.reason) == (Mode.E_STOP, "e-stop pressed")
        # What was read does not end the next slice.
        assert not select.select([called], [], [], 0.0)[0]
    desk.until(lambda: first.done() and second.done(), "answers")
    plant.destroy_node()


def test_a_reset_or_arming_that_waited_in_a_queue_while_the_e_stop_was_pressed_takes_nothing_back(desk: Desk) -> None:
    plant = PollingNode("polled", context=desk.context)
    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)))
    interface = PlantInterface(plant, supervisor, time.monotonic_ns, polled=True)
    answer_who_listens(plant)
    plant.poll_services(timer=False)
    desk.servers.append(interface._e_stop)
    interface.sample = JointSample.of_one(0, 0.0, 0.0)
    interface.clock = lambda: 0
    reset = desk.person.create_client(Trigger, "polled/e_stop_reset")
    arm = desk.person.create_client(SetBool, "polled/arm")
    desk.until(lambda: reset.service_is_ready() and arm.service_is_ready(), "services")

    def ask(client: Client, request: object, *, before_a_press: bool) -> tuple[bool, str]:
        future = client.call_async(request)
        desk.until(lambda: select.select([plant.request_descriptor], [], [], 0.0)[0], "request")
        if before_a_press:
            interface.e_stop("meanwhile")
        desk.until(lambda: (plant.attend(), future.done())[1], "answer")
        return future.result().success, future.result().message

    told = "asked for before the e-stop was pressed; "
    interface.e_stop("first")
    assert ask(reset, Trigger.Request(), before_a_press=True) == (False, f"{told}reset it once more")
    assert supervisor.mode is Mode.E_STOP
    assert ask(reset, Trigger.Request(), before_a_press=False) == (True, "disarmed")
    assert ask(arm, SetBool.Request(data=True), before_a_press=True) == (False, f"{told}ask again")
    assert ask(reset, Trigger.Request(), before_a_press=False) == (True, "disarmed")
    assert ask(arm, SetBool.Request(data=True), before_a_press=False) == (True, "armed_effort")
    plant.destroy_node()


@pytest.mark.skipif(not may_run_in_real_time(50), reason="this user may have no real-time priority")
@pytest.mark.parametrize("forbidden", [False, True])
def test_the_threads_of_an_e_stop_go_before_ordinary_ones_where_the_user_may(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, forbidden: bool
) -> None:
    monkeypatch.delenv(NO_REALTIME, raising=False)
    if forbidden:
        monkeypatch.setenv(NO_REALTIME, "1")
    before = thread_numbers()
    desk.servers.append(EStopServer(desk.owner, desk.press))
    # Its own thread, and those of its participant.
    added = thread_numbers() - before
    assert len(added) > 3
    expected = os.SCHED_OTHER if forbidden else os.SCHED_FIFO
    assert {os.sched_getscheduler(thread) for thread in added} == {expected}
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_press_counts_though_the_release_came_before_it_was_read(desk: Desk) -> None:
    server = EStopInputServer(desk.owner, 60.0, desk.press, lambda: bool(desk.reasons))
    desk.servers.append(server)
    held, heard = threading.Lock(), threading.Event()
    hear = server._input.hear

    def slow(*, pressed: bool, now_ns: int) -> None:
        heard.set()
        with held:
            hear(pressed=pressed, now_ns=now_ns)

    server._input.hear = slow  # type: ignore[method-assign]
    button = desk.person.create_publisher(Bool, names.E_STOP_INPUT, 10)
    desk.until(button.get_subscription_count, "listener of the button")
    with held:
        # The thread is busy with the first message while the button is pressed and released.
        while not heard.is_set():
            button.publish(Bool(data=False))
            desk.until(lambda: heard.wait(0.01) or True, "message")
        for pressed in [True, False, False]:
            button.publish(Bool(data=pressed))
        sent = time.monotonic() + 0.3
        desk.until(lambda: time.monotonic() > sent, "time for three messages to arrive")
    desk.until(lambda: desk.reasons, "press of the button")
    assert desk.reasons == ["e-stop button is pressed"]


def test_an_error_of_the_button_is_a_press_and_silence_is_noticed_after_it(desk: Desk) -> None:
    desk.broken = True
    desk.servers.append(EStopInputServer(desk.owner, 0.2, desk.press, lambda: False))
    desk.until(lambda: any("never heard" in reason for reason in desk.reasons), "press by silence")
    assert desk.reasons[0].startswith("e-stop itself failed")


def test_silence_of_the_button_is_measured_by_a_clock_that_nobody_sets(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks, periods_ns = [], []
    create_timer = Node.create_timer

    def watched(node: Node, *arguments: object, **named: object) -> object:
        timer = create_timer(node, *arguments, **named)
        clocks.append(timer.clock.clock_type)
        periods_ns.append(timer.timer_period_ns)
        return timer

    monkeypatch.setattr(Node, "create_timer", watched)
    desk.servers.append(EStopInputServer(desk.owner, 1.0, desk.press, lambda: False))
    # Silence is noticed a quarter of its limit late at most.
    assert periods_ns == [250_000_000]
    assert clocks == [ClockType.STEADY_TIME]
