"""An emulated module and a person who agrees, for the procedures of a lab."""

from __future__ import annotations

from typing import Any

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import Feedback
from pendulum_hw_bridge.port.clocks import SteppedClock

__all__ = ["PARAMETERS", "Person", "changed", "emulator"]

PARAMETERS = load_emulator("thesis")


class Person:
    """Agrees to everything, and remembers what was said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    go_on = say


def emulator() -> EmulatorBackend:
    port = EmulatorBackend(EmulatedX5(PARAMETERS, seed=3), SteppedClock())
    port.connect()
    return port


def changed(monkeypatch: pytest.MonkeyPatch, port: EmulatorBackend, change: Any) -> None:
    """Change each record on its way."""
    read = port.read

    def altered(timeout: float) -> Feedback | None:
        record = read(timeout)
        return record and change(record)

    monkeypatch.setattr(port, "read", altered)
