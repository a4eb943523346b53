"""Good recordings, made by SciPy alone, with one thing spoiled, and what a verdict on them names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Geometry, Options
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.errors import PendulumError
from pendulum_testing.scipy_pendulum import Array, coulomb_pendulum, tones

__all__ = ["NOISE", "PERIOD", "QUICK", "SPOILS", "TAKEN", "Spoiled", "good", "hinted", "pendulum", "spoil", "verdict"]

PERIOD, NOISE = 0.01, 5e-4
QUICK = Options(friction="coulomb", multi_start=False, folds=2)

WORDS = {
    "unit": r"in degrees|in revolutions|is the unit deg|unit: (deg|rev)",
    "zero": r"measured from",
    "sign": r"opposite sign",
    "wrap": r"it was wrapped",
    "gap": r"no samples for",
    "time": r"is the unit ms|time steps back",
    "clock": r"stamps of the torque",
    "torque": r"torque is [-\d.e]+ (N m )?throughout",
    "velocity": r": the velocity is",
    "position": r"moves by",
    "gain": r"CONTRADICTION",
    "window": r"--window",
    "hand": r"function of the angle alone",
    "columns": r"exchanged|swapped",
}
"""How a sentence names a cause."""


@dataclass(frozen=True)
class Spoiled:
    """A table of time, position, velocity and torque, and how it is identified."""

    table: Array
    options: Options = QUICK


@cache
def pendulum(seed: int) -> dict[str, float]:
    """Return inertia, damping and gravity of a pendulum."""
    rng = np.random.default_rng([seed, 1])
    inertia, frequency = float(np.exp(rng.uniform(np.log(0.02), np.log(0.2)))), rng.uniform(3.5, 7.0)
    return {
        "inertia": inertia,
        "gravity": inertia * frequency**2,
        "damping": rng.uniform(0.02, 0.12) * inertia * frequency,
    }


@cache
def good(seed: int, seconds: float = 6.0) -> Array:
    """Return the table of a pendulum that swings through large angles."""
    rng, arm = np.random.default_rng(seed), pendulum(seed)
    time = PERIOD * np.arange(round(seconds / PERIOD), dtype=np.float64)
    drive = tones(rng, rng.uniform(0.8, 1.3) * arm["gravity"])
    dry = rng.uniform(0.0, 0.06) * arm["gravity"]
    angle = coulomb_pendulum(drive, time, coulomb=dry, start=(rng.uniform(0.5, 1.5), 0.0), **arm)
    noisy = angle + NOISE * rng.standard_normal(time.size)
    return np.column_stack((time, noisy, np.gradient(angle, time), drive(time)))


@cache
def whirling(seed: int) -> Array:
    """Return the table of a pendulum that is driven over the top again and again."""
    rng, arm = np.random.default_rng(seed), pendulum(seed)
    time = PERIOD * np.arange(800, dtype=np.float64)
    drive = tones(rng, 2.7 * arm["gravity"], lowest=0.5)
    angle = coulomb_pendulum(drive, time, coulomb=0.03 * arm["gravity"], start=(2.5, 0.0), **arm)
    return np.column_stack(
        (time, angle + NOISE * rng.standard_normal(time.size), np.gradient(angle, time), drive(time))
    )


def _scaled(*factors: float) -> Callable[[Array, int], Spoiled]:
    return lambda table, _: Spoiled(table * np.array(factors))


def _shifted(angle: float) -> Callable[[Array, int], Spoiled]:
    return lambda table, _: Spoiled(table + np.array([0.0, angle, 0.0, 0.0]))


def _ordered(*order: int) -> Callable[[Array, int], Spoiled]:
    return lambda table, _: Spoiled(table[:, list(order)])


def _wrapped(_: Array, seed: int) -> Spoiled:
    # Only an angle that passes the top can wrap.
    table = whirling(seed)
    return Spoiled(np.column_stack((table[:, 0], np.angle(np.exp(1j * table[:, 1])), table[:, 2:])))


def _late(table: Array, seed: int) -> Spoiled:
    torque = np.interp(table[:, 0] - 0.5 * (-1) ** seed, table[:, 0], table[:, 3])
    return Spoiled(np.column_stack((table[:, :3], torque)))


def _stepped_back(table: Array, _: int) -> Spoiled:
    return Spoiled(
        np.column_stack((np.where(np.arange(len(table)) < 300, table[:, 0], table[:, 0] - 1.0), table[:, 1:]))
    )


def _gain(table: Array, seed: int) -> Spoiled:
    known = Geometry(pendulum(seed)["gravity"] / 9.80665 / 0.15, 0.15)
    return Spoiled(table * np.array([1.0, 1.0, 1.0, 2.5]), replace(QUICK, geometry=known))


SPOILS: dict[str, tuple[str | None, Callable[[Array, int], Spoiled]]] = {
    "degrees": ("unit", _scaled(1.0, 180 / np.pi, 180 / np.pi, 1.0)),
    "revolutions": ("unit", _scaled(1.0, 0.5 / np.pi, 0.5 / np.pi, 1.0)),
    "upright": ("zero", _shifted(np.pi)),
    "horizontal": ("zero", _shifted(-np.pi / 2)),
    "elsewhere": ("zero", _shifted(1.1)),
    "sign": ("sign", _scaled(1.0, 1.0, 1.0, -1.0)),
    "mirrored": ("sign", _scaled(1.0, -1.0, -1.0, 1.0)),
    "wrap": ("wrap", _wrapped),
    "gap": ("gap", lambda t, s: Spoiled(np.delete(t, np.s_[250:330], axis=0))),
    "milliseconds": ("time", _scaled(1e3, 1.0, 1.0, 1.0)),
    "clock back": ("time", _stepped_back),
    "clock": ("clock", _late),
    "dead torque": ("torque", _scaled(1.0, 1.0, 1.0, 0.0)),
    "stuck torque": ("torque", lambda t, s: Spoiled(np.column_stack((t[:, :3], np.full(len(t), 0.3))))),
    "dead velocity": ("velocity", _scaled(1.0, 1.0, 0.0, 1.0)),
    "velocity in degrees": ("velocity", _scaled(1.0, 1.0, 180 / np.pi, 1.0)),
    "velocity negated": ("velocity", _scaled(1.0, 1.0, -1.0, 1.0)),
    "dead position": ("position", _scaled(1.0, 0.0, 0.0, 1.0)),
    "position and velocity": ("columns", _ordered(0, 2, 1, 3)),
    "position and torque": ("columns", _ordered(0, 3, 2, 1)),
    "velocity and torque": ("columns", _ordered(0, 1, 3, 2)),
    "degrees alone": ("unit", lambda t, s: Spoiled(t[:, [0, 1, 3]] * np.array([1.0, 180 / np.pi, 1.0]))),
    "upright alone": ("zero", lambda t, s: Spoiled(t[:, [0, 1, 3]] - np.array([0.0, np.pi, 0.0]))),
    "gain": ("gain", _gain),
    "short window": ("window", lambda t, s: Spoiled(t, replace(QUICK, window=0.04))),
    "long window": ("window", lambda t, s: Spoiled(whirling(s), replace(QUICK, window=8.0))),
    "chaos": (None, lambda t, s: Spoiled(whirling(s))),
    "nothing": (None, lambda t, s: Spoiled(t)),
}
"""What is spoiled: the cause to be named, and how."""

TAKEN = {"sign", "mirrored", "wrap", "gap", "clock back", "chaos", "nothing"}
"""What a fit is taken in spite of, with a word; everything else is refused."""


def spoil(name: str, seed: int) -> Spoiled:
    """Return a recording of which one thing is spoiled."""
    return SPOILS[name][1](good(seed), seed)


def hinted(spoiled: Spoiled, said: str) -> tuple[Options, dict[str, Any]] | None:
    """Return options and mapping as a hint says; None where it says of none what to write."""
    columns = ["position", "velocity", "torque"] if spoiled.table.shape[1] == 4 else ["position", "torque"]
    rules: dict[str, Any] = {name: {"column": name} for name in columns}
    rules |= {"time": {"column": "time", "unit": "s"}, "input": rules.pop("torque")}
    rules["position"]["unit"], rules["input"]["unit"] = "rad", "N m"
    rules["input"]["hold"] = "linear"
    if "velocity" in rules:
        rules["velocity"]["unit"] = "rad/s"
    options, text = spoiled.options, said
    if found := re.search(r"is the unit (ms)|unit: (deg|rev)|is the unit (deg)", text):
        where, unit = ("time", "ms") if found[1] else ("position", found[2] or found[3])
        rules[where]["unit"] = unit
        if where == "position" and "velocity" in rules:
            rules["velocity"]["unit"] = f"{unit}/s"
    if offset := re.search(r"`offset: (\S+?)`", text):
        rules["position"]["offset"] = float(offset[1])
    if "`sign: -1` of `input`" in text:
        rules["input"]["sign"] = -1
    if "Leave out --window" in text:
        options = replace(options, window=None)
    if swap := re.search(r"columns of (\w+) and (\w+) seem to be exchanged", text):
        one, other = rules[swap[1]], rules[swap[2]]
        one["column"], other["column"] = other["column"], one["column"]
    if "looks like deg/s" in text:
        rules["velocity"]["unit"] = "deg/s"
    if "reversed sign in the velocity" in text:
        rules["velocity"]["sign"] = -1
    if "another column in a mapping file, or none" in text and "velocity" in rules:
        del rules["velocity"]
    written = options, rules
    return None if said and written == (spoiled.options, (hinted(spoiled, "") or written)[1]) else written


def verdict(spoiled: Spoiled, path: Path, mapping: dict[str, Any] | None = None) -> tuple[set[str], bool, list[str]]:
    """Return the causes that are named, whether the recording is refused, and what is said of it."""
    header = "time,position,velocity,torque" if spoiled.table.shape[1] == 4 else "time,position,torque"
    np.savetxt(path, spoiled.table, delimiter=",", header=header, comments="", fmt="%.7g")
    try:
        result = identify([read_recording(path, mapping)], spoiled.options, profiles=0)
    except PendulumError as error:
        said, refused = [str(error)], True
    else:
        said = result.sentences()
        refused = result.refused or (result.geometry is not None and result.geometry.contradicts)
    named = {cause for cause, words in WORDS.items() if any(re.search(words, one) for one in said)}
    return named, refused, said
