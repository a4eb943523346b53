"""HEBI's library: its names of our quantities, and its log files.

The library's thread writes a ``.hebilog`` at the full feedback rate with the module's clock, independently of the
bridge, ROS and the recorder.
"""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES, ActuatorError
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.programs.extras import how_to_install
from pendulum_msgs_py.programs.hang_guard import guard_exit

__all__ = ["ATTRIBUTES", "import_hebi", "read_hebilog", "start_log", "stop_log", "to_joint"]

ATTRIBUTES = {
    **{name: name for name in FEEDBACK_QUANTITIES},
    "winding_current": "motor_winding_current",
    "winding_temperature": "motor_winding_temperature",
    "housing_temperature": "motor_housing_temperature",
}
"""Our quantity -> attribute of hebi-py's feedback."""
_POSITIONS = ("position", "position_command")
_ODD = ("velocity", "effort", "velocity_command", "effort_command")
"""Quantities other than positions that change sign with the joint."""


def import_hebi() -> Any:
    """Return hebi-py, imported on first use; ActuatorError if it is not installed."""
    try:
        # The library prints to standard output if an optional module of its own is missing.
        with contextlib.redirect_stdout(io.StringIO()):
            import hebi
    except ImportError as error:
        raise ActuatorError("not_installed", how_to_install(error) or f"hebi-py cannot be imported: {error}") from error
    # The library releases all groups at exit, and of thousands of releases one never returns.
    guard_exit()
    return hebi


def start_log(group: Any, path: Path) -> None:
    """Let hebi-py log all feedback of a group; ActuatorError if it cannot or the file exists."""
    if path.exists():
        raise ActuatorError("exception", f"HEBI log {path} is there already; expected a new file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        group.start_log(str(path.parent), path.name)
    except OSError as error:
        raise ActuatorError("exception", f"HEBI log {path} cannot be started: {error}") from error


def stop_log(group: Any) -> None:
    """End the log of a group; an empty one is no error."""
    # The library opens the finished file, and refuses one without a record.
    with contextlib.suppress(Exception):
        group.stop_log()


def read_hebilog(path: Path, *, module: int | None = None) -> dict[str, NDArray[np.float64]]:
    """Return ``time`` [s] by the module's clock and quantities by name, in SI units, of one module of a HEBI log.

    ``module`` counts from 0; None requires a log of one module.

    Raises:
        ActuatorError: hebi-py is not installed.
        DataError: No such file, no log, several modules, or no records.
    """
    log = _open(path)
    count = int(log.number_of_modules)
    if module is None and count > 1:
        raise DataError(f"{path} holds {count} modules; expected one, or a choice from 0 to {count - 1}")
    index = module or 0
    if not 0 <= index < count:
        raise DataError(f"{path}: module is {index}; expected 0 to {count - 1}")
    stamps: list[tuple[int, int]] = []
    rows: list[list[float]] = []
    names = list(FEEDBACK_QUANTITIES)
    for record in log.feedback_iterate:
        stamps.append((int(record.hardware_transmit_time_us[index]), int(record.receive_time_us[index])))
        rows.append([float(getattr(record, ATTRIBUTES[name])[index]) for name in names])
    if len(rows) < 2:
        raise DataError(f"{path} holds {len(rows)} records; expected at least 2")
    times = np.array(stamps, dtype=np.int64)
    # The module's clock has no network jitter; without it, the time of receipt is used.
    clock = times[:, 0] if np.all(np.diff(times[:, 0]) >= 0) and times[-1, 0] > times[0, 0] else times[:, 1]
    new = np.concatenate([[True], np.diff(clock) > 0])
    table = np.array(rows, dtype=np.float64)[new]
    clock = clock[new]
    quantities = {name: table[:, column] for column, name in enumerate(names)}
    return {"time": (clock - clock[0]) * 1e-6, **quantities}


def to_joint(
    quantities: dict[str, NDArray[np.float64]], *, zero: float = 0.0, sign: int = 1, tare: float = 0.0
) -> dict[str, NDArray[np.float64]]:
    """Return :func:`read_hebilog`'s quantities in joint coordinates, by zero [rad], sign (1 or -1) and tare [N m]."""
    found = dict(quantities)
    for name in _POSITIONS:
        found[name] = sign * quantities[name] + zero
    for name in _ODD:
        found[name] = sign * quantities[name]
    found["effort"] = found["effort"] - tare
    return found


def _open(path: Path) -> Any:
    if not path.is_file():
        raise DataError(f"HEBI log {path} does not exist")
    hebi = import_hebi()
    try:
        return hebi.util.load_log(str(path), load=False)
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path} is no HEBI log: {error}") from error
