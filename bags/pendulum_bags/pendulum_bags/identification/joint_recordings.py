"""Recordings of all joints of a mechanism, of any format."""

from __future__ import annotations

import math
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
from pendulum_bags.runs.run_data import find_prefix
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.contract.names import APPLIED_EFFORT, JOINT_STATES, PUSH
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import read_bag

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
        effort: What drives each joint, 0 where nothing does, shape (s, n) [N m or N].
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
        """Check that the arrays fit together."""
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
    path: str | os.PathLike[str], coordinates: Coordinates, mapping: str | Path | None = None
) -> JointRecording:
    """Read a recording of every joint.

    Of a bag, velocities are read too, unless they contradict the positions. The input is what the plant says it applied
    (topic ``applied_effort``, held until the next state), or else the effort measured with the states.

    Args:
        path: File or folder, or a :class:`~pendulum_bags.recordings.reading.Reading`.
        coordinates: Joints of the plant, and which are driven.
        mapping: Mapping file; by default the columns are guessed, ``JOINT.position`` and ``JOINT.effort`` surely.

    Raises:
        BagError: The bag cannot be read.
        DataError: A column, a unit or a joint is not as the mapping says, joints are missing or foreign, or the
            input is not an effort.
    """
    reading = Reading.of(path)
    if mapping is not None:
        reading = replace(reading, mapping=mapping, _cache={})
    if reading.has_states:
        return _chosen_part(_read_bag(reading.path, coordinates), reading)
    motion = reading.motion
    parts: list[Recording] = []
    for index, (joint, moved) in enumerate(zip(coordinates.joints, _ordered(reading, coordinates), strict=True)):
        drive = moved.drive
        if drive is None and index in coordinates.driven:
            raise DataError(
                f"{motion.meta['mapping']}: joints.{joint.name} has no effort, but the plant has an actuator there; "
                "expected the column of its torque or force"
            )
        if moved.slides != (joint.unit == "m"):
            raise DataError(
                f"{reading.path}: {moved.name} is in {'m' if moved.slides else 'rad'}; expected {joint.unit} for "
                f"{joint.name}: correct its unit in a mapping file"
            )
        if drive is not None and drive.quantity != ("effort" if joint.unit == "rad" else "force"):
            raise DataError(
                f"{motion.meta['mapping']}: the input of {joint.name} is a {drive.quantity}; expected an effort in "
                f"{joint.effort_unit}"
            )
        part = recording_of(motion, moved)
        parts.append(check_consistency(unwrap(part)) if joint.turns else check_consistency(part))
    recording = JointRecording(
        reading.name,
        parts[0].time,
        np.stack([part.position for part in parts], axis=1),
        np.stack([_at(part, parts[0].time) for part in parts], axis=1),
        tuple(part.hold for part in parts),
        str(reading.path),
        sum(int(motion.meta.get(key, 0)) for key in ("repeated_stamps", "nan_rows")),
        _passive(coordinates, [bool(np.any(part.input)) for part in parts]),
    )
    return _chosen_part(recording, reading)


def _chosen_part(recording: JointRecording, reading: Reading) -> JointRecording:
    """Return the part of a recording that its reading asks for, from its beginning [s]."""
    if reading.start is None and reading.stop is None:
        return recording
    time, stop = recording.time - recording.time[0], math.inf if reading.stop is None else reading.stop
    rows = (time >= (reading.start or 0.0)) & (time <= stop)
    cut = {name: getattr(recording, name)[rows] for name in ("time", "position", "effort")}
    velocity = None if recording.velocity is None else recording.velocity[rows]
    return replace(recording, **cut, velocity=velocity)


def _ordered(reading: Reading, coordinates: Coordinates) -> list[JointMotion]:
    """Return the joints of a recording in the order of the plant's.

    They go by their names, or by which are driven; guessed columns by their places where neither decides.
    """
    found = {joint.name: joint for joint in reading.motion.joints}
    names = coordinates.names
    if sorted(found) == sorted(names):
        return [found[name] for name in names]
    if len(found) != len(names) or not reading.rules.guessed:
        known = ", ".join(name or "one without a name" for name in found)
        raise DataError(f"{reading.rules.origin} of {reading.name}: joints are {known}; expected {', '.join(names)}")
    driven = [one for one, joint in found.items() if joint.drive is not None and np.any(joint.drive.values)]
    sure = matched_joints(list(found), driven, coordinates)
    order, how = sure or (list(found), "by its place in the file")
    for name, one in zip(names, order, strict=True):
        reading.add_guess(Guess(name, one, "", f"{how}, of the plant's joints", sure is None))
    return [found[one] for one in order]


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


def _read_bag(source: Path, coordinates: Coordinates) -> JointRecording:
    with read_bag(source) as bag:
        space = find_prefix(bag)
        states = bag.joints(f"{space}/{JOINT_STATES}")
        applied_topic, push_topic = f"{space}/{APPLIED_EFFORT}", f"{space}/{PUSH}"
        applied = bag.joints(applied_topic) if applied_topic in bag.topics else None
        if push_topic in bag.topics and np.any(bag.joints(push_topic).effort):
            raise DataError(f"topic {push_topic} of bag {source} pushes links from outside; expected none of that")
        meta = dict(bag.metadata)
    order, how = list(coordinates.names), ""
    if sorted(states.names) != sorted(order):
        pairs = zip(states.names, states.effort.T, strict=True)
        driven = [name for name, effort in pairs if np.any(effort)] if applied is None else list(applied.names)
        same = len(states.names) == len(order)
        if not same or (matched := matched_joints(states.names, driven, coordinates)) is None:
            way = ", and neither names nor efforts show which is which: `--mapping FILE` names their columns"
            raise DataError(
                f"bag {source} is of the joints {', '.join(states.names)}; expected {', '.join(order)}{way * same}"
            )
        order, how = matched
    columns = [states.names.index(name) for name in order]
    # A plant in lockstep sends a state again when its answer was missed: the same stamp is the same state.
    stamps, first = np.unique(states.stamp_ns, return_index=True)
    position, effort = states.position[first][:, columns], np.zeros((stamps.size, len(columns)))
    if applied is None:
        rows_of = list(coordinates.driven)
        effort[:, rows_of] = states.effort[first][:, columns][:, rows_of]
    else:
        motors = {order[index] for index in coordinates.driven}
        if not motors <= set(applied.names) <= set(order):
            raise DataError(
                f"topic {applied_topic} of bag {source} is of {', '.join(applied.names)}; expected the driven joints, "
                f"{', '.join(sorted(motors, key=order.index))}"
            )
        rows_of = [order.index(name) for name in applied.names]
        told, rows = np.unique(applied.stamp_ns, return_index=True)
        newest = np.searchsorted(told, stamps, side="right") - 1
        # Before the first of them nothing was applied yet.
        effort[:, rows_of] = np.where((newest >= 0)[:, None], applied.effort[rows][np.maximum(newest, 0)], 0.0)
    return JointRecording(
        source.resolve().name,
        (stamps - stamps[0]) * 1e-9,
        position,
        effort,
        ("linear" if applied is None else "zero",) * len(states.names),
        str(source),
        int(states.stamp_ns.size - stamps.size),
        _passive(coordinates, np.any(effort, axis=0).tolist()),
        _tracks_position((stamps - stamps[0]) * 1e-9, position, states.velocity[first][:, columns]),
        meta,
        how
        and f"joints {', '.join(order)} are taken for {', '.join(coordinates.names)}, {how.replace('its', 'their')}",
    )


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
