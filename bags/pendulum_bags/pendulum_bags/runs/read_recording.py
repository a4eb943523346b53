"""Any recording as a Recording: a bag, a CSV file, a log of a module or of a servo."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.runs.bag_recordings import read_bag_recording
from pendulum_bags.runs.bridge_programs import last_words, run_bridge_program
from pendulum_bags.runs.csv_mapping import read_csv
from pendulum_bags.runs.datasets import Recording, check_consistency, first_of_each_stamp, unwrap
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.open_source import is_ros1

__all__ = ["read_recording", "read_servo_log"]

_TIMEOUT = 300.0
"""Longest time that reading a HEBI log may take [s]."""
_SERVO_ENTRY_KEYS = ("timestamp", "position", "goal_position", "torque_enable")


def read_recording(
    path: str | Path,
    mapping: str | Path | Mapping[str, Any] | None = None,
    *,
    effort: str = "applied",
    namespace: str | None = None,
    hold: str | None = None,
) -> Recording:
    """Read a CSV file, a friction-study JSON log or a rosbag2 bag.

    Args:
        path: ``*.csv`` / ``*.txt``, ``*.json``, ``*.hebilog``, or a bag (folder, ``*.mcap`` or ``*.db3``).
        mapping: For a HEBI log the lab file, which says zero, sign and tare; for a bag nothing but ``free_swing``,
            which takes no effort from it. For CSV:
            mapping file, name of a built-in mapping or the mapping itself; by default the
            columns must be called as in the built-in mapping ``pendulum``.
        effort: For bags: ``applied`` takes what the plant says it applied (topic ``applied_effort``),
            ``measured`` the measured joint torque in ``joint_states``.
        namespace: For bags with several plants, such as ``/sim``.
        hold: For CSV: ``zero`` (a command, held) or ``linear`` (a measurement), in place of the mapping's.

    Raises:
        DataError: for missing columns, unsorted time, NaN, wrong units.
        BagError: for a bag that cannot be read.
    """
    source = Path(path)
    if not source.exists():
        raise DataError(f"{source} does not exist; expected a CSV file, a JSON log or a bag")
    suffix = source.suffix.lower()
    if source.is_dir() or suffix in {".mcap", ".db3"}:
        swings_freely = mapping == "free_swing"
        return check_consistency(
            unwrap(read_bag_recording(source, effort=effort, namespace=namespace, swings_freely=swings_freely))
        )
    if suffix == ".json":
        return check_consistency(unwrap(read_servo_log(source)))
    if is_ros1(source):
        raise DataError(f"{source} is a bag of ROS 1; `pendulum convert {source} -o FOLDER` makes one that can be read")
    if suffix in {".csv", ".txt"}:
        return check_consistency(unwrap(read_csv(source, mapping, hold=hold)))
    if suffix == ".hebilog":
        return check_consistency(unwrap(_read_hebi_log(source, mapping)))
    raise DataError(
        f"{source} has the suffix {suffix!r}; expected .csv, .txt, .json, .hebilog, .mcap, .db3 or a bag folder"
    )


def read_servo_log(path: str | Path) -> Recording:
    """Read a JSON log of the friction study: a position-controlled servo that carries a bob on an arm.

    The set point is the input (``position_goal``), held between entries; ``enabled`` is the torque switch.
    Constants of the rig (``mass`` [kg], ``length`` [m], ``kp`` [firmware], ``vin`` [V]) and, as ``load`` [-1 to 1],
    the servo's own report of its duty cycle go to ``meta``.

    Raises:
        DataError: for a file that is not such a log, naming the key or entry at fault.
    """
    source = Path(path)
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{source} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{source} is not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("entries"), list) or not content["entries"]:
        raise DataError(f"{source} has no list 'entries'; expected a log of the friction study")
    entries: list[dict[str, Any]] = content["entries"]
    wrong = next((i for i, entry in enumerate(entries) if not isinstance(entry, dict)), None)
    if wrong is not None:
        raise DataError(f"{source}: entry {wrong} is {entries[wrong]!r}; expected a mapping")
    columns: dict[str, Array] = {}
    for key in (*_SERVO_ENTRY_KEYS, "speed", "load", "input_volts", "temp"):
        missing = [i for i, entry in enumerate(entries) if key not in entry]
        if not missing:
            try:
                columns[key] = np.array([entry[key] for entry in entries], dtype=float)
            except (TypeError, ValueError, OverflowError) as error:
                raise DataError(f"{source}: entries[].{key} is not a number everywhere: {error}") from error
        elif key in _SERVO_ENTRY_KEYS:
            raise DataError(f"{source}: entry {missing[0]} has no {key!r}; expected {', '.join(_SERVO_ENTRY_KEYS)}")
    meta = {key: value for key, value in content.items() if key != "entries"}
    meta["source"] = str(source)
    if "load" in columns:
        # The register is 16 bit two's complement in thousandths of full duty.
        load = columns["load"]
        meta["load"] = np.where(load > 32767, load - 65536, load) / 1000.0
    kept = first_of_each_stamp(columns["timestamp"])
    if not kept.all():
        meta["repeated_stamps"] = int(np.sum(~kept))
        columns = {key: values[kept] for key, values in columns.items()}
        if "load" in meta:
            meta["load"] = meta["load"][kept]
    for key in ("input_volts", "temp"):
        if key in columns:
            meta[f"mean_{key}"] = float(columns[key].mean())
    return Recording(
        columns["timestamp"],
        columns["position"],
        columns.get("speed"),
        columns["goal_position"],
        input_kind="position_goal",
        hold="zero",
        enabled=columns["torque_enable"],
        meta=meta,
    )


def _read_hebi_log(path: Path, lab: str | Path | Mapping[str, Any] | None) -> Recording:
    """Read a ``.hebilog``; the input is the torque measured through the spring.

    The vendor's library stays with the bridge, whose program ``convert`` reads it.

    Args:
        path: The file.
        lab: Lab file with zero, sign and tare of the joint; None for those of the actuator.

    Raises:
        DataError: It cannot be read, or the lab file is something else.
    """
    if isinstance(lab, Mapping):
        raise DataError(f"{path}: mapping is given as values; expected the lab file of a HEBI log")
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "log.csv"
        options = [] if lab is None else ["--lab", str(lab)]
        try:
            done = run_bridge_program("convert", str(path), "--out", str(table), *options, timeout=_TIMEOUT)
        except subprocess.TimeoutExpired:
            raise DataError(f"{path} was not read within {_TIMEOUT:g} s") from None
        if done.returncode != 0:
            raise DataError(last_words(done.stderr, f"{path} cannot be read"))
        recording = read_csv(table)
    return replace(recording, meta={**recording.meta, "source": str(path), "mapping": str(lab or "")})
