"""A plant of several joints driven by recorded efforts, in windows whose start is fitted."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.identification.explained import LARGEST_SHARE
from pendulum_bags.identification.joint_fit import Score, fit, line_errors, prepare_windows
from pendulum_bags.identification.joint_model import DELAY, LAG, JointModel
from pendulum_bags.identification.joint_recordings import read_joints
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay, load_mechanism

__all__ = ["JointReplay", "replay_joints"]


@dataclass(frozen=True)
class JointReplay:
    """A plant of n joints along a recording, in windows [s]: errors by joint, and positions, shape (k, n) [rad or m].

    ``renamed``: which of the recording's joints are taken for those of the plant; empty where they have its names.
    """

    name: str
    plant: str
    joints: Sequence[Joint]
    window: float
    score: Score
    time: Array
    measured: Array
    simulated: Array
    renamed: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures for JSON."""
        rows = zip(self.joints, self.score.rms, self.score.lines, strict=True)
        return {
            "recording": self.name,
            "plant": self.plant,
            "window_s": self.window,
            "joints": {j.name: {"unit": j.unit, "rms": float(r), "straight_lines_rms": float(s)} for j, r, s in rows},
        }

    @property
    def objection(self) -> str | None:
        """That the plant does not describe this motion, in a sentence; None where it may."""
        if self.score.share <= LARGEST_SHARE:
            return None
        return (
            f"The plant {self.plant!r} does not describe {self.name}: it misses {100.0 * self.score.share:.0f} % of "
            f"what straight lines through windows of {self.window:g} s miss; expected less than "
            f"{100.0 * LARGEST_SHARE:.0f} %. It is the plant of another machine, or lacks what moves this one."
        )

    def sentence(self) -> str:
        """Return the result as text."""
        errors = ", ".join(
            f"{joint.name} {1e3 * rms:.3g} m{joint.unit}"
            for joint, rms in zip(self.joints, self.score.rms, strict=True)
        )
        return (
            f"Driven by the efforts of {self.name}, the plant {self.plant!r} errs over windows of {self.window:g} s by "
            f"{errors} rms, {100.0 * self.score.share:.2g} % of what straight lines miss."
            + (f" Its {self.renamed}." if self.renamed else "")
        )

    def figure(self) -> Figure:
        """Return measured and simulated positions, by joint."""
        panels = [
            Panel(
                "time [s]",
                f"{joint.name} [{joint.unit}]",
                [
                    Trace(self.time, self.measured[:, i], "measured", "difference"),
                    Trace(self.time, self.simulated[:, i], f"simulated, {self.window:g} s windows", "hw"),
                ],
            )
            for i, joint in enumerate(self.joints)
        ]
        return Figure("replay", f"Replay of {self.name}", self.sentence(), panels, section="Replay", panel_height=220)


def replay_joints(
    path: str | os.PathLike[str],
    plant: str | PlantParameters,
    *,
    window: float = 1.0,
) -> JointReplay:
    """Drive a plant of several joints with the efforts of a recording, in windows [s].

    A DataError if it is damaged or of other joints, a ParameterError if the plant file is refused.
    """
    if not window > 0.0:
        raise DataError(f"window is {window} s; expected > 0")
    own = load_mechanism(plant) if isinstance(plant, str) else plant
    recording = read_joints(path, own.coordinates).at_standstill(own)
    recording.check(own.coordinates)
    lag = max((actuator.time_constant for actuator in own.actuators), default=0.0)
    model = JointModel.of(own.torque_plant).with_changes({DELAY: common_delay(own), LAG: lag})
    data = prepare_windows(recording, window)
    weights = 1.0 / np.maximum(line_errors(data), 1e-9)
    found = fit(model, [data], (), weights, most=12, tolerance=1e-6)
    inside = data.inside
    measured = data.position[inside]
    return JointReplay(
        recording.name,
        own.name,
        own.coordinates.joints,
        window,
        found.scores[0],
        data.time[inside] - recording.time[0],
        measured,
        measured + found.residuals[0][inside],
        recording.renamed,
    )
