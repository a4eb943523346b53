"""Bags with the topics of this project's contract, under any namespace: joint states and what drove them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.recordings.clock import gap_length
from pendulum_bags.recordings.mapping import Drive, JointMotion, Motion
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader import Bag, read_bag
from pendulum_rosbag.reader.joint_table import JointTable

__all__ = ["EFFORTS", "find_prefix", "read_contract_bag"]

EFFORTS = {"applied": names.APPLIED_EFFORT, "commanded": names.EFFORT_COMMAND, "measured": names.JOINT_STATES}
"""Topics of the effort that may be asked for, of a plant that is not driven in volts."""


def find_prefix(bag: Bag, prefix: str | None = None) -> str:
    """Return a namespace such as ``/sim``, by default that of the one plant of a bag; empty for ``/joint_states``.

    A DataError if the bag has no plant, or several and no namespace is given.
    """
    if prefix is not None:
        return f"/{prefix.strip('/')}".rstrip("/")
    ending = f"/{names.JOINT_STATES}"
    found = sorted(topic[: -len(ending)] for topic in bag.topics if topic.endswith(ending))
    if len(found) == 1:
        return found[0]
    if not found:
        raise DataError(f"bag {bag.path} has no topic that ends in {ending}; it has {', '.join(bag.topics) or 'none'}")
    raise DataError(
        f"bag {bag.path} holds several plants ({', '.join(found)}); choose one by its namespace, or keep one with "
        f"`pendulum filter {bag.path} --regex '^{found[0]}/' -o FOLDER`"
    )


def read_contract_bag(
    path: Path, *, effort: str = "applied", namespace: str | None = None, swings_freely: bool = False
) -> Motion:
    """Read states and the effort that belongs to them; a bag without any effort is that of a free swing.

    Args:
        path: Bag folder or storage file.
        effort: ``applied`` or ``commanded``, held until its next sample; ``measured``: that of ``joint_states``,
            varying linearly, also taken where a bag has no applied one.
        namespace: For a bag with several plants, such as ``/sim``; by default the only one.
        swings_freely: Nothing drives the plant, whatever effort the bag has.

    Raises:
        DataError: There are no joint states, several plants and no namespace, or no effort in a topic of it.
    """
    if effort not in EFFORTS:
        raise DataError(f"effort is {effort!r}; expected {', '.join(EFFORTS)}")
    with read_bag(path) as bag:
        space = find_prefix(bag, namespace)
        own = names.drive_topics(bag.topics, space)
        of_kind = {**EFFORTS, "applied": own.applied, "commanded": own.command}
        topic, drive_topic = f"{space}/{names.JOINT_STATES}", f"{space}/{of_kind[effort]}"
        states = _table(bag, topic)
        measured = effort == "measured" or (effort == "applied" and drive_topic not in bag.topics)
        if effort == "commanded" and not (drive_topic in bag.topics and bag.topics[drive_topic].count):
            raise DataError(f"topic {drive_topic} of bag {path} has no message; expected the commands to its states")
        driven = None if swings_freely or measured else _table(bag, drive_topic)
        origin = int(states.stamp_ns[0]) if states.stamp_ns.size else 0
        meta: dict[str, Any] = {
            "source": str(path),
            "mapping": f"bag {path}",
            "topic": topic,
            "start_ns": origin,
            "effort": "measured" if measured else effort,
            "phases": [
                ((int(event["stamp_ns"]) - origin) * 1e-9, str(event.get("name", "")), event)
                for event in bag.events()
                if "stamp_ns" in event
            ],
            "clock_notes": bag.clock_notes,
            "pushed": _pushed(bag, f"{space}/{names.PUSH}"),
            **{key: value for key, value in bag.metadata.items() if key.startswith("pendulum.")},
        }
        cuts = list(bag.cuts_ns)
    has_effort = not np.isnan(states.effort).all()
    if driven is not None and not np.isfinite(driven.effort).any():
        count = driven.stamp_ns.size
        held = f"{count} messages, none with an effort" if count else "no message"
        way = (
            "--effort measured takes the measured one instead, from joint_states"
            if has_effort
            else "--mapping free_swing takes it for a pendulum that nothing drives"
        )
        raise DataError(
            f"topic {drive_topic} of bag {path} has {held}; expected the torque that drove the plant ({way})"
        )
    if swings_freely or (driven is None and not has_effort):
        meta |= {"effort": "none", "no_effort": not has_effort}
    # A plant in lockstep sends a state again when its answer was missed: the same stamp is the same state.
    rows = np.append(True, np.diff(states.stamp_ns) != 0)[: states.stamp_ns.size]
    meta["repeated_states"] = int(np.sum(~rows))
    elapsed = (states.stamp_ns - origin) * 1e-9
    gap = gap_length(elapsed[rows])

    def seconds(stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return times since the first state; those behind a step of the clock are moved beyond any window."""
        times = (stamps - origin).astype(np.float64) * 1e-9
        for cut in cuts:
            times = np.where(stamps >= cut, times + gap, times)
        return times

    time = seconds(states.stamp_ns[rows])
    joints, carried = [], "voltage" if own is names.VOLTAGE_TOPICS else "effort"
    for column, name in enumerate(states.names):
        drive = None
        if driven is not None and (name in driven.names or len(states.names) == len(driven.names) == 1):
            stamps, first = np.unique(driven.stamp_ns, return_index=True)
            values = driven.effort[first, driven.names.index(name) if len(driven.names) > 1 else 0]
            drive = Drive(seconds(stamps), values, carried, "zero", own_clock=True)
        elif driven is None and meta["effort"] == "measured":
            drive = Drive(time, states.effort[rows, column], "effort", "linear")
        velocity = states.velocity[rows, column]
        joints.append(
            JointMotion(name, states.position[rows, column], None if np.isnan(velocity).all() else velocity, drive)
        )
    return Motion(time, joints, meta)


def _pushed(bag: Bag, topic: str) -> str:
    """Return the topic of a bag that pushes links from outside, if it does so."""
    return topic if topic in bag.topics and bag.joint_names(topic) and np.any(_table(bag, topic).effort) else ""


def _table(bag: Bag, topic: str) -> JointTable:
    joints = bag.joint_names(topic)
    if len(joints) > 1:
        return bag.joints(topic)
    rows = bag.array(topic)  # several times faster
    values = (rows[name][:, None] for name in ("position", "velocity", "effort"))
    return JointTable(joints or ("",), rows["log_time_ns"], rows["stamp_ns"], *values)
