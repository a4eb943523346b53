"""The console survives what plants do: a broken service, events without sense, a torque that is no longer sent."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from pendulum_console.console.console_node import Hub
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.ros import qos
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer

FIRST, SECOND = "/first/plant", "/second/plant"
DEADLINE = 20.0


class Lab:
    """Two plants that can only be stopped, and a console."""

    def __init__(self) -> None:
        self.peer = GraphPeer("plants")
        self.stopped: list[str] = []
        for plant in (FIRST, SECOND):
            # Before the other: of two requests that wait, a reset is served first.
            self.peer.node.create_service(Trigger, f"{plant}/e_stop_reset", self._reset(plant))
            self.peer.node.create_service(Trigger, f"{plant}/e_stop", self._stop(plant))
        self.events = self.peer.node.create_publisher(String, "/first/events", qos.EVENTS)
        self.hub = Hub()
        self.until(lambda: len(self.hub.plants()) == 2, "plants")

    def _stop(self, plant: str) -> Callable[..., Trigger.Response]:
        def stop(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            self.stopped.append(plant)
            response.success = True
            return response

        return stop

    def _reset(self, plant: str) -> Callable[..., Trigger.Response]:
        def reset(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success = plant in self.stopped
            self.stopped = [one for one in self.stopped if one != plant]
            return response

        return reset

    def until(self, condition: Callable[[], object], what: str) -> None:
        self.peer.until(condition, what, DEADLINE)

    def reset(self, plant: str, meanwhile: Callable[[], object] = lambda: None) -> str:
        """Reset a plant by the console, with something done before the plants serve again; return what is refused."""
        refusals: list[str] = []

        def press() -> None:
            try:
                asyncio.run(self.hub.reset(plant))
            except FaultError as error:
                refusals.append(str(error))

        pressed = threading.Thread(target=press)
        pressed.start()
        meanwhile()
        self.until(lambda: not pressed.is_alive(), "answer to the reset")
        return "".join(refusals)

    def state(self, plant: str) -> str:
        order = self.hub.stop_state()
        return "" if order is None else str(order["rows"][plant]["state"])

    def close(self) -> None:
        self.hub.close()
        self.peer.close()


@pytest.fixture
def lab(domain_id: int) -> Iterator[Lab]:
    made = Lab()
    yield made
    made.close()


def test_a_plant_whose_service_breaks_keeps_no_other_from_being_stopped(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = lab.hub._stop_client
    broken = [True]

    def client_of(node: str) -> Any:
        if node == FIRST and broken:
            raise RuntimeError("client of a service that is gone")
        return find(node)

    monkeypatch.setattr(lab.hub, "_stop_client", client_of)
    asyncio.run(lab.hub.e_stop())
    lab.until(lambda: lab.state(SECOND) == "stopped", "stop of the other plant")
    order = lab.hub.stop_state()
    assert order is not None
    assert order["rows"][FIRST]["state"] == "asked"
    assert "client of a service that is gone" in order["rows"][FIRST]["text"]
    broken.clear()
    lab.until(lambda: lab.state(FIRST) == "stopped", "stop of a plant that is whole again")


def test_a_reset_is_not_overtaken_by_a_stop_that_was_asked_for_before(lab: Lab) -> None:
    # Nobody serves the plants meanwhile: the stop is on its way when the reset is pressed.
    asyncio.run(lab.hub.e_stop([FIRST]))
    assert lab.reset(FIRST, lambda: time.sleep(0.3)) == ""
    lab.peer.spin(0.3)
    assert lab.stopped == []


def test_a_reset_that_waits_takes_back_no_stop_that_is_pressed_after_it(lab: Lab) -> None:
    asyncio.run(lab.hub.e_stop([FIRST]))

    def press_again() -> None:
        # Its thread has begun when it has taken the first stop back.
        wait_for(lambda: not lab.hub._order.holds(FIRST), DEADLINE, "the reset to wait")
        asyncio.run(lab.hub.e_stop([FIRST]))

    assert "got another stop meanwhile" in lab.reset(FIRST, press_again)
    assert lab.state(FIRST) == "stopped"
    assert FIRST in lab.stopped


def test_a_stop_that_a_plant_died_over_holds_no_later_reset_up(lab: Lab) -> None:
    asyncio.run(lab.hub.e_stop([FIRST]))
    lab.until(lambda: lab.state(FIRST) == "stopped", "stop")
    lab.hub._stop_calls[FIRST].append((time.monotonic() - 60.0, Future(executor=None)))
    began = time.monotonic()
    assert lab.reset(FIRST) == ""
    assert time.monotonic() - began < 2.0


def test_an_event_that_makes_no_sense_keeps_no_answer_to_a_stop_away(lab: Lab) -> None:
    lab.until(lab.events.get_subscription_count, "console that hears events")
    for stamp in ("yesterday", None, [1]):
        lab.events.publish(String(data=json.dumps({"name": "plant_mode", "mode": "nonsense", "stamp_ns": stamp})))
    lab.events.publish(String(data=json.dumps({"name": "plant_mode", "mode": "disarmed", "stamp_ns": time.time_ns()})))
    lab.until(lambda: lab.hub.frame()["/first"]["mode"] == "disarmed", "event after it")
    asyncio.run(lab.hub.e_stop())
    lab.until(lambda: lab.state(FIRST) == lab.state(SECOND) == "stopped", "answers of both plants")


def test_a_torque_that_nobody_sends_any_more_is_not_shown_as_if_somebody_did(lab: Lab) -> None:
    states = lab.peer.node.create_publisher(JointState, "/first/joint_states", qos.STATE)
    commands = lab.peer.node.create_publisher(JointState, "/first/effort_command", qos.COMMAND)

    def shown(*, commanded: bool) -> dict[str, Any]:
        now = time.time_ns()
        states.publish(encode_joint_state(now, position=1.0, velocity=0.0, effort=0.0))
        if commanded:
            commands.publish(encode_joint_state(now, frame_id="somebody", effort=0.7))
        joints: list[dict[str, Any]] = lab.hub.frame()["/first"]["joints"]
        return joints[0] if joints else {}

    lab.until(lambda: shown(commanded=True).get("command") == 0.7, "command in the picture")
    lab.until(lambda: "command" not in shown(commanded=False), "picture without it")
    assert shown(commanded=False)["theta"] == 1.0
