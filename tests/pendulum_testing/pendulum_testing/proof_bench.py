"""A module for the proofs of a lab, whose motion stop and feedback do what a test wants at times of the drive."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.lab import proofs
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    Command,
    Feedback,
    Strategy,
)
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_testing.lab_rig import Person, emulator

__all__ = ["BOTH", "Bench", "keeps_its_lifetime"]

BOTH = pytest.mark.parametrize("proof", [proofs.prove_lifetime, proofs.prove_m_stop])


class Bench:
    """An emulated module whose motion stop is pressed, and whose feedback is changed, at times of the drive [s]."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, press_at: float = math.inf) -> None:
        self.port, self.person = emulator(), Person()
        self.press_at = press_at
        self.begin_ns: int | None = None
        self.sent: list[float] = []
        read, write, begin = self.port.read, self.port.write, self.port.set_strategy

        def noted_begin(strategy: Strategy, command: Command | None = None) -> Strategy:
            reads = begin(strategy, command)
            if strategy is Strategy.DIRECT_PWM:
                self.begin_ns = self.port.now_ns()
            return reads

        def noted_write(command: Command) -> Any:
            self.sent.append(self.now())
            return write(command)

        def pressed_read(timeout: float) -> Feedback | None:
            if self.now() >= self.press_at:
                self.port.actuator.inject(ActuatorFault.M_STOP)
            record = read(timeout)
            return record and self.change(record, self.time_of(record.stamp_ns))

        monkeypatch.setattr(self.port, "set_strategy", noted_begin)
        monkeypatch.setattr(self.port, "write", noted_write)
        monkeypatch.setattr(self.port, "read", pressed_read)

    def now(self) -> float:
        return self.time_of(self.port.now_ns())

    def time_of(self, stamp_ns: int) -> float:
        return -math.inf if self.begin_ns is None else (stamp_ns - self.begin_ns) / 1e9

    def change(self, record: Feedback, now: float) -> Feedback | None:
        return record

    def refused(self, proof: Any, settings: BridgeSettings, match: str) -> str:
        """Expect a proof to say why it proves nothing, and to leave the motor off; return the fault's name."""
        with pytest.raises(ActuatorError, match=match) as told:
            proof(self.port, settings, self.person)
        assert self.port.strategy is Strategy.OFF
        assert not any("Proved" in sentence for sentence in self.person.said)
        return told.value.fault


def keeps_its_lifetime(monkeypatch: pytest.MonkeyPatch, bench: Bench, lifetime: float) -> None:
    """Let a module keep another command lifetime than it says."""
    monkeypatch.setattr(bench.port, "set_command_lifetime", lambda wanted: wanted)
    bench.port.actuator.configure(command_lifetime=lifetime)
