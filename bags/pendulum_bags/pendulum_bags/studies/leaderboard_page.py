"""The leaderboard as one self-contained page: a sortable table for each plant, the motion behind each line."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pendulum_bags.pages.html import encoded, render_plain
from pendulum_bags.runs.run_folder import git_revision, versions
from pendulum_bags.studies.leaderboard import (
    COSTS,
    GOAL_ANGLE,
    GOAL_VELOCITY,
    HARDWARE,
    HOLD_TIME,
    PATIENCE,
    PERTURBATIONS,
    Entry,
)
from pendulum_msgs_py.atomic_write import write_atomically

__all__ = ["best_sentence", "to_json", "write_page"]

_ORDER = "v2"


def write_page(path: Path, entries: Sequence[Entry], duration: float) -> Path:
    """Write the page for runs of ``duration`` [s] and return its path."""
    plants: dict[str, list[dict[str, Any]]] = {entry.plant: [] for entry in entries}
    for entry in sorted(entries, key=lambda one: -one.scores.get(_ORDER, -math.inf)):
        plants[entry.plant].append(_row(entry))
    heads = [("controller", ""), ("up", ""), ("v1", ""), ("v2", ""), ("v3", "")]
    heads += [(cost.name.replace("_", " "), cost.unit) for cost in COSTS]
    heads += [(name.replace("_", " "), "%") for name in PERTURBATIONS]
    text = render_plain(
        "leaderboard.html.j2",
        plants=plants,
        hardware=HARDWARE,
        heads=heads,
        duration=f"{duration:g}",
        angle=GOAL_ANGLE,
        velocity=GOAL_VELOCITY,
        hold=f"{HOLD_TIME:g}",
        patience=PATIENCE,
        sentence=best_sentence(entries),
        provenance={"revision": git_revision() or "unknown", **versions()},
    )
    write_atomically(path, text)
    return path


def best_sentence(entries: Sequence[Entry]) -> str:
    """Return the best controller on each plant, and its lead, as a sentence."""
    said = []
    for plant in dict.fromkeys(entry.plant for entry in entries):
        able = [entry for entry in entries if entry.plant == plant and entry.success]
        total = sum(entry.plant == plant for entry in entries)
        if not able:
            said.append(f"On {plant} none of {total} controllers brings the pendulum up.")
            continue
        first = max(able, key=lambda one: one.scores[_ORDER])
        fastest = min(able, key=lambda one: one.costs["time"])
        said.append(
            f"On {plant}, {len(able)} of {total} controllers bring the pendulum up; {first.controller} has the best "
            f"score ({_ORDER} {first.scores[_ORDER]:.3f}), {fastest.controller} is the fastest "
            f"({fastest.costs['time']:.2f} s)."
        )
    return " ".join(said)


def to_json(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the board as JSON."""
    return [
        {
            "plant": entry.plant,
            "controller": entry.controller,
            "reason": entry.reason,
            "success": entry.success,
            "scores": dict(entry.scores),
            "costs": dict(entry.costs),
            "robustness": dict(entry.robustness),
            "wall_s": entry.wall,
        }
        for entry in entries
    ]


def _row(entry: Entry) -> dict[str, Any]:
    cells: list[tuple[str, float | str]] = [("yes" if entry.success else "no", int(entry.success))]
    cells += [_cell(entry.scores.get(name), ".3f") for name in ("v1", "v2", "v3")]
    cells += [_cell(entry.costs.get(cost.name), ".3g") for cost in COSTS]
    cells += [_cell(entry.robustness.get(name), ".0f", 100.0) for name in PERTURBATIONS]
    return {
        "controller": entry.controller,
        "anchor": f"{entry.plant}-{entry.controller}",
        "cells": cells,
        "reason": entry.reason,
        "image": _image(entry) if entry.motion.size else "",
    }


def _cell(value: float | None, form: str, scale: float = 1.0) -> tuple[str, float | str]:
    return ("–", "-1e9") if value is None else (format(scale * value, form), value)


def _image(entry: Entry) -> str:
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(6.6, 3.3), layout="constrained")
    upper, lower = canvas.subplots(2, 1, sharex=True)
    t, angle, torque = entry.motion
    upper.plot(t, angle, color="#0072b2", lw=1.2)
    upper.axhline(0.0, color="#999999", lw=0.8, ls="--")
    upper.set_ylabel("theta - pi [rad]")
    lower.step(t, torque, color="#d55e00", lw=1.0, where="post")
    lower.set_ylabel("torque [N m]")
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        axes.grid(color="#dddddd", lw=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    sink = io.BytesIO()
    canvas.savefig(sink, format="png", dpi=100)
    return encoded(sink.getvalue())
