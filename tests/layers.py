"""The layers of the lock as data, and an environment in which only some of them seem to be installed."""

from __future__ import annotations

import json
import os
import re
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from pendulum_testing.fixtures import PROJECT

__all__ = ["LAYERS", "ROOM", "distributions_of_modules", "environment_of", "pins", "requirements"]

ROOM = PROJECT / "requirements"
LAYERS = ("run", "extras", "build", "checks", "docs", "test")

_HIDE = """
import json, os, sys

_HIDDEN = set(json.loads(os.environ["HIDDEN_MODULES"]))

class _Hider:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in _HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, _Hider)
"""


distributions_of_modules = cache(packages_distributions)
"""Modules and who brings them; to read it off all that is installed takes a third of a second."""


@cache
def pins(layer: str) -> tuple[Requirement, ...]:
    """Return the pinned packages of a layer, with their markers."""
    text = (ROOM / f"{layer}.txt").read_text(encoding="utf-8")
    return tuple(
        Requirement(line) for line in re.findall(r"^([A-Za-z0-9][^\\\n]*?==[^\\\n]*?)\s*\\?$", text, re.MULTILINE)
    )


@cache
def requirements(layer: str) -> tuple[Requirement, ...]:
    """Return what a layer is asked for."""
    lines = (line.partition("#")[0].strip() for line in (ROOM / f"{layer}.in").read_text(encoding="utf-8").splitlines())
    return tuple(Requirement(line) for line in lines if line)


def environment_of(folder: Path, *layers: str, ros: bool = True) -> dict[str, str]:
    """Return variables under which Python finds, of the libraries of others, only those of the given layers.

    Args:
        folder: Empty; what hides the rest goes here.
        layers: Names of layers.
        ros: Whether the layers' wheels of ROS are found too.
    """
    there = {canonicalize_name(pin.name) for layer in layers for pin in pins(layer)}
    there = {name for name in there if ros or not name.startswith("ros-")}
    hidden = [
        module
        for module, names in distributions_of_modules().items()
        if not any(canonicalize_name(name) in there or name.startswith("pendulum_") for name in names)
    ]
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(_HIDE, encoding="utf-8")
    return {**os.environ, "PYTHONPATH": str(folder), "HIDDEN_MODULES": json.dumps(hidden)}
