"""All parameters of the bridge's node: its own, and those of every plant with defaults for a machine."""

from __future__ import annotations

import dataclasses

from pendulum_hw_bridge.bridge.bridge_parameters import BRIDGE_SPECS
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, LOOP_SPECS
from pendulum_msgs_py.parameters import ParameterSpec, ParameterValue

__all__ = ["SPECS"]

_HARDWARE_DEFAULTS: dict[str, ParameterValue] = {
    "velocity_limit": 1.5,
    "position_window": [-4.0, 4.0],
    "effort_slew_limit": 2000.0,
    "starvation_limit": 30.0,
    "realtime_priority": -1,
}
"""Limits that a real plant needs and a simulated one does not."""

SPECS: tuple[ParameterSpec, ...] = (
    *BRIDGE_SPECS,
    *(
        dataclasses.replace(spec, default=_HARDWARE_DEFAULTS.get(spec.name, spec.default))
        for spec in (*LOOP_SPECS, *LIMIT_SPECS)
    ),
)
"""In the order of the README."""
