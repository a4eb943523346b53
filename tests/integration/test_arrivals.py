"""Who looks for requests and inputs himself is told by the middleware that something has come, on real DDS."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.ros import arrivals, qos
from pendulum_msgs_py.ros.arrivals import ArrivalSignal
from pendulum_msgs_py.ros.polled import PolledInput, PollingNode
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer

ROUNDS = 8
"""Entities that go under fire; 1000 were tried by hand."""
STATE = encode_joint_state(1, position=1.0, velocity=2.0, effort=3.0)


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("sender", domain=domain_id)
    yield peer
    peer.close()


@pytest.fixture
def node(peer: GraphPeer) -> Iterator[PollingNode]:
    node = PollingNode("plant", context=peer.context)
    yield node
    node.destroy_node()


def taken(source: PolledInput) -> int:
    """Return how many messages were waiting."""
    messages: list[bytes] = []
    source.take(lambda data, _: messages.append(data))
    return len(messages)


def test_an_input_that_is_watched_is_notified_once_of_what_came_and_not_of_what_did_not(
    peer: GraphPeer, node: PollingNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrivals, "_LONGEST_TRUST", 1e6)
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    source = node.create_polled_input(JointState, "states", qos.COMMAND_INPUT)
    assert source.came(), "an input that nobody watches may always have something"
    wait_for(lambda: states.get_subscription_count() == 1, 30.0, "the match")
    states.publish(STATE)
    wait_for(lambda: taken(source) == 1, 30.0, "the state")
    states.publish(STATE)
    source.watch()
    source.came()  # whatever was before
    for _ in range(3):
        states.publish(STATE)
        wait_for(source.came, 30.0, "word of a state")
        wait_for(lambda: taken(source) > 0, 30.0, "the state")
    assert not source.came()


def test_what_waited_before_somebody_watched_is_reported(peer: GraphPeer, node: PollingNode) -> None:
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    source = node.create_polled_input(JointState, "states", qos.COMMAND_INPUT)
    wait_for(lambda: states.get_subscription_count() == 1, 30.0, "the match")
    states.publish(STATE)
    source.watch()
    wait_for(source.came, 30.0, "word of the state")


def test_after_a_second_without_word_somebody_looks_all_the_same(
    node: PollingNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("pendulum_msgs_py.ros.arrivals.time.monotonic", lambda: now[0])
    signal = ArrivalSignal([node.create_service(Trigger, "~/ask", lambda _, response: response)])
    assert signal.works
    assert (signal.came(), signal.came()) == (True, False)
    now[0] += 1.01
    assert (signal.came(), signal.came()) == (True, False)


@pytest.mark.parametrize("told", [True, False], ids=["told by the middleware", "looked for"])
def test_who_waits_is_woken_by_a_message(
    peer: GraphPeer, node: PollingNode, monkeypatch: pytest.MonkeyPatch, told: bool
) -> None:
    if not told:
        monkeypatch.setattr(arrivals, "_count", lambda *_: False)
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    source = node.create_polled_input(JointState, "states", qos.COMMAND_INPUT)
    wait_for(lambda: states.get_subscription_count() == 1, 30.0, "the match")
    signal = ArrivalSignal([source.subscription])
    assert signal.works is told
    signal.came()
    assert signal.wait(0.001) is not told, "somebody was told of what had not come"
    states.publish(STATE)
    found, patience = 0, 60.0
    while not found and patience > 0.0:
        before = time.monotonic()
        if signal.wait(patience):
            found = taken(source)
        patience -= time.monotonic() - before
    assert found == 1


@pytest.mark.parametrize("missing", ["librcl.so", "eventfd_write", "eventfd"])
def test_where_the_middleware_cannot_tell_each_look_looks(
    node: PollingNode, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    without(missing, monkeypatch)
    signal = ArrivalSignal([node.create_service(Trigger, "~/ask", lambda _, response: response)])
    assert not signal.works
    assert [signal.came() for _ in range(3)] == [True] * 3


def without(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take something away that the signal needs, as another system or build of ROS would lack it."""
    if missing == "eventfd":
        monkeypatch.setattr(arrivals, "_free", [])
        monkeypatch.delattr(os, "eventfd")
        return
    whole = ctypes.CDLL

    def load(name: str | None, *arguments: Any, **options: Any) -> object:
        if name == missing:
            raise OSError(f"{missing}: cannot open shared object file")
        return object() if name is None and missing == "eventfd_write" else whole(name, *arguments, **options)

    monkeypatch.setattr("pendulum_msgs_py.ros.arrivals.ctypes.CDLL", load)


def test_nodes_that_go_in_the_middle_of_messages_leave_neither_a_crash_nor_a_descriptor(peer: GraphPeer) -> None:
    """The middleware's threads call for entities that are being destroyed, with an exception on the way out or not."""
    states = peer.node.create_publisher(JointState, "states", qos.STATE)
    keeper = PollingNode("keeper", context=peer.context)

    def live_and_go() -> None:
        source = keeper.create_polled_input(JointState, "states", qos.COMMAND_INPUT)
        service = keeper.create_service(Trigger, "~/ask", lambda _, response: response)
        source.watch()
        signal = ArrivalSignal([service])
        wait_for(lambda: states.get_subscription_count() >= 1, 30.0, "the match")
        for _ in range(20):
            states.publish(STATE)
        keeper.destroy_polled_input(source)
        keeper.destroy_service(service)
        assert signal.works
        raise ZeroDivisionError

    open_after: list[int] = []
    for _ in range(ROUNDS):
        with pytest.raises(ZeroDivisionError):
            live_and_go()
        gc.collect()
        open_after.append(descriptors())
    keeper.destroy_node()
    assert open_after[-1] <= open_after[1], "descriptors were left open"


def descriptors() -> int:
    """Return how many event counters this process has open."""
    found = 0
    for each in Path("/proc/self/fd").iterdir():
        try:
            found += "eventfd" in str(each.readlink())
        except OSError:
            continue
    return found
