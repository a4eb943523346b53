"""``python -m pendulum_lqr design``: design gains for lists of weights, and draw the figures of one."""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # before anything that imports numpy
# isort: on

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from pendulum_lqr.design_command.certificate_table import certificate_document, certify_rows, print_certificates
from pendulum_lqr.design_command.design_tables import (
    RowTable,
    hidden_and_late,
    margin_cells,
    pole_cell,
    print_time_figures,
    print_worst_cases,
    time_cell,
)
from pendulum_lqr.design_command.time_figures import time_figures
from pendulum_lqr.design_command.tracking_table import design_tracking, print_tracking, tracking_document
from pendulum_lqr.linear.analysis import LoopReport, analyse
from pendulum_lqr.linear.design import Gain, output_lqr
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.parameter_box import UNCERTAIN, parse_box, worst_case
from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import json_text
from pendulum_msgs_py.plants.determined import require_determined
from pendulum_msgs_py.plants.plant_parameters import (
    MECHANISM_PRESETS,
    PRESET_NAMES,
    PlantParameters,
    load_mechanism,
)
from pendulum_msgs_py.programs.executables import command_line
from pendulum_msgs_py.programs.options import Json
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["THESIS_CHOICE", "THESIS_WEIGHTS", "main", "read_diagonal"]

THESIS_WEIGHTS: tuple[tuple[tuple[float, float], float], ...] = (
    ((1.0, 0.01), 0.1),
    ((1.0, 0.1), 0.1),
    ((100.0, 0.01), 0.1),
    ((100.0, 0.1), 0.1),
)
"""Combinations 1 to 4 of the thesis: (q11, q22) and r."""
THESIS_CHOICE = 3
"""Combination that the thesis runs on its hardware."""


def design(
    preset: Annotated[
        str, typer.Option(help=f"Plant: {PRESET_NAMES}; of several joints: {', '.join(MECHANISM_PRESETS)}.")
    ] = "thesis",
    plant: Annotated[Path | None, typer.Option(help="Plant file, instead of a preset.")] = None,
    q: Annotated[
        list[str] | None, typer.Option(help="Diagonal of Q, as 100,0.01; may be given again for more rows.")
    ] = None,
    r: Annotated[list[float] | None, typer.Option(help="R; may be given again. Every Q meets every R.")] = None,
    theta: Annotated[float, typer.Option(help="Angle of the fixed point, 0 hanging down [rad].")] = UPRIGHT,
    effort_limit: Annotated[float, typer.Option(help="Torque limit [N m]; 0 for the plant's.")] = 0.0,
    figures: Annotated[Path | None, typer.Option(help="Folder for the figures (PNG).")] = None,
    row: Annotated[int, typer.Option(help="Row that the figures show; 0 for the thesis's choice or the last.")] = 0,
    machine: Annotated[
        Path | None,
        typer.Option(
            help="Measured response of a machine (hw_response.json of experiment frequency_response, or its folder): "
            "say which rows are certified for it."
        ),
    ] = None,
    uncertainty: Annotated[
        list[str] | None,
        typer.Option(
            help="Worst margins over plants that are possible: inertia=10%, or transport_delay=0:0.01 (lowest and "
            f"highest value); may be given again ({', '.join(UNCERTAIN)}; of several joints mass_2=10% or "
            "elbow.damping=20%). Or identified: intervals of the plant file."
        ),
    ] = None,
    tracking: Annotated[
        list[str] | None,
        typer.Option(
            help="Say what lqr_tracking does with the weights of the row that --row chooses: one of its parameters as "
            "amplitude=0.3, or period=0.002 (of the loop, 0.01 s without it); may be given again."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Design LQR gains: eigenvalues, K, margins, largest stable sampling period, figures in time, worst case.

    The model is that of the plant as simulated: motor, spring and lag have states, and the margins count the delay.
    K acts on angle and velocity, which are what is measured. Without --q and --r the four combinations of the thesis
    are designed. Example:

        python -m pendulum_lqr design --preset dfki --q 10,1 --q 100,1 --r 1 --figures build/design

        python -m pendulum_lqr design --plant identified.yaml --uncertainty identified

        python -m pendulum_lqr design --preset dfki --tracking reference=sine --tracking frequency=0.3

    Of a plant of several joints Q has a weight for each joint and then for each velocity:

        python -m pendulum_lqr design --preset cart_pole --q 10,100,1,1 --r 0.1
    """
    chosen_plant = str(plant) if plant is not None else preset
    require_determined(chosen_plant)
    parameters = load_mechanism(chosen_plant)
    own: Sequence[tuple[tuple[float, ...], float]] = THESIS_WEIGHTS
    fixed, limit = theta if parameters.is_pendulum else None, 0.0
    if parameters.is_pendulum:
        limit = _limit(effort_limit, parameters.effort_limit)
    else:
        own = (parameters.weights,)
        if any((theta != UPRIGHT, effort_limit, tracking)):
            raise ParameterError(
                f"plant {chosen_plant!r} has several joints; expected --theta, --effort-limit and --tracking left out: "
                "a passive joint follows no reference of its own"
            )
        if (driven := len(parameters.effort_limits)) > 1 and (machine or uncertainty):
            raise ParameterError(
                f"plant {chosen_plant!r} has {driven} motors; expected --machine and --uncertainty left out: margins "
                "are those of one motor's loop"
            )
    table = _designed(parameters, linearise(parameters, fixed), q, r, own, row)
    model, gains, weights, chosen = table.model, table.gains, table.weights, table.chosen
    certified = certify_rows(machine, parameters, model, gains) if machine is not None else None
    follower = design_tracking(tracking, parameters, weights[chosen - 1], limit) if tracking else None
    in_time = [time_figures(model, gain.K, parameters) for gain in gains] if parameters.is_pendulum else []
    box = parse_box(uncertainty, parameters, plant) if uncertainty else None
    worst = []
    if box is not None:
        possible = box.plants(parameters)
        print(f"asking {len(possible)} plants with {len(gains)} gains ...", file=sys.stderr)
        worst = [worst_case(possible, gain.K, fixed, tuple(box.bounds)) for gain in gains]
    if as_json:
        document = table.document()
        for line, figure in zip(document["rows"][1:], in_time, strict=parameters.is_pendulum):
            line["time"] = None if figure is None else figure.to_dict()
        if box is not None:
            document["uncertainty"] = {"source": box.source, "bounds": {n: list(b) for n, b in box.bounds.items()}}
            for line, case in zip(document["rows"][1:], worst, strict=True):
                line["worst_case"] = case.to_dict()
        if follower is not None:
            document["tracking"] = tracking_document(follower)
        if certified is not None:
            document["machine"] = certificate_document(*certified)
        sys.stdout.write(json_text(document) + "\n")
    else:
        console = make_console(highlight=False)
        table.show(console)
        if parameters.is_pendulum:
            print_time_figures(console, in_time, chosen, limit)
        if box is not None:
            print_worst_cases(console, parameters, box, worst, chosen)
        if follower is not None:
            print_tracking(console, follower, chosen)
        if certified is not None:
            print_certificates(console, *certified, chosen)
    if figures is not None:
        for path in _save(parameters, table, limit, figures):
            print(path, file=sys.stderr if as_json else sys.stdout)


def _limit(given: float, plants_own: float) -> float:
    if not (math.isfinite(given) and given >= 0.0):
        raise ParameterError(f"--effort-limit is {given} N m; expected a finite number > 0, or 0 for the plant's")
    return given or plants_own


@dataclass(frozen=True)
class _Table:
    """Gains of a plant for pairs of weights, and their figures, preceded by those without feedback."""

    plant: PlantParameters
    model: LinearModel
    weights: Sequence[tuple[tuple[float, ...], float]]
    gains: Sequence[Gain]
    reports: Sequence[LoopReport]
    chosen: int

    def document(self) -> dict[str, Any]:
        model, rows = self.model, []
        for index, report in enumerate(self.reports):
            row: dict[str, Any] = {"combination": index, "q": None, "r": None, **report.to_dict()}
            if index:
                row["q"], row["r"] = list(self.weights[index - 1][0]), self.weights[index - 1][1]
                row["K"] = self.gains[index - 1].K.tolist()
            rows.append(row)
        return {
            "plant": self.plant.name,
            "joints": list(self.plant.coordinates.names),
            "driven": list(self.plant.coordinates.driven_names),
            "command_unit": self.plant.coordinates.drive_unit,
            "theta": model.theta,
            "effort": model.effort,
            "position": list(model.position),
            "efforts": list(model.efforts),
            "states": list(model.states),
            "delay": model.delay,
            "A": model.A.tolist(),
            "B": model.B.tolist(),
            "C": model.C.tolist(),
            "E": model.E.tolist(),
            "rows": rows,
        }

    def show(self, console: Console) -> None:
        for line in self._plant_lines():
            console.print(line)
        left = {"Q", "eigenvalues \\[1/s]", "computed", "K"}
        headings = ("#", "Q", "r", "eigenvalues \\[1/s]", "computed", "K", "tau \\[s]", "damping")
        table = RowTable("Eigenvalues and gains", headings, left=left, no_wrap=True)
        margins_table = RowTable(
            "Robustness of the loop",
            ("#", "gain up", "gain down", "phase margin", "delay margin", "modulus", "largest period"),
        )
        for index, report in enumerate(self.reports):
            cells = ["\u2013"] * 3
            if index:
                diagonal, cost = self.weights[index - 1]
                rows = (", ".join(f"{value:.6f}" for value in row) for row in self.gains[index - 1].rows)
                cells = [", ".join(f"{value:g}" for value in diagonal), f"{cost:g}", "\n".join(rows)]
            table.add(
                index,
                *cells[:2],
                pole_cell(report.poles),
                pole_cell(report.poles, 6),
                cells[2],
                f"{report.time_constant:.4f}" if report.stable else "unstable",
                f"{report.damping_ratio:.3f}",
                chosen=self.chosen,
            )
            if index:
                margins = ["\u2013"] * 5 if report.margins is None else margin_cells(report.margins)
                period = time_cell(report.largest_period) if report.largest_period else "none"
                margins_table.add(index, *margins, period, chosen=self.chosen)
        console.print(table)
        console.print(margins_table)
        report = self.reports[self.chosen]
        K = ", ".join(f"{value:.3f}" for value in report.K)
        slowest = report.poles[0].real
        rounded = f"; from the rounded eigenvalue 1/{-slowest:.2f} = {1.0 / round(-slowest, 2):.4f} s"
        console.print(
            f"combination {self.chosen}: K = \\[{K}], tau = {report.time_constant:.4f} s{rounded * (slowest < -0.005)}"
        )

    def _plant_lines(self) -> list[str]:
        """Return sentences on the plant of the design."""
        model, joints = self.model, self.plant.coordinates.joints
        at = ", ".join(
            f"{state} = {value:.4f} {joint.unit}"
            for state, value, joint in zip(model.states, model.position, joints, strict=False)
        )
        held = ", ".join(
            f"{value:.4g} {'V' if self.plant.coordinates.volts else joints[index].effort_unit}"
            for index, value in zip(self.plant.coordinates.driven, model.efforts, strict=True)
        )
        what = f"states {', '.join(model.states)};"
        if model.states == ("theta", "theta_dot"):
            a, b = model.A[1], model.B[1, 0]
            what = f"A = [[0, 1], [{a[0]:.2f}, {a[1]:.2f}]], B = [0, {b:.2f}],"
        lines = [f"plant {self.plant.name} at {at}: {what} u* = {held}", *hidden_and_late(model)]
        for index, actuator in zip(self.plant.coordinates.driven, self.plant.actuators, strict=True):
            if (of := actuator.motor) is not None:
                joint = joints[index]
                lines.append(
                    f"K in V per unit of its state: the motor of {joint.name} gives {of.gain:.4g} "
                    f"{joint.effort_unit}/V, damps by {of.damping:.4g} {joint.damping_unit}"
                )
        if not self.plant.is_pendulum and self.plant.has_dry_friction:
            lines.append(
                "dry friction has no derivative at rest and is not in the model: simulate the loop to see its cost"
            )
        return lines


def _designed(
    plant: PlantParameters,
    model: LinearModel,
    q: Sequence[str] | None,
    r: Sequence[float] | None,
    own: Sequence[tuple[tuple[float, ...], float]],
    row: int,
) -> _Table:
    """Return the gains of every Q with every R, by default of the plant's own weights."""
    weights = [*own]
    if q or r:
        diagonals = (
            [read_diagonal(text, model.measured) for text in q] if q else sorted({diagonal for diagonal, _ in own})
        )
        weights = [(diagonal, cost) for diagonal in diagonals for cost in r or [own[0][1]]]
    if not 0 <= row <= len(weights):
        raise ParameterError(f"--row is {row}; expected 1 to {len(weights)}, or 0 for the default")
    gains = [output_lqr(model, diagonal, cost) for diagonal, cost in weights]
    reports = [analyse(model, None), *(analyse(model, gain.K) for gain in gains)]
    usual = THESIS_CHOICE if weights == [*THESIS_WEIGHTS] and not (q or r) else len(weights)
    return _Table(plant, model, weights, gains, reports, row or usual)


def read_diagonal(text: str, states: Sequence[str] = ("theta", "theta_dot")) -> tuple[float, ...]:
    """Return the diagonal of Q from a text such as ``100,0.01``; ParameterError without one weight per state."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != len(states):
        raise ParameterError(f"--q is {text!r}; expected {len(states)} numbers, for {', '.join(states)}, as 100,0.01")
    return values


def _save(plant: PlantParameters, table: _Table, effort_limit: float, folder: Path) -> list[Path]:
    # Imported late: only --figures needs matplotlib.
    from pendulum_lqr.design_command.figures import design_figures

    rows = [
        (f"{index}: Q = ({', '.join(f'{weight:g}' for weight in diagonal)}), R = {cost:g}", gain)
        for index, ((diagonal, cost), gain) in enumerate(zip(table.weights, table.gains, strict=True), start=1)
    ]
    paths = []
    with writing(f"figures in {folder}", ParameterError):
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in design_figures(plant, table.model, rows, table.chosen - 1, effort_limit).items():
            path = folder / f"{name}.png"
            figure.savefig(path)
            paths.append(path)
    return paths


main = command_line(design, "python -m pendulum_lqr design")
