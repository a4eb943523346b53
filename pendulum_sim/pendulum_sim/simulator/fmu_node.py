"""``fmu``: run a functional mock-up unit in place of the simulator."""

from __future__ import annotations

from collections.abc import Sequence

from pendulum_sim.simulator.engines import FMU
from pendulum_sim.simulator.simulator_node import run_engine

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run an FMU in the simulator's place."""
    return run_engine(FMU, argv)
