"""The emulated actuator in machine code, imported by the compiler's process only."""

from __future__ import annotations

from typing import Any

from pendulum_hw_bridge.emulation.kernel import LAYOUT, advance
from pendulum_msgs_py.loops.primitives import entry
from pendulum_msgs_py.loops.trees import compile_tree

__all__ = ["actuator_loop"]


def actuator_loop() -> Any:
    """Return the compiled steps of the emulated actuator."""
    steps = compile_tree(advance, exact=True)

    @entry(LAYOUT)
    def run(s: Any) -> Any:
        steps(s.state, s.constants, s.gains, s.memory, s.setpoints, s.strategy, s.link_torque, s.first_step, s.steps)
        return 0

    return run
