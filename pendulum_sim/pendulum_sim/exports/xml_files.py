"""Small words for writing XML: an element with attributes, a number in full, a name that every reader takes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.etree import ElementTree

__all__ = ["add", "document_text", "lateness", "number", "safe_name"]


def add(
    parent: ElementTree.Element, tag: str, attributes: Mapping[str, str] | None = None, **more: str
) -> ElementTree.Element:
    """Return a new element with attributes under another one."""
    return ElementTree.SubElement(parent, tag, {**(attributes or {}), **more})


def number(value: float) -> str:
    """Return a number so that it is read back to the last bit."""
    return repr(float(value))


def lateness(lag: float, delay: float, timestep: float) -> dict[str, str]:
    """Return the attributes of a MuJoCo actuator with a delayed effort.

    Args:
        lag: Time constant; 0 for none [s].
        delay: Transport delay, which needs MuJoCo 4 or later; 0 for none [s].
        timestep: Of the model [s].
    """
    attributes = {"dyntype": "filterexact", "dynprm": number(lag)} if lag > 0.0 else {}
    if delay > 0.0:
        attributes |= {"delay": number(delay), "nsample": str(math.ceil(delay / timestep - 1e-9) + 1)}
    return attributes


def safe_name(name: str) -> str:
    """Return a name with letters, digits, ``_`` and ``-`` alone."""
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "pendulum"


def document_text(root: ElementTree.Element) -> str:
    """Return the whole document, indented."""
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
