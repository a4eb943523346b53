"""The design command's table for plants of several joints."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pendulum_lqr.design_command.design_tables import RowTable, hidden_and_late, pole_cell, time_cell
from pendulum_lqr.linear.analysis import LoopReport, analyse
from pendulum_lqr.linear.design import Gain, output_lqr
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["design_mechanism"]


@dataclass(frozen=True)
class _Row:
    q: tuple[float, ...]
    r: float
    gain: Gain
    report: LoopReport


def design_mechanism(
    plant: MechanismParameters, q: Sequence[str] | None, r: Sequence[float] | None, *, as_json: bool
) -> None:
    """Print the LQR gains of a plant of several joints about upright.

    Args:
        plant: The plant.
        q: Diagonals of Q as text, 2n numbers each; the mechanism's own where there is none.
        r: Weights of the efforts; the mechanism's own where there is none.
        as_json: Print JSON instead of tables.

    Raises:
        ParameterError: A weight is refused, or the plant cannot be held upright.
    """
    model = linearise(plant)
    diagonal, cost = plant.mechanism.weights
    rows = []
    for weights in [_diagonal(text, model.measured) for text in q] if q else [diagonal]:
        for each in r or [cost]:
            gain = output_lqr(model, weights, each)
            rows.append(_Row(weights, each, gain, analyse(model, gain.K)))
    if as_json:
        sys.stdout.write(json_text(_document(plant, model, rows)) + "\n")
    else:
        _print(plant, model, rows)


def _print(plant: MechanismParameters, model: LinearModel, rows: Sequence[_Row]) -> None:
    console = make_console(highlight=False)
    joints = plant.mechanism.joints
    held = ", ".join(
        f"{joint.name} {value:.4f} {joint.unit}" for joint, value in zip(joints, model.position, strict=True)
    )
    driven = ", ".join(
        f"{joints[index].name} {value:.4g} {joints[index].effort_unit}"
        for index, value in zip(plant.coordinates.driven, model.efforts, strict=True)
    )
    console.print(f"plant {plant.name}, a {plant.mechanism.name}, at {held}; held by {driven}")
    console.print(f"states {', '.join(model.states)}; poles without control {pole_cell(model.poles)} 1/s")
    for line in hidden_and_late(model):
        console.print(line)
    if plant.has_dry_friction:
        console.print(
            "dry friction has no derivative at rest and is not in the model: simulate the loop to see its cost"
        )
    headings = ("#", "Q", "r", "eigenvalues \\[1/s]", "K", "tau \\[s]", "delay margin", "largest period")
    left = {"Q", "eigenvalues \\[1/s]", "K", "delay margin", "largest period"}
    table = RowTable("LQR gains, u = -K x", headings, left=left, no_wrap=True)
    for count, row in enumerate(rows, 1):
        report = row.report
        table.add(
            count,
            ", ".join(f"{value:g}" for value in row.q),
            f"{row.r:g}",
            pole_cell(row.gain.poles),
            "\n".join(", ".join(f"{value:.4f}" for value in line) for line in row.gain.rows),
            f"{report.time_constant:.4f}" if report.stable else "unstable",
            "\u2013" if report.margins is None else time_cell(report.margins.delay),
            "none" if not report.largest_period else time_cell(report.largest_period),
        )
    console.print(table)


def _document(plant: MechanismParameters, model: LinearModel, rows: Sequence[_Row]) -> dict[str, Any]:
    return {
        "plant": plant.name,
        "model": plant.mechanism.name,
        "joints": list(plant.coordinates.names),
        "driven": list(plant.coordinates.driven_names),
        "position": list(model.position),
        "efforts": list(model.efforts),
        "states": list(model.states),
        "delay": model.delay,
        "A": model.A.tolist(),
        "B": model.B.tolist(),
        "E": model.E.tolist(),
        "rows": [
            {
                "q": list(row.q),
                "r": row.r,
                "K": row.gain.rows.tolist(),
                "poles": [[pole.real, pole.imag] for pole in row.gain.poles],
                **{key: row.report.to_dict()[key] for key in ("stable", "margins", "largest_period")},
            }
            for row in rows
        ],
    }


def _diagonal(text: str, states: Sequence[str]) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(states):
        raise ParameterError(f"--q is {text!r}; expected {len(states)} numbers, for {', '.join(states)}")
    return values
