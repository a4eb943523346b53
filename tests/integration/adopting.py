"""The plain node of others with our ``adopt`` before it, as processes."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from tests.processes import ProcessGroup, RunningProgram

__all__ = ["EFFORTS", "adopt", "start_robot"]

_ROBOT = Path(__file__).with_name("plain_plant.py")
EFFORTS = "/robot/effort_controller/commands"


def start_robot(processes: ProcessGroup, name: str = "robot") -> RunningProgram:
    """Start the node that knows none of our rules."""
    return processes.start_command([sys.executable, str(_ROBOT)], name=name)


def adopt(processes: ProcessGroup, namespace: str, **changes: object) -> RunningProgram:
    """Start the adopter in a namespace, told how this robot counts; further parameters as given."""
    told = {
        "states": "/robot/joint_states",
        "commands": EFFORTS,
        "joint": "shoulder",
        "command_index": 1,
        "command_size": 2,
        "sign": -1,
        "zero": -math.pi / 2.0,
        "state_timeout": 0.5,
        **changes,
    }
    arguments = [item for name, value in told.items() for item in ("-p", f"{name}:={value}")]
    return processes.start("pendulum_sim", "adopt", "--ros-args", "-r", f"__ns:={namespace}", *arguments)
