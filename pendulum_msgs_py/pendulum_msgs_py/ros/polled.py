"""Inputs and requests that a node looks at when it needs them, instead of being woken for each message.

A plant that acts at deadlines has no use for a torque before the next one. Emptying its inputs there saves it one
wake-up a period, a third of its time at 1 kHz, and bounds what a flood of messages can cost. A recorder empties its
inputs every few milliseconds, a page when a picture is due. Requests to a plant wait for their turn as well: who asks
without pause would keep Python's lock, and with it the threads of actuator and e-stop, and a processor.
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
"""Time without a look after something big was read, in the time that it took the processor: a fifth of it at most."""
_LOOK_FOR_REQUESTS = 0.01
"""Time between two looks for requests [s]."""
_LONGEST_REST = 0.1
"""Longest time without a look [s]: after a change of state, which computes, somebody waits to go on."""
_LONGEST_LOOK = 0.001
"""Time of the processor after which a look takes no further request [s]; a period at 500 Hz has 2 ms."""


class PolledInput:
    """A subscription to raw messages that its owner empties.

    Args:
        subscription: Of a :class:`PollingNode`, raw.
        depth: Messages that it keeps; also the most that one look takes, however fast others publish.
    """

    def __init__(self, subscription: Subscription, depth: int) -> None:
        self.subscription = subscription
        self.depth = depth
        self._take = subscription.handle.take_message
        self._type = subscription.msg_type
        self._looks = range(depth)
        self._signal: ArrivalSignal | None = None

    def watch(self) -> None:
        """Have the middleware say when something comes, for an owner who looks often at what seldom comes."""
        self._signal = ArrivalSignal([self.subscription])

    @property
    def descriptor(self) -> int:
        """The event counter to which each message adds, where somebody watches; else -1."""
        return -1 if self._signal is None else self._signal.descriptor

    def came(self) -> bool:
        """Return whether anything may have come since this was asked last; always, where nobody watches."""
        return self._signal is None or self._signal.came()

    def take(self, receive: Callable[[bytes, int], object]) -> None:
        """Hand over what has come since the last look, to the thread that owns the node.

        Args:
            receive: Gets each message, serialised, and the system time at which it reached this process [ns].
        """
        for _ in self._looks:
            taken = self._take(self._type, True)
            if taken is None:
                return
            receive(taken[0], taken[1]["received_timestamp"])

    def messages(self) -> Iterator[tuple[bytes, Mapping[str, int]]]:
        """Yield what has come since the last look, serialised, with what the middleware knows of it; in any thread."""
        with self.subscription.handle:
            while (taken := self._take(self._type, True)) is not None:
                yield taken


class WaitedInput(PolledInput):
    """A subscription to raw messages that its owner waits for, where the middleware says when one comes.

    Where it does not, on other systems or with another middleware, an executor hands the messages over as ever, and
    there is nothing to wait for.

    Args:
        subscription: Of a :class:`PollingNode`, raw; ``receive`` is its callback.
        depth: Messages that it keeps; also the most that one look takes.
        receive: Gets each message, serialised, in the thread that owns the node.
        signal: Of this subscription alone.
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
        """Whether its owner waits for it; otherwise the executor attends to it."""
        return self._arrivals.works

    def serve(self, longest: float) -> bool:
        """Hand over what has come, and what comes within a time; return whether anything did.

        Args:
            longest: Time after which nothing more is waited for [s].
        """
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
    """A node that can have polled inputs besides the subscriptions that an executor attends to.

    Without ``__init__``, since rclpy's lifecycle node, which it may be joined with, calls that of ``Node`` directly.
    """

    _polled: frozenset[Subscription] = frozenset()
    _served_in_turn: frozenset[Service] = frozenset()
    _in_turn: deque[Service]
    _requests: ArrivalSignal | None = None
    _more_requests = False
    _next_look = 0.0
    _attend_at = 0.0
    request_ns = 0
    """System time at which the request being answered reached this process [ns]; 0 where that is not known."""

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor attends to."""
        return (each for each in super().subscriptions if each not in self._polled)

    @property
    def services(self) -> Iterator[Service]:
        """The services that an executor attends to."""
        return (each for each in super().services if each not in self._served_in_turn)

    @property
    def notified_of_requests(self) -> bool:
        """Whether the middleware says when a request has come; otherwise each service is looked at every 10 ms."""
        return self._requests is not None and self._requests.works

    @property
    def request_descriptor(self) -> int:
        """The event counter to which each request adds; -1 where there is none."""
        return -1 if self._requests is None else self._requests.descriptor

    def wake(self) -> None:
        """Have the node's thread look for requests, and for what else it does between two slices; from any thread."""
        if self._requests is not None:
            self._requests.wake()

    def poll_services(self, *, timer: bool = True) -> None:
        """Attend to the services that there are at a bounded rate from now on, one request after the other.

        Args:
            timer: Look by a timer; without one, the owner of the node's thread calls :meth:`attend` where it wakes up
                anyway. Each tick of a timer wakes two threads.
        """
        self._in_turn = deque(self.services)
        self._served_in_turn = frozenset(self._in_turn)
        self._requests = ArrivalSignal(self._in_turn)
        if timer:
            create_wall_timer(self, _LOOK_FOR_REQUESTS, self._look_for_requests)

    def attend(self) -> float:
        """Look for requests if it is time to; return the time until it is [s], 0 after a look that took some itself."""
        left = self._attend_at - time.monotonic()
        if left > 0.0:
            return left
        self._look_for_requests()
        self._attend_at = time.monotonic() + _LOOK_FOR_REQUESTS
        return 0.0

    def _look_for_requests(self) -> None:
        """Answer what waits, or as much of it as a look may take; DDS keeps the ten newest requests of a client."""
        if time.monotonic() < self._next_look:
            return
        if self._requests is not None and not (self._requests.came() or self._more_requests):
            return
        began, spent, silent = time.thread_time(), 0.0, 0
        while silent < len(self._in_turn) and spent <= _LONGEST_LOOK:
            # Each has its turn, whoever else is asked without pause.
            service = self._in_turn[0]
            self._in_turn.rotate(-1)
            silent = 0 if self._answer_one(service) else silent + 1
            spent = time.thread_time() - began
        self._more_requests = silent < len(self._in_turn)
        if spent > _LONGEST_LOOK:
            self._next_look = time.monotonic() + min(_LONGEST_REST, REST_AFTER_READING * spent)

    def _answer_one(self, service: Service) -> bool:
        """Answer the oldest request that waits; return whether there was one."""
        request, header = take_request(service)
        if header is None:
            return False
        self.request_ns = header.received_timestamp
        response = service.srv_type.Response()
        if isinstance(request, TooLarge):
            # With an empty answer, so that nobody waits for another.
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
        """Return an input that no executor is woken for."""
        subscription = self.create_subscription(message_type, topic, _never_called, profile, raw=True)
        self._polled |= {subscription}
        return PolledInput(subscription, profile.depth)

    def create_waited_input(
        self, message_type: type, topic: str, profile: QoSProfile, receive: Callable[[bytes], object]
    ) -> WaitedInput:
        """Return an input that the owner of the node's thread waits for, where the middleware says when one comes.

        Args:
            message_type: Of the topic.
            topic: Its name.
            profile: Quality of service.
            receive: Gets each message, serialised: from :meth:`WaitedInput.serve`, or from the executor where the
                middleware does not tell.
        """
        subscription = self.create_subscription(message_type, topic, receive, profile, raw=True)
        signal = ArrivalSignal([subscription])
        if signal.works:
            self._polled |= {subscription}
        return WaitedInput(subscription, profile.depth, receive, signal)

    def destroy_polled_input(self, polled: PolledInput) -> None:
        """Let go of an input."""
        self.destroy_subscription(polled.subscription)
        self._polled -= {polled.subscription}


def _never_called(_data: bytes) -> None:
    raise AssertionError("a polled input was handed to an executor")
