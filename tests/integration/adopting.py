"""The plain node of others with our ``adopt`` before it, as processes, and a model file of the same pendulum."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from pendulum_bags.experiments.session import LOOP_NICENESS
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.exports.model_files import mjcf
from pendulum_testing.processes import ProcessGroup, RunningProgram

__all__ = ["EFFORTS", "adopt", "adopt_cart_pole", "start_robot", "write_model"]

EFFORTS = "/robot/effort_controller/commands"


def start_robot(processes: ProcessGroup, name: str = "robot", file: str = "plain_plant.py") -> RunningProgram:
    """Start the node that knows none of our rules; a robot has a processor of its own."""
    command = [sys.executable, str(Path(__file__).with_name(file))]
    return processes.start_command(command, name=name, niceness=LOOP_NICENESS)


def adopt(processes: ProcessGroup, namespace: str, **changes: object) -> RunningProgram:
    """Start the adopter in a namespace, configured for how this robot counts; further parameters as given."""
    mapping = {
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
    return _adopt(processes, namespace, mapping)


def adopt_cart_pole(processes: ProcessGroup, namespace: str) -> RunningProgram:
    """Start the adopter of the plain cart-pole: other order and signs, a further joint, commands of the slide alone."""
    mapping: dict[str, object] = {
        "states": "/robot/joint_states",
        "commands": EFFORTS,
        "plant": "cart_pole",
        "joints": "[-slide,-tilt]",
        "zeros": f"[0.0,{math.pi}]",
        "command_joints": "[slide]",
        "state_timeout": 0.5,
    }
    return _adopt(processes, namespace, mapping)


def _adopt(processes: ProcessGroup, namespace: str, mapping: dict[str, object]) -> RunningProgram:
    arguments = [item for name, value in mapping.items() for item in ("-p", f"{name}:={value}")]
    return processes.start("pendulum_sim", "adopt", "--ros-args", "-r", f"__ns:={namespace}", *arguments)


def write_model(path: Path) -> Path:
    """Write a MuJoCo model of the same pendulum, of 100 states a second as that node has; return the file."""
    model = mjcf(load_plant("thesis"))
    assert 'timestep="0.002"' in model
    path.write_text(model.replace('timestep="0.002"', 'timestep="0.01"'), encoding="utf-8")
    return path
