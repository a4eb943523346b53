"""QoS profiles as a bag stores them (rosbag2 metadata version 9: named policies)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import yaml

__all__ = ["INFINITE_NS", "QosProfile", "profiles_of"]

INFINITE_NS = 2**63 - 1
"""rmw's "no limit" for a deadline, a lifespan or a lease [ns]."""


@dataclass(frozen=True, slots=True)
class QosProfile:
    """Offered QoS of one publisher, in rosbag2's terms and rmw's defaults, ``unknown`` and 0 if not discovered.

    ``lifespan_ns`` is the age after which a message is worthless, ``lease_ns`` the liveliness lease.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    lease_ns: int = INFINITE_NS

    def to_yaml(self, indent: str) -> str:
        """Return the profile as an item of a block-style YAML list."""
        inner = indent + "  "
        return (
            f"{indent}- history: {self.history}\n"
            f"{inner}depth: {self.depth}\n"
            f"{inner}reliability: {self.reliability}\n"
            f"{inner}durability: {self.durability}\n"
            f"{_duration(inner, 'deadline', self.deadline_ns)}"
            f"{_duration(inner, 'lifespan', self.lifespan_ns)}"
            f"{inner}liveliness: {self.liveliness}\n"
            f"{_duration(inner, 'liveliness_lease_duration', self.lease_ns)}"
            f"{inner}avoid_ros_namespace_conventions: false\n"
        )

    @classmethod
    def from_mapping(cls, item: dict[str, Any]) -> QosProfile:
        """Read one profile of a ``metadata.yaml`` (named policies; older files use numbers)."""
        return cls(
            history=_name(item.get("history"), _HISTORY),
            depth=int(item.get("depth", 10)),
            reliability=_name(item.get("reliability"), _RELIABILITY),
            durability=_name(item.get("durability"), _DURABILITY),
            deadline_ns=_nanoseconds(item.get("deadline")),
            lifespan_ns=_nanoseconds(item.get("lifespan")),
            liveliness=_name(item.get("liveliness"), _LIVELINESS),
            lease_ns=_nanoseconds(item.get("liveliness_lease_duration")),
        )


def profiles_of(text: str) -> list[QosProfile]:
    """Return the QoS profiles in a bag's YAML text; none if it cannot be read."""
    try:
        items = yaml.safe_load(text) if text else []
    except yaml.YAMLError:
        items = []
    return [QosProfile.from_mapping(item) for item in items or [] if isinstance(item, dict)]


_HISTORY = ("system_default", "keep_last", "keep_all", "unknown")
_RELIABILITY = ("system_default", "reliable", "best_effort", "unknown", "best_available")
_DURABILITY = ("system_default", "transient_local", "volatile", "unknown", "best_available")
_LIVELINESS = ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available")


def _name(value: object, names: tuple[str, ...]) -> str:
    if isinstance(value, int) and 0 <= value < len(names):
        return names[value]
    return value if isinstance(value, str) and value in names else "unknown"


def _nanoseconds(value: object) -> int:
    if not isinstance(value, dict):
        return INFINITE_NS
    return min(int(value.get("sec", 0)) * 10**9 + int(value.get("nsec", 0)), INFINITE_NS)


def _duration(indent: str, key: str, nanoseconds: int) -> str:
    sec, nsec = divmod(nanoseconds, 10**9)
    return f"{indent}{key}:\n{indent}  sec: {sec}\n{indent}  nsec: {nsec}\n"
