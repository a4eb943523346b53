"""Small words for writing XML: an element with attributes, a number in full, a name that every reader takes."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree

__all__ = ["add", "document_text", "number", "safe_name"]


def add(
    parent: ElementTree.Element, tag: str, attributes: Mapping[str, str] | None = None, **more: str
) -> ElementTree.Element:
    """Return a new element with attributes under another one."""
    return ElementTree.SubElement(parent, tag, {**(attributes or {}), **more})


def number(value: float) -> str:
    """Return a number so that it is read back to the last bit."""
    return repr(float(value))


def safe_name(name: str) -> str:
    """Return a name with letters, digits, ``_`` and ``-`` alone."""
    return "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "pendulum"


def document_text(root: ElementTree.Element) -> str:
    """Return the whole document, indented."""
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
