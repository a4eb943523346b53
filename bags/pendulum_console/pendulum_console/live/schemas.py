"""Schemas for viewers: the text of messages and of both halves of services."""

from __future__ import annotations

import re
from typing import Any

from pendulum_rosbag.storage.message_types import message_type

__all__ = ["service_text"]

_NESTED = re.compile(r"(\w+)/(\w+)")
_RULE = "=" * 80
_BOUNDED_TEXT = re.compile(r"(w?string)<(\d+)>")
_SEQUENCE = re.compile(r"sequence<(.+?)(?:, (\d+))?>$")


def service_text(half: Any) -> str:
    """Return the ``ros2msg`` text of a service's request or response; a BagError for unknown messages in it."""
    lines, nested = [], []
    for name, kind in half.get_fields_and_field_types().items():
        written = _in_message(kind)
        if found := _NESTED.search(written):
            nested.append(f"{found[1]}/msg/{found[2]}")
        lines.append(f"{written} {name}")
    text = "\n".join(lines) + "\n"
    for full in dict.fromkeys(nested):
        package, _, short = full.split("/")
        text += f"{_RULE}\nMSG: {package}/{short}\n{message_type(full).definition}"
    return text


def _in_message(kind: str) -> str:
    """Return a type as message files write it: ``sequence<double>`` is ``float64[]``."""
    if found := _SEQUENCE.match(kind):
        return f"{_in_message(found[1])}[{'<=' + found[2] if found[2] else ''}]"
    if found := re.fullmatch(r"(.+)\[(\d+)\]", kind):
        return f"{_in_message(found[1])}[{found[2]}]"
    if found := _BOUNDED_TEXT.fullmatch(kind):
        return f"{found[1]}<={found[2]}"
    return {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}.get(kind, kind)
