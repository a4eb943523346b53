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

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import BagError
from pendulum_rosbag.reader import read_bag
from tests.faults.doubles import DOUBLES
from tests.faults.impostor import IMPOSTORS
from tests.faults.live import START_TIMEOUT, LiveSystem
from tests.faults.outcome import MAX_LOSS, Fault, Outcome, demand_zero

__all__ = ["CAMPAIGN"]


def _lose_controller(number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        system.kill("controller", number)
        outcome = Outcome(time_to_zero=system.time_to_zero())
        demand_zero(outcome)
        system.start("controller")
        return outcome

    return act


def _demand_rate(outcome: Outcome, system: LiveSystem) -> None:
    """Take note of a loop that has not come back to its rate."""
    rate = system.rate()
    outcome.demand(abs(rate - 500.0) < 25.0, f"rate {rate:.0f} Hz afterwards; expected 500 Hz within 5 %")


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


def _freeze_plant(system: LiveSystem, generator: random.Random) -> Outcome:
    duration = 10 ** generator.uniform(-2, 0.3)
    system.send("simulator", signal.SIGSTOP)
    system.listen(duration)
    system.send("simulator", signal.SIGCONT)
    system.listen(0.3)
    return Outcome(detail=f"{duration:.2f} s")


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
                return bag.topics["/sim/joint_states"].count > 0
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
        kept = set(read_bag(bag)["/sim/applied_effort"]["stamp_ns"].tolist())
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
        if name == "simulator":
            system.wait_for("the plant to be back", lambda: system.rate(0.2) > 100.0, START_TIMEOUT)
        return Outcome()

    return act


def _kill_recorder(system: LiveSystem, generator: random.Random) -> Outcome:
    system.listen(generator.uniform(0.5, 1.5))
    bag = system.bag
    killed_ns = time.time_ns()
    system.kill("recorder")
    states = read_bag(bag)["/sim/joint_states"]
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
        system.listen(0.6)
        outcome = Outcome()
        counted = sum(system.refused(topic).values()) - before
        outcome.demand(counted > 0, f"none of 300 strange messages on {topic} was counted as refused")
        _demand_rate(outcome, system)
        return outcome

    return act


def _flood(topic: str) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        before, strangers = system.memory("simulator"), system.refused(topic).get("second_commander", 0)
        started = time.monotonic()
        sent = system.attack(topic, itertools.islice(system.flood(100.0), 20_000))
        outcome = Outcome(detail=f"{sent / (time.monotonic() - started) / 1000:.1f} kHz")
        system.listen(0.6)
        counted = system.refused(topic).get("second_commander", 0) - strangers
        outcome.demand(counted > 0, "no command of the stranger was counted as that of a second commander")
        grown = system.memory("simulator") - before
        outcome.demand(grown < 10.0, f"the plant grew by {grown:.1f} MB; expected less than 10 MB")
        _demand_rate(outcome, system)
        return outcome

    return act


def _service_storm(system: LiveSystem, _generator: random.Random) -> Outcome:
    client = system.conductor.node.create_client(Trigger, "/sim/simulator/e_stop_reset")
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
    rate = system.rate()
    outcome.demand(abs(rate - 500.0) < 25.0, f"rate {rate:.0f} Hz afterwards; expected 500 Hz within 5 %")
    system.conductor.node.destroy_client(client)
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
    Fault("controller: SIGKILL", _lose_controller(signal.SIGKILL), short=True),
    Fault("controller: SIGTERM", _lose_controller(signal.SIGTERM)),
    Fault("controller: SIGINT", _lose_controller(signal.SIGINT)),
    Fault("controller: SIGSTOP for 10 ms to 5 s", _freeze_controller, short=True),
    Fault("plant: SIGSTOP for 10 ms to 2 s", _freeze_plant),
    Fault("plant: SIGKILL, started again", _restart("simulator", signal.SIGKILL)),
    Fault("plant: SIGINT, started again", _restart("simulator", signal.SIGINT)),
    Fault("plant: SIGTERM, started again", _restart("simulator", signal.SIGTERM)),
    Fault("disturbance: SIGKILL, started again", _restart("disturbance", signal.SIGKILL)),
    Fault("disturbance: SIGINT, started again", _restart("disturbance", signal.SIGINT)),
    Fault("disturbance: SIGTERM, started again", _restart("disturbance", signal.SIGTERM)),
    Fault("disturbance: SIGSTOP for 10 ms to 5 s", _freeze("disturbance", 5.0)),
    Fault("recorder: SIGKILL, its bag read", _kill_recorder, short=True),
    Fault("recorder: SIGINT, its bag read", _end_recorder(signal.SIGINT)),
    Fault("recorder: SIGTERM, its bag read", _end_recorder(signal.SIGTERM)),
    Fault("recorder: SIGSTOP for 10 ms to 3 s", _freeze("recorder", 3.0)),
    *DOUBLES,
    *IMPOSTORS,
    *(
        Fault(f"strange messages on {topic}", _malformed(topic), short=topic == "effort_command")
        for topic in ("effort_command", "disturbance", "push")
    ),
    *(Fault(f"flood of a stranger on {topic}", _flood(topic)) for topic in ("effort_command", "disturbance")),
    Fault("service called at 1 kHz", _service_storm),
)
