"""Controller replay: feed recorded states to a controller and compare its torque with what was commanded."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.read_recording import read_recording
from pendulum_bags.runs.run_data import slope
from pendulum_bags.runs.run_record import run_record
from pendulum_lqr.controller_interface.controller import controller_parameters, make_controller
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant

if TYPE_CHECKING:
    from pendulum_bags.figures.figure import Figure

__all__ = ["ControllerReplay", "parse_values", "recorded_controller", "replay_controller"]

SETTLED = 1e-9
"""Torque difference up to which two commands count as equal [N m]."""


@dataclass(frozen=True)
class ControllerReplay:
    """Torque that was commanded and that a controller would have commanded, shape (n,) [N m].

    ``t`` counts from the first answered state [s]; ``unanswered``: states from first to last command that got none.
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
    """Return name, parameters and plant of the controller that made a bag by its metadata, else a DataError."""
    run = run_record(metadata)
    recorded = run.get("controller")
    if not isinstance(recorded, Mapping) or "kind" not in recorded:
        raise DataError("the recording does not say which controller made it: name one, with its gains")
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
    """Feed recorded states to a controller, in order, and pair its commands with the recorded ones by their stamp.

    Args:
        path: Recording of any format, with states and the torque that answered them; of a bag ``effort_command``.
        controller: Its name; None for the one that made the recording.
        plant: Plant to design on; None for that of the recording, or the thesis's where it was real hardware.
        values: Parameters of the controller.
        prefix: Namespace of the topics; None for that of the only plant.

    Raises:
        DataError: States or commands are missing, or no command answers a state.
        ParameterError: No such controller or plant, or a value out of domain.
    """
    reading = Reading.of(path)
    recording = read_recording(reading, effort="commanded", namespace=prefix)
    if recording.input_kind != "effort":
        raise DataError(f"{reading.path} has no commands in N m; expected the torque that answered each state")
    if controller is None:
        controller, recorded_values, design_plant = recorded_controller(recording.meta)
        values = {**recorded_values, **(values or {})}
    else:
        design_plant = "thesis"
    if plant is None:
        plant = "thesis" if design_plant in {"emulator", "hebi"} else design_plant
    parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
    time, stamps = recording.time, recording.input_stamps
    # A command has the stamp of its state; in files with a clock for each it answers the newest state.
    answered = np.searchsorted(time, stamps, side="right") - 1
    same = (answered >= 0) & (time[np.maximum(answered, 0)] == stamps)
    rows = np.flatnonzero(same if same.any() or reading.has_states else answered >= 0)
    mine, first = np.unique(answered[rows], return_index=True)
    if mine.size < 2:
        raise DataError(f"{reading.path} has no command that answers a state; expected equal stamps")
    law = make_controller(controller, parameters, recording.period, values)
    law.reset()
    part = slice(int(mine[0]), int(mine[-1]) + 1)
    velocity = slope(time, recording.position) if recording.velocity is None else recording.velocity
    states = zip(
        (time[part] - time[part][0]).tolist(),
        from_upright(recording.position[part]).tolist(),
        velocity[part].tolist(),
        strict=True,
    )
    answers = np.array([law.command(t, (angle, rate)) for t, angle, rate in states])
    return ControllerReplay(
        controller,
        law.describe(),
        time[mine] - time[part][0],
        recording.input[rows[first]],
        answers[mine - part.start],
        int(answers.size - mine.size),
    )


def parse_values(texts: Sequence[str]) -> dict[str, object]:
    """Return parameters from texts such as ``q=[100.0, 0.01]`` (YAML); a DataError without ``=`` or if named twice."""
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
