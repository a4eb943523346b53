"""Discovery of HEBI modules on the network, and selection of one.

Names are not unique; MAC addresses and serial numbers are. The selection waits for the whole search time, because a
second module of the same name may reply later, and requires exactly one match.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from pendulum_hw_bridge.port.actuator import ActuatorError

__all__ = ["LOOK_TIME", "ModuleRecord", "ModuleSelection", "discover", "select_module"]

LOOK_TIME = 2.0
"""Search time before a selection: ten of hebi-py's lookup periods [s]."""
_STEP = 0.25
_ANSWER_MS = 500


@dataclass(frozen=True)
class ModuleRecord:
    """One module on the network; ``serial``, ``type`` and ``firmware`` are empty if it did not reply.

    Attributes:
        mac_address: ``aa:bb:cc:dd:ee:ff``.
        type: Mechanical type, such as ``X5-9``.
        address: IP address.
        stale: Whether it has been silent lately.
    """

    family: str
    name: str
    mac_address: str
    serial: str = ""
    type: str = ""
    firmware: str = ""
    address: str = ""
    stale: bool = False

    def __str__(self) -> str:
        marks = [self.serial or "no answer", self.mac_address, "stale" if self.stale else ""]
        return f"{self.family}/{self.name} ({', '.join(mark for mark in marks if mark)})"


@dataclass(frozen=True)
class ModuleSelection:
    """Criteria for a module, such as ``module_type`` ``X5-9``; empty ones match anything."""

    family: str = ""
    name: str = ""
    mac_address: str = ""
    serial: str = ""
    module_type: str = ""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> ModuleSelection:
        """Return the selection by the bridge's parameters; missing ones match anything."""
        return cls(**{field.name: values[field.name] for field in fields(cls) if field.name in values})

    def __str__(self) -> str:
        marks = [text for text in (self.serial, self.mac_address) if text]
        return f"{self.family or '*'}/{self.name or '*'}" + (f" ({', '.join(marks)})" if marks else "")

    def names(self, module: ModuleRecord) -> bool:
        """Return whether a module matches, whatever its type."""
        return (
            self.family in {"", module.family}
            and self.name in {"", module.name}
            and _plain(self.mac_address) in {"", _plain(module.mac_address)}
            and self.serial.strip().lower() in {"", module.serial.strip().lower()}
        )


def discover(
    lookup: Any, *, look_time: float = LOOK_TIME, patience: float = 5.0, wait: Callable[[float], object] | None = None
) -> list[ModuleRecord]:
    """Return the modules on the network with their identity, ordered by name.

    Args:
        lookup: hebi-py's ``Lookup``.
        look_time: Shortest search time [s].
        patience: Search time after which to give up without any reply [s].
        wait: Waits for some seconds; by default on the wall clock.
    """
    pause = wait or threading.Event().wait
    waited = 0.0
    entries: list[Any] = []
    while waited < look_time or (not entries and waited < patience):
        pause(_STEP)
        waited += _STEP
        entries = list(lookup.entrylist)
    records = [_identify(lookup, entry) for entry in entries]
    return sorted(records, key=lambda record: (record.family, record.name, record.mac_address))


def select_module(modules: Sequence[ModuleRecord], wanted: ModuleSelection, *, seconds: float) -> ModuleRecord:
    """Return the one module that matches, after a search of ``seconds`` [s].

    Raises:
        ActuatorError: None or several match, or the match is stale or of another type.
    """
    listed = ", ".join(map(str, modules)) or "none"
    fitting = [module for module in modules if wanted.names(module)]
    alive = [module for module in fitting if not module.stale]
    if fitting and not alive:
        raise ActuatorError("module_lost", f"HEBI module {fitting[0]} was seen but is silent now; is its supply on?")
    if not alive:
        raise ActuatorError(
            "module_lost", f"no HEBI module {wanted} answered within {seconds:g} s; modules seen: {listed}"
        )
    if len(alive) > 1:
        twins = ", ".join(map(str, alive))
        raise ActuatorError(
            "module_lost", f"HEBI module {wanted} is not the only one: {twins}; choose by serial or mac_address"
        )
    module = alive[0]
    if wanted.module_type and _plain(wanted.module_type) != _plain(module.type):
        reads = repr(module.type) if module.type else "not known, for it did not answer"
        raise ActuatorError(
            "module_lost",
            f"type of HEBI module {module} is {reads}; expected {wanted.module_type!r}, whose constants and limits "
            "are used (parameter module_type; empty for any)",
        )
    return module


def _identify(lookup: Any, entry: Any) -> ModuleRecord:
    mac = str(entry.mac_address)
    record = ModuleRecord(
        str(entry.family), str(entry.name), mac, address=str(entry.ip_address), stale=bool(entry.is_stale)
    )
    if record.stale:
        return record
    group = lookup.get_group_from_macs([mac], _ANSWER_MS)
    info = None if group is None else group.request_info(_ANSWER_MS)
    if info is None:
        return record
    return replace(
        record,
        serial=str(info.serial[0] or ""),
        type=str(info.mechanical_type[0] or ""),
        firmware=str(info.firmware_revision[0] or ""),
    )


def _plain(text: str) -> str:
    """Return lower-case letters and digits only: AA-BB, aa:bb and aabb are one address, X5-9 and X5_9 one type."""
    return re.sub(r"[^0-9a-z]", "", text.lower())
