"""Helpers to write XML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.etree import ElementTree

__all__ = ["add", "document_text", "lateness", "number", "safe_name"]


def add(
    parent: ElementTree.Element, tag: str, attributes: Mapping[str, str] | None = None, **more: str
) -> ElementTree.Element:
    """Return a new child element."""
    return ElementTree.SubElement(parent, tag, {**(attributes or {}), **more})


def number(value: float) -> str:
    """Return a number as text with all digits."""
    return repr(float(value))


def lateness(lag: float, delay: float, timestep: float) -> dict[str, str]:
    """Return a MuJoCo actuator's attributes for lag and transport delay [s]; a delay needs MuJoCo 4 or later."""
    attributes = {"dyntype": "filterexact", "dynprm": number(lag)} if lag > 0.0 else {}
    if delay > 0.0:
        attributes |= {"delay": number(delay), "nsample": str(math.ceil(delay / timestep - 1e-9) + 1)}
    return attributes


def safe_name(name: str) -> str:
    """Return a name of letters, digits, ``_`` and ``-``."""
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "pendulum"


def document_text(root: ElementTree.Element) -> str:
    """Return the document, indented."""
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
