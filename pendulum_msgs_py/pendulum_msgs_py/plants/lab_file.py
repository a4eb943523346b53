"""The lab file: which actuator stands in a lab, and how it is mounted, limited, driven and supplied.

All programs read the same file; values carry units, and unknown entries are refused::

    format: pendulum_lab/1
    module: {backend: hebi, family: Lab, name: Pendulum, serial: X5-9-00123, type: X5-9}
    joint:
      zero: {value: 0.12, unit: rad}
      sign: 1
    limits:
      effort: {value: 5.0, unit: N m}
    proofs: {...}          # written by the guided procedures

An entry is a parameter of the bridge, whose table has the allowed values. A bridge's 0 (or window with equal ends) that
means no limit or a default is refused here: the entry is omitted. Relative paths start at the file's folder.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import dump_yaml, load_yaml, reject_unknown, require_mapping

__all__ = [
    "DRIVES",
    "EMULATED_BACKENDS",
    "EMULATED_NETWORK",
    "FORMAT",
    "LAB_ENTRIES",
    "LabEntry",
    "LabFile",
    "load_lab",
    "write_lab",
]

FORMAT = "pendulum_lab/1"
EMULATED_BACKENDS = frozenset({"emulator", "emulator_process"})
"""Backends that emulate a pendulum, which may be pushed and restarted without a prompt; any other is a machine."""
DRIVES: Mapping[str, str] = MappingProxyType({"dynamixel": "xl330"})
"""Backends of drives with a current loop, and the preset of a pendulum on each."""
EMULATED_NETWORK = "emulator:"
"""Prefix of ``interface`` for emulators behind backend ``hebi``: ``emulator:HOST:PORT``."""
_HEADER = """\
# Lab file: read by bridge, check, scan, lab, launch files and `experiment --hardware hebi --lab FILE`.
# The guided procedures of `python -m pendulum_hw_bridge lab` rewrite it; remarks of your own go under `notes`.
"""


@dataclass(frozen=True)
class LabEntry:
    """One entry of the lab file.

    Attributes:
        parameter: Parameter of the bridge.
        unit: SI unit; with one, the entry is written ``{value: ..., unit: ...}``.
        kind: ``float``, ``int``, ``str``, or ``list`` of numbers.
        path: Whether the text may be a path, relative to the lab file's folder.
        left_out: Meaning of a missing entry, the bridge's 0; values <= 0 are then refused.
    """

    parameter: str
    unit: str = ""
    kind: type = str
    path: bool = False
    left_out: str = ""


_OWN = "the bridge's own"
LAB_ENTRIES: Mapping[str, Mapping[str, LabEntry]] = {
    "module": {
        "backend": LabEntry("backend"),
        "family": LabEntry("family"),
        "name": LabEntry("name"),
        "mac_address": LabEntry("mac_address"),
        "serial": LabEntry("serial"),
        "type": LabEntry("module_type"),
        "interface": LabEntry("interface"),
        "emulator_address": LabEntry("emulator_address"),
        "id": LabEntry("drive_id", "", int),
        "model": LabEntry("drive_model"),
        "bus_rate": LabEntry("bus_rate", "", int),
    },
    "joint": {
        "zero": LabEntry("joint_offset", "rad", float),
        "sign": LabEntry("joint_sign", "", int),
        "effort_tare": LabEntry("effort_tare", "N m", float),
    },
    "limits": {
        "effort": LabEntry("effort_limit", "N m", float, left_out="the plant file's own, 13 N m for an X5-9"),
        "velocity": LabEntry("velocity_limit", "rad/s", float, left_out=_OWN),
        "position_window": LabEntry("position_window", "rad", list, left_out=_OWN),
        "effort_slew": LabEntry("effort_slew_limit", "N m/s", float, left_out=_OWN),
        "tracking_error": LabEntry("tracking_error_limit", "rad", float),
        "measured_effort": LabEntry("measured_effort_limit", "N m", float, left_out="1 N m above the effort limit"),
        "winding_temperature": LabEntry("winding_temperature_limit", "degC", float),
        "derating_temperature": LabEntry("derating_temperature", "degC", float, left_out=_OWN),
        "pwm": LabEntry("pwm_limit", "", float),
    },
    "drive": {
        "plant": LabEntry("plant", path=True),
        "effort_strategy": LabEntry("effort_strategy"),
        "effort_efficiency": LabEntry("effort_efficiency", "", float),
        "back_emf_compensation": LabEntry("back_emf_compensation", "", float),
        "gains_file": LabEntry("gains_file", path=True),
        "feedback_rate": LabEntry("feedback_rate", "Hz", float),
        "command_lifetime": LabEntry("command_lifetime", "s", float),
        "feedback_watchdog": LabEntry("feedback_watchdog", "", int),
        "m_stop_action": LabEntry("m_stop_action"),
        "enable_timeout": LabEntry("enable_timeout", "s", float, left_out="no such switch"),
        "stop_time": LabEntry("stop_time", "s", float, left_out="at once"),
        "e_stop_input_timeout": LabEntry("e_stop_input_timeout", "s", float, left_out="no such input"),
    },
    "supply": {"voltage_window": LabEntry("voltage_window", "V", list)},
}
"""The entries of a lab file, by section."""

_TOP = ("format", "name", "notes", *LAB_ENTRIES, "proofs")
_KINDS = {float: "a number", int: "an integer", str: "text", list: "a list of numbers"}


@dataclass(frozen=True)
class LabFile:
    """The content of a lab file.

    Attributes:
        values: Given values by parameter of the bridge.
        name: Name of the bench.
        notes: Free text.
        proofs: Date and result of each guided procedure.
        folder: Folder of the file, where relative paths start.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    notes: str = ""
    proofs: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", MappingProxyType(dict(self.values)))

    def changed(self, **values: Any) -> LabFile:
        """Return the lab with changed values; raise a ParameterError for a parameter without an entry."""
        reject_unknown(values, _parameters(), where="lab file")
        return replace(self, values={**self.values, **values})

    def proved(self, procedure: str, date: str, result: str) -> LabFile:
        """Return the lab with the result of a guided procedure."""
        return replace(self, proofs={**self.proofs, procedure: {"date": date, "result": result}})

    def no_longer_proved(self, procedure: str) -> LabFile:
        """Return the lab without the result of a guided procedure."""
        return replace(self, proofs={name: proof for name, proof in self.proofs.items() if name != procedure})

    @property
    def emulated(self) -> bool:
        """Whether a pendulum is emulated behind it."""
        backend = self.values.get("backend", "hebi")
        on_network = backend == "hebi" and str(self.values.get("interface", "")).startswith(EMULATED_NETWORK)
        return on_network or backend in EMULATED_BACKENDS

    def describe(self) -> str:
        """Return the actuator in a few words, for a question to the operator."""
        values = self.values
        if values.get("backend") in DRIVES:
            return f"{values['backend']} number {values.get('drive_id', 1)} on {values.get('interface')}"
        who = f"{values.get('family') or '*'}/{values.get('name') or '*'}"
        marks = [str(values[key]) for key in ("serial", "mac_address") if values.get(key)]
        return f"{values.get('backend', 'hebi')} {who}" + (f" ({', '.join(marks)})" if marks else "")


def load_lab(path: str | Path) -> LabFile:
    """Return the content of a lab file.

    Raises:
        ParameterError: The file is missing or not YAML, a name is unknown, or a value has the wrong type, no unit, or
            limits nothing; the message names the place.
    """
    document = load_yaml(path, "lab file")
    where = str(path)
    reject_unknown(document, _TOP, where=where)
    if document.get("format") != FORMAT:
        raise ParameterError(f"{where}: format is {document.get('format')!r}; expected {FORMAT!r}")
    folder = Path(path).resolve().parent
    values: dict[str, Any] = {}
    for section, entries in LAB_ENTRIES.items():
        if section not in document:
            continue
        given = require_mapping(document[section], f"{where}: {section}")
        reject_unknown(given, entries, where=f"{where}: {section}")
        for name, value in given.items():
            entry = entries[name]
            read = _read(value, entry, f"{where}: {section}.{name}")
            values[entry.parameter] = _absolute(read, folder) if entry.path else read
    values.setdefault("backend", "hebi")
    return LabFile(
        values,
        name=_text(document, "name", where),
        notes=_text(document, "notes", where),
        proofs=_proofs(document.get("proofs", {}), f"{where}: proofs"),
        folder=folder,
    )


def write_lab(path: str | Path, lab: LabFile) -> Path:
    """Write a lab file atomically; raise a ParameterError if that fails or a limit limits nothing."""
    path = Path(path)
    document: dict[str, Any] = {"format": FORMAT}
    if lab.name:
        document["name"] = lab.name
    if lab.notes:
        document["notes"] = lab.notes
    for section, entries in LAB_ENTRIES.items():
        content = {
            name: _written(lab.values[entry.parameter], entry, path.resolve().parent, f"{path}: {section}.{name}")
            for name, entry in entries.items()
            if entry.parameter in lab.values
        }
        if content:
            document[section] = content
    if lab.proofs:
        document["proofs"] = {name: dict(proof) for name, proof in lab.proofs.items()}
    with writing(f"lab file {path}", ParameterError):
        write_atomically(path, _HEADER + dump_yaml(document, "lab file"))
    return path


def _parameters() -> set[str]:
    return {entry.parameter for entries in LAB_ENTRIES.values() for entry in entries.values()}


def _read(value: object, entry: LabEntry, where: str) -> Any:
    if entry.unit:
        if not isinstance(value, dict):
            raise ParameterError(f"{where} is {value!r}; expected {{value: ..., unit: {entry.unit}}}")
        reject_unknown(value, ("value", "unit"), where=where)
        if value.get("unit") != entry.unit:
            given = repr(value["unit"]) if "unit" in value else "missing"
            raise ParameterError(f"{where}: unit is {given}; expected {entry.unit!r}")
        if "value" not in value:
            raise ParameterError(f"{where}: value is missing; expected {_KINDS[entry.kind]} in {entry.unit}")
        value = value["value"]
    if entry.kind is list:
        if not isinstance(value, list) or len(value) != 2:
            raise ParameterError(f"{where} is {value!r}; expected [low, high] in {entry.unit}")
        return _limiting([_number(element, where) for element in value], entry, where)
    if entry.kind is float:
        return _limiting(_number(value, where), entry, where)
    if not isinstance(value, entry.kind) or isinstance(value, bool):
        raise ParameterError(f"{where} is {value!r}; expected {_KINDS[entry.kind]}")
    return value


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ParameterError(f"{where} is {value!r}; expected a finite number")
    return float(value)


def _limiting(value: Any, entry: LabEntry, where: str) -> Any:
    if entry.left_out:
        good, expected = (value[0] < value[1], "low < high") if entry.kind is list else (value > 0.0, "> 0")
        if not good:
            raise ParameterError(
                f"{where} is {value} {entry.unit}; expected {expected} (leave it out for {entry.left_out})"
            )
    return value


def _written(value: Any, entry: LabEntry, folder: Path, where: str) -> Any:
    _limiting(value, entry, where)
    if entry.path and value and Path(value).is_absolute() and Path(value).is_relative_to(folder):
        value = str(Path(value).relative_to(folder))
    return {"value": value, "unit": entry.unit} if entry.unit else value


def _absolute(text: str, folder: Path) -> str:
    is_path = "/" in text or Path(text).suffix != ""
    return str((folder / Path(text).expanduser()).resolve()) if text and is_path else text


def _text(document: Mapping[str, Any], name: str, where: str) -> str:
    value = document.get(name, "")
    if not isinstance(value, str):
        raise ParameterError(f"{where}: {name} is {value!r}; expected text")
    return value


def _proofs(value: object, where: str) -> dict[str, dict[str, str]]:
    found = {}
    for name, proof in require_mapping(value, where).items():
        content = require_mapping(proof, f"{where}.{name}")
        reject_unknown(content, ("date", "result"), where=f"{where}.{name}")
        found[name] = {key: str(text) for key, text in content.items()}
    return found
