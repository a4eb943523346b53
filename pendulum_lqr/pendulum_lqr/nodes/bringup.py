"""Arguments of ``bringup.launch.py``, and the nodes for their values; independent of launch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pendulum_lqr.controller_interface.controller import controller_names
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import load_yaml, parameter_sections, suggestion
from pendulum_msgs_py.plants.lab_file import LabFile, load_lab
from pendulum_msgs_py.plants.plant_parameters import PRESET_NAMES
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram

__all__ = ["ARGUMENTS", "SIDES", "Argument", "parameter_file", "programs"]

SIDES = {"sim": ("sim",), "emulator": ("hw",), "hebi": ("hw",), "both": ("sim", "hw")}
"""Plants, which are also namespaces, by the argument ``plant``."""
_KINDS = next(tuple(spec.choices or ()) for spec in DISTURBANCE_SPECS if spec.name == "kind")
_YES_NO = ("true", "false")
_NODES = ("simulator", "bridge", "controller", "disturbance", "viewer", "markers", "recorder", "robot_state_publisher")
"""Nodes of a launch, for which a parameter file may have sections."""


@dataclass(frozen=True)
class Argument:
    """Argument of the launch file."""

    name: str
    default: str
    description: str
    choices: tuple[str, ...] = ()


ARGUMENTS: tuple[Argument, ...] = (
    Argument(
        "plant",
        "sim",
        "Plant to start: sim (simulator, as /sim), emulator or hebi (bridge to the emulated or the real X5-9, as "
        "/hw), or both (simulator and emulator).",
        tuple(SIDES),
    ),
    Argument("lab", "", "Lab file, for plant:=hebi: selects the actuator and sets its zero, sign, limits and rate."),
    Argument("controller", "lqr", "Controller of each plant.", (*controller_names(), "none")),
    Argument(
        "controller_waits",
        "auto",
        "Leave the controller inactive until it is activated. auto does so for a bridge whose pendulum does not start "
        "upright, because the bridge refuses to arm while a controller commands more than 0.5 N m.",
        ("auto", *_YES_NO),
    ),
    Argument(
        "disturbance",
        "none",
        "Disturbance on each plant; it starts when its service ~/start is called.",
        (*_KINDS, "none"),
    ),
    Argument("disturb_at_start", "false", "Start the disturbance with the first state instead.", _YES_NO),
    Argument("seed", "1", "Seed of the disturbance; the same seed gives the same torque."),
    Argument(
        "model",
        "thesis",
        f"Preset ({PRESET_NAMES}) or plant file, for the simulation and for the design of the controller.",
    ),
    Argument("start", "bottom", "Where a simulated or emulated pendulum starts.", ("bottom", "top")),
    Argument("sim_rate", "500.0", "Rate of the simulator [Hz]."),
    Argument("hw_rate", "100.0", "Rate of the bridge [Hz]."),
    Argument("params_file", "", "ROS parameter file for all nodes, such as config/lqr_thesis.yaml of pendulum_lqr."),
    Argument("record", "false", "Record each plant to a bag of its own.", _YES_NO),
    Argument("bag", "", "Folder of the bags; runs/<date and time> when empty."),
    Argument("viewer", "false", "Open a window that draws each plant.", _YES_NO),
    Argument("rviz", "false", "Show the plants in RViz, with markers for torque and disturbance.", _YES_NO),
)
"""Output of ``--show-args``."""


def programs(value: Mapping[str, str]) -> list[NodeProgram]:
    """Return the nodes of a run for values of all ``ARGUMENTS``; recorders and RViz come from the launch file.

    Raises:
        ParameterError: A number is invalid, or these nodes cannot read the parameter file.
    """
    parameter_file(value["params_file"])
    waits = _controller_waits(value)
    found: list[NodeProgram] = []
    for side in SIDES[value["plant"]]:
        space = f"/{side}"
        rate = _number(value, f"{side}_rate")
        lab = _lab(value)
        if side == "hw" and lab is not None:
            rate = float(lab.values.get("feedback_rate", rate))
        if side == "sim":
            found.append(graph.simulator(space, plant=value["model"], rate_hz=rate, start=value["start"]))
        else:
            found.append(_bridge(space, value, rate, lab))
        if value["controller"] != "none":
            kind, model = value["controller"], value["model"]
            found.append(
                graph.controller(space, controller=kind, plant=model, period=1.0 / rate, autoactivate=not waits[side])
            )
        if value["disturbance"] != "none":
            found.append(
                graph.disturbance(
                    space,
                    kind=value["disturbance"],
                    seed=_seed(value["seed"]),
                    autostart=value["disturb_at_start"] == "true",
                )
            )
        if value["viewer"] == "true":
            found.append(NodeProgram("pendulum_sim", "viewer", space))
    return found


def parameter_file(given: str) -> str:
    """Return the absolute path of the ROS parameter file of all nodes; empty if there is none.

    Checked here because ``launch_ros`` only warns of a missing file, and starts the plant without its limits; rcl does
    not report a section that no node reads.

    Raises:
        ParameterError: The file cannot be read, has no parameters, or has a section for a node of no launch.
    """
    if not given.strip():
        return ""
    path = Path(given.strip()).expanduser().absolute()
    sections = [pattern for pattern, _ in parameter_sections(load_yaml(path, "params_file"))]
    if not sections:
        raise ParameterError(f"params_file {path} has no section with ros__parameters; expected at least one")
    for pattern in sections:
        node = pattern.rpartition("/")[2]
        if node not in {"*", "**", *_NODES}:
            hint = suggestion(node, (*_NODES, "/**"))
            raise ParameterError(f"params_file {path} has a section {pattern!r}, which no node reads; {hint}")
    return str(path)


def _lab(value: Mapping[str, str]) -> LabFile | None:
    if value["plant"] != "hebi":
        if value["lab"]:
            raise ParameterError(f"lab is {value['lab']!r} with plant {value['plant']!r}; expected plant:=hebi")
        return None
    if not value["lab"]:
        if value["params_file"]:
            return None
        raise ParameterError(
            "plant is 'hebi' without a lab file; expected lab:=FILE (or params_file:=FILE), which says which actuator "
            "it is, its zero, sign and limits"
        )
    return load_lab(value["lab"])


def _bridge(space: str, value: Mapping[str, str], rate: float, lab: LabFile | None) -> NodeProgram:
    if lab is not None:
        # A real pendulum starts where it is; only a call of its service arms it.
        path = str(Path(value["lab"]).expanduser().resolve())
        return graph.bridge(space, lab_file=path, feedback_rate=rate)
    if value["plant"] == "hebi":
        return graph.bridge(space, backend="hebi", feedback_rate=rate)
    at = math.pi if value["start"] == "top" else 0.0
    return graph.bridge(space, backend="emulator", feedback_rate=rate, initial_position=at)


def _controller_waits(value: Mapping[str, str]) -> dict[str, bool]:
    """Return for each side whether its controller waits for activation."""
    asked = value["controller_waits"]
    # Hanging, the angle from upright is pi: a balancing controller would saturate before the bridge is armed.
    upright = value["start"] == "top" and value["plant"] != "hebi"
    return {
        side: asked == "true" or (asked == "auto" and side == "hw" and not upright) for side in SIDES[value["plant"]]
    }


def _number(value: Mapping[str, str], name: str) -> float:
    try:
        number = float(value[name])
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise ParameterError(f"{name} is {value[name]!r}; expected a number of Hz > 0")
    return number


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise ParameterError(f"seed is {text!r}; expected an integer >= 0")
    return int(text)
