"""The two plants that are attacked alike: the simulator, and the bridge with an actuator in a process of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram, ParameterArgument

__all__ = ["BRIDGE", "EFFORT_LIMIT", "PLANTS", "SIMULATOR", "Plant"]

EFFORT_LIMIT = 5.0
"""Limit given to the plant under attack, below what an angry controller asks for [N m]."""


@dataclass(frozen=True)
class Plant:
    """A plant under attack.

    Attributes:
        name: Name of its node.
        namespace: Of its topics.
        rate: States per second [Hz].
        has_module: Whether an emulated actuator in a process of its own stands behind it: it goes on whoever dies, the
            plant has to be armed, and a fault is latched until somebody arms again.
    """

    name: str
    namespace: str
    rate: float
    has_module: bool

    @property
    def period(self) -> float:
        """Time between two states [s]."""
        return 1.0 / self.rate

    @property
    def nodes(self) -> tuple[str, ...]:
        """The nodes of its system, in the order in which they usually start."""
        return ("recorder", self.name, "controller", "disturbance")

    def program(self, address: str = "", **changes: ParameterArgument) -> NodeProgram:
        """Return the program of its node; the bridge finds its module at ``address``."""
        values: dict[str, ParameterArgument]
        if self.has_module:
            values = {
                "backend": "emulator_process",
                "emulator_address": address,
                "effort_limit": EFFORT_LIMIT,
            }
            return graph.bridge(self.namespace, **{**values, **changes})
        # A pendulum that fell while its controller was away is commanded again where it hangs.
        values = {"initial_theta": math.pi, "effort_limit": EFFORT_LIMIT, "start_effort_limit": 0.0}
        return graph.simulator(self.namespace, **{**values, **changes})


SIMULATOR = Plant("simulator", "/sim", 500.0, has_module=False)
BRIDGE = Plant("bridge", "/hw", 100.0, has_module=True)
PLANTS = (SIMULATOR, BRIDGE)
