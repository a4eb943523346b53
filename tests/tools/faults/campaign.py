"""The faults that are tried on the running system: what is done, and what must hold afterwards."""

from __future__ import annotations

import itertools
import math
import random
import signal
import time
from collections.abc import Callable, Iterator

from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from pendulum_bags.experiments.session import PLANT_PRIORITY, permitted
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import BagError, FaultError
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.doubles import DOUBLES
from tests.tools.faults.impostor import IMPOSTORS
from tests.tools.faults.live import MODULE, START_TIMEOUT, LiveSystem
from tests.tools.faults.outcome import MAX_LOSS, Fault, Outcome, demand_rest, demand_zero
from tests.tools.faults.plants import BRIDGE, PLANTS, SIMULATOR
from tests.tools.faults.presses import PRESSES

__all__ = ["CAMPAIGN"]

_STALL = 0.15
"""Pause of plant or module that must be a fault [s]: a cycle is 10 ms, the watchdog 30 ms, the command lifetime 50."""
_BACK_AT_RATE = 10.0
"""Time in which a loop without real-time priority must have been at its rate for a second [s]."""


def _lose_controller(number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        system.kill("controller", number)
        outcome = Outcome(time_to_zero=system.time_to_zero())
        demand_zero(outcome)
        system.start("controller")
        return outcome

    return act


def _demand_rate(outcome: Outcome, system: LiveSystem) -> None:
    """Take note of a loop that does not come back to its rate, in the first second where it has real-time priority.

    From another a busy machine takes some periods of any one second; what a fault has left behind takes them from all.
    """
    patience = 0.0 if permitted(PLANT_PRIORITY) else _BACK_AT_RATE
    expected, deadline = system.plant.rate, time.monotonic() + patience
    while abs((rate := system.rate()) - expected) >= 0.05 * expected:
        if time.monotonic() > deadline:
            outcome.demand(False, f"rate {rate:.0f} Hz afterwards; expected {expected:.0f} Hz within 5 %")
            return


def _freeze_controller(system: LiveSystem, generator: random.Random) -> Outcome:
    duration = 10 ** generator.uniform(-2, 0.7)
    system.send("controller", signal.SIGSTOP)
    outcome = Outcome(detail=f"{duration:.2f} s")
    if duration > 0.3:
        outcome.time_to_zero = system.time_to_zero(duration)
        demand_zero(outcome)
    else:
        system.listen(duration)
    system.send("controller", signal.SIGCONT)
    return outcome


def _freeze_plant(name: str, longest: float) -> Callable[[LiveSystem, random.Random], Outcome]:
    """Stop plant or module: behind a module, a pause that is long is a fault, and no torque comes back by itself."""

    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        duration = 10 ** generator.uniform(-2, math.log10(longest))
        child = name or system.plant.name
        stopped_ns = time.time_ns()
        system.send(child, signal.SIGSTOP)
        system.listen(duration)
        system.send(child, signal.SIGCONT)
        system.listen(0.7)
        outcome = Outcome(detail=f"{duration:.2f} s")
        if system.plant.has_module and duration > _STALL:
            demand_rest(outcome, system, stopped_ns)
            outcome.demand(system.mode() == "fault", f"plant is {system.mode()}; expected a fault")
        return outcome

    return act


def _freeze(name: str, longest: float) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        duration = 10 ** generator.uniform(-2, math.log10(longest))
        system.send(name, signal.SIGSTOP)
        system.listen(duration)
        system.send(name, signal.SIGCONT)
        outcome = Outcome(detail=f"{duration:.2f} s")
        _demand_rate(outcome, system)
        return outcome

    return act


def _wait_for_states_in_bag(system: LiveSystem) -> None:
    """Wait until a recorder that was started has met the plant; before, there is nothing to lose."""

    def holds_states() -> bool:
        try:
            with read_bag(system.bag) as bag:
                return bag.topics[f"{system.plant.namespace}/{names.JOINT_STATES}"].count > 0
        except (BagError, KeyError):
            return False

    system.wait_for("states in the new bag", holds_states, START_TIMEOUT)


def _end_recorder(number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    """Ask the recorder to end: everything that it heard must be in its bag."""

    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        began = len(system.applied)
        system.listen(generator.uniform(0.5, 1.5))
        bag, child = system.bag, system.children["recorder"]
        system.kill("recorder", number)
        outcome = Outcome(lost=0.0)
        code, words = child.process.returncode, child.last_words(1)
        outcome.demand(code == 0 and "nothing lost" in words, f"the recorder ended with code {code}: {words}")
        kept = set(read_bag(bag)[f"{system.plant.namespace}/{names.APPLIED_EFFORT}"]["stamp_ns"].tolist())
        # Beside what the probe heard, for the plant itself may have been held up.
        missing = {applied.stamp_ns for applied in system.applied[began:] if applied.stamp_ns <= max(kept)} - kept
        outcome.demand(not missing, f"{len(missing)} torques that the probe heard are not in the bag")
        system.start("recorder")
        _wait_for_states_in_bag(system)
        return outcome

    return act


def _restart(name: str, number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        system.kill(name, number)
        system.listen(0.3)
        system.start(name)
        return Outcome()

    return act


def _restart_plant(name: str, number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    """End plant or module and start it again: behind a module, nothing may move until somebody arms."""

    def act(system: LiveSystem, _: random.Random) -> Outcome:
        child = name or system.plant.name
        outcome = Outcome()
        ended_ns = time.time_ns()
        system.kill(child, number)
        # A plant that ends in an orderly way may take until then to do so.
        ended_ns = ended_ns if number == signal.SIGKILL else time.time_ns()
        system.listen(0.3)
        system.start(child)
        heard = len(system.applied)
        system.wait_for("the plant to be back", lambda: len(system.applied) > heard + 20, START_TIMEOUT)
        if system.plant.has_module:
            system.listen(0.7)
            demand_rest(outcome, system, ended_ns)
            outcome.demand(not system.mode().startswith("armed"), f"plant is {system.mode()} before anybody armed it")
        return outcome

    return act


def _kill_recorder(system: LiveSystem, generator: random.Random) -> Outcome:
    system.listen(generator.uniform(0.5, 1.5))
    bag = system.bag
    killed_ns = time.time_ns()
    system.kill("recorder")
    states = read_bag(bag)[f"{system.plant.namespace}/{names.JOINT_STATES}"]
    lost = (killed_ns - int(states["log_time_ns"][-1])) * 1e-9
    outcome = Outcome(lost=lost)
    outcome.demand(lost <= MAX_LOSS, f"{lost:.2f} s lost; expected at most {MAX_LOSS} s")
    system.start("recorder")
    _wait_for_states_in_bag(system)
    return outcome


def _malformed(topic: str) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        before = sum(system.refused(topic).values())
        system.attack(topic, itertools.islice(_strange_messages(generator), 300), rate=1000.0)
        outcome = Outcome()
        try:
            # Seen by the plant's own words, which come twice a second, and later on a busy machine.
            system.wait_for("a refusal", lambda: sum(system.refused(topic).values()) > before, START_TIMEOUT)
        except FaultError:
            outcome.demand(False, f"none of 300 strange messages on {topic} was counted as refused")
        _demand_rate(outcome, system)
        return outcome

    return act


def _flood(topic: str) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        before, strangers = system.memory(system.plant.name), system.refused(topic).get("second_commander", 0)
        started = time.monotonic()
        sent = system.attack(topic, itertools.islice(system.flood(100.0), 20_000))
        outcome = Outcome(detail=f"{sent / (time.monotonic() - started) / 1000:.1f} kHz")
        system.listen(0.6)
        counted = system.refused(topic).get("second_commander", 0) - strangers
        outcome.demand(counted > 0, "no command of the stranger was counted as that of a second commander")
        grown = system.memory(system.plant.name) - before
        outcome.demand(grown < 10.0, f"the plant grew by {grown:.1f} MB; expected less than 10 MB")
        _demand_rate(outcome, system)
        return outcome

    return act


def _service_storm(system: LiveSystem, _generator: random.Random) -> Outcome:
    client = system.orchestrator.node.create_client(Trigger, system.service(names.E_STOP_RESET))
    system.wait_for("the service", client.service_is_ready, 10.0)
    futures = []
    for _ in range(1000):
        futures.append(client.call_async(Trigger.Request()))
        system.listen(0.001)
    system.listen(2.0)
    # DDS keeps the last ten requests of a client: a storm may lose some, and the plant must not mind.
    answered = [future for future in futures if future.done()]
    outcome = Outcome(detail=f"{len(answered)} of {len(futures)} calls answered")
    outcome.demand(bool(answered), "no call was answered")
    outcome.demand(all(not future.result().success for future in answered), "a reset of no e-stop succeeded")
    _demand_rate(outcome, system)
    system.orchestrator.node.destroy_client(client)
    return outcome


def _strange_messages(generator: random.Random) -> Iterator[JointState]:
    strange = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e9, -0.0, 5e-324)
    while True:
        stamp_ns = generator.choice(
            (0, time.time_ns(), time.time_ns() - 10**9, time.time_ns() + 10**10, (2**31 - 1) * 10**9)
        )
        header = Header(
            stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9),
            frame_id=generator.choice(("", "/stranger", "/sim/impostor", "x" * 10_000, "\u2028")),
        )
        count = generator.choice((0, 1, 1, 1, 2, 10_000))
        yield JointState(
            header=header,
            name=generator.choice(([], [JOINT], ["elbow"], [JOINT] * 2, [""])),
            position=[generator.choice(strange)] * generator.choice((0, 1)),
            velocity=[generator.choice(strange)] * generator.choice((0, 1)),
            effort=[generator.choice(strange)] * count,
        )


CAMPAIGN: tuple[Fault, ...] = (
    Fault("controller: SIGKILL", _lose_controller(signal.SIGKILL), short=PLANTS),
    Fault("controller: SIGTERM", _lose_controller(signal.SIGTERM)),
    Fault("controller: SIGINT", _lose_controller(signal.SIGINT)),
    Fault("controller: SIGSTOP for 10 ms to 5 s", _freeze_controller, short=(SIMULATOR,)),
    Fault("plant: SIGSTOP for 10 ms to 2 s", _freeze_plant("", 2.0)),
    Fault("plant: SIGKILL, started again", _restart_plant("", signal.SIGKILL)),
    Fault("plant: SIGINT, started again", _restart_plant("", signal.SIGINT)),
    Fault("plant: SIGTERM, started again", _restart_plant("", signal.SIGTERM)),
    Fault("module: SIGSTOP for 10 ms to 2 s", _freeze_plant(MODULE, 2.0), plants=(BRIDGE,)),
    Fault("module: SIGKILL, started again", _restart_plant(MODULE, signal.SIGKILL), plants=(BRIDGE,)),
    Fault("disturbance: SIGKILL, started again", _restart("disturbance", signal.SIGKILL)),
    Fault("disturbance: SIGINT, started again", _restart("disturbance", signal.SIGINT)),
    Fault("disturbance: SIGTERM, started again", _restart("disturbance", signal.SIGTERM)),
    Fault("disturbance: SIGSTOP for 10 ms to 5 s", _freeze("disturbance", 5.0)),
    Fault("recorder: SIGKILL, its bag read", _kill_recorder, short=(SIMULATOR,), plants=(SIMULATOR,)),
    Fault("recorder: SIGINT, its bag read", _end_recorder(signal.SIGINT), plants=(SIMULATOR,)),
    Fault("recorder: SIGTERM, its bag read", _end_recorder(signal.SIGTERM), plants=(SIMULATOR,)),
    Fault("recorder: SIGSTOP for 10 ms to 3 s", _freeze("recorder", 3.0), plants=(SIMULATOR,)),
    *DOUBLES,
    *IMPOSTORS,
    *PRESSES,
    *(
        Fault(f"strange messages on {topic}", _malformed(topic), short=PLANTS if topic == "effort_command" else ())
        for topic in ("effort_command", "disturbance", "push")
    ),
    *(Fault(f"flood of a stranger on {topic}", _flood(topic)) for topic in ("effort_command", "disturbance")),
    Fault("service called at 1 kHz", _service_storm),
)
