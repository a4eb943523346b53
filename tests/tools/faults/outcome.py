"""What a fault is, how it is tried once, and what must hold after any."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.tools.faults.live import EFFORT_LIMIT, START_TIMEOUT, LiveSystem
from tests.tools.faults.motor import ROUNDING
from tests.tools.faults.plants import PLANTS, Plant

__all__ = [
    "MACHINE_PATIENCE",
    "MAX_LOSS",
    "MAX_TIME_TO_ZERO",
    "Fault",
    "Outcome",
    "Trial",
    "demand_limit",
    "demand_rest",
    "demand_zero",
    "is_at_rest",
    "try_fault",
]

MAX_TIME_TO_ZERO = 0.060
"""Longest time from the last valid command to zero torque [s]."""
MACHINE_PATIENCE = 0.060
"""Allowance for a machine that lets the probe and the plant wait while other processes run [s]."""
MAX_LOSS = 0.2
"""Longest stretch of data that a killed recorder may lose [s]."""
_UNDER_WAY = 0.05
"""Time in which the probe hears what was asked for before [s]."""


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
        short: On which plants it is part of the short form.
        tries: How often the long form tries it, whatever is asked for; 0 for as often as is asked for.
        plants: On which plants it is tried.
        own_torque: Somebody else than the running controller rightfully asks for torque meanwhile: the fault itself
            judges how much there may be, beside the limit.
    """

    name: str
    act: Callable[[LiveSystem, random.Random], Outcome]
    short: tuple[Plant, ...] = ()
    tries: int = 0
    plants: tuple[Plant, ...] = PLANTS
    own_torque: bool = False


@dataclass(frozen=True)
class Trial:
    """A fault that is tried on a system of its own.

    Attributes:
        name: What is done, as the table says it.
        act: Does it in a folder and says what it saw.
        why_not: Returns why it cannot be tried on this machine, empty where it can.
    """

    name: str
    act: Callable[[Path, random.Random], Outcome]
    why_not: Callable[[], str] = lambda: ""


def try_fault(system: LiveSystem, fault: Fault, generator: random.Random) -> Outcome:
    """Try a fault once on a system that runs, and check what must hold after any fault."""
    system.bring_back(f"torque to flow, and its commands to be heard, before: {fault.name}", heard=True)
    # At a random moment of the loop, as faults come.
    system.listen(generator.uniform(0.05, 0.25))
    begin_ns = time.time_ns()
    outcome = fault.act(system, generator)
    system.bring_back(f"torque to flow again after: {fault.name}")
    missing = set(system.plant.nodes) - set(system.alive())
    outcome.demand(not missing, f"{', '.join(sorted(missing))} died")
    if not missing:
        # A plant may meet a new node long before the probe does: only who has been heard can be told to have asked.
        system.wait_for(f"commands to be heard again after: {fault.name}", system.hears_all, START_TIMEOUT)
    # Until here, though the motor goes on while it is judged, and the probe listens no more.
    end_ns = time.time_ns()
    system.listen(_UNDER_WAY)
    _judge_motor(outcome, system, fault, begin_ns, end_ns)
    return outcome


def _judge_motor(outcome: Outcome, system: LiveSystem, fault: Fault, begin_ns: int, end_ns: int) -> None:
    """Take note of torque beyond the limit, and beyond what the rightful nodes asked for."""
    demand_limit(outcome, system.largest_torque(), measured=system.plant.has_module)
    if not fault.own_torque:
        when, excess = system.beyond_asked(begin_ns, end_ns)
        outcome.demand(
            excess <= 0.0,
            f"{excess:.2f} N m beyond what was asked for, {(when - begin_ns) * 1e-6:.0f} ms after the fault began",
        )


def demand_limit(outcome: Outcome, largest: float, *, measured: bool) -> None:
    """Take note of a torque beyond the limit.

    Args:
        outcome: Notes it.
        largest: Largest absolute torque [N m].
        measured: It is a module's, with the rounding of one; else what a simulator applied.
    """
    outcome.demand(
        largest <= EFFORT_LIMIT + (ROUNDING if measured else 0.0),
        f"{largest:.3f} N m applied; expected at most {EFFORT_LIMIT} N m",
    )


def demand_rest(outcome: Outcome, system: LiveSystem, since_ns: int) -> None:
    """Take note of a motor that has driven for longer after an instant than it may, or drives again.

    Args:
        outcome: Notes it.
        system: What runs.
        since_ns: When the last torque may have been asked for, by the wall clock [ns].
    """
    outcome.time_to_zero = (system.driven_until_ns(since_ns) - since_ns) * 1e-9
    demand_zero(outcome)


def demand_zero(outcome: Outcome) -> None:
    """Take note of a time to zero torque that is too long."""
    reached = outcome.time_to_zero
    outcome.demand(
        reached is not None and reached <= MAX_TIME_TO_ZERO + MACHINE_PATIENCE,
        f"zero torque after {math.inf if reached is None else reached * 1e3:.0f} ms; "
        f"expected at most {MAX_TIME_TO_ZERO * 1e3:.0f} ms",
    )


def is_at_rest(system: LiveSystem) -> bool:
    """Tell whether every plant that is heard has applied zero torque for a tenth of a second."""
    recent = [applied.effort for applied in system.applied[-60:] if time.monotonic() - applied.when < 0.1]
    return len(recent) > 10 and not any(recent)
