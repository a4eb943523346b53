"""A controller that answers late, twice, never, with stamps of the past or of the future: the probe plays it.

What the plant does with it is measured on the plant's own clock, which no busy machine disturbs: a torque says from
which state on it acted, and the command that it came from says which state it answers.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sensor_msgs.msg import JointState

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.ros import qos
from tests.tools.faults.live import START_TIMEOUT, LiveSystem
from tests.tools.faults.motor import ROUNDING
from tests.tools.faults.outcome import Fault, Outcome, demand_rest
from tests.tools.faults.plants import SIMULATOR

__all__ = ["IMPOSTORS"]

_MILLISECOND = 1_000_000
_EFFORT = 0.5
_OTHER_EFFORT = -1.5
_LISTENERS = 3
"""Subscriptions to the commands: the plant's, the recorder's and the probe's."""


@dataclass
class _Impostor:
    """Answers states in the controller's name, in a way that can be changed at any moment.

    Attributes:
        system: The system whose controller has ended.
        answer: Called with each state's stamp [ns].
        valid_ns: Stamp of the newest command that a plant must believe [ns].
    """

    system: LiveSystem

    def __post_init__(self) -> None:
        self.valid_ns = 0
        self.newest_ns = 0
        self.pending: list[tuple[float, int]] = []
        self.answer: Callable[[int], None] = lambda _stamp_ns: None
        node = self.system.orchestrator.node
        self._publisher = node.create_publisher(
            JointState, f"{self.system.plant.namespace}/{names.EFFORT_COMMAND}", qos.COMMAND
        )
        self._states = node.create_subscription(
            JointState,
            f"{self.system.plant.namespace}/{names.JOINT_STATES}",
            self._on_state,
            qos.NEWEST_STATE,
            raw=True,
        )

    def is_heard(self) -> bool:
        """Tell whether plant, recorder and probe are matched, so that the bag has the command behind each torque."""
        return bool(self._publisher.get_subscription_count() >= _LISTENERS)

    def send(self, stamp_ns: int, effort: float = _EFFORT) -> None:
        frame = f"{self.system.plant.namespace}/controller"
        self._publisher.publish(encode_joint_state(stamp_ns, frame_id=frame, effort=effort))

    def punctual(self, stamp_ns: int) -> None:
        self.valid_ns = max(self.valid_ns, stamp_ns)
        self.send(stamp_ns)

    def close(self) -> None:
        # A state that has come already is still handed over.
        self.answer = lambda _stamp_ns: None
        self.pending.clear()
        self.system.orchestrator.node.destroy_subscription(self._states)
        self.system.orchestrator.node.destroy_publisher(self._publisher)

    def _on_state(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None:
            self.newest_ns = fields.stamp_ns
            self.answer(fields.stamp_ns)
        self.send_due()

    def send_due(self) -> None:
        """Send the answers that have waited long enough."""
        while self.pending and self.pending[0][0] <= time.monotonic():
            self.send(self.pending.pop(0)[1])


@contextmanager
def _in_its_place(system: LiveSystem) -> Iterator[_Impostor]:
    """Let the probe stand where the controller was, without a disturbance that would add to what it sends."""
    for name in ("controller", "disturbance"):
        system.processes.finish(system.children.pop(name))
    impostor = _Impostor(system)
    try:
        system.wait_for("plant and recorder to hear the probe", impostor.is_heard, START_TIMEOUT)
        impostor.answer = impostor.punctual
        system.bring_back("the plant to believe the probe")
        yield impostor
    finally:
        impostor.close()
        system.start("controller")
        system.start("disturbance")


def _no_longer_valid(misbehave: Callable[[_Impostor, int], None], refusal: str) -> Callable[..., Outcome]:
    """Return a fault after which nothing that is sent is valid any more: torque must end."""

    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        outcome = Outcome()
        with _in_its_place(system) as impostor:
            system.listen(generator.uniform(0.2, 0.4))
            before = system.refused().get(refusal, 0)
            impostor.answer = lambda stamp_ns: misbehave(impostor, stamp_ns)
            last_ns = impostor.valid_ns
            system.listen(1.2)
            demand_rest(outcome, system, last_ns)
            if refusal:
                counted = system.refused().get(refusal, 0) - before
                least = round(0.2 * system.plant.rate)
                outcome.demand(counted > least, f"{counted} commands counted as {refusal}; expected more than {least}")
                outcome.detail = outcome.detail or f"{counted} refused as {refusal}"
        return outcome

    return act


def _never(_impostor: _Impostor, _stamp_ns: int) -> None:
    """Do not answer."""


def _late(delay: float) -> Callable[[_Impostor, int], None]:
    def misbehave(impostor: _Impostor, stamp_ns: int) -> None:
        impostor.pending.append((time.monotonic() + delay, stamp_ns))

    return misbehave


def _shifted(milliseconds: int) -> Callable[[_Impostor, int], None]:
    def misbehave(impostor: _Impostor, stamp_ns: int) -> None:
        impostor.send(stamp_ns + milliseconds * _MILLISECOND)

    return misbehave


def _of_last_minute(impostor: _Impostor, _stamp_ns: int) -> None:
    impostor.send(impostor.valid_ns - 60_000 * _MILLISECOND)


def _zero_stamp(impostor: _Impostor, _stamp_ns: int) -> None:
    impostor.send(0)


def _a_little_late(system: LiveSystem, _: random.Random) -> Outcome:
    """Answer 20 ms late: within what a command may be old, so torque goes on."""
    outcome = Outcome()
    with _in_its_place(system) as impostor:
        impostor.answer = lambda stamp_ns: _late(0.02)(impostor, stamp_ns)
        system.listen(1.0)
        recent = system.applied[-round(0.4 * system.plant.rate) :]
        driven = sum(applied.effort != 0.0 for applied in recent)
        # A busy machine may make some of them later than that.
        outcome.demand(
            driven > 0.5 * len(recent), f"torque in {driven} of {len(recent)} periods; expected most of them"
        )
        sent = all(applied.effort == 0.0 or abs(applied.effort - _EFFORT) < ROUNDING for applied in recent)
        outcome.demand(sent, "a torque that nobody sent")
    return outcome


def _send_twice(impostor: _Impostor) -> Callable[[int], None]:
    """Answer each state in two ways: the first counts."""

    def answer(stamp_ns: int) -> None:
        impostor.send(stamp_ns)
        impostor.send(stamp_ns, _OTHER_EFFORT)

    return answer


def _send_backwards(impostor: _Impostor) -> Callable[[int], None]:
    """Answer states in pairs, the newer first: the older one must not act after the newer."""
    held: list[int] = []

    def answer(stamp_ns: int) -> None:
        held.append(stamp_ns)
        if len(held) == 2:
            impostor.send(held[1])
            impostor.send(held[0], _OTHER_EFFORT)
            held.clear()

    return answer


def _half_refused(
    answering: Callable[[_Impostor], Callable[[int], None]], refusal: str, share: float
) -> Callable[[LiveSystem, random.Random], Outcome]:
    """Answer so that one of two answers must be refused and counted, and never act."""

    def act(system: LiveSystem, _: random.Random) -> Outcome:
        outcome = Outcome()
        with _in_its_place(system) as impostor:
            before = system.refused().get(refusal, 0)
            began_ns = time.time_ns()
            impostor.answer = answering(impostor)
            system.listen(1.2)
            counted = system.refused().get(refusal, 0) - before
            least = share * system.plant.rate
            outcome.demand(counted > least, f"{counted} answers counted as {refusal}; expected more than {least:.0f}")
            efforts = [drive.torque for drive in system.drives() if drive.time_ns > began_ns]
            # The motor drives one way only: the other answer, which would turn it the other way, never acts.
            low, high = min(efforts), max(efforts)
            outcome.demand(
                low >= -ROUNDING and high <= _EFFORT + ROUNDING,
                f"torques from {low:.2f} to {high:.2f} N m; expected {_EFFORT} N m or none",
            )
            outcome.detail = outcome.detail or f"{counted} refused as {refusal}"
        return outcome

    return act


IMPOSTORS: tuple[Fault, ...] = (
    Fault("controller answers 20 ms late", _a_little_late),
    Fault("controller answers 80 ms late", _no_longer_valid(_late(0.08), "too_old"), short=(SIMULATOR,)),
    Fault("controller answers twice, differently", _half_refused(_send_twice, "duplicate", 0.2)),
    Fault("controller answers never", _no_longer_valid(_never, "")),
    Fault("controller answers with stamps of a minute ago", _no_longer_valid(_of_last_minute, "too_old")),
    Fault("controller answers with a stamp of zero", _no_longer_valid(_zero_stamp, "too_old")),
    Fault(
        "controller answers with stamps 1 s ahead", _no_longer_valid(_shifted(1000), "from_future"), short=(SIMULATOR,)
    ),
    Fault("controller answers out of order", _half_refused(_send_backwards, "out_of_order", 0.1)),
)
