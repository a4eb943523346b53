"""What a module was set to before us: gains, safety parameters and M-stop action, kept in files and given back.

The files are HEBI's own XML, written and read by hebi-py, so that HEBI Scope reads them too. An emulator keeps its
gains in the same format and its limits in JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pendulum_hw_bridge.actuator import ActuatorError, ActuatorPort
from pendulum_hw_bridge.emulation.wire import limits_from_json, limits_to_json
from pendulum_hw_bridge.gains import load_gains, write_gains
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import read_text

__all__ = ["backup_emulator", "backup_group", "restore_emulator", "restore_group"]

GAINS = "gains.xml"
SAFETY = "safety.xml"
LIMITS = "limits.json"
_ANSWER_MS = 500
_ATTEMPTS = 3


def backup_group(group: Any, folder: Path) -> list[Path]:
    """Write gains, safety parameters and M-stop action of a HEBI module; return the files.

    Args:
        group: hebi-py's group of the one module.
        folder: Where; it must be new, so that an older state is never lost.

    Raises:
        ActuatorError: The module does not answer.
        ParameterError: The folder is there already, or cannot be made.
    """
    info = _info(group)
    _make(folder)
    info.write_gains(str(folder / GAINS))
    info.write_safety_params(str(folder / SAFETY))
    return [folder / GAINS, folder / SAFETY]


def restore_group(group: Any, folder: Path, make_command: Callable[[], Any]) -> None:
    """Send a module the gains, safety parameters and M-stop action of :func:`backup_group`, and read them back.

    No setpoint is sent, so nothing moves.

    Args:
        group: hebi-py's group of the one module.
        folder: Where they are.
        make_command: Makes an empty ``GroupCommand`` for one module.

    Raises:
        ActuatorError: The module does not acknowledge, or other values read back.
        ParameterError: A file is missing or not understood.
    """
    for name, read in ((GAINS, "read_gains"), (SAFETY, "read_safety_params")):
        read_text(folder / name, "backup")
        command = make_command()
        try:
            getattr(command, read)(str(folder / name))
        except Exception as error:
            raise ParameterError(f"backup {folder / name} is not understood: {error}") from error
        # An empty command of hebi-py reads as position 0; said to be none, nothing can be taken for a wish to move.
        command.position = command.velocity = command.effort = math.nan
        if not any(group.send_command_with_acknowledgement(command, _ANSWER_MS) for _ in range(_ATTEMPTS)):
            raise ActuatorError("no_acknowledgement", f"HEBI module did not acknowledge {name} within {_ANSWER_MS} ms")
    info = _info(group)
    for name, write in ((GAINS, "write_gains"), (SAFETY, "write_safety_params")):
        now = folder / f".now_{name}"
        try:
            getattr(info, write)(str(now))
            if now.read_text(encoding="utf-8") != (folder / name).read_text(encoding="utf-8"):
                raise ActuatorError(
                    "no_acknowledgement", f"HEBI module reads back other values than those of {folder / name}"
                )
        finally:
            now.unlink(missing_ok=True)


def backup_emulator(port: ActuatorPort, folder: Path) -> list[Path]:
    """Write gains and limits of an emulator; return the files."""
    info = port.connect()
    if info.gains is None:
        raise ActuatorError("not_connected", f"{info.backend} does not tell its gains; expected hebi or an emulator")
    _make(folder)
    write_gains(folder / GAINS, info.gains)
    (folder / LIMITS).write_text(json.dumps(limits_to_json(info.limits), indent=2) + "\n", encoding="utf-8")
    return [folder / GAINS, folder / LIMITS]


def restore_emulator(port: ActuatorPort, folder: Path) -> None:
    """Give an emulator the gains and limits of :func:`backup_emulator`, and read them back."""
    gains = load_gains(folder / GAINS)
    try:
        limits = limits_from_json(json.loads(read_text(folder / LIMITS, "backup")))
    except ValueError as error:
        raise ParameterError(f"backup {folder / LIMITS} is not understood: {error}") from error
    port.connect()
    if port.set_gains(gains) != gains or port.set_limits(limits) != limits:
        raise ActuatorError("no_acknowledgement", f"emulator reads back other values than those of {folder}")


def _info(group: Any) -> Any:
    for _ in range(_ATTEMPTS):
        info = group.request_info(_ANSWER_MS)
        if info is not None:
            return info
    raise ActuatorError("module_lost", f"HEBI module did not tell its settings within {_ANSWER_MS} ms")


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ParameterError(f"backup {folder} is there already; expected a new folder") from None
    except OSError as error:
        raise ParameterError(f"backup {folder} cannot be made: {error.strerror}") from error
