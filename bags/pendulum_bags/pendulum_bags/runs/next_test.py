"""How a plant file is put to the test: the experiment that was recorded, with that file and noise of another seed."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

__all__ = ["next_test_of"]

_EXPERIMENTS = ("thesis", "joints")
_REPLACED = ("--plant", "--seed", "--out", "-o")
"""Options, each with a value, that the test has of its own: noise that a fit has seen is no test of it."""
_LEFT_OUT = ("--yes",)
"""Nobody is to be spared the question whether a machine may move."""


def next_test_of(record: Mapping[str, Any], plant: str) -> str:
    """Return the command that runs a recorded experiment again with another plant and other noise.

    Args:
        record: What a bag says of its run.
        plant: The plant file.

    Returns:
        The command; empty where the record tells of no experiment that compares two plants.
    """
    try:
        words = shlex.split(str(record.get("command", "")))
    except ValueError:  # a quote without its end: by hand
        return ""
    if words[:4] != ["python", "-m", "pendulum_bags", "experiment"] or " ".join(words[4:5]) not in _EXPERIMENTS:
        return ""
    kept, seed = words[:5], "1"
    rest = iter(words[5:])
    for word in rest:
        name, has_value, value = word.partition("=")
        if name in _REPLACED:
            value = value if has_value else next(rest, "")
            seed = value if name == "--seed" else seed
        elif name not in _LEFT_OUT:
            kept.append(word)
    return shlex.join([*kept, "--plant", plant, "--seed", str(int(seed) + 1 if seed.isdecimal() else 2)])
