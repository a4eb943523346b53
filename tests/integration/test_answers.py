"""A client that has gone holds up neither the service nor the process, on real DDS."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Iterator

import pytest
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.experimental import EventsExecutor
from rclpy.task import Future
from std_srvs.srv import Trigger

from pendulum_msgs_py.ros import arrivals
from pendulum_msgs_py.ros.answers import answer_who_listens
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_testing.graph_peer import GraphPeer

REQUESTS = 30
SERVICE = "/server/set_parameters"


@pytest.fixture(params=["by an executor", "in turn"])
def server(domain_id: int, request: pytest.FixtureRequest) -> Iterator[GraphPeer]:
    in_turn = request.param == "in turn"
    peer = GraphPeer("runner" if in_turn else "server", domain=domain_id, make_executor=EventsExecutor)
    if in_turn:
        peer.node = PollingNode("server", context=peer.context)
        peer.executor.add_node(peer.node)
    answer_who_listens(peer.node)
    if isinstance(peer.node, PollingNode):
        peer.node.poll_services()
    yield peer
    if in_turn:
        peer.node.destroy_node()
    peer.close()


def client_of(peer: GraphPeer) -> Client:
    client = peer.node.create_client(SetParameters, SERVICE)
    peer.until(client.service_is_ready, "the service")
    return client


def asked_and_gone(server: GraphPeer, domain_id: int, left: int) -> None:
    """Let a client leave its requests unread and go; wait until the server's graph says so."""
    peer = GraphPeer("caller", domain=domain_id)
    client = client_of(peer)
    for _ in range(REQUESTS):
        client.remove_pending_request(client.call_async(SetParameters.Request()))
    deadline = time.monotonic() + 30.0
    peer.close()
    while server.node.count_clients(SERVICE) > left:
        assert time.monotonic() < deadline, "the client is still on the graph"
        time.sleep(0.01)


def until_done(server: GraphPeer, peer: GraphPeer, future: Future, what: str) -> None:
    def done() -> bool:
        peer.spin_once(0.0)
        return bool(future.done())

    server.until(done, what)


def in_vain(caught: list[warnings.WarningMessage]) -> int:
    """Return how often the middleware has waited for a client, holding Python's lock."""
    return sum("client will not receive response" in str(each.message) for each in caught)


def test_a_client_that_went_with_requests_unread_is_not_waited_for(server: GraphPeer, domain_id: int) -> None:
    asked_and_gone(server, domain_id, left=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        server.spin(0.3)
    assert in_vain(caught) == 0
    peer = GraphPeer("next", domain=domain_id)
    future = client_of(peer).call_async(SetParameters.Request())
    try:
        until_done(server, peer, future, "the answer to who comes next")
    finally:
        peer.close()


def test_a_client_that_went_is_waited_for_once_where_another_is_there(server: GraphPeer, domain_id: int) -> None:
    peer = GraphPeer("other", domain=domain_id)
    client = client_of(peer)
    try:
        asked_and_gone(server, domain_id, left=1)
        future = client.call_async(SetParameters.Request())
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            until_done(server, peer, future, "the answer to the other client")
        assert in_vain(caught) <= 1
    finally:
        peer.close()


@pytest.mark.parametrize("server", ["in turn"], indirect=True)
def test_another_client_whose_requests_have_the_next_numbers_is_answered(server: GraphPeer, domain_id: int) -> None:
    """Numbers are each client's own, and rclpy does not tell whose they are."""
    peer = GraphPeer("other", domain=domain_id)
    client = client_of(peer)
    try:
        for _ in range(REQUESTS + 5):
            until_done(server, peer, client.call_async(SetParameters.Request()), "an answer before")
        asked_and_gone(server, domain_id, left=1)
        until_done(server, peer, client.call_async(SetParameters.Request()), "the answer to the other client")
    finally:
        peer.close()


@pytest.mark.parametrize(("told", "at_once"), [(True, 3), (False, 1)], ids=["told by the middleware", "judged by time"])
def test_who_was_answered_by_a_thread_that_then_stood_still_is_answered_again(
    domain_id: int, told: bool, at_once: int
) -> None:
    """Such a thread has waited for as long as for a client that has gone."""
    server = GraphPeer("runner", domain=domain_id)
    node = PollingNode("server", context=server.context)
    service = node.create_service(Trigger, "~/ask", lambda _, response: response)
    answer_who_listens(node)
    answers = service.send_response.__self__
    send, stalls, ends = answers._send, [0.12], threading.Event()

    def send_and_stall(response: Trigger.Response, header: object) -> bool | None:
        gone = send(response, header)
        time.sleep(stalls.pop() if stalls else 0.0)
        return gone if told else None

    def serve() -> None:
        while not ends.is_set():
            server.spin_once()

    answers._send = send_and_stall
    node.poll_services()
    server.executor.add_node(node)
    peer = GraphPeer("asker", domain=domain_id)
    client = peer.node.create_client(Trigger, "/server/ask")
    serving = threading.Thread(target=serve)
    try:
        peer.until(client.service_is_ready, "the service")
        first = [client.call_async(Trigger.Request()) for _ in range(at_once)]
        serving.start()
        peer.until(lambda: all(future.done() for future in first), "the answers to all at once", 10.0)
        peer.until(client.call_async(Trigger.Request()).done, "the answer to the next", 10.0)
    finally:
        ends.set()
        if serving.ident is not None:
            serving.join()
        node.destroy_node()
        peer.close()
        server.close()


@pytest.mark.parametrize("told", [True, False], ids=["told by the middleware", "looked for"])
def test_requests_without_pause_are_answered_at_a_bounded_rate_and_every_service_has_its_turn(
    domain_id: int, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not told:
        monkeypatch.setattr(arrivals, "_count", lambda *_: False)
    peer = GraphPeer("asker", domain=domain_id)
    node = PollingNode("plant", context=peer.context)
    answered: list[str] = []

    def busy(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        began = time.thread_time()
        while time.thread_time() - began < 0.002:
            pass
        answered.append("busy")
        return response

    def other(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        answered.append("other")
        return response

    node.create_service(Trigger, "~/busy", busy)
    node.create_service(Trigger, "~/other", other)
    peer.executor.add_node(node)
    answer_who_listens(node)
    node.poll_services()
    assert node.notified_of_requests is told
    try:
        assert list(node.services) == [], "an executor is woken for requests"
        flood, client = (peer.node.create_client(Trigger, f"/plant/{name}") for name in ("busy", "other"))
        peer.until(lambda: flood.service_is_ready() and client.service_is_ready(), "the services")
        waiting = [flood.call_async(Trigger.Request()) for _ in range(8)]
        future = client.call_async(Trigger.Request())
        peer.until(lambda: len(answered) >= 2, "the first answers")
        # One that takes longer than a look may is the only one of it, and the other service does not stand behind all.
        looks = answered.index("other")
        assert looks <= 2, f"the other service was asked after {looks} requests of the first"
        peer.until(lambda: future.done() and all(each.done() for each in waiting), "all answers")
        node._next_look = time.monotonic() + 60.0
        waiting = [flood.call_async(Trigger.Request()) for _ in range(3)]
        peer.spin(0.1)
        assert len(answered) == 9, "a look came before the rest was over"
        node._next_look, began = 0.0, time.monotonic()
        node._look_for_requests()
        assert answered[9:] == ["busy"], "a look that had its time went on"
        # The 2 ms of the answer, and four times as long without a look; not as of now, which may be later.
        assert node._next_look - began >= 0.01
    finally:
        node.destroy_node()
        peer.close()


def test_a_node_without_a_timer_answers_where_its_owner_attends_to_it(
    domain_id: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = GraphPeer("asker", domain=domain_id)
    node = PollingNode("plant", context=peer.context)
    node.create_service(Trigger, "~/ask", lambda _, response: response)
    answer_who_listens(node)
    node.poll_services(timer=False)
    assert list(node.timers) == []
    try:
        client = peer.node.create_client(Trigger, "/plant/ask")
        peer.until(client.service_is_ready, "the service")
        future = client.call_async(Trigger.Request())
        waits: list[float] = []

        def attended() -> bool:
            waits.append(node.attend())
            return bool(future.done())

        peer.until(attended, "the answer")
        assert 0.0 in waits, "it never looked"
        now = time.monotonic()
        monkeypatch.setattr("pendulum_msgs_py.ros.polled.time.monotonic", lambda: now)
        node.attend()
        assert node.attend() > 0.0, "it looks without pause"
    finally:
        node.destroy_node()
        peer.close()


def test_a_request_that_nobody_understands_gets_an_empty_answer_and_the_next_is_served(
    server: GraphPeer, domain_id: int
) -> None:
    server.node.declare_parameter("a", 1.0)
    peer = GraphPeer("asker", domain=domain_id)
    client = client_of(peer)
    # A parameter of no known type, and one of a type that is known.
    for kind, answers in ((99, []), (3, [True])):
        value = ParameterValue(type=kind, double_value=2.0)
        future = client.call_async(SetParameters.Request(parameters=[Parameter(name="a", value=value)]))
        until_done(server, peer, future, f"the answer to a parameter of type {kind}")
        assert [each.successful for each in future.result().results] == answers
    assert server.node.get_parameter("a").value == 2.0
    peer.close()


def test_a_fault_in_a_service_of_the_node_itself_ends_it(domain_id: int) -> None:
    server = GraphPeer("server", domain=domain_id, make_executor=EventsExecutor)

    def fail(_request: Trigger.Request, _response: Trigger.Response) -> Trigger.Response:
        raise RuntimeError("the file of the recording is gone")

    server.node.create_service(Trigger, "~/fail", fail)
    answer_who_listens(server.node)
    peer = GraphPeer("asker", domain=domain_id)
    client = peer.node.create_client(Trigger, "/server/fail")
    peer.until(client.service_is_ready, "the service")
    future = client.call_async(Trigger.Request())
    with pytest.raises(RuntimeError, match="the file of the recording is gone"):
        until_done(server, peer, future, "the fault")
    peer.close()
    server.close()
