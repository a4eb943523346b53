"""Recordings out of rosbag2 bags: joint states and what drove them, under whatever namespace they were recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.recordings.clock import gap_length
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.run_data import find_prefix
from pendulum_msgs_py.contract.names import APPLIED_EFFORT, JOINT_STATES
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import Bag, read_bag

__all__ = ["cut_at_steps", "phases", "read_bag_recording"]

_NS = 1e-9


def read_bag_recording(
    path: str | Path, *, effort: str = "applied", namespace: str | None = None, swings_freely: bool = False
) -> Recording:
    """Read position and velocity from ``joint_states`` and their input; without any effort, it is a free swing.

    Args:
        effort: ``applied``: topic ``applied_effort``, held until its next sample; ``measured``: the effort of
            ``joint_states``, varying linearly.
        namespace: For a bag with several plants, such as ``/sim``; by default the only one.

    Raises:
        DataError: No joint states, several plants and no namespace, or too few samples.
    """
    if effort not in {"applied", "measured"}:
        raise DataError(f"effort is {effort!r}; expected 'applied' or 'measured'")
    with read_bag(path) as bag:
        return _recording(bag, path, effort, namespace, swings_freely)


def _recording(bag: Bag, path: str | Path, effort: str, namespace: str | None, swings_freely: bool) -> Recording:
    states_topic = f"{find_prefix(bag, namespace)}/{JOINT_STATES}"
    states = bag.array(states_topic)
    # A plant in lockstep sends a state again when its answer was missed: the same stamp is the same state.
    states = states[np.append(True, np.diff(states["stamp_ns"]) != 0)] if states.size else states
    origin = int(states["stamp_ns"][0]) if states.size else 0
    time = cut_at_steps(bag, states["stamp_ns"], origin)
    meta: dict[str, Any] = {
        "source": str(path),
        "topic": states_topic,
        "start_ns": origin,
        "effort": effort,
        "phases": phases(bag, origin),
        "clock_notes": bag.clock_notes,
        **{key: value for key, value in bag.metadata.items() if key.startswith("pendulum.")},
    }
    velocity = None if np.isnan(states["velocity"]).all() else states["velocity"]
    applied_topic = states_topic.removesuffix(JOINT_STATES) + APPLIED_EFFORT
    has_effort = not np.isnan(states["effort"]).all()
    if not swings_freely and effort == "applied" and applied_topic in bag.topics:
        applied = bag.array(applied_topic)
        if not np.isfinite(applied["effort"]).any():
            held = "no message" if not applied.size else f"{applied.size} messages, none with an effort"
            way = (
                "--effort measured takes the measured one instead, from joint_states"
                if has_effort
                else "--mapping free_swing takes it for a pendulum that nothing drives"
            )
            raise DataError(
                f"topic {applied_topic} of bag {path} has {held}; expected the torque that drove the plant ({way})"
            )
        stamps, first = np.unique(applied["stamp_ns"], return_index=True)
        return Recording(
            time,
            states["position"],
            velocity,
            applied["effort"][first],
            hold="zero",
            input_time=cut_at_steps(bag, stamps, origin),
            meta={**meta, "input_topic": applied_topic},
        )
    if swings_freely or not has_effort:
        meta = {**meta, "effort": "none", "no_effort": not has_effort}
        return Recording(time, states["position"], velocity, np.zeros_like(time), input_kind="none", meta=meta)
    return Recording(time, states["position"], velocity, states["effort"], meta={**meta, "effort": "measured"})


def cut_at_steps(bag: Bag, stamps: NDArray[np.int64], origin: int) -> NDArray[np.float64]:
    """Return stamps in seconds since ``origin`` [ns], with a long gap at each step of the clock."""
    times = (stamps - origin).astype(np.float64) * _NS
    gap = gap_length(times)
    for cut in bag.cuts_ns:
        times = np.where(stamps >= cut, times + gap, times)
    return times


def phases(bag: Bag, origin: int) -> list[tuple[float, str, dict[str, Any]]]:
    """Return the events of a bag as (time since ``origin`` [s], name, content), in order."""
    return [
        ((int(event["stamp_ns"]) - origin) * _NS, str(event.get("name", "")), event)
        for event in bag.events()
        if "stamp_ns" in event
    ]
