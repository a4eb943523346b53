"""Checks that pooled runs are independent recordings of the same experiment."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.runs.run_data import RunData, is_in_lockstep
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import load_plant

__all__ = ["check_clocks", "check_pairs"]

_MUST_AGREE: tuple[tuple[str, str], ...] = (
    ("controller", "controllers"),
    ("strategy", "effort strategies"),
    ("set_point", "set-points"),
    ("plant", "plants"),
    ("emulated_plant", "emulated plants"),
    ("design_plant", "plants of the design"),
    ("simulation", "simulations"),
)
_PLANTS = ("plant", "emulated_plant", "design_plant")
_OF_THE_NOISE = ("kind", "amplitude", "hold_time")


def check_pairs(pairs: Sequence[tuple[RunData, RunData]]) -> None:
    """Refuse swapped sides, different controllers, and a recording or a seed that is given twice.

    Runs to pool must also agree in controller, disturbance and plant. Raises a DataError.
    """
    for simulation, hardware in pairs:
        _check_sides(simulation, hardware)
    if len(pairs) < 2:
        return
    for side in (0, 1):
        runs = [pair[side] for pair in pairs]
        for i, run in enumerate(runs):
            for other in runs[:i]:
                _check_two(other, run)
    _check_seeds([pair[1] for pair in pairs])


def check_clocks(runs: Sequence[RunData]) -> None:
    """Refuse to pool runs in lockstep with runs in real time, whose loops have a random phase."""
    clocks = ["lockstep" if is_in_lockstep(run) else "real time" for run in runs]
    for clock, run in zip(clocks, runs, strict=True):
        if clock != clocks[0]:
            _refuse("clocks", clocks[0], clock, runs[0], run)


def _check_sides(simulation: RunData, hardware: RunData) -> None:
    first, second = run_record(simulation.metadata), run_record(hardware.metadata)
    if first.get("namespace") == "/hw" and second.get("namespace") == "/sim":
        raise DataError(
            f"{simulation.source} is a recording of hardware and {hardware.source} one of the simulation; "
            "expected the simulation first"
        )
    # A bag may hold both plants: compare motions.
    if np.array_equal(simulation.window.position, hardware.window.position) and np.ptp(hardware.window.position) > 0.0:
        raise DataError(
            f"{simulation.source} and {hardware.source} hold one and the same recording; expected one of each plant"
        )
    ones, others = first.get("controller"), second.get("controller")
    if ones is not None and others is not None and _plain(ones) != _plain(others):
        raise DataError(
            f"simulation and hardware had different controllers ({_text(ones)} in {simulation.source}, "
            f"{_text(others)} in "
            f"{hardware.source}); expected one"
        )


def _check_two(one: RunData, other: RunData) -> None:
    same_place = bool(one.source) and Path(one.source).resolve() == Path(other.source).resolve()
    a, b = one.window, other.window
    if same_place or (a.t.size == b.t.size and np.array_equal(a.position, b.position) and np.ptp(a.position) > 0.0):
        raise DataError(
            f"{one.source} and {other.source} hold one and the same recording; expected independent runs to pool"
        )
    first, second = run_record(one.metadata), run_record(other.metadata)
    for key, words in _MUST_AGREE:
        if key in first and key in second and _value(key, first[key]) != _value(key, second[key]):
            _refuse(words, first[key], second[key], one, other)
    noises = [record.get("disturbance") for record in (first, second)]
    if all(isinstance(noise, Mapping) for noise in noises):
        for key in _OF_THE_NOISE:
            before, after = (noise.get(key) if noise else None for noise in noises)
            if before is not None and after is not None and _plain(before) != _plain(after):
                _refuse(f"disturbances, in {key.replace('_', ' ')}", before, after, one, other)


def _refuse(words: str, first: Any, second: Any, one: RunData, other: RunData) -> None:
    raise DataError(
        f"runs with different {words} cannot be pooled: {_text(first)} in {one.source}, {_text(second)} in "
        f"{other.source}; "
        "compare them one at a time"
    )


def _check_seeds(runs: Sequence[RunData]) -> None:
    seen: dict[str, RunData] = {}
    for run in runs:
        record = run_record(run.metadata)
        seed = record.get("seed")
        if seed is None:
            continue
        if str(seed) in seen:
            raise DataError(
                f"{seen[str(seed)].source} and {run.source} have one seed ({seed}), so one and the "
                "same noise; expected "
                "independent runs to pool, such as one recorded with another --seed"
            )
        seen[str(seed)] = run


def _value(key: str, value: Any) -> str:
    """Return what two runs must have in common: of a plant file its contents, not its path."""
    if key in _PLANTS and isinstance(value, str):
        with suppress(ParameterError):
            return describe_plants([load_plant(value)])
    return _plain(value)


def _plain(value: Any) -> str:
    """Normalise values that JSON, YAML and Python write differently."""
    return json.dumps(_numbers(value), sort_keys=True)


def _numbers(value: Any) -> Any:
    if isinstance(value, bool):
        return value
    if isinstance(value, (int, float)):
        return float(value)
    if isinstance(value, Mapping):
        return {key: _numbers(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_numbers(item) for item in value]
    return value


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {item}" for key, item in value.items()).replace("kind ", "")
    return str(value)
