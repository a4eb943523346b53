"""Measurements of one pendulum in SI units, with the stamps that were recorded: nothing is resampled."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.clock import gap_length, longest_step
from pendulum_bags.recordings.mapping import JointMotion, Motion
from pendulum_bags.recordings.physics import ALIKE, FASTEST, derivative
from pendulum_msgs_py.errors import DataError

__all__ = [
    "INPUT_KINDS",
    "Recording",
    "check_consistency",
    "data_notes",
    "distinct_names",
    "gaps",
    "recording_of",
    "unwrap",
]

INPUT_KINDS: Mapping[str, str] = {"effort": "N m", "voltage": "V", "position_goal": "rad", "none": "-"}
"""What drives the pendulum, and its unit. ``position_goal`` is the set point of a servo's own position loop."""

_MOST_JOINTS, _LEAST_PIECE, _LEAST_JUMP = 5, 50, 0.3
"""Jumps of the angle that join recordings: how many at most, samples between two of them, and size [rad] at least."""

_MOVES = 1e-2
"""Travel from which on an angle moves [rad]."""

_CONSISTENCY_FACTORS = (
    ("deg/s instead of rad/s", 180.0 / np.pi),
    ("rpm instead of rad/s", 30.0 / np.pi),
    ("rev/s instead of rad/s", 0.5 / np.pi),
    ("a reversed sign", -1.0),
)


_KINDS = {"effort": "effort", "force": "effort", "voltage": "voltage", "command": "voltage", "angle": "position_goal"}
"""Quantity of an input -> what drives the pendulum; a number without a unit has a gain of its own, as a voltage has."""


@dataclass(frozen=True)
class Recording:
    """A run of one pendulum, measured.

    Args:
        time: Stamps of position and velocity, strictly increasing, shape (n,) [s].
        position: Joint angle, 0 hanging down, not wrapped, shape (n,) [rad].
        velocity: Joint velocity, shape (n,) [rad/s], or None.
        input: Input of the joint, shape (n,), or (m,) where ``input_time`` is given; unit by ``input_kind``.
        input_kind: One of ``INPUT_KINDS``.
        hold: ``zero`` if the input is held (a command), ``linear`` if it varies between samples (a measurement).
        input_time: Stamps of the input where they differ from ``time``, shape (m,) [s].
        enabled: Share of the time in which the drive is on, shape of ``input``, 0 or 1; None for always.
        meta: Provenance and constants of the rig: ``source``, ``mass`` [kg], ``length`` [m], ``kp``, ``vin`` [V].

    Raises:
        DataError: Stamps that do not increase, NaN, or arrays that do not match.
    """

    time: Array
    position: Array
    velocity: Array | None
    input: Array
    input_kind: str = "effort"
    hold: str = "linear"
    input_time: Array | None = None
    enabled: Array | None = None
    meta: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Convert to float arrays and check that they fit together."""
        for name in ("time", "position", "velocity", "input", "input_time", "enabled"):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, np.ascontiguousarray(values, dtype=float))
        if self.input_kind not in INPUT_KINDS:
            raise DataError(f"input_kind is {self.input_kind!r}; expected one of {', '.join(INPUT_KINDS)}")
        if self.hold not in {"zero", "linear"}:
            raise DataError(f"hold is {self.hold!r}; expected 'zero' (a command) or 'linear' (a measurement)")
        size = self.time.size
        if size < 3:
            raise DataError(f"{self.name} has {size} samples; expected at least 3")
        lengths = {"position": size, "velocity": size, "input": self.input_stamps.size}
        lengths["enabled"] = lengths["input"]
        for name, length in lengths.items():
            values = getattr(self, name)
            if values is not None and values.shape != (length,):
                raise DataError(f"{self.name}: {name} has shape {values.shape}; expected ({length},)")
        for name in ("time", "input_time", "position", "velocity", "input", "enabled"):
            self._check_finite(name)
        self._check_increasing("time", self.time)
        if self.input_time is not None:
            self._check_increasing("input_time", self.input_time)

    def _check_finite(self, name: str) -> None:
        values = getattr(self, name)
        if values is None:
            return
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise DataError(
                f"{self.name}: {name} is {values[bad[0]]} in sample {bad[0]} ({bad.size} such samples); "
                "expected finite numbers: cut the range with `rows` or repair the file"
            )

    def _check_increasing(self, name: str, stamps: Array) -> None:
        bad = np.flatnonzero(np.diff(stamps) <= 0.0)
        if bad.size:
            i = int(bad[0]) + 1
            raise DataError(
                f"{self.name}: {name} goes from {stamps[i - 1]:.6f} s to {stamps[i]:.6f} s in sample {i} "
                f"({bad.size} such steps); expected strictly increasing stamps"
            )

    @property
    def source(self) -> str:
        """File that it was read from; empty for none."""
        return str(self.meta.get("source", ""))

    @property
    def name(self) -> str:
        """Short name for messages and figures: that of the source file."""
        return Path(self.source or "recording").resolve().name

    @property
    def input_stamps(self) -> Array:
        """Stamps of the input [s]."""
        return self.time if self.input_time is None else self.input_time

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def period(self) -> float:
        """Median sampling period [s]."""
        return float(np.median(np.diff(self.time)))

    def rows(self, start: int, stop: int | None = None) -> Recording:
        """Return samples ``start`` to ``stop`` (exclusive); the whole input stays, so that a delay can look back."""
        cut = slice(start, stop)
        if self.time[cut].size < 3:
            raise DataError(f"{self.name}: rows {start} to {stop} hold fewer than 3 of {self.time.size} samples")
        return replace(
            self,
            time=self.time[cut],
            position=self.position[cut],
            velocity=None if self.velocity is None else self.velocity[cut],
            input_time=self.input_stamps,
            meta={**self.meta, "rows": [start, self.time.size if stop is None else stop]},
        )

    def between(self, start: float, stop: float) -> Recording:
        """Return the samples with ``start <= time < stop`` [s]; the whole input stays."""
        first, last = np.searchsorted(self.time, (start, stop), side="left")
        return self.rows(int(first), int(last))


def recording_of(motion: Motion, joint: JointMotion, hold: str | None = None) -> Recording:
    """Return one joint of a recording."""
    drive, meta = joint.drive, dict(motion.meta)
    if drive is None:
        return Recording(motion.time, joint.position, joint.velocity, np.zeros_like(motion.time), "none", meta=meta)
    if hold is None and drive.hold_assumed:
        meta["hold_assumed"] = True
    if drive.quantity == "command":
        meta["input_unit"] = "-"
    return Recording(
        motion.time,
        joint.position,
        joint.velocity,
        drive.values,
        input_kind=_KINDS[drive.quantity],
        hold=hold or drive.hold,
        input_time=drive.time if drive.own_clock else None,
        meta=meta,
    )


def data_notes(recording: Recording) -> list[str]:
    """Return what was done to a recording while it was read, in words."""
    notes = [f"{sentence}." for sentence in recording.meta.get("clock_notes", ())]
    if recording.meta.get("no_effort"):
        notes.append("there is no effort in the bag: it is taken for a free swing.")
    if recording.meta.get("rows_by_topic"):
        between = ", the velocity by interpolation" * ("velocity" in recording.meta["rows_by_topic"])
        notes.append(f"no row holds all quantities: each is taken from its own rows{between}.")
    if recording.meta.get("nan_rows"):
        notes.append(f"{recording.meta['nan_rows']} rows without a number are left out.")
    if recording.meta.get("input_unit") == "-":
        notes.append("the input has no unit: its gain is per unit of the recorded number.")
    if recording.meta.get("repeated_stamps"):
        notes.append(f"{recording.meta['repeated_stamps']} samples repeat the stamp before them and are left out.")
    if recording.meta.get("unwrapped"):
        notes.append(
            f"the angle jumps by a turn {recording.meta['unwrapped']} times: it was wrapped, and is unwrapped here."
        )
    if recording.meta.get("no_torque"):
        notes.append("the recorded torque is 0 throughout: it is taken for a free swing.")
    # After a backward step of the clock the recording resumes behind a gap.
    made = gap_length(recording.time) if recording.meta.get("clock_notes") else -1.0
    notes.extend(
        f"no samples for {stop - start:.2f} s from {start:.2f} s after its start: no window reaches across."
        for start, stop in gaps(recording)
        if not 0.0 <= round(stop - start - made, 6) < 1.5 * recording.period
    )
    return notes


def gaps(recording: Recording) -> list[tuple[float, float]]:
    """Return where neither motion nor input is known for ten median periods and 0.1 s: (start, end) [s]."""
    found = []
    for stamps in {id(s): s for s in (recording.time, recording.input_stamps)}.values():
        for i in np.flatnonzero(np.diff(stamps) > longest_step(stamps)):
            start, stop = float(stamps[i]), float(stamps[i + 1])
            if stop > recording.time[0] and start < recording.time[-1]:
                found.append((start - float(recording.time[0]), stop - float(recording.time[0])))
    return sorted(found)


def _cut_at(recording: Recording, rows: NDArray[np.int64]) -> Recording:
    """Return a recording with gaps behind some samples."""
    gap = gap_length(recording.time)
    time, stamps = recording.time, recording.input_time
    for row in rows.tolist():
        at = time[row + 1]
        stamps = None if stamps is None else np.where(stamps >= at, stamps + gap, stamps)
        time = np.where(time >= at, time + gap, time)
    return replace(recording, time=time, input_time=stamps)


def _joints(time: Array, position: Array) -> NDArray[np.int64]:
    """Return the samples behind which angle and speed both jump, as in joined recordings (not in a slip)."""
    step, intervals = np.diff(position), np.diff(time)
    ordinary = 20.0 * float(np.quantile(np.abs(step), 0.99))
    rows = np.flatnonzero((intervals <= longest_step(time)) & (np.abs(step) > max(_LEAST_JUMP, ordinary)))
    rows = rows[(rows > 0) & (rows < step.size - 1)]
    speed = step / intervals
    usual = float(np.quantile(np.abs(np.diff(speed)), 0.95))
    return rows[np.abs(speed[rows + 1] - speed[rows - 1]) > 5.0 * usual]


def unwrap(recording: Recording) -> Recording:
    """Return the recording with a continuous angle, and the number of whole turns removed as ``unwrapped`` in ``meta``.

    It is cut where the angle jumps once for good. A DataError for repeated jumps by anything else.
    """
    position = recording.position
    jumps = np.abs(np.diff(position)) > np.pi
    result = recording
    # Wrapped angles stay within one turn.
    if jumps.any() and np.ptp(position) <= 2.0 * np.pi * 1.01:
        position = np.unwrap(position)
        meta = {**recording.meta, "unwrapped": int(jumps.sum())}
        result = replace(recording, position=position, meta=meta)
    step = np.abs(np.diff(position))
    fast = np.flatnonzero((step > 1.0) & (step > FASTEST * np.diff(recording.time)))
    odd = _joints(recording.time, position)
    if 0 < odd.size <= _MOST_JOINTS and np.all(np.diff(odd, prepend=0, append=step.size) > _LEAST_PIECE):
        notes = [
            f"the angle jumps by {step[i]:.3g} rad {recording.time[i] - recording.time[0]:.2f} s after the start, as "
            "between two recordings that were joined: the recording is cut there"
            for i in odd
        ]
        meta = {**result.meta, "clock_notes": [*result.meta.get("clock_notes", ()), *notes]}
        return replace(_cut_at(result, odd), meta=meta)
    if fast.size:
        i = int(fast[0])
        raise DataError(
            f"{recording.name}: the angle jumps by {step[i]:.3g} rad in "
            f"{recording.time[i + 1] - recording.time[i]:.3g} s ({fast.size} such jumps); expected a continuous "
            "angle in rad: is the unit deg, or the sensor at fault?"
        )
    return result


class _Named(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def source(self) -> str: ...


def distinct_names(recordings: Sequence[_Named]) -> list[str]:
    """Return a name for each recording: its file, with as many folders as make it unique."""
    parts = [Path(r.source or r.name).parts or (r.name,) for r in recordings]
    names = []
    for i, own in enumerate(parts):
        others = parts[:i] + parts[i + 1 :]
        depth = next((n for n in range(1, len(own)) if all(own[-n:] != other[-n:] for other in others)), len(own))
        name = str(Path(*own[-depth:]))
        twins = [j for j, other in enumerate(parts) if other == own]
        # Parts of one file, or recordings without one.
        names.append(name if len(twins) == 1 else f"{own[-1]} ({twins.index(i) + 1})")
    return names


def check_consistency(recording: Recording) -> Recording:
    """Return the recording if its velocity is the derivative of its position, else name the likely unit.

    The slope of travelled angle against integrated velocity is 1 in consistent units, 57.3 for degrees taken as
    radians. Recordings that move less than 0.2 rad are not judged, nor are gaps.

    Raises:
        DataError: The slope lies outside 0.5 to 2.
    """
    if recording.velocity is None:
        return recording
    if not np.any(recording.velocity) and np.ptp(recording.position) >= _MOVES:
        raise DataError(
            f"{recording.name}: the velocity is 0 throughout, and the angle travels {np.ptp(recording.position):.2g} "
            "rad; expected its derivative: name another column in a mapping file, or none"
        )
    if np.ptp(recording.position) < 0.2:
        return recording
    position, velocity = recording.position, recording.velocity
    slope, alike = derivative(recording.time, position, velocity)
    if 0.5 <= slope <= 2.0:
        return recording
    drive = np.interp(recording.time, recording.input_stamps, recording.input)
    orders = (("position and velocity", velocity, position), ("position and input", drive, velocity))
    for words, angle, rate in (*orders, ("velocity and input", position, drive)):
        other, fits = derivative(recording.time, angle, rate)
        if 0.5 <= other <= 2.0 and fits > ALIKE > abs(alike):
            raise DataError(
                f"{recording.name}: the columns of {words} seem to be exchanged: so read, the velocity is {other:.2g} "
                f"times the derivative of the position, and as given {slope:.3g} times; correct them in a mapping file"
            )
    likely = ""
    for text, factor in _CONSISTENCY_FACTORS:
        if abs(slope / factor - 1.0) < 0.3:
            likely = f"; this looks like {text} in the velocity"
        elif factor > 0.0 and abs(slope * factor - 1.0) < 0.3:
            likely = f"; this looks like {text.split('/s')[0]} instead of rad in the position"
    mend = "correct `unit` or `sign` in the mapping file"
    if abs(alike) < ALIKE:
        likely, mend = "", "name another column in a mapping file, or none: no unit or sign makes it the derivative"
    raise DataError(
        f"{recording.name}: the velocity is {slope:.3g} times the derivative of the position; "
        f"expected 0.5 to 2{likely}: {mend}"
    )
