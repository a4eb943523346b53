"""Repeats of the thesis's experiment with new noise, in lockstep, if the first run cannot decide.

The emulated hardware runs as nodes over DDS. The simulation runs in this process, which gives bit for bit its nodes'
numbers in a tenth of the time; both are stored as bags.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.deadline import NEVER, Deadline
from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.in_process import RunArrays, simulate
from pendulum_bags.experiments.joint_run import JointSettings
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.runs.run_data import END_EVENT, START_EVENT
from pendulum_bags.runs.run_folder import REPEATS
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.joints import ONE_JOINT, Vector
from pendulum_rosbag.storage import BagWriter

__all__ = ["SHORTEST", "record_repeat", "record_simulation", "record_spec", "repeat_folder", "repeat_settings"]

SEED_STEP = 10_000_000
"""Added to the seed for each repeat, so that the repeats of one seed are not another seed's run."""
SHORTEST = 20.0
"""Length of the first repeat [s], four times the thesis's run: starting the nodes takes longer than the noise."""
LONGEST = 60.0
"""Longest repeat, so that a run ends soon after its budget [s]."""
_SIMULATING = 0.1
"""Processor time per second of noise to simulate and write one side [s]."""
_Settings = TypeVar("_Settings", bound=RegulationSettings | JointSettings)
_STATE = "sensor_msgs/msg/JointState"
_TEXT = "std_msgs/msg/String"


def repeat_folder(folder: Path, number: int) -> Path:
    """Return the folder of a repeat, counted from 1, with the bags ``sim`` and ``hw``."""
    return folder / REPEATS / str(number)


def repeat_settings(settings: _Settings, number: int) -> _Settings:
    """Return the settings of a repeat: new noise, twice as much each time."""
    noise = settings.noise
    duration = min(LONGEST, max(SHORTEST, noise.duration) * 2.0 ** (number - 1))
    return replace(settings, noise=replace(noise, seed=noise.seed + SEED_STEP * number, duration=duration))


def record_repeat(
    folder: Path, settings: RegulationSettings | JointSettings, number: int, deadline: Deadline = NEVER
) -> None:
    """Record the missing bags of a repeat, counted from 1; a recording that began before the deadline ends.

    Raises:
        BagError: A bag cannot be written.
        BudgetSpentError: No time is left for one of them.
        FaultError: A program ended or did not respond.
    """
    chosen = repeat_settings(settings, number)
    place = repeat_folder(folder, number)
    for side in ("hw", "sim"):
        if not (place / side).exists():
            deadline.require(_SIMULATING * chosen.noise.duration)
            record_spec(place / side, chosen.run(side))


def record_spec(bag: Path, spec: RunSpec, *, hosts: HostPool | None = None) -> Path:
    """Record a run in lockstep, a simulation in this process, else as :func:`record_run`; return the bag."""
    if spec.has_bridge:
        return record_run(bag, spec, hosts=hosts)
    return record_simulation(bag, spec)


def record_simulation(bag: Path, spec: RunSpec) -> Path:
    """Simulate a run in this process and write its bag as a recorder would; return the bag."""
    _write(bag, spec, simulate(spec))
    return bag


def _write(bag: Path, spec: RunSpec, run: RunArrays) -> None:
    metadata = spec.metadata()
    metadata[RUN_RECORD]["engine"] = "in_process"
    own = spec.topics
    topics = {name: f"{spec.namespace}/{name}" for name in (names.JOINT_STATES, *own)}
    events = f"{spec.namespace}/{names.EVENTS}"
    with BagWriter(bag, storage=spec.storage, metadata=metadata) as writer:
        for topic in topics.values():
            writer.add_topic(topic, _STATE)
        writer.add_topic(events, _TEXT)

        def event(stamp: int, name: str) -> None:
            text = json.dumps({"stamp_ns": stamp, "name": name}).encode() + b"\0"
            writer.write(events, stamp, b"\0\1\0\0" + len(text).to_bytes(4, "little") + text)

        stamps = [int(stamp) for stamp in run.stamp_ns]
        coordinates = ONE_JOINT if (mechanism := spec.mechanism) is None else mechanism.coordinates
        driven = coordinates.driven_names
        disturbed = tuple(spec.disturbance_parameters().get("joints", driven))
        states = zip(*map(_rows, (run.position, run.velocity, run.effort)), strict=True)
        efforts = [
            (topics[name], source, joints, _rows(values))
            for name, source, joints, values in (
                (own.command, "controller", driven, run.command),
                (own.disturbance, "disturbance", disturbed, run.disturbance),
                (own.applied, "", driven, run.applied),
            )
        ]
        event(stamps[0], START_EVENT)
        for i, (stamp, state) in enumerate(zip(stamps, states, strict=True)):
            writer.write(topics[names.JOINT_STATES], stamp, encode_joints(stamp, "", coordinates.names, *state))
            for topic, source, joints, rows in efforts:
                if i < len(rows) and not math.isnan(rows[i][0]):
                    writer.write(topic, stamp, encode_joints(stamp, source, joints, effort=rows[i]))
        event(stamps[-1], END_EVENT)


def _rows(values: Array) -> list[Vector]:
    return [tuple(row) for row in values.reshape(len(values), -1).tolist()]
