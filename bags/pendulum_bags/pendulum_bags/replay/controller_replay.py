"""Controller replay: feed recorded states to a controller and compare its torque with what was commanded."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.runs.run_data import find_prefix
from pendulum_bags.runs.run_record import run_record
from pendulum_lqr.controller_interface.controller import controller_parameters, make_controller
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_rosbag.reader import read_bag

if TYPE_CHECKING:
    from pendulum_bags.figures.figure import Figure

__all__ = ["ControllerReplay", "parse_values", "recorded_controller", "replay_controller"]

SETTLED = 1e-9
"""Torque difference up to which two commands count as equal [N m]."""


@dataclass(frozen=True)
class ControllerReplay:
    """What a controller would have commanded, and what was commanded.

    Args:
        controller: Its name.
        description: Its gains in one line.
        t: Time of each state that got a command, since the first of them, shape (n,) [s].
        recorded: Torque that was commanded, shape (n,) [N m].
        replayed: Torque of the controller now, shape (n,) [N m].
        unanswered: States between the first and the last command that got none.
    """

    controller: str
    description: str
    t: Array
    recorded: Array
    replayed: Array
    unanswered: int

    @property
    def difference(self) -> Array:
        """Replayed minus recorded torque, shape (n,) [N m]."""
        return self.replayed - self.recorded

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        difference = np.abs(self.difference)
        apart = np.flatnonzero(difference > SETTLED)
        return {
            "controller": self.controller,
            "description": self.description,
            "commands": int(self.t.size),
            "unanswered_states": self.unanswered,
            "rms_difference_nm": rms(difference),
            "max_difference_nm": float(difference.max()),
            "equal_share": float(np.mean(difference <= SETTLED)),
            "first_difference_s": float(self.t[apart[0]]) if apart.size else None,
            "rms_recorded_nm": rms(self.recorded),
            "rms_replayed_nm": rms(self.replayed),
        }

    def sentence(self) -> str:
        """Return the result as text."""
        figures = self.as_dict()
        if figures["equal_share"] == 1.0:
            return f"{self.controller} answers all {self.t.size} recorded states with the torque that was commanded."
        return (
            f"{self.controller} answers {100.0 * figures['equal_share']:.1f} % of {self.t.size} recorded states as "
            f"recorded; the others differ by up to {figures['max_difference_nm']:.4g} N m "
            f"(rms {figures['rms_difference_nm']:.4g} N m, first after {figures['first_difference_s']:.3f} s)."
        )

    def figure(self) -> Figure:
        """Return both torques over time, and their difference."""
        from pendulum_bags.figures.figure import Figure, Panel, Trace

        time = "time [s]"
        panels = [
            Panel(
                time,
                "torque [N m]",
                [
                    Trace(self.t, self.recorded, "commanded in the recording", "sim", "step"),
                    Trace(self.t, self.replayed, f"{self.controller}, replayed", "hw", "step"),
                ],
            ),
            Panel(time, "difference [N m]", [Trace(self.t, self.difference, "", "difference", "step")]),
        ]
        return Figure("controller_replay", f"Replay of the controller {self.controller}", self.sentence(), panels)


def recorded_controller(metadata: Mapping[str, Any]) -> tuple[str, dict[str, Any], str]:
    """Return name, parameters and plant of the controller that made a recording, from the bag's metadata.

    Raises:
        DataError: The bag lacks it.
    """
    run = run_record(metadata)
    recorded = run.get("controller")
    if not isinstance(recorded, Mapping) or "kind" not in recorded:
        raise DataError("the bag does not say which controller made it; expected pendulum.run.controller, or name one")
    name = str(recorded["kind"])
    known = {spec.name for spec in controller_parameters(name)}
    values = {key: value for key, value in recorded.items() if key in known}
    design = run.get("design_plant", run.get("plant", "thesis"))
    return name, values, str(design)


def replay_controller(
    path: str | os.PathLike[str],
    controller: str | None = None,
    *,
    plant: str | PlantParameters | None = None,
    values: Mapping[str, object] | None = None,
    prefix: str | None = None,
) -> ControllerReplay:
    """Feed the states of a bag to a controller, in order, and pair its commands with the recorded ones by their stamp.

    Args:
        path: Bag with ``joint_states`` and ``effort_command``.
        controller: Name of the controller; None for the one that made the recording.
        plant: Plant to design on; None for that of the recording, or the thesis's where it was real hardware.
        values: Parameters of the controller.
        prefix: Namespace of the topics; None for that of the only plant.

    Raises:
        DataError: The bag lacks states or commands, or no command has the stamp of a state.
        ParameterError: No such controller or plant, or a value out of domain.
    """
    with read_bag(path) as bag:
        space = find_prefix(bag, prefix)
        states = bag.array(f"{space}/{names.JOINT_STATES}")
        commands = bag.array(f"{space}/{names.EFFORT_COMMAND}")
        metadata = dict(bag.metadata)
    if controller is None:
        controller, recorded_values, design_plant = recorded_controller(metadata)
        values = {**recorded_values, **(values or {})}
    else:
        design_plant = "thesis"
    if plant is None:
        plant = "thesis" if design_plant in {"emulator", "hebi"} else design_plant
    parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
    states = _by_stamp(states, f"{space}/{names.JOINT_STATES} of bag {path}")
    commands = _by_stamp(commands, f"{space}/{names.EFFORT_COMMAND} of bag {path}")
    first, last = (int(i) for i in np.searchsorted(states["stamp_ns"], commands["stamp_ns"][[0, -1]]))
    states = states[first : last + 1]
    if len(states) < 2:
        raise DataError(f"bag {path} has no command that answers a state; expected equal stamps")
    period = float(np.median(np.diff(states["stamp_ns"]))) / NANOSECONDS
    law = make_controller(controller, parameters, period, values)
    law.reset()
    t = (states["stamp_ns"] - states["stamp_ns"][0]) / NANOSECONDS
    angles = from_upright(np.ascontiguousarray(states["position"], dtype=float))
    answers = np.array(
        [
            law.command(time, (angle, velocity))
            for time, angle, velocity in zip(t.tolist(), angles.tolist(), states["velocity"].tolist(), strict=True)
        ]
    )
    _, mine, theirs = np.intersect1d(states["stamp_ns"], commands["stamp_ns"], return_indices=True)
    if mine.size == 0:
        raise DataError(f"bag {path} has no command that answers a state; expected equal stamps")
    return ControllerReplay(
        controller,
        law.describe(),
        t[mine],
        commands["effort"][theirs],
        answers[mine],
        len(states) - int(mine.size),
    )


def _by_stamp(array: NDArray[Any], topic: str) -> NDArray[Any]:
    if not len(array):
        raise DataError(f"topic {topic} has no message; expected states, and commands that answer them")
    _, first = np.unique(array["stamp_ns"], return_index=True)
    return array[first]


def parse_values(texts: Sequence[str]) -> dict[str, object]:
    """Return parameters from texts such as ``q=[100.0, 0.01]``; values are YAML.

    Raises:
        DataError: A text has no ``=``, or a name stands twice.
    """
    import yaml

    values: dict[str, object] = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign:
            raise DataError(f"parameter is {text!r}; expected NAME=VALUE")
        if name.strip() in values:
            raise DataError(f"parameter {name.strip()} is given twice; expected once")
        values[name.strip()] = yaml.safe_load(value)
    return values
