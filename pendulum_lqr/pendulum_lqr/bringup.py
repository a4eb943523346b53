"""What ``bringup.launch.py`` brings up: its arguments, and the nodes that their values ask for. Knows no launch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pendulum_lqr.controller import CONTROLLERS
from pendulum_lqr.disturbance import DISTURBANCE_SPECS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram

__all__ = ["ARGUMENTS", "SIDES", "Argument", "programs"]

SIDES = {"sim": ("sim",), "emulator": ("hw",), "hebi": ("hw",), "both": ("sim", "hw")}
"""Plants by the argument ``plant``; each is a namespace too."""
_KINDS = next(tuple(spec.choices or ()) for spec in DISTURBANCE_SPECS if spec.name == "kind")
_YES_NO = ("true", "false")


@dataclass(frozen=True)
class Argument:
    """One argument of the launch file: name, default, meaning and, where there are few, its choices."""

    name: str
    default: str
    description: str
    choices: tuple[str, ...] = ()


ARGUMENTS: tuple[Argument, ...] = (
    Argument(
        "plant",
        "sim",
        "What to bring up: the simulator as /sim, the bridge to the emulated or the real X5-9 as /hw, or simulator "
        "and emulator.",
        tuple(SIDES),
    ),
    Argument("controller", "lqr", "Controller of each plant.", (*CONTROLLERS, "none")),
    Argument(
        "disturbance",
        "none",
        "Disturbance on each plant; it starts when its service ~/start is called.",
        (*_KINDS, "none"),
    ),
    Argument("disturb_at_start", "false", "Start the disturbance with the first state instead.", _YES_NO),
    Argument("seed", "1", "Seed of the disturbance; one seed, one torque."),
    Argument(
        "model",
        "thesis",
        "Preset (thesis, x5_9, dfki) or plant file: what is simulated and what the controller is designed for.",
    ),
    Argument("start", "bottom", "Where a simulated or emulated pendulum starts.", ("bottom", "top")),
    Argument("sim_rate", "500.0", "Rate of the simulator [Hz]."),
    Argument("hw_rate", "100.0", "Rate of the bridge [Hz]."),
    Argument(
        "params_file", "", "ROS parameter file for all nodes, such as config/lqr_thesis.yaml of pendulum_lqr."
    ),
    Argument("record", "false", "Record each plant to a bag of its own.", _YES_NO),
    Argument("bag", "", "Folder of the bags; runs/<date and time> when empty."),
    Argument("viewer", "false", "Open a window that draws each plant.", _YES_NO),
    Argument("rviz", "false", "Show the plants in RViz, with markers for torque and disturbance.", _YES_NO),
)
"""What ``--show-args`` lists."""


def programs(value: Mapping[str, str]) -> list[NodeProgram]:
    """Return the nodes of a run; recorders and RViz come from the launch file.

    Args:
        value: Values of all ``ARGUMENTS`` by name.

    Raises:
        ParameterError: A number is none.
    """
    found: list[NodeProgram] = []
    for side in SIDES[value["plant"]]:
        space = f"/{side}"
        rate = _number(value, f"{side}_rate")
        if side == "sim":
            found.append(graph.simulator(space, plant=value["model"], rate_hz=rate, start=value["start"]))
        else:
            found.append(_bridge(space, value, rate))
        if value["controller"] != "none":
            kind, model = value["controller"], value["model"]
            found.append(graph.controller(space, controller=kind, plant=model, period=1.0 / rate))
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


def _bridge(space: str, value: Mapping[str, str], rate: float) -> NodeProgram:
    if value["plant"] == "hebi":
        # A real pendulum starts where it is.
        return graph.bridge(space, backend="hebi", feedback_rate=rate)
    at = math.pi if value["start"] == "top" else 0.0
    return graph.bridge(space, backend="emulator", feedback_rate=rate, initial_position=at)


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
