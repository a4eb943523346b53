"""From a recording to the arrays of one plant: of a run of an experiment during its noise, of others all of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.recordings.contract_bags import find_prefix
from pendulum_bags.recordings.mapping import Drive
from pendulum_bags.recordings.reading import Reading, holds_states
from pendulum_bags.runs.correlation import effective_size
from pendulum_bags.runs.datasets import check_consistency, data_notes, recording_of, unwrap
from pendulum_bags.runs.moving_reference import follows_reference, recorded_reference
from pendulum_bags.runs.run_record import SURROGATE, is_surrogate, run_record
from pendulum_bags.runs.series import Series, Signal, unwrap_near_upright
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.mechanisms import MECHANISMS
from pendulum_rosbag.reader import Bag, read_bag

__all__ = [
    "END_EVENT",
    "START_EVENT",
    "TOLERATED",
    "OpenBag",
    "RunData",
    "is_emulated",
    "is_in_lockstep",
    "joints_of",
    "missed_periods",
    "missed_share",
    "plant_summary",
    "read_run",
    "shared_joints",
    "slope",
    "surrogate_of",
    "timing_warning",
]

START_EVENT = Event.NOISE_START
END_EVENT = Event.NOISE_END

OpenBag: TypeAlias = Callable[[str | os.PathLike[str]], AbstractContextManager[Bag]]
"""How a bag is opened: ``read_bag``, or ``CachedBags`` for several joints."""


_SLIDING = frozenset(joint.name for mechanism in MECHANISMS.values() for joint in mechanism.joints if joint.unit == "m")
"""Sliding joints, for messages without a unit."""


@dataclass(frozen=True)
class RunData:
    """One plant in one run; all times count from the start of the noise.

    Args:
        label: Name for tables and legends, such as ``sim``.
        disturbance: Commanded disturbance torque, or None [N m].
        applied: Torque that the plant reports as applied, or None [N m].
        measured: Measured joint torque over the whole recording, or None [N m].
        arrival: Intervals between arrivals of states at the recorder during the noise, shape (n - 1,) [s].
        rate_hz: Sampling rate during the noise [Hz].
        events: Events with ``name`` and ``t`` [s].
        reference: Moving reference from upright, at the times of the window [rad]; None if unknown.
        joint: Joint of the motion, of a plant of several; else empty.
        followed: Reference of a file, over the whole recording; None for a bag [rad or m].
        recorded: Disturbance of a file; ``disturbance`` may be another signal that two files share.
    """

    label: str
    window: Series
    whole: Series
    disturbance: Signal | None
    applied: Signal | None
    measured: Signal | None
    arrival: NDArray[np.float64]
    rate_hz: float
    missed_deadlines: int
    metadata: Mapping[str, Any] = field(default_factory=dict)
    events: Sequence[Mapping[str, Any]] = ()
    source: str = ""
    damage: Sequence[str] = ()
    follows_reference: bool = False
    reference: NDArray[np.float64] | None = None
    joint: str = ""
    followed: Signal | None = None
    recorded: Signal | None = None
    of_file: bool = False
    guessed: bool = False

    @property
    def is_disturbed(self) -> bool:
        """Whether so many states are missing that the run shows the computer rather than the plant."""
        return missed_share(self.missed_deadlines, self.window.t.size) > TOLERATED

    @property
    def is_whole(self) -> bool:
        """Whether the recording has neither a disturbance nor events, so that all of it is the window."""
        return not self.of_file and self.disturbance is None and self.event_time(START_EVENT) is None

    def moved(self, shift: float) -> RunData:
        """Return the run with all of its stamps later by a time [s]."""

        def later(signal: Signal | None) -> Signal | None:
            return None if signal is None else Signal(signal.t + shift, signal.value, signal.name)

        signals: dict[str, Any] = {
            name: later(getattr(self, name)) for name in ("disturbance", "applied", "measured", "followed")
        }
        window, whole = self.window.shifted(-shift), self.whole.shifted(-shift)
        events = [{**event, "t": event["t"] + shift} for event in self.events]
        return replace(self, window=window, whole=whole, events=events, **signals)

    def between(self, start: float, stop: float) -> RunData:
        """Return the run with the window cut to a span [s]."""
        window = self.window.between(start, stop)
        return replace(self, window=window, arrival=np.diff(window.t), rate_hz=window.rate)

    @property
    def tracking_error(self) -> NDArray[np.float64] | None:
        """Angle less its moving reference during the noise [rad]; None where none is known."""
        return None if self.reference is None else self.window.position - UPRIGHT - self.reference

    def event_time(self, name: str) -> float | None:
        """Return when an event of a name first happened [s], None where it did not."""
        return next((float(event["t"]) for event in self.events if event["name"] == name), None)


def joints_of(
    path: str | os.PathLike[str], prefix: str | None = None, *, open_bag: OpenBag = read_bag
) -> tuple[str, ...]:
    """Return the joints of a bag's plant of several joints, or of one in volts, in order; else none.

    The pages of one joint state its torque, so that they would show volts as newton metres.

    Raises:
        DataError: The bag lacks the states.
    """
    reading = Reading.of(path)
    bag_of: AbstractContextManager[Bag | None] = open_bag(path) if reading.is_bag else nullcontext()
    with bag_of as bag:
        if bag is not None and (prefix is not None or holds_states(bag)):
            space = find_prefix(bag, prefix)
            found = bag.joint_names(f"{space}/{names.JOINT_STATES}")
            volts = names.drive_topics(bag.topics, space) is names.VOLTAGE_TOPICS
            return found if len(found) > 1 or volts else ()
    joints = reading.motion.joints
    return tuple(joint.name for joint in joints) if len(joints) > 1 else ()


def shared_joints(
    readings: Sequence[Reading], prefixes: tuple[str | None, str | None] = (None, None), *, open_bag: OpenBag = read_bag
) -> dict[str, str | None]:
    """Return the joints that both recordings have, and the hardware's names if they differ, or raise a DataError."""
    ours = joints_of(readings[0], prefixes[0], open_bag=open_bag)
    every = [joints_of(reading, prefixes[1], open_bag=open_bag) for reading in readings[1:]]
    theirs = every[0]
    for reading, found in zip(readings[1:], every, strict=True):
        if set(found) != set(theirs):
            raise DataError(
                f"{reading} has the joints {', '.join(found) or 'of a plant of one'} and {readings[1]} "
                f"{', '.join(theirs) or 'that of a plant of one'}; expected repeated runs of one machine"
            )
    common: dict[str, str | None] = {joint: None for joint in ours if joint in theirs}
    if common or not (ours or theirs):
        return common
    if len(ours) == len(theirs):
        return dict(zip(ours, theirs, strict=True))
    raise DataError(
        f"{readings[0]} has the joints {', '.join(ours) or 'of a plant of one'} and {readings[1]} "
        f"{', '.join(theirs) or 'that of a plant of one'}; expected the same: a mapping file names the columns of each"
    )


def timing_warning(plants: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence if too many states are missing in the figures of :func:`plant_summary`, by the plant's name."""
    words = [
        f"{name} missed {plant['missed_deadlines']} of {plant['missed_deadlines'] + plant['samples']} states "
        f"({100.0 * missed_share(plant['missed_deadlines'], plant['samples']):.1f} %)"
        for name, plant in plants.items()
        if missed_share(plant["missed_deadlines"], plant["samples"]) > TOLERATED
    ]
    if not words:
        return ""
    return f"States are missing: {', '.join(words)}; check for pauses, end other programs, and repeat the run."


def missed_share(missed: int, samples: int) -> float:
    """Return the share of states that a plant left out."""
    return missed / max(missed + samples, 1)


TOLERATED = 0.02
"""Share of states that may be missing before a run is called disturbed."""


def missed_periods(stamps_ns: NDArray[np.int64]) -> int:
    """Return how many periods have no state, from the stamps: a gap of k median periods misses k - 1."""
    steps = np.diff(stamps_ns)
    period = float(np.median(steps))
    return int(np.maximum(np.round(steps / period) - 1.0, 0.0).sum()) if period > 0.0 else 0


def read_run(
    path: str | os.PathLike[str],
    *,
    prefix: str | None = None,
    label: str | None = None,
    joint: str | None = None,
    or_all: bool = False,
    open_bag: OpenBag = read_bag,
) -> RunData:
    """Read one plant's part of a recording.

    Args:
        path: A bag, or any recording as a :class:`~pendulum_bags.recordings.reading.Reading` describes it.
        prefix: Namespace of the plant's topics; None for that of its only plant.
        label: Name for tables; by default that of the bag's folder.
        joint: Joint of a plant of several, see :func:`joints_of`; with its own disturbance, else the first joint's.
        or_all: Whether the window is the whole recording if it has neither events nor a disturbance. Else it goes from
            the event ``noise_start`` to ``noise_end``, or from the first to the last sample of the disturbance.

    Raises:
        BagError: The bag cannot be read.
        DataError: It lacks the states or the window, or has other joints.
    """
    reading = Reading.of(path)
    if not reading.is_bag:
        return _run_of(reading, label or reading.name, joint)
    with open_bag(path) as bag:
        if prefix is None and not holds_states(bag):
            return _run_of(reading, label or reading.name, joint)
        space = find_prefix(bag, prefix)
        topic = f"{space}/{names.JOINT_STATES}"
        states = _increasing(bag.array(topic) if joint is None else bag.joints(topic).of(joint))
        topics = names.drive_topics(bag.topics, space)
        commands = _optional(bag, f"{space}/{topics.command}", joint)
        disturbance = _optional(bag, f"{space}/{topics.disturbance}", joint, otherwise_another=True)
        applied = _optional(bag, f"{space}/{topics.applied}", joint)
        events = [event for event in bag.events() if event["topic"].startswith(f"{space}/")]
        metadata, damage = dict(bag.metadata), [*bag.damage, *bag.clock_notes]
    foreign = or_all and disturbance is None and not any(event["name"] == START_EVENT for event in events)
    if foreign:
        # Recordings of others leave cells empty; in a run of an experiment a position that is no number is a failure.
        states = states[np.isfinite(states["position"])]
    if len(states) < 4:
        raise DataError(f"bag {path} has {len(states)} states; expected at least 4")
    start, stop = _window(events, disturbance, str(path), states["stamp_ns"] if or_all else None)
    name = label or Path(path).stem
    stamps = states["stamp_ns"]
    times = (stamps - start) / NANOSECONDS
    slides = joint in _SLIDING
    position = states["position"] if slides else unwrap_near_upright(states["position"])
    measured = not foreign or np.isfinite(states["velocity"]).all()
    whole = Series(
        times,
        position,
        states["velocity"] if measured else np.gradient(position, times),
        _answers(stamps, commands, states["effort"]),
        name,
        "m" if slides else "rad",
        "V" if topics is names.VOLTAGE_TOPICS and commands is not None else "",
    )
    span = (stop - start) / NANOSECONDS
    inside = (stamps >= start) & (stamps < stop)
    window = whole.between(0.0, span)
    reference = None
    if commands is not None:
        first_answer = float(commands["stamp_ns"][0] - start) / NANOSECONDS
        reference = recorded_reference(metadata, space, window.t, first_answer)
    run = RunData(
        label=name,
        window=window,
        whole=whole,
        disturbance=_signal(disturbance, start, stop, f"disturbance on {name}"),
        applied=_signal(applied, start, stop, f"torque applied to {name}"),
        measured=_measured(states, times, name),
        arrival=np.diff(states["log_time_ns"][inside]) / NANOSECONDS,
        rate_hz=window.rate,
        missed_deadlines=missed_periods(stamps[inside]),
        metadata=metadata,
        events=[{**event, "t": (event["stamp_ns"] - start) / NANOSECONDS} for event in events],
        source=str(path),
        damage=damage,
        follows_reference=follows_reference(metadata, space),
        reference=reference,
        joint=joint or "",
    )
    if reading.start is None and reading.stop is None:
        return run
    # The chosen part counts from the start of the recording.
    part = times[reading.rows(times)]
    return run.between(max(part[0], window.t[0]), min(part[-1], window.t[-1]) + 0.5 * whole.period)


def _run_of(reading: Reading, name: str, joint: str | None) -> RunData:
    """Return a joint of a file as a run; the window is all of it, or the chosen part."""
    motion = reading.motion
    found = next((one for one in motion.joints if one.name == (joint or motion.joints[0].name)), None)
    if found is None or (joint is None and len(motion.joints) > 1):
        raise DataError(
            f"joint is {joint or 'not chosen'} of {reading.path}; expected one of "
            f"{', '.join(one.name for one in motion.joints)}"
        )
    recording = recording_of(motion, found)
    recording = check_consistency(recording if found.slides else unwrap(recording))
    times = recording.time - recording.time[0]
    position = recording.position if found.slides else unwrap_near_upright(recording.position)
    velocity = slope(times, position) if recording.velocity is None else recording.velocity
    drive, begin = found.drive, float(recording.time[0])

    def signal(drive: Drive | None, what: str) -> Signal | None:
        return None if drive is None else Signal(drive.time - begin, drive.values, f"{what} {name}")

    applied = signal(drive, "input of")
    units = {"voltage": "V", "command": "-", "angle": "rad"}
    whole = Series(
        times,
        position,
        velocity,
        np.zeros_like(times) if applied is None else applied.held_at(times),
        name,
        "m" if found.slides else "rad",
        "" if drive is None else units.get(drive.quantity, ""),
    )
    part = reading.rows(times)
    window = whole if part == slice(0, times.size) else whole.at(part)
    followed, disturbance = signal(found.reference, "reference of"), signal(found.disturbance, "disturbance on")
    stamps = np.round(window.t * NANOSECONDS).astype(np.int64)
    return RunData(
        label=name,
        window=window,
        whole=whole,
        disturbance=disturbance,
        applied=applied,
        measured=None,
        arrival=np.diff(window.t),
        rate_hz=window.rate,
        missed_deadlines=missed_periods(stamps),
        source=str(reading.path),
        damage=[sentence.rstrip(".") for sentence in data_notes(recording)],
        joint=joint or "",
        followed=followed,
        recorded=disturbance,
        of_file=True,
        guessed=reading.is_guessed,
    )


def slope(times: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the velocity of a position that is quantised: slopes of parabolas through 20 ms, or five samples."""
    period = float(np.median(np.diff(times)))
    width = 2 * max(2, round(0.5 * _SMOOTHED / period)) + 1
    if times.size <= width:
        return np.gradient(position, times)
    even = times[0] + period * np.arange(int((times[-1] - times[0]) / period) + 1)
    slopes = scipy.signal.savgol_filter(np.interp(even, times, position), width, 2, deriv=1, delta=period)
    return np.asarray(np.interp(times, even, slopes))


_SMOOTHED = 0.02
"""Time over which an angle without a velocity is smoothed [s]."""


def plant_summary(run: RunData) -> dict[str, Any]:
    """Return the figures of one plant during the noise, as ``summary.json`` holds them."""
    window, error = run.window, run.tracking_error
    moving = {} if error is None else {"rms_tracking_error": float(np.sqrt(np.mean(error**2)))}
    return {
        "rate_hz": run.rate_hz,
        "missed_deadlines": run.missed_deadlines,
        "std_theta": float(window.position.std(ddof=1)),
        "std_theta_dot": float(window.velocity.std(ddof=1)),
        "mean_theta": float(window.position.mean()),
        "mean_theta_dot": float(window.velocity.mean()),
        "max_abs_u": float(np.abs(window.effort).max()),
        "rms_u": float(np.sqrt(np.mean(window.effort**2))),
        "samples": int(window.t.size),
        "effective_samples": effective_size(window.position),
        "duration_s": window.duration,
        "noise_hold_time": noise_hold_time(run),
        "damage": list(run.damage),
        **moving,
    }


def is_emulated(run: RunData) -> bool:
    """Return whether the hardware was an emulator or a second simulation."""
    return is_surrogate(run_record(run.metadata))


def is_in_lockstep(run: RunData) -> bool:
    """Return whether plant, controller and disturbance waited for each other, so that their phase was fixed."""
    record = run_record(run.metadata)
    return record.get("clock", "lockstep" if record.get("experiment") == "joints" else "") == "lockstep"


def surrogate_of(run: RunData) -> str:
    """Return what stood in for the hardware of a run in which no machine was measured."""
    simulated = run_record(run.metadata).get(SURROGATE) == "simulation"
    return "a second simulation" if simulated else "an emulator"


def noise_hold_time(run: RunData) -> float | None:
    """Return how long each noise sample was held [s], by the run record, else by its disturbance."""
    recorded = run_record(run.metadata).get("disturbance")
    if isinstance(recorded, Mapping):
        value = recorded.get("hold_time")
        if isinstance(value, (int, float)) and value > 0.0:
            return float(value)
    if run.disturbance is None or run.disturbance.t.size < 4:
        return None
    changes = run.disturbance.t[np.flatnonzero(np.diff(run.disturbance.value)) + 1]
    return float(np.median(np.diff(changes))) if changes.size > 2 else None


def _increasing(array: NDArray[Any]) -> NDArray[Any]:
    _, first = np.unique(array["stamp_ns"], return_index=True)
    return array[first]


def _optional(
    bag: Bag, topic: str, joint: str | None = None, *, otherwise_another: bool = False
) -> NDArray[Any] | None:
    if topic not in bag.topics:
        return None
    if joint is None:
        found = bag.array(topic)
    elif not bag.log_times(topic).size:
        return None
    else:
        table = bag.joints(topic)
        having = [one for one, effort in zip(table.names, table.effort.T, strict=True) if np.any(effort != 0.0)]
        if otherwise_another and having and joint not in having:
            joint = having[0]
        if joint not in table.names:
            return None
        found = table.of(joint)
    array = _increasing(found)
    array = array[np.isfinite(array["effort"])]
    return array if len(array) else None


def _answers(stamps: NDArray[np.int64], commands: NDArray[Any] | None, otherwise: NDArray[Any]) -> NDArray[np.float64]:
    """Return the torque that the controller returned for each state, else the newest."""
    if commands is None:
        return np.nan_to_num(otherwise)
    index = np.searchsorted(commands["stamp_ns"], stamps, side="right") - 1
    held = np.where(index >= 0, commands["effort"][np.maximum(index, 0)], 0.0)
    # Long after the last command there is no commander.
    age = (stamps - commands["stamp_ns"][np.maximum(index, 0)]) / NANOSECONDS
    return np.where((index >= 0) & (age < 0.1), held, 0.0)


def _measured(states: NDArray[Any], times: NDArray[np.float64], name: str) -> Signal | None:
    known = np.isfinite(states["effort"])
    return Signal(times[known], states["effort"][known], f"measured torque of {name}") if known.any() else None


def _signal(array: NDArray[Any] | None, start: int, stop: int, name: str) -> Signal | None:
    if array is None:
        return None
    inside = array[(array["stamp_ns"] >= start) & (array["stamp_ns"] < stop)]
    if not len(inside):
        return None
    return Signal((inside["stamp_ns"] - start) / NANOSECONDS, inside["effort"], name)


def _window(
    events: Sequence[Mapping[str, Any]],
    disturbance: NDArray[Any] | None,
    path: str,
    stamps: NDArray[np.int64] | None,
) -> tuple[int, int]:
    found = {
        name: [int(event["stamp_ns"]) for event in events if event["name"] == name] for name in (START_EVENT, END_EVENT)
    }
    starts, stops = found[START_EVENT], found[END_EVENT]
    active = None
    if disturbance is not None:
        live = disturbance["stamp_ns"][disturbance["effort"] != 0.0]
        if len(live):
            active = int(live[0]), int(live[-1])
    if starts or active is not None:
        start = starts[-1] if active is None or starts else active[0]
    elif stamps is not None:
        return int(stamps[0]), int(stamps[-1]) + 1
    else:
        raise DataError(f"bag {path} has neither an event {START_EVENT!r} nor a disturbance; expected one of them")
    after = [stop for stop in stops if stop > start]
    stop = after[0] if after else active[1] if active else None
    if stop is None or stop <= start:
        raise DataError(f"bag {path}: the noise starts at {start} ns and has no end; expected an event {END_EVENT!r}")
    return start, stop
