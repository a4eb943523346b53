"""The e-stop while everybody talks: how soon it answers, and whether the motor then rests until somebody arms."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from rclpy.experimental import EventsExecutor
from std_srvs.srv import SetBool, Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import FaultError
from pendulum_testing.graph_peer import GraphPeer
from tests.tools.faults.live import START_TIMEOUT, LiveSystem
from tests.tools.faults.outcome import Fault, Outcome, demand_rest

__all__ = ["LATEST_ANSWER", "PRESSES"]

LATEST_ANSWER = 0.1
"""Time within which the e-stop must have answered, whatever else is being said to the plant [s]."""
_PRESSES = 10

Load = Callable[[LiveSystem, random.Random], AbstractContextManager[None]]


class _Button:
    """Presses the e-stop from a participant of its own, which hears nothing but the answer.

    The probe hears every command and state: in a flood of them an answer waited in the probe, not in the plant.
    """

    def __init__(self, system: LiveSystem) -> None:
        self._peer = GraphPeer("button", domain=system.domain, make_executor=EventsExecutor)
        self._client = self._peer.node.create_client(Trigger, system.service(names.E_STOP))
        self._wait_for("the e-stop", self._client.service_is_ready)
        # A button is there before it is pressed: who has just found the service is not known to it yet.
        self._peer.spin(0.5)

    def press(self) -> float:
        """Press once and return how long the answer took [s]."""
        answered: list[float] = []
        pressed = time.monotonic()
        self._client.call_async(Trigger.Request()).add_done_callback(lambda _: answered.append(time.monotonic()))
        self._wait_for("the answer of the e-stop", lambda: answered)
        return answered[0] - pressed

    def close(self) -> None:
        self._peer.close()

    def _wait_for(self, what: str, predicate: Callable[[], object]) -> None:
        try:
            self._peer.until(predicate, what)
        except TimeoutError as error:
            raise FaultError(str(error)) from error


def _press(load: Load) -> Callable[[LiveSystem, random.Random], Outcome]:
    """Return a fault: press while a load lasts."""

    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        outcome = Outcome()
        reset = system.orchestrator.node.create_client(Trigger, system.service(names.E_STOP_RESET))
        button = _Button(system)
        try:
            with load(system, generator):
                pressed_ns = time.time_ns()
                # The first stops the plant; a latched e-stop answers by the same path.
                waits = [button.press() for _ in range(_PRESSES)]
                system.listen(0.3)
        finally:
            button.close()
        told = f"{len(waits)} presses answered after {max(waits) * 1e3:.0f} ms at most, the first {waits[0] * 1e3:.0f}"
        outcome.demand(max(waits) <= LATEST_ANSWER, f"{told}; expected within {LATEST_ANSWER * 1e3:.0f} ms")
        outcome.detail = outcome.detail or told
        demand_rest(outcome, system, pressed_ns)
        refusal = system.arm()
        outcome.demand("e-stop is latched" in refusal, f"arming after the e-stop: {refusal or 'accepted'}")
        outcome.demand(system.orchestrator.call(reset, Trigger.Request(), "the reset").success, "no e-stop to reset")
        system.listen(0.3)
        demand_rest(outcome, system, pressed_ns)
        system.orchestrator.node.destroy_client(reset)
        if not system.plant.has_module:
            _arm_upright(system)
        return outcome

    return act


def _arm_upright(system: LiveSystem) -> None:
    """Put a simulated pendulum upright and arm it: it has fallen, and no plant is armed into full torque."""
    client = system.orchestrator.node.create_client(Trigger, system.service("~/reset"))

    def armed() -> bool:
        return system.orchestrator.call(client, Trigger.Request(), "the reset").success and not system.arm()

    system.wait_for("the simulator to be armed upright", armed, START_TIMEOUT)
    system.orchestrator.node.destroy_client(client)


@contextmanager
def _quiet(_system: LiveSystem, _generator: random.Random) -> Iterator[None]:
    """Let nobody say anything else."""
    yield


def _flooded(kind: str) -> Load:
    """Let a process of its own send as fast as it can: the probe, which measures, has nothing to do with it."""

    @contextmanager
    def load(system: LiveSystem, generator: random.Random) -> Iterator[None]:
        command = [sys.executable, "-m", "tests.tools.faults.flood", system.plant.namespace, system.plant.name, kind]
        child = system.processes.start(f"flood_{kind}", command)
        system.wait_for("the flood", lambda: "flooding" in child.last_words(), START_TIMEOUT)
        system.listen(generator.uniform(0.3, 1.0))
        yield
        code = system.processes.finish(child)
        assert code == 0, f"the flood ended with code {code}: {child.last_words(1)}"

    return load


@contextmanager
def _arming(system: LiveSystem, generator: random.Random) -> Iterator[None]:
    """Let the plant be in the middle of arming: settings are written and read back."""
    system.arm(False)
    client = system.orchestrator.node.create_client(SetBool, system.service(names.ARM))
    system.wait_for("the service", client.service_is_ready, START_TIMEOUT)
    future = client.call_async(SetBool.Request(data=True))
    time.sleep(generator.uniform(0.0, 0.01))
    yield
    system.wait_for("the answer to arming", future.done, START_TIMEOUT)
    system.orchestrator.node.destroy_client(client)


PRESSES: tuple[Fault, ...] = (
    Fault("e-stop", _press(_quiet)),
    Fault("e-stop among trajectories of 200 000 points", _press(_flooded("long_trajectories"))),
    Fault("e-stop in a flood of commands", _press(_flooded("commands"))),
    Fault("e-stop in a flood of trajectories", _press(_flooded("trajectories"))),
    Fault("e-stop in a flood of parameters", _press(_flooded("parameters"))),
    Fault("e-stop among requests of 8 MB", _press(_flooded("large_parameters"))),
    Fault("e-stop in a flood of service calls", _press(_flooded("calls"))),
    Fault("e-stop while the plant arms", _press(_arming)),
)
"""The plant answers each within 100 ms, and rests within 60 ms of the press until it is reset and armed."""
