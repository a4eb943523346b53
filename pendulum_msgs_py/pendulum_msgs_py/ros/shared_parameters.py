"""Parameters that a file gives to every node, as in a ``/**:`` section: which a node may ignore."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import pairwise
from typing import Any

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import load_yaml, parameter_sections

__all__ = ["given_to_every_node", "refuse_near_misses"]

_MISSPELT = 0.85
"""Similarity from which a name counts as a misspelling; names of our nodes differ more."""


def given_to_every_node(arguments: Sequence[str], node: str) -> set[str]:
    """Return the parameters that a node (full name) gets only because a file gives them to every node.

    A section whose pattern ends in ``*`` or ``**`` (``/**``, ``/sim/*``) names no node; one that does (``controller``,
    ``/**/controller``), or ``-p``, means this one.

    Raises:
        ParameterError: A parameter file is refused, for example for a duplicate key.
    """
    files = [value for flag, value in pairwise(arguments) if flag == "--params-file"]
    sections = [section for file in files for section in parameter_sections(load_yaml(file, "parameter file"))]
    to_all: set[str] = set()
    to_us: set[str] = set()
    for pattern, content in sections:
        if pattern.endswith("*"):
            to_all |= set(_flat(content, ""))
        elif _matches(pattern, node):
            to_us |= set(_flat(content, ""))
    for flag, value in pairwise(arguments):
        if flag in {"-p", "--param"}:
            to_us.add(value.partition(":=")[0].rpartition(":")[2])
    return to_all - to_us


def refuse_near_misses(names: Iterable[str], known: Iterable[str], *, where: str) -> None:
    """Raise a ParameterError for the first unknown name that resembles a known one.

    A shared section may hold other nodes' parameters, but a misspelt limit would silently not be in force.
    """
    known = list(known)
    for name in names:
        near = get_close_matches(name, known, n=1, cutoff=_MISSPELT)
        if near:
            raise ParameterError(
                f"{where}: unknown parameter {name!r} in a section for every node; did you mean {near[0]!r}? "
                "If it belongs to another node, give it in that node's section"
            )


def _flat(content: Mapping[str, Any], prefix: str) -> Iterator[str]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def _matches(pattern: str, node: str) -> bool:
    """Return whether a section is for a node: ``*`` matches one part of the name, ``**`` any number."""
    parts = pattern.strip("/").split("/")
    expression = "".join({"*": "/[^/]+", "**": "(?:/[^/]+)*"}.get(part, f"/{re.escape(part)}") for part in parts)
    return re.fullmatch(expression, node) is not None
