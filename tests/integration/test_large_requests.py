"""A request of any size keeps no thread of a plant from running, on real DDS."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.service import Service

from pendulum_msgs_py.ros import requests
from pendulum_msgs_py.ros.answers import answer_who_listens
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.requests import MOST_BYTES, TooLarge, take_request
from pendulum_testing.graph_peer import GraphPeer


@pytest.fixture
def peer(domain_id: int) -> Iterator[GraphPeer]:
    peer = GraphPeer("asker", domain=domain_id)
    yield peer
    peer.close()


@pytest.fixture
def node(peer: GraphPeer) -> Iterator[PollingNode]:
    node = PollingNode("plant", context=peer.context)
    node.declare_parameter("a", 1.0)
    answer_who_listens(node)
    node.poll_services()
    peer.executor.add_node(node)
    yield node
    node.destroy_node()


def client_of(peer: GraphPeer) -> Client:
    client = peer.node.create_client(SetParameters, "/plant/set_parameters")
    peer.until(client.service_is_ready, "the service")
    return client


def of_names(size: int) -> SetParameters.Request:
    """Return a request to set two parameters of which one takes so many bytes to name."""
    value = ParameterValue(type=3, double_value=2.0)
    return SetParameters.Request(parameters=[Parameter(name="a", value=value), Parameter(name="x" * size, value=value)])


def test_a_request_that_is_too_large_sets_nothing_and_gets_an_empty_answer(peer: GraphPeer, node: PollingNode) -> None:
    client = client_of(peer)
    future = client.call_async(of_names(MOST_BYTES))
    peer.until(future.done, "the answer to the large request")
    assert list(future.result().results) == []
    assert node.get_parameter("a").value == 1.0
    # A little less is read, and the next is served as ever.
    future = client.call_async(of_names(MOST_BYTES - 500))
    peer.until(future.done, "the answer to a request of just the limit")
    assert [each.successful for each in future.result().results] == [True, False]
    assert node.get_parameter("a").value == 2.0


def set_parameters(node: PollingNode) -> Service:
    return next(each for each in node._in_turn if each.srv_name.endswith("set_parameters"))


def test_other_threads_run_while_a_request_of_many_parameters_is_taken(peer: GraphPeer) -> None:
    node = PollingNode("plant", context=peer.context)
    node.poll_services(timer=False)
    try:
        # On a busy machine a thread waits for a processor, too; for Python's lock it would wait each time.
        shares = [_longest_gap(peer, set_parameters(node))]
        while shares[-1] >= 0.5 and len(shares) < 5:
            shares.append(_longest_gap(peer, set_parameters(node)))
    finally:
        node.destroy_node()
    assert min(shares) < 0.5, shares


def _longest_gap(peer: GraphPeer, service: Service) -> float:
    """Take a large request; return for how long another thread did not run, as a share of the time that it took."""
    value = ParameterValue(type=1)
    client_of(peer).call_async(SetParameters.Request(parameters=[Parameter(name="a", value=value)] * 150_000))
    gaps, done, started = [0.0], threading.Event(), threading.Event()

    def witness() -> None:
        last = time.monotonic()
        while not done.is_set():
            started.set()
            time.sleep(0.0)
            now = time.monotonic()
            gaps.append(now - last)
            last = now

    taken: list[tuple[object, float]] = []

    def take() -> bool:
        began = time.monotonic()
        request, header = take_request(service)
        if header is not None:
            taken.append((request, time.monotonic() - began))
        return bool(taken)

    thread = threading.Thread(target=witness)
    thread.start()
    started.wait()
    try:
        peer.until(take, "the request")
    finally:
        done.set()
        thread.join()
    (request, duration), *_ = taken
    assert isinstance(request, TooLarge)
    return max(gaps) / duration


def test_where_the_library_of_ros_is_not_as_expected_requests_are_taken_as_rclpy_does(
    peer: GraphPeer, node: PollingNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(requests, "_rcl", lambda: None)
    future = client_of(peer).call_async(of_names(10))
    peer.until(future.done, "the answer")
    assert [each.successful for each in future.result().results] == [True, False]
