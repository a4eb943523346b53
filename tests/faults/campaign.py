"""The faults that are tried on the running system: what is done, and what must hold afterwards."""

from __future__ import annotations

import itertools
import math
import random
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from builtin_interfaces.msg import Time
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from pendulum_bags.reader import read_bag
from pendulum_msgs_py.names import JOINT
from tests.faults.live import EFFORT_LIMIT, START_TIMEOUT, LiveSystem

__all__ = ["CAMPAIGN", "MAX_LOSS", "MAX_TIME_TO_ZERO", "Fault", "Outcome", "try_fault"]

MAX_TIME_TO_ZERO = 0.060
"""Longest time from the last valid command to zero torque [s]."""
MACHINE_PATIENCE = 0.060
"""Allowance for a machine that lets the probe and the plant wait while other processes run [s]."""
MAX_LOSS = 0.2
"""Longest stretch of data that a killed recorder may lose [s]."""


@dataclass
class Outcome:
    """What one try of a fault showed.

    Attributes:
        survived: Everything that must hold did hold.
        detail: Why not, or a figure worth telling.
        time_to_zero: From the last command to zero torque [s]; None where commands went on.
        lost: Data lost by a killed recorder [s]; None where none was killed.
    """

    survived: bool = True
    detail: str = ""
    time_to_zero: float | None = None
    lost: float | None = None

    def demand(self, holds: bool, otherwise: str) -> None:
        """Take note of something that must hold."""
        if not holds:
            self.survived = False
            self.detail = f"{self.detail}; {otherwise}" if self.detail else otherwise


@dataclass(frozen=True)
class Fault:
    """One kind of fault.

    Attributes:
        name: What is done, as the table says it.
        act: Does it and says what it saw.
        expected_alive: Nodes that must run afterwards.
        short: Part of the short form.
    """

    name: str
    act: Callable[[LiveSystem, random.Random], Outcome]
    short: bool = False
    expected_alive: tuple[str, ...] = field(default=("recorder", "simulator", "controller", "disturbance"))


def try_fault(system: LiveSystem, fault: Fault, generator: random.Random) -> Outcome:
    """Try a fault once on a system that runs, and check what must hold after any fault."""
    system.wait_for("torque to flow before the fault", system.torque_flows, START_TIMEOUT)
    # At a random moment of the loop, as faults come.
    system.listen(generator.uniform(0.05, 0.25))
    outcome = fault.act(system, generator)
    system.wait_for(f"torque to flow again after: {fault.name}", system.torque_flows, START_TIMEOUT)
    missing = set(fault.expected_alive) - set(system.alive())
    outcome.demand(not missing, f"{', '.join(sorted(missing))} died")
    largest = system.largest_torque()
    outcome.demand(largest <= EFFORT_LIMIT, f"{largest:.3f} N m applied; expected at most {EFFORT_LIMIT} N m")
    return outcome


def _lose_controller(number: int) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        system.kill("controller", number)
        outcome = Outcome(time_to_zero=system.time_to_zero())
        _demand_zero(outcome)
        system.start("controller")
        return outcome

    return act


def _freeze_controller(system: LiveSystem, generator: random.Random) -> Outcome:
    duration = 10 ** generator.uniform(-2, 0.7)
    system.send("controller", signal.SIGSTOP)
    outcome = Outcome(detail=f"{duration:.2f} s")
    if duration > 0.3:
        outcome.time_to_zero = system.time_to_zero(duration)
        _demand_zero(outcome)
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
    system.wait_for("the new bag to be there", (system.bag / "metadata.yaml").exists, START_TIMEOUT)
    return outcome


def _twin_controller(system: LiveSystem, _: random.Random) -> Outcome:
    outcome = Outcome()
    twin = system.processes.start_node(system.program("controller", q=[1.0, 0.01]))
    system.wait_for("twins to be noticed", partial(_is_at_rest, system), START_TIMEOUT)
    outcome.detail = "twins: zero torque while both are there"
    system.processes.finish(twin)
    return outcome


def _second_controller(system: LiveSystem, _: random.Random) -> Outcome:
    program = system.program("controller", q=[1.0, 0.01])
    second = system.processes.start_node(type(program)(**{**vars(program), "name": "usurper"}))
    system.listen(4.0)
    outcome = Outcome()
    outcome.demand(system.torque_flows(), "the first controller lost the plant to the second")
    system.processes.finish(second)
    return outcome


def _malformed(topic: str) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, generator: random.Random) -> Outcome:
        system.attack(topic, itertools.islice(_strange_messages(generator), 300), rate=1000.0)
        outcome = Outcome()
        rate = system.rate()
        outcome.demand(abs(rate - 500.0) < 25.0, f"rate {rate:.0f} Hz; expected 500 Hz within 5 %")
        return outcome

    return act


def _flood(topic: str) -> Callable[[LiveSystem, random.Random], Outcome]:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        before = system.memory("simulator")
        started = time.monotonic()
        sent = system.attack(topic, itertools.islice(system.flood(100.0), 20_000))
        outcome = Outcome(detail=f"{sent / (time.monotonic() - started) / 1000:.1f} kHz")
        grown = system.memory("simulator") - before
        outcome.demand(grown < 10.0, f"the plant grew by {grown:.1f} MB; expected less than 10 MB")
        rate = system.rate()
        outcome.demand(abs(rate - 500.0) < 25.0, f"rate {rate:.0f} Hz afterwards; expected 500 Hz within 5 %")
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


def _demand_zero(outcome: Outcome) -> None:
    reached = outcome.time_to_zero
    outcome.demand(
        reached is not None and reached <= MAX_TIME_TO_ZERO + MACHINE_PATIENCE,
        f"zero torque after {math.inf if reached is None else reached * 1e3:.0f} ms; "
        f"expected at most {MAX_TIME_TO_ZERO * 1e3:.0f} ms",
    )


def _is_at_rest(system: LiveSystem) -> bool:
    recent = [effort for when, effort in system.applied[-60:] if time.monotonic() - when < 0.1]
    return len(recent) > 10 and not any(recent)


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
    Fault("disturbance: SIGKILL, started again", _restart("disturbance", signal.SIGKILL)),
    Fault("recorder: SIGKILL, its bag read", _kill_recorder, short=True),
    Fault("two controllers under one name", _twin_controller),
    Fault("two controllers under two names", _second_controller, short=True),
    *(
        Fault(f"strange messages on {topic}", _malformed(topic), short=topic == "effort_command")
        for topic in ("effort_command", "disturbance", "push")
    ),
    *(Fault(f"flood of a stranger on {topic}", _flood(topic)) for topic in ("effort_command", "disturbance")),
    Fault("service called at 1 kHz", _service_storm),
)
