"""Recordings of all joints of a mechanism, of any format."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.guess import Guess
from pendulum_bags.recordings.mapping import JointMotion
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.datasets import Recording, check_consistency, recording_of, unwrap
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["JointRecording", "matched_joints", "read_joints"]

_FOLLOWED = 0.1
"""Time over which a velocity has to lead to the position [s]."""

_STILL = 1e-3
"""Travel below which a joint counts as not moving [rad or m]."""


@dataclass(frozen=True)
class JointRecording:
    """A run of a mechanism with n joints, measured.

    Attributes:
        name: Of the file, for messages.
        time: Strictly increasing, shape (s,) [s].
        position: Shape (s, n) [rad or m].
        effort: What drives each joint, 0 where nothing does, shape (s, n) [N m or N, or V].
        hold: ``zero`` or ``linear``, per joint.
        source: Where it was read.
        velocity: Shape (s, n) [rad/s or m/s]; None where it was not measured, or is made of the positions.
        left_out: Rows with a NaN or a repeated stamp that were left out.
        passive_effort: Joints without an actuator in the plant at which an effort was recorded all the same.
        meta: What a bag says about its run.
        renamed: Which joints are taken for those of the plant, and why; empty where they have its names.
    """

    name: str
    time: Array
    position: Array
    effort: Array
    hold: tuple[str, ...]
    source: str = ""
    left_out: int = 0
    passive_effort: tuple[str, ...] = ()
    velocity: Array | None = None
    meta: Mapping[str, Any] = field(default_factory=dict)
    renamed: str = ""

    def __post_init__(self) -> None:
        size = self.time.size
        if self.position.shape != self.effort.shape or self.position.shape[0] != size:
            raise DataError(
                f"{self.name}: position has shape {self.position.shape}, effort {self.effort.shape}; "
                f"expected both ({size}, joints)"
            )
        values = np.column_stack((self.time, self.position, self.effort))
        if size < 10 or not np.isfinite(values).all() or np.any(np.diff(self.time) <= 0.0):
            raise DataError(f"{self.name}: expected at least 10 samples, finite numbers and increasing stamps")

    @property
    def input(self) -> Array:
        """The effort."""
        return self.effort

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def period(self) -> float:
        """Median sampling period [s]."""
        return float(np.median(np.diff(self.time)))

    def at_standstill(self, plant: PlantParameters) -> JointRecording:
        """Return the recording with the efforts at standstill of the voltages of a plant's motors; else itself."""
        if not plant.coordinates.volts:
            return self
        effort = self.effort.copy()
        for index, actuator in zip(plant.coordinates.driven, plant.actuators, strict=True):
            assert actuator.motor is not None
            band = actuator.motor.dead_band
            effort[:, index] = actuator.motor.gain * (effort[:, index] - np.clip(effort[:, index], -band, band))
        return replace(self, effort=effort)

    def check(self, coordinates: Coordinates) -> None:
        """Refuse a recording that cannot be of this mechanism.

        Raises:
            DataError: Another number of joints, or a joint that does not move.
        """
        names = coordinates.names
        if self.position.shape[1] != len(names):
            raise DataError(
                f"{self.name} has {self.position.shape[1]} joints; expected {len(names)}: {', '.join(names)}"
            )
        for index, joint in enumerate(coordinates.joints):
            travel = float(np.ptp(self.position[:, index]))
            if travel < _STILL:
                raise DataError(
                    f"{self.name}: joint {joint.name} moves by {travel:.2g} {joint.unit}; expected a joint that moves: "
                    "is its column another one, or was it locked?"
                )


def read_joints(
    path: str | os.PathLike[str],
    coordinates: Coordinates,
    mapping: str | Path | None = None,
    hold: str | None = None,
) -> JointRecording:
    """Read a recording of every joint.

    Of a bag, velocities are read too, unless they contradict the positions. The input is what the plant says it applied
    (topic ``applied_effort``, held until the next state), or else the effort measured with the states.

    Args:
        path: File or folder, or a :class:`~pendulum_bags.recordings.reading.Reading`.
        coordinates: Joints of the plant, and which are driven.
        mapping: Mapping file; by default the columns are guessed, ``JOINT.position`` and ``JOINT.effort`` surely.
        hold: Of a file's efforts, ``zero`` (commands) or ``linear`` (measurements), in place of the mapping's.

    Raises:
        BagError: The bag cannot be read.
        DataError: A column, a unit or a joint is not as the mapping says, joints are missing or foreign, or the
            input is not an effort.
    """
    reading = Reading.of(path)
    if mapping is not None:
        reading = replace(reading, mapping=mapping, _cache={})
    motion, is_bag = reading.motion, reading.has_states
    if pushed := motion.meta.get("pushed"):
        raise DataError(f"topic {pushed} of {motion.meta['mapping']} pushes links from outside; expected none of that")
    ordered, renamed = _ordered(reading, coordinates)
    parts: list[Recording] = []
    for index, (joint, moved) in enumerate(zip(coordinates.joints, ordered, strict=True)):
        drive = moved.drive
        if drive is None and index in coordinates.driven:
            raise DataError(
                f"{motion.meta['mapping']}: joints.{joint.name} has no effort, but the plant has an actuator there; "
                "expected its torque or force"
            )
        if not is_bag and moved.slides != (joint.unit == "m"):
            raise DataError(
                f"{reading.path}: {moved.name} is in {'m' if moved.slides else 'rad'}; expected {joint.unit} for "
                f"{joint.name}: correct its unit in a mapping file"
            )
        wanted = "voltage" if coordinates.volts else "effort" if is_bag or joint.unit == "rad" else "force"
        if drive is not None and drive.quantity != wanted and (not is_bag or index in coordinates.driven):
            article = "an" if drive.quantity[0] in "ae" else "a"
            what = "a voltage" if coordinates.volts else f"an effort in {joint.effort_unit}"
            raise DataError(
                f"{motion.meta['mapping']}: the input of {joint.name} is {article} {drive.quantity}; expected {what}"
            )
        if is_bag:  # whose messages state no units, and where sensors measure an effort at passive joints
            measured = drive is not None and not drive.own_clock and index not in coordinates.driven
            part = recording_of(motion, replace(moved, velocity=None, drive=None if measured else drive))
        else:
            part = recording_of(motion, moved, hold)
        parts.append(check_consistency(unwrap(part)) if joint.turns else check_consistency(part))
    time, position = parts[0].time, np.stack([part.position for part in parts], axis=1)
    velocities = [moved.velocity for moved in ordered if is_bag and moved.velocity is not None]
    velocity = np.stack(velocities, axis=1) if len(velocities) == len(parts) else None
    recording = JointRecording(
        reading.name,
        time,
        position,
        np.stack([_at(part, time) for part in parts], axis=1),
        tuple(part.hold for part in parts),
        str(reading.path),
        sum(int(motion.meta.get(key, 0)) for key in ("repeated_stamps", "repeated_states", "nan_rows")),
        _passive(coordinates, [bool(np.any(part.input)) for part in parts]),
        None if velocity is None else _tracks_position(time, position, velocity),
        {**motion.meta, "hold_assumed": any(part.meta.get("hold_assumed") for part in parts)},
        renamed,
    )
    return _chosen_part(recording, reading)


def _chosen_part(recording: JointRecording, reading: Reading) -> JointRecording:
    """Return the part of a recording that its reading asks for."""
    rows = reading.rows(recording.time)
    cut = {name: getattr(recording, name)[rows] for name in ("time", "position", "effort")}
    return replace(recording, **cut, velocity=None if recording.velocity is None else recording.velocity[rows])


def _ordered(reading: Reading, coordinates: Coordinates) -> tuple[list[JointMotion], str]:
    """Return the joints of a recording in the order of the plant's, and which of a bag are taken for them.

    They go by their names, or by which are driven; guessed columns by their places where neither decides.
    """
    found = {joint.name: joint for joint in reading.motion.joints}
    names, is_bag = coordinates.names, reading.has_states
    if sorted(found) == sorted(names):
        return [found[name] for name in names], ""
    if len(found) == len(names) == 1:
        return list(found.values()), ""
    known, origin = ", ".join(name or "one without a name" for name in found), reading.motion.meta["mapping"]
    if len(found) != len(names) or not (is_bag or reading.rules.guessed):
        raise DataError(f"{origin} of {reading.name}: joints are {known}; expected {', '.join(names)}")
    driven = [
        name
        for name, joint in found.items()
        if joint.drive is not None and (np.any(joint.drive.values) or (is_bag and joint.drive.own_clock))
    ]
    sure = matched_joints(list(found), driven, coordinates)
    order, how = sure or (list(found), "by its place in the file")
    if not is_bag:
        for name, one in zip(names, order, strict=True):
            reading.add_guess(Guess(name, one, "", f"{how}, of the plant's joints", sure is None))
        return [found[one] for one in order], ""
    if sure is None:
        raise DataError(
            f"{origin} is of the joints {known}; expected {', '.join(names)}, and neither names nor efforts show which "
            "is which: `--mapping FILE` names their columns"
        )
    renamed = f"joints {', '.join(order)} are taken for {', '.join(names)}, {how.replace('its', 'their')}"
    return [found[one] for one in order], renamed


def matched_joints(
    found: Sequence[str], driven: Sequence[str], coordinates: Coordinates
) -> tuple[list[str], str] | None:
    """Return other names of a plant's joints in its order, and how they were matched; None where nothing decides.

    Args:
        found: Their names.
        driven: Those that an effort drives.
        coordinates: Joints of the plant, and which are driven.
    """
    names = coordinates.names
    by_name = [[one for one in found if name.casefold() in one.casefold()] for name in names]
    moved = [index in coordinates.driven for index in range(len(names))]
    by_drive = [[one for one in found if (one in driven) is drive] for drive in moved]
    for ones, how in ((by_name, "by its name"), (by_drive, "by which joints are driven")):
        if all(len(one) == 1 for one in ones) and len({one for (one,) in ones}) == len(names):
            return [one for (one,) in ones], how
    return None


def _at(part: Recording, time: Array) -> Array:
    """Return the input at the stamps of the states."""
    if part.input_time is None:
        return part.input
    newest = np.searchsorted(part.input_time, time, side="right") - 1
    return np.where(newest >= 0, part.input[np.maximum(newest, 0)], 0.0)


def _passive(coordinates: Coordinates, driven: Sequence[bool]) -> tuple[str, ...]:
    return tuple(name for i, name in enumerate(coordinates.names) if i not in coordinates.driven and driven[i])


def _tracks_position(time: Array, position: Array, velocity: Array) -> Array | None:
    """Return the velocity where its integral over a tenth of a second follows every position; else None."""
    if not np.isfinite(velocity).all():
        return None
    stride = max(5, round(_FOLLOWED / float(np.median(np.diff(time)))))
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)[:, None]
    way = np.concatenate((np.zeros((1, steps.shape[1])), np.cumsum(steps, axis=0)))
    moved = np.diff(position[::stride], axis=0)
    left = np.sum((np.diff(way[::stride], axis=0) - moved) ** 2, axis=0)
    return velocity if np.all(left < 0.25 * np.sum(moved**2, axis=0)) else None
