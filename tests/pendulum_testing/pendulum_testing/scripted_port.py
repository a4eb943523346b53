"""An actuator port that keeps what it is told and answers what a test wants."""

from __future__ import annotations

from typing import Any

from pendulum_hw_bridge.port.actuator import Applied, Command, Feedback, HardwareLimits, Strategy
from pendulum_hw_bridge.port.command_check import check_command
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters

__all__ = ["DRIVETRAIN", "MILLISECOND", "PERIOD", "SECOND", "STEP", "TIMEOUT", "Port"]

PERIOD = 2.0**-6
STEP = 15_625_000
TIMEOUT = 3 * STEP
MILLISECOND = 1_000_000
SECOND = 1_000_000_000
# R / (N V K_t) is 1/4 per newton metre at 32 V.
DRIVETRAIN = SeriesElasticParameters(
    gear_ratio=4.0, torque_constant=0.5, back_emf_constant=0.25, winding_resistance=16.0, supply_voltage=32.0
)


class Port:
    """An actuator of which a test says what happens: time passes, records come, and calls fail, as it wants."""

    def __init__(self) -> None:
        self.time_ns = SECOND
        self.tick_ns = 0
        self.calls: list[str] = []
        self.commands: list[Command] = []
        self.pushes: list[float] = []
        self.strategy = Strategy.OFF
        self.limits = HardwareLimits()
        self.records: list[Feedback | None] = []
        self.fails: dict[str, Exception] = {}
        self.takes: dict[str, int] = {}
        self.reads_strategy: Strategy | None = None
        self.gains: GainSet | None = None

    def _called(self, name: str) -> None:
        self.calls.append(name)
        self.time_ns += self.takes.get(name, 0)
        if name in self.fails:
            raise self.fails[name]

    def now_ns(self) -> int:
        self.time_ns += self.tick_ns
        return self.time_ns

    def connect(self) -> Any:
        self._called("connect")
        return f"connected {self.calls.count('connect')}"

    def read(self, timeout: float) -> Feedback | None:
        self.calls.append(f"read {timeout}")
        self.time_ns += self.takes.get("read", 0)
        if "read" in self.fails:
            raise self.fails["read"]
        return self.records.pop(0) if self.records else None

    def write(self, command: Command) -> Applied:
        self._called("write")
        limited, changed = check_command(command, self.strategy, self.limits)
        self.commands.append(limited)
        return Applied(limited, self.strategy, changed, self.time_ns)

    def set_strategy(self, strategy: Strategy, command: Command | None = None) -> Strategy:
        self._called(f"strategy {int(strategy)}")
        self.strategy = strategy
        self.commands.append(command or Command())
        return strategy if self.reads_strategy is None else self.reads_strategy

    def set_gains(self, gains: GainSet) -> GainSet:
        self._called("gains")
        self.gains = gains
        return gains

    def set_limits(self, limits: HardwareLimits) -> HardwareLimits:
        self._called("limits")
        return limits

    def set_command_lifetime(self, lifetime: float) -> float:
        return lifetime

    def set_feedback_rate(self, rate: float) -> float:
        return rate

    def stop(self) -> None:
        self._called("stop")
        self.strategy = Strategy.OFF

    def close(self) -> None:
        self._called("close")

    def push(self, effort: float) -> None:
        self.pushes.append(effort)
