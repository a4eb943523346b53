"""Inputs and requests that a node polls instead of being woken for each message.

A plant with deadlines needs no torque before the next one: polling there saves one wake-up a period, a third of its
time at 1 kHz, and bounds the cost of a flood of messages. Requests are polled too: a client that calls without pause
would hold the GIL, and block the threads of actuator and e-stop.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription

from pendulum_msgs_py.ros.arrivals import ArrivalSignal
from pendulum_msgs_py.ros.requests import MOST_BYTES, TooLarge, take_request
from pendulum_msgs_py.ros.timers import create_wall_timer

__all__ = ["REST_AFTER_READING", "PolledInput", "PollingNode", "WaitedInput"]

REST_AFTER_READING = 4.0
"""Pause after reading, relative to its CPU time: reading takes at most a fifth."""
_LOOK_FOR_REQUESTS = 0.01
"""Poll period of requests [s]."""
_LONGEST_REST = 0.1
"""Longest pause [s]: a client waits after a change of state, which computes long."""
_LONGEST_LOOK = 0.001
"""CPU time after which a poll takes no further request [s]; a period at 500 Hz has 2 ms."""


class PolledInput:
    """A raw subscription of a :class:`PollingNode` that its owner polls, at most ``depth`` messages at once."""

    def __init__(self, subscription: Subscription, depth: int) -> None:
        self.subscription = subscription
        self.depth = depth
        self._take = subscription.handle.take_message
        self._type = subscription.msg_type
        self._looks = range(depth)
        self._signal: ArrivalSignal | None = None

    def watch(self) -> None:
        """Let the middleware signal arrivals, for frequent polls of rare messages."""
        self._signal = ArrivalSignal([self.subscription])

    @property
    def descriptor(self) -> int:
        """The event counter of arrivals, or -1 without :meth:`watch`."""
        return -1 if self._signal is None else self._signal.descriptor

    def came(self) -> bool:
        """Return whether anything may have come since the last call; always, without :meth:`watch`."""
        return self._signal is None or self._signal.came()

    def take(self, receive: Callable[[bytes, int], object]) -> None:
        """Pass new messages, serialised, with their arrival in system time [ns], in the node's thread."""
        for _ in self._looks:
            taken = self._take(self._type, True)
            if taken is None:
                return
            receive(taken[0], taken[1]["received_timestamp"])

    def messages(self) -> Iterator[tuple[bytes, Mapping[str, int]]]:
        """Yield new messages, serialised, with the middleware's information; from any thread."""
        with self.subscription.handle:
            while (taken := self._take(self._type, True)) is not None:
                yield taken


class WaitedInput(PolledInput):
    """A raw subscription that its owner waits for if the middleware signals arrivals; otherwise an executor serves it.

    ``receive`` is the subscription's callback and gets each message, serialised, in the node's thread.
    """

    def __init__(
        self, subscription: Subscription, depth: int, receive: Callable[[bytes], object], signal: ArrivalSignal
    ) -> None:
        super().__init__(subscription, depth)
        self._signal = signal
        self._arrivals = signal
        self._receive = receive

    @property
    def works(self) -> bool:
        """Whether its owner waits for it."""
        return self._arrivals.works

    def serve(self, longest: float) -> bool:
        """Pass new messages, and those that come within a time [s]; return whether there were any."""
        ends, any_came = time.monotonic() + longest, False
        while True:
            for _ in self._looks:
                taken = self._take(self._type, True)
                if taken is None:
                    break
                any_came = True
                self._receive(taken[0])
            left = ends - time.monotonic()
            if left <= 0.0 or not self._arrivals.wait(left):
                return any_came


class PollingNode(Node):
    """A node with polled inputs, alongside subscriptions served by an executor.

    It has no ``__init__``: rclpy's lifecycle node, a possible sibling, calls that of ``Node`` directly.
    """

    _polled: frozenset[Subscription] = frozenset()
    _served_in_turn: frozenset[Service] = frozenset()
    _in_turn: deque[Service]
    _requests: ArrivalSignal | None = None
    _more_requests = False
    _next_look = 0.0
    _attend_at = 0.0
    request_ns = 0
    """Arrival of the request being answered, in system time [ns]; 0 if unknown."""

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions served by an executor."""
        return (each for each in super().subscriptions if each not in self._polled)

    @property
    def services(self) -> Iterator[Service]:
        """The services served by an executor."""
        return (each for each in super().services if each not in self._served_in_turn)

    @property
    def notified_of_requests(self) -> bool:
        """Whether the middleware signals requests; otherwise each service is polled every 10 ms."""
        return self._requests is not None and self._requests.works

    @property
    def request_descriptor(self) -> int:
        """The event counter of requests; -1 for none."""
        return -1 if self._requests is None else self._requests.descriptor

    def wake(self) -> None:
        """Make the node's thread poll now, from any thread."""
        if self._requests is not None:
            self._requests.wake()

    def poll_services(self, *, timer: bool = True) -> None:
        """Serve the present services by polling at a bounded rate, one request after the other.

        Without ``timer``, the owner of the node's thread calls :meth:`attend`; each tick of a timer wakes two threads.
        """
        self._in_turn = deque(self.services)
        self._served_in_turn = frozenset(self._in_turn)
        self._requests = ArrivalSignal(self._in_turn)
        if timer:
            create_wall_timer(self, _LOOK_FOR_REQUESTS, self._look_for_requests)

    def attend(self) -> float:
        """Poll requests if due; return the time until the next poll [s], 0 after one."""
        left = self._attend_at - time.monotonic()
        if left > 0.0:
            return left
        self._look_for_requests()
        self._attend_at = time.monotonic() + _LOOK_FOR_REQUESTS
        return 0.0

    def _look_for_requests(self) -> None:
        """Answer waiting requests within the limit of a poll; DDS keeps the ten newest of a client."""
        if time.monotonic() < self._next_look:
            return
        if self._requests is not None and not (self._requests.came() or self._more_requests):
            return
        began, spent, silent = time.thread_time(), 0.0, 0
        while silent < len(self._in_turn) and spent <= _LONGEST_LOOK:
            # Round robin, also under a flood of requests to one service.
            service = self._in_turn[0]
            self._in_turn.rotate(-1)
            silent = 0 if self._answer_one(service) else silent + 1
            spent = time.thread_time() - began
        self._more_requests = silent < len(self._in_turn)
        if spent > _LONGEST_LOOK:
            self._next_look = time.monotonic() + min(_LONGEST_REST, REST_AFTER_READING * spent)

    def _answer_one(self, service: Service) -> bool:
        request, header = take_request(service)
        if header is None:
            return False
        self.request_ns = header.received_timestamp
        response = service.srv_type.Response()
        if isinstance(request, TooLarge):
            # An empty response, so that the client does not wait.
            self.get_logger().error(
                f"request to {service.srv_name} has {request.size / 1e3:.0f} kB; expected at most "
                f"{MOST_BYTES / 1e3:.0f} kB: not read",
                throttle_duration_sec=1.0,
            )
        else:
            response = service.callback(request, response)
        service.send_response(response, header)
        return True

    def create_polled_input(self, message_type: type, topic: str, profile: QoSProfile) -> PolledInput:
        """Return an input that wakes no executor."""
        subscription = self.create_subscription(message_type, topic, _never_called, profile, raw=True)
        self._polled |= {subscription}
        return PolledInput(subscription, profile.depth)

    def create_waited_input(
        self, message_type: type, topic: str, profile: QoSProfile, receive: Callable[[bytes], object]
    ) -> WaitedInput:
        """Return an input for the owner of the node's thread to wait for.

        ``receive`` gets each message, serialised: from :meth:`WaitedInput.serve`, or from the executor without signals.
        """
        subscription = self.create_subscription(message_type, topic, receive, profile, raw=True)
        signal = ArrivalSignal([subscription])
        if signal.works:
            self._polled |= {subscription}
        return WaitedInput(subscription, profile.depth, receive, signal)

    def destroy_polled_input(self, polled: PolledInput) -> None:
        """Destroy an input."""
        self.destroy_subscription(polled.subscription)
        self._polled -= {polled.subscription}


def _never_called(_data: bytes) -> None:
    raise AssertionError("a polled input was handed to an executor")
