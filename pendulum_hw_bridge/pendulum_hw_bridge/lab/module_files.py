"""Backup and restore of a module's gains, safety parameters and M-stop action.

The files are HEBI's XML, written and read by hebi-py, so HEBI Scope reads them too. hebi-py writes six decimals, so
numbers are rewritten with all digits. An emulator's gains have the same format, its limits are JSON.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from pendulum_hw_bridge.backends.hebi_settings import limits_of
from pendulum_hw_bridge.emulation.wire import limits_from_json, limits_to_json
from pendulum_hw_bridge.port.actuator import ActuatorError, ActuatorPort, HardwareLimits
from pendulum_hw_bridge.port.gains import load_gains, write_gains
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import read_text

__all__ = ["backup_emulator", "backup_group", "limits_of_group", "restore_emulator", "restore_group"]

GAINS = "gains.xml"
SAFETY = "safety.xml"
LIMITS = "limits.json"
ENDS = "position_limit_strategies.json"
"""Actions at either end of the position limits: hebi-py's file has one entry for both."""
_END_NAMES = ("min_position_limit_strategy", "max_position_limit_strategy")
_ANSWER_MS = 500
_ATTEMPTS = 3
_WRITERS = {GAINS: "write_gains", SAFETY: "write_safety_params"}
_DECIMAL = re.compile(r"-?\d+\.\d+")
"""Number that hebi-py may have rounded; integers are choices."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?inf")
_HALF = ".unfinished"
"""Suffix of an unfinished folder."""


def backup_group(group: Any, folder: Path) -> list[Path]:
    """Write gains, safety parameters and M-stop action of a HEBI module to a new folder; return the files.

    Raises:
        ActuatorError: The module does not reply.
        ParameterError: The folder exists, so that no older backup is lost, or cannot be made.
    """
    info = _info(group)
    names = (GAINS, SAFETY, ENDS)
    with _new(folder) as half:
        _write(info, half / GAINS)
        _write(info, half / SAFETY)
        (half / ENDS).write_text(json.dumps(_ends_of(info)) + "\n", encoding="utf-8")
        # hebi-py reports no error when a disk is full.
        if not all((half / name).is_file() and (half / name).stat().st_size for name in names):
            raise OSError(errno.ENOSPC, "not all of it was written: is the disk full?")
    return [folder / name for name in names]


def restore_group(group: Any, folder: Path, make_command: Callable[[], Any], say: Callable[[str], None]) -> None:
    """Send a module the settings of :func:`backup_group`, and read them back; no setpoint is sent, so nothing moves.

    ``say`` warns if some settings may be in force after an error.

    Raises:
        ActuatorError: The module does not acknowledge, or other values read back.
        ParameterError: A file is missing or not understood; nothing was sent.
    """
    _expect_whole(folder)
    ends = _read_ends(folder / ENDS)
    commands = []
    for name, read in ((GAINS, "read_gains"), (SAFETY, "read_safety_params")):
        read_text(folder / name, "backup")
        command = make_command()
        try:
            getattr(command, read)(str(folder / name))
        except Exception as error:
            raise ParameterError(f"backup {folder / name} is not understood: {error}") from error
        if name == SAFETY:
            _set_open_ends(command, folder / name)
            for end, strategy in ends.items():
                setattr(command, end, strategy)
        # An empty command of hebi-py reads as position 0; NaN cannot be taken for a setpoint.
        command.position = command.velocity = command.effort = math.nan
        commands.append((name, command))
    with _warn_if_interrupted(folder, say):
        for name, command in commands:
            if not any(group.send_command_with_acknowledgement(command, _ANSWER_MS) for _ in range(_ATTEMPTS)):
                raise ActuatorError(
                    "no_acknowledgement", f"HEBI module did not acknowledge {name} within {_ANSWER_MS} ms"
                )
        _expect_group(_info(group), folder, ends)


def limits_of_group(group: Any, wanted: HardwareLimits) -> HardwareLimits:
    """Return the limits that a HEBI module reports; ``wanted`` has the ends at which it should switch off.

    Raises:
        ActuatorError: The module does not reply, or acts differently at an end.
    """
    return limits_of(_info(group), wanted)


def _expect_group(info: Any, folder: Path, ends: dict[str, int]) -> None:
    # Not next to the backup, whose medium may be full or read-only.
    with tempfile.TemporaryDirectory(prefix="pendulum_module_") as temporary:
        for name in (GAINS, SAFETY):
            now = Path(temporary, name)
            _write(info, now)
            read, kept = _values(now), _values(folder / name)
            wrong = [where for where in dict.fromkeys([*kept, *read]) if read.get(where) != kept.get(where)]
            if wrong:
                where = wrong[0]
                raise ActuatorError(
                    "no_acknowledgement",
                    f"HEBI module reads back other values than those of {folder / name}: {where} is {read.get(where)}; "
                    f"expected {kept.get(where)}",
                )
    if ends and _ends_of(info) != ends:
        raise ActuatorError("no_acknowledgement", f"HEBI module reads back {_ends_of(info)}; expected {ends}")


def backup_emulator(port: ActuatorPort, folder: Path) -> list[Path]:
    """Write gains and limits of an emulator; return the files."""
    info = port.connect()
    if info.gains is None:
        raise ActuatorError("not_connected", f"{info.backend} does not tell its gains; expected hebi or an emulator")
    with _new(folder) as half:
        write_gains(half / GAINS, info.gains)
        (half / LIMITS).write_text(json.dumps(limits_to_json(info.limits)) + "\n", encoding="utf-8")
    return [folder / GAINS, folder / LIMITS]


def restore_emulator(port: ActuatorPort, folder: Path, say: Callable[[str], None]) -> None:
    """Restore a backup of :func:`backup_emulator` and read it back; ``say`` as for a group."""
    _expect_whole(folder)
    gains = load_gains(folder / GAINS)
    try:
        limits = limits_from_json(json.loads(read_text(folder / LIMITS, "backup")))
    except ValueError as error:
        raise ParameterError(f"backup {folder / LIMITS} is not understood: {error}") from error
    with _warn_if_interrupted(folder, say):
        if port.set_gains(gains) != gains or port.set_limits(limits) != limits:
            raise ActuatorError("no_acknowledgement", f"emulator reads back other values than those of {folder}")


@contextlib.contextmanager
def _warn_if_interrupted(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Warn if an error or Ctrl-C may have left a mixture of two sets of settings."""
    try:
        yield
    except BaseException:
        say(
            f"Broken off: the module may hold some settings of {folder} and some that it had before. Do not arm it; "
            "restore again."
        )
        raise


def _set_open_ends(command: Any, path: Path) -> None:
    """Set infinite position limits of a file: hebi-py reads them as NaN and would send that."""
    try:
        position = ElementTree.parse(path).getroot().find("position")
        ends = {} if position is None else {end: position.findtext(f"{end}_limit") for end in ("min", "max")}
        limits = {end: float(text) for end, text in ends.items() if text is not None}
    except (ElementTree.ParseError, ValueError) as error:
        raise ParameterError(f"backup {path} is not understood: {error}") from error
    for end, limit in limits.items():
        if math.isnan(limit):
            raise ParameterError(f"backup {path}: {end}_limit of the position is no number; expected one, or inf")
        if math.isinf(limit):
            setattr(command, f"position_limit_{end}", limit)


def _write(info: Any, path: Path) -> None:
    """Let hebi-py write a file of settings, and restore the digits that it omits."""
    getattr(info, _WRITERS[path.name])(str(path))
    if not path.is_file() or not path.stat().st_size:
        return  # (the caller asks whether there was room)
    tree = ElementTree.parse(path)
    for part in tree.getroot():
        for element in part:
            field = f"{part.tag}_{element.tag}"
            # hebi-py names a limit "position_limit_min", its file "<position><min_limit>".
            end = element.tag.removesuffix("_limit")
            field = f"{part.tag}_limit_{end}" if end != element.tag else field
            value = getattr(info, field, None)
            if _is_decimal(element.text) and value is not None and math.isfinite(float(value[0])):
                element.text = str(np.float32(value[0]))
    path.write_text(
        '<?xml version="1.0"?>\n' + ElementTree.tostring(tree.getroot(), encoding="unicode") + "\n", encoding="utf-8"
    )


def _is_decimal(text: str | None) -> bool:
    return text is not None and _DECIMAL.fullmatch(text.strip()) is not None


def _values(path: Path) -> dict[str, Any]:
    """Return the values of a settings file by place, numbers in single precision as in the module."""
    found: dict[str, Any] = {}
    for part in ElementTree.parse(path).getroot():
        for element in (part, *part):
            text = (element.text or "").strip()
            if text:
                where = part.tag if element is part else f"{part.tag} {element.tag}"
                found[where] = float(np.float32(text)) if _NUMBER.fullmatch(text) else text
    return found


def _ends_of(info: Any) -> dict[str, int]:
    return {name: int(getattr(info, name)[0]) for name in _END_NAMES}


def _read_ends(path: Path) -> dict[str, int]:
    if not path.exists():
        # An older backup has one strategy for both ends, in the file of safety parameters. It cannot be an unfinished
        # one, because a folder gets its name when it is complete.
        return {}
    try:
        content = json.loads(read_text(path, "backup"))
        return {name: int(content[name]) for name in _END_NAMES}
    except (KeyError, TypeError, ValueError) as error:
        raise ParameterError(f"backup {path} is not understood: {error}") from error


def _info(group: Any) -> Any:
    for _ in range(_ATTEMPTS):
        info = group.request_info(_ANSWER_MS)
        if info is not None:
            return info
    raise ActuatorError("module_lost", f"HEBI module did not tell its settings within {_ANSWER_MS} ms")


@contextlib.contextmanager
def _new(folder: Path) -> Iterator[Path]:
    """Make a temporary folder that is renamed when complete, and removed otherwise."""
    if folder.exists():
        raise ParameterError(f"backup {folder} is there already; expected a new folder")
    # Absolute, because "." has no name.
    whole = folder.absolute()
    half = whole.with_name(whole.name + _HALF)
    try:
        # A killed program can leave an unfinished folder.
        shutil.rmtree(half, ignore_errors=True)
        half.mkdir(parents=True)
    except OSError as error:
        raise ParameterError(f"backup {folder} cannot be made: {error.strerror}") from error
    try:
        yield half
        half.rename(whole)
    except (OSError, RuntimeError, ParameterError) as error:
        why = getattr(error, "strerror", None) or error
        raise ParameterError(f"backup {folder} cannot be written: {why}") from error
    finally:
        shutil.rmtree(half, ignore_errors=True)


def _expect_whole(folder: Path) -> None:
    if folder.absolute().name.endswith(_HALF):
        raise ParameterError(f"backup {folder} was interrupted and is not whole; expected one that lab backup finished")
