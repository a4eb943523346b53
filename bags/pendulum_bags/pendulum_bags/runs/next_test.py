"""How a plant file is put to the test: the experiment that was recorded, with that file and noise of another seed."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping, Sequence, Set
from itertools import count, pairwise
from pathlib import Path
from typing import Any

__all__ = [
    "MACHINE_FILE",
    "MUJOCO_FILES",
    "measurement_of",
    "model_options",
    "next_test_of",
    "plant_file_of",
    "question_of",
    "with_budget",
]

_EXPERIMENTS = ("thesis", "joints")
MACHINE_FILE = "machine.yaml"
"""Plant file of the emulated machine of several joints, within its run folder."""
_REPLACED = ("--plant", "--seed", "--out", "-o", "--simulation", "--mapping", "--only")
"""Options, each with a value, that the test has of its own: noise that a fit has seen is no test of it, and somebody
else's simulation would stand where the plant is to."""
_OF_THE_CASE = ("--plant", "--simulation", "--mapping", "--strategy")
"""Options that say which plants an experiment is of; those that measure other layers take them too."""
_PLANT_FILES = (".yaml", ".yml")
MUJOCO_FILES = (".xml", ".mjcf", ".urdf")
"""Endings of the model files that MuJoCo reads."""
_LEFT_OUT = ("--yes", "--json")
"""The question whether a machine may move is asked again, and the answer is for a reader."""


def next_test_of(records: Sequence[Mapping[str, Any]], plant: str, bags: Sequence[str] = ()) -> str:
    """Return the command that repeats a recorded experiment with another plant and new noise, or "".

    Args:
        records: Run records of bags; the first of an experiment is repeated.
        bags: The recordings; the emulated machine next to one of several joints is reused.
    """
    seen = {str(record.get("seed", "")) for record in records}
    command = next(filter(None, (_again(record, plant, seen) for record in records)), "")
    machines = (path for bag in bags if (path := Path(bag).parent / MACHINE_FILE).is_file())
    words = shlex.split(command)
    if command and set(_values_of("--hardware", words)) <= {"emulator"}:
        command += "".join(f" --hardware {shlex.quote(str(path))}" for path in [*machines][:1])
    return command


def measurement_of(records: Sequence[Mapping[str, Any]], experiment: str) -> str:
    """Return the command of another experiment with the plants of the first recorded one on the emulator, or "".

    ``experiment`` is ``frequency_response`` or ``ranking``, which move no other hardware.
    """
    for words in map(_words, records):
        hardware = set(_values_of("--hardware", words)) - {"emulator"}
        running = any(value.startswith("ros:") for value in _values_of("--simulation", words))
        if words[:5] == ["python", "-m", "pendulum_bags", "experiment", "thesis"] and not hardware and not running:
            options = [(name, value) for name in _OF_THE_CASE for value in _values_of(name, words)[-1:]]
            return shlex.join([*words[:4], experiment, *(word for pair in options for word in pair)])
    return ""


def model_options(records: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """Return the options that identify a simulation's MuJoCo or URDF file, and those that run the result, or ""."""
    for words in map(_words, records):
        for model in map(Path, _values_of("--simulation", words)):
            if model.suffix in MUJOCO_FILES:
                out = shlex.quote(f"{model.stem}_identified{model.suffix}")
                mapping = "".join(shlex.quote(value) for value in _values_of("--mapping", words)[-1:])
                of, run = (f" --{name} {mapping}" if mapping else "" for name in ("model-mapping", "mapping"))
                return f"--model {shlex.quote(str(model))}{of} --out {out}", f"--simulation {out}{run}"
    return "", ""


def with_budget(records: Sequence[Mapping[str, Any]], seconds: float = 0.0) -> str:
    """Return the command that repeats the first recorded experiment, with another budget [s] or the default for 0."""
    for words in map(_words, records):
        if _is_experiment(words):
            kept, _ = _without(words[5:], ("--budget", "--only", "--out", "-o"))
            kept = [word for word in kept if word not in _LEFT_OUT]
            return shlex.join([*words[:5], *kept, *(["--budget", f"{seconds:.0f}"] if seconds else [])])
    return ""


def plant_file_of(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the plant file that the recorded experiment simulated, as its command names it; empty for a preset."""
    named = (name for record in records for name in _values_of("--plant", _words(record)))
    return next((name for name in named if Path(name).suffix in _PLANT_FILES), "")


def question_of(command: str) -> str:
    """Return the sentence to set behind a command that may move a machine; empty behind one that moves an emulator."""
    hardware = set(_values_of("--hardware", shlex.split(command)))
    moves = {one for one in hardware - {"emulator"} if Path(one).suffix not in _PLANT_FILES}
    return " Where that moves a machine, it asks first." if moves else ""


def _again(record: Mapping[str, Any], plant: str, seen: Set[str]) -> str:
    words = _words(record)
    if not _is_experiment(words):
        return ""
    kept, left = _without(words[5:], _REPLACED)
    seed = left.get("--seed", "1")
    kept = [word for word in kept if word not in _LEFT_OUT]
    first = int(seed) + 1 if seed.isdecimal() else 2
    unseen = next(number for number in count(first) if str(number) not in seen)
    return shlex.join([*words[:5], *kept, "--plant", plant, "--seed", str(unseen)])


def _is_experiment(words: Sequence[str]) -> bool:
    return words[:4] == ["python", "-m", "pendulum_bags", "experiment"] and " ".join(words[4:5]) in _EXPERIMENTS


def _without(words: Sequence[str], names: Collection[str]) -> tuple[list[str], dict[str, str]]:
    """Return words without some options and their values, and the last value of each."""
    kept: list[str] = []
    left: dict[str, str] = {}
    rest = iter(words)
    for word in rest:
        name, has_value, value = word.partition("=")
        if name in names:
            left[name] = value if has_value else next(rest, "")
        elif not (word.startswith("-o") and word[1:2] != "-"):
            kept.append(word)
    return kept, left


def _values_of(option: str, words: Sequence[str]) -> list[str]:
    attached = [word.partition("=")[2] for word in words if word.startswith(f"{option}=")]
    return [value for name, value in pairwise(words) if name == option] + attached


def _words(record: Mapping[str, Any]) -> list[str]:
    try:
        words = shlex.split(str(record.get("command", "")))
    except ValueError:  # a quote without its end: by hand
        return []
    return ["python", "-m", "pendulum_bags", *words[2:]] if Path("".join(words[1:2])).name == "pendulum" else words
