"""Recorded feedback from a rosbag2 folder, read in a separate process.

A bag is untrusted: it can claim gigabytes or exploit its reader. The reading process has bounds on memory and time and
returns only numbers; the process that drives an actuator never opens the bag.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = ["read_bag_feedback"]

_MEMORY = 1 << 30
"""Memory that reading may use in addition to the libraries [bytes]."""
_PATIENCE = 120
"""CPU time that reading may use [s]."""
_EXIT_REFUSED = 2


def read_bag_feedback(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Return ``time`` [s] and recorded quantities of a bag, as arrays by name.

    Reads the complete records on ``actuator/feedback``, else position, velocity and effort on ``joint_states``.

    Raises:
        DataError: The bag cannot be read within bounds, or has no such topic.
    """
    with tempfile.TemporaryDirectory(prefix="pendulum_feedback_") as place:
        result = Path(place, "feedback.npz")
        command = [sys.executable, "-m", __name__, str(folder.absolute()), str(result)]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=2 * _PATIENCE,
                env=environment,
                cwd=place,
            )
        except subprocess.TimeoutExpired:
            raise DataError(f"bag {folder} cannot be read: it took more than {2 * _PATIENCE} s") from None
        if done.returncode == _EXIT_REFUSED:
            raise DataError(done.stderr.strip())
        if done.returncode == -signal.SIGXCPU:
            raise DataError(f"bag {folder} cannot be read: it took more than {_PATIENCE} s of computing")
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["no word"])[-1]
            raise DataError(f"bag {folder} cannot be read: its reader ended with code {done.returncode}: {last}")
        with np.load(result, allow_pickle=False) as arrays:
            return {name.removeprefix("q_"): arrays[name] for name in arrays.files}


def _bound() -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    memory = pages * os.sysconf("SC_PAGE_SIZE") + _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (_PATIENCE, _PATIENCE + 5))


def _columns(folder: Path) -> dict[str, list[float]]:
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise DataError(how_to_install(error) or f"bag {folder} needs rosbags to be read: {error}") from error
    store = get_typestore(Stores.ROS2_JAZZY)
    _bound()
    columns: dict[str, list[float]] = {}
    ending = ""
    # AnyReader would compile types that the bag defines; the contract fixes the types of our topics.
    with Reader(folder) as reader:
        for ending in ("actuator/feedback", "joint_states"):
            connections = [c for c in reader.connections if c.topic.endswith(f"/{ending}")]
            if len({c.topic for c in connections}) > 1:
                topics = ", ".join(sorted({c.topic for c in connections}))
                raise DataError(f"bag {folder} holds several recordings: {topics}; expected one")
            if connections:
                break
        for connection, _, raw in reader.messages(connections=connections):
            if connection.msgtype != "sensor_msgs/msg/JointState":
                raise DataError(
                    f"bag {folder}: topic {connection.topic} has type {connection.msgtype}; "
                    "expected sensor_msgs/msg/JointState"
                )
            message: Any = store.deserialize_cdr(raw, connection.msgtype)
            several = sorted({name.partition("/")[0] for name in message.name if "/" in name} or set(message.name))
            if len(several) > 1 and (ending == "joint_states" or "/" in message.name[0]):
                raise DataError(
                    f"bag {folder}: topic {connection.topic} is of several joints ({', '.join(several)}); expected "
                    "feedback of one module"
                )
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            if ending == "joint_states":
                values = {name: getattr(message, name)[0] for name in ("position", "velocity", "effort")}
            else:
                values = dict(zip(message.name, message.position, strict=True))
            columns.setdefault("time", []).append(stamp)
            for name, value in values.items():
                columns.setdefault(name, []).append(float(value))
    if not columns:
        raise DataError(f"bag {folder} has no feedback; expected messages on actuator/feedback or joint_states")
    return columns


def main(argv: Sequence[str] | None = None) -> int:
    """Read the bag named first into the file named second; a refusal is one sentence and code 2."""
    folder, result = map(Path, sys.argv[1:] if argv is None else argv)
    try:
        # Column names from the bag must not collide with arguments of savez.
        arrays: dict[str, Any] = {f"q_{name}": np.asarray(column) for name, column in _columns(folder).items()}
        np.savez(result, **arrays)
    except DataError as error:
        print(error, file=sys.stderr)
        return _EXIT_REFUSED
    except MemoryError:
        print(f"bag {folder} cannot be read: it takes more than {_MEMORY >> 20} MB of memory", file=sys.stderr)
        return _EXIT_REFUSED
    except Exception as error:  # noqa: BLE001 (rosbags raises its own, those of its parsers, and what hostile bytes bring about)
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        print(f"bag {folder} cannot be read: {reason}", file=sys.stderr)
        return _EXIT_REFUSED
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
