"""Any recording of one pendulum as a Recording, for identification and replay."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.recordings.clock import first_of_each_stamp
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.datasets import Recording, check_consistency, recording_of, unwrap
from pendulum_msgs_py.errors import DataError

__all__ = ["read_recording"]


def read_recording(
    path: str | os.PathLike[str],
    mapping: str | Path | Mapping[str, Any] | None = None,
    *,
    effort: str = "applied",
    namespace: str | None = None,
    hold: str | None = None,
) -> Recording:
    """Read a recording of one pendulum, of any format, or the part of it that a reading chooses.

    Args:
        path: File or folder, or a :class:`~pendulum_bags.recordings.reading.Reading`.
        mapping: Mapping file, name of a built-in mapping or the mapping itself; by default the columns are guessed. For
            a HEBI log the lab file with zero, sign and tare; ``free_swing`` takes no effort from a bag.
        effort: Of a bag, as :func:`~pendulum_bags.recordings.contract_bags.read_contract_bag` takes it.
        namespace: Of a bag with several plants, such as ``/sim``.
        hold: ``zero`` (a command, held) or ``linear`` (a measurement), in place of the mapping's.

    Raises:
        DataError: Missing columns, unsorted time, NaN, wrong units, or several joints.
        BagError: A bag cannot be read.
    """
    reading = Reading.of(path)
    if mapping is not None:
        reading = replace(reading, mapping=mapping, _cache={})
    if reading.has_states:
        reading = replace(reading, effort=effort, namespace=namespace, _cache={})
    motion = reading.motion
    if len(motion.joints) != 1:
        raise DataError(
            f"{reading.path} holds the joints {', '.join(joint.name for joint in motion.joints)}; expected one: "
            "--plant names the mechanism of several, a mapping file chooses the columns of one"
        )
    recording = recording_of(motion, motion.joints[0], hold)
    recording = check_consistency(unwrap(_with_switch(recording, reading)))
    rows = reading.rows(recording.time)
    return recording if rows == slice(0, recording.time.size) else recording.rows(rows.start, rows.stop)


def _with_switch(recording: Recording, reading: Reading) -> Recording:
    """Return a servo's log with its torque switch, and its own report of its duty cycle, -1 to 1, as ``load``."""
    if reading.has_states:
        return recording
    columns = reading.columns
    if not {"goal_position", "torque_enable"} <= columns.columns.keys() or recording.input_kind != "position_goal":
        return recording
    rows = first_of_each_stamp(columns.values("timestamp"))
    meta = dict(recording.meta)
    if "load" in columns.columns:
        # The register is 16 bit two's complement in thousandths of full duty.
        load = columns.values("load")[rows]
        meta["load"] = np.where(load > 32767, load - 65536, load) / 1000.0
    for key in ("input_volts", "temp"):
        if key in columns.columns:
            meta[f"mean_{key}"] = float(columns.values(key)[rows].mean())
    return replace(recording, enabled=columns.values("torque_enable")[rows], meta=meta)
