"""Recordings of all joints of a mechanism, from bags, or from CSV files of any columns by a mapping file.

Example of a mapping file::

    format: pendulum_joint_columns/1
    time: {column: time, unit: s}
    joints:
      shoulder:
        position: {column: pos_meas1, unit: rad}
        velocity: {column: vel_meas1, unit: rad/s}        # optional: checks the unit of the position
        effort: {column: tau_meas1, unit: N m, hold: linear}
      elbow:
        position: {column: pos_meas2, unit: rad}          # no effort: nothing drives this joint

Each joint is read as one pendulum is (:mod:`~pendulum_bags.runs.csv_mapping`): units, signs, offsets, unwrapping, the
check of the velocity against the position. Rows with a NaN are left out and counted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.runs.csv_mapping import read_csv
from pendulum_bags.runs.datasets import Recording, check_consistency, unwrap
from pendulum_bags.runs.run_data import find_prefix
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.contract.names import APPLIED_EFFORT, JOINT_STATES, PUSH
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.parameters import load_yaml, reject_unknown, require_mapping
from pendulum_rosbag.reader import read_bag

__all__ = ["FORMAT", "JointRecording", "read_joints"]

FORMAT = "pendulum_joint_columns/1"

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


def read_joints(path: str | Path, coordinates: Coordinates, mapping: str | Path | None = None) -> JointRecording:
    """Read a bag, or a CSV file with the columns of every joint.

    Of a bag, velocities are read too, unless they contradict the positions. The input is what the plant says it applied
    (topic ``applied_effort``, held until the next state), or else the effort measured with the states.

    Args:
        path: The bag or file.
        coordinates: Joints of the plant, and which are driven.
        mapping: Mapping file, for CSV files; by default the columns are ``time`` and, for each joint,
            ``JOINT.position`` and, where it is driven, ``JOINT.effort`` in SI units (``JOINT.velocity`` is used where
            it is there).

    Raises:
        BagError: The bag cannot be read.
        DataError: A column, a unit or a joint is not as the mapping says, joints are missing or foreign, or the
            input is not an effort.
    """
    source = Path(path)
    if not source.exists():
        raise DataError(f"{source} does not exist; expected a bag or a CSV file")
    if source.is_dir() or source.suffix.lower() in {".mcap", ".db3"}:
        if mapping is not None:
            raise DataError(f"{source} is a bag, whose joints have names; expected no mapping file for it")
        return _read_bag(source, coordinates)
    if source.suffix.lower() not in {".csv", ".txt"}:
        raise DataError(f"{source} is neither a bag nor a CSV file; expected a recording of all joints")
    rules, origin = _rules(coordinates, mapping, source)
    common = {key: value for key, value in rules.items() if key not in {"format", "joints"}}
    parts: list[Recording] = []
    # A row with a hole in one joint's column is left out for all joints: their rows must stay those of one moment.
    others = [
        {**section, "input": section.get("effort")}
        for section in rules["joints"].values()
        if isinstance(section, Mapping)
    ]
    for index, joint in enumerate(coordinates.joints):
        section = require_mapping(rules["joints"][joint.name], f"{origin}: joints.{joint.name}")
        reject_unknown(section, ("position", "velocity", "effort"), where=f"{origin}: joints.{joint.name}")
        own = {key: value for key, value in section.items() if key != "effort"}
        if "effort" in section:
            own["input"] = section["effort"]
        elif index in coordinates.driven:
            raise DataError(
                f"{origin}: joints.{joint.name} has no effort, but the plant has an actuator there; expected the "
                "column of its torque or force"
            )
        if joint.effort_unit == "N":
            own = _as_turning(own)
        part = read_csv(source, {**common, "drop_nan": True, **own}, also=others)
        if part.input_kind not in {"effort", "none"}:
            raise DataError(
                f"{origin}: the input of {joint.name} is a {part.input_kind}; expected an effort in {joint.effort_unit}"
            )
        part = check_consistency(unwrap(part)) if joint.turns else check_consistency(part)
        parts.append(part)
    return JointRecording(
        source.resolve().name,
        parts[0].time,
        np.stack([part.position for part in parts], axis=1),
        np.stack([part.input for part in parts], axis=1),
        tuple(part.hold for part in parts),
        str(source),
        sum(int(parts[0].meta.get(key, 0)) for key in ("repeated_stamps", "nan_rows")),
        _passive(coordinates, [bool(np.any(part.input)) for part in parts]),
    )


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
    if sorted(states.names) != sorted(coordinates.names):
        way = " (`pendulum export` makes a CSV file of it, in which a mapping file names the joints)"
        raise DataError(
            f"bag {source} is of the joints {', '.join(states.names)}; expected {', '.join(coordinates.names)}"
            f"{way * (len(states.names) == len(coordinates.names))}"
        )
    columns = [states.names.index(name) for name in coordinates.names]
    # A plant in lockstep sends a state again when its answer was missed: the same stamp is the same state.
    stamps, first = np.unique(states.stamp_ns, return_index=True)
    position, effort = states.position[first][:, columns], np.zeros((stamps.size, len(columns)))
    driven = list(coordinates.driven)
    if applied is None:
        effort[:, driven] = states.effort[first][:, columns][:, driven]
    else:
        if not set(coordinates.driven_names) <= set(applied.names) <= set(coordinates.names):
            raise DataError(
                f"topic {applied_topic} of bag {source} is of {', '.join(applied.names)}; expected the driven joints, "
                f"{', '.join(coordinates.driven_names)}"
            )
        driven = [coordinates.names.index(name) for name in applied.names]
        told, rows = np.unique(applied.stamp_ns, return_index=True)
        newest = np.searchsorted(told, stamps, side="right") - 1
        # Before the first of them nothing was applied yet.
        effort[:, driven] = np.where((newest >= 0)[:, None], applied.effort[rows][np.maximum(newest, 0)], 0.0)
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


_SLIDING = {"m": "rad", "m/s": "rad/s", "N": "N m"}
"""Units of a joint that slides, and what the reader of one hinge calls them."""


def _as_turning(own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of a joint that slides with those units that the reader knows."""
    found = {}
    for key, section in own.items():
        if not isinstance(section, Mapping) or section.get("unit") not in _SLIDING:
            raise DataError(f"unit of {key} is {section!r}; expected m, m/s or N: this joint slides")
        found[key] = {**section, "unit": _SLIDING[section["unit"]]}
    return found


def _rules(coordinates: Coordinates, mapping: str | Path | None, source: Path) -> tuple[dict[str, Any], str]:
    names = coordinates.names
    if mapping is None:
        joints: dict[str, Any] = {}
        with source.open(encoding="utf-8", errors="replace") as file:
            head = {cell.strip().casefold() for cell in file.readline().lstrip("# ").split(",")}
        for index, joint in enumerate(coordinates.joints):
            joints[joint.name] = {
                "position": {"column": [f"{joint.name}.position", f"{joint.name}_position"], "unit": joint.unit},
                "velocity": {
                    "column": [f"{joint.name}.velocity", f"{joint.name}_velocity"],
                    "unit": joint.velocity_unit,
                    "optional": True,
                },
            }
            columns = [f"{joint.name}.effort", f"{joint.name}_effort"]
            if index in coordinates.driven or head & set(columns):
                joints[joint.name]["effort"] = {"column": columns, "unit": joint.effort_unit, "hold": "linear"}
        return {"time": {"column": "time", "unit": "s"}, "joints": joints}, "names of the joints"
    rules = load_yaml(Path(mapping), "mapping file")
    origin = str(mapping)
    if rules.get("format") != FORMAT:
        raise DataError(f"{origin}: format is {rules.get('format')!r}; expected {FORMAT!r}")
    joints = dict(require_mapping(rules.get("joints"), f"{origin}: joints"))
    if list(joints) != list(names):
        raise DataError(f"{origin}: joints are {', '.join(joints)}; expected {', '.join(names)}, in this order")
    _check_distinct_columns(joints, origin)
    return {**rules, "joints": joints}, origin


def _check_distinct_columns(joints: Mapping[str, Any], origin: str) -> None:
    seen: dict[str, str] = {}
    for joint, section in joints.items():
        column = (section or {}).get("position", {}).get("column")
        if isinstance(column, str) and column in seen:
            raise DataError(f"{origin}: {seen[column]} and {joint} have the same column {column!r}; expected two")
        seen[str(column)] = joint
