"""Tables of ``design``, one row per combination: the loop in time, and the worst case over uncertain plants."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence

from rich.console import Console

from pendulum_lqr.design_command.time_figures import TimeFigures
from pendulum_lqr.linear.analysis import Margins
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.parameter_box import ParameterBox, WorstCase
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = [
    "RowTable",
    "hidden_and_late",
    "margin_cells",
    "pole_cell",
    "print_time_figures",
    "print_worst_cases",
    "time_cell",
]

_ANY_GAIN = 1e6
"""Gain margin from which it is limited by rounding alone."""


class RowTable(WholeTable):
    """A table of combinations, one of them marked.

    Args:
        title: Title.
        headings: Column headings, that of the combination's number first.
        left: Headings of left-aligned columns.
        no_wrap: Break no cell.
    """

    def __init__(self, title: str, headings: Sequence[str], *, left: Collection[str] = (), no_wrap: bool = False):
        super().__init__(title=title, title_justify="left", header_style="bold")
        for heading in headings:
            self.add_column(heading, justify="left" if heading in left else "right", no_wrap=no_wrap)

    def add(self, index: int, *cells: str, chosen: int | None = None) -> None:
        """Add a combination, marked if it is the chosen one."""
        self.add_row(f"{index}", *cells, style="bold cyan" if index == chosen else "")


def margin_cells(margins: Margins) -> list[str]:
    """Return the cells of gain margins up and down, phase margin, delay margin and modulus."""
    return [
        "any" if margins.gain_up > _ANY_GAIN else f"{margins.gain_up:.3f}",
        f"{margins.gain_down:.4f}",
        f"{math.degrees(margins.phase):.2f}\u00b0",
        time_cell(margins.delay),
        f"{margins.modulus:.3f}",
    ]


def time_cell(time: float) -> str:
    """Return the cell of a time, which may be infinite [s]."""
    return f"{time:.4f} s" if math.isfinite(time) else "any"


def pole_cell(poles: Iterable[complex], digits: int = 2) -> str:
    """Return the cell of poles, with conjugate pairs as one."""
    return ", ".join(
        f"{pole.real:.{digits}f}" + (f" \u00b1 {pole.imag:.{digits}f}j" if abs(pole.imag) >= 1e-9 else "")
        for pole in poles
        if pole.imag > -1e-9
    )


def print_time_figures(console: Console, found: Sequence[TimeFigures | None], chosen: int, limit: float) -> None:
    """Print one line per row, and the step from which the chosen one exceeds the torque limit [N m]."""
    table = RowTable(
        "In time (linear, delay included)",
        (
            "#",
            "rise \\[s]",
            "settling \\[s]",
            "overshoot",
            "torque \\[N m/rad]",
            "push rests \\[rad/(N m)]",
            "push peak \\[rad/(N m)]",
            "friction holds \\[rad]",
        ),
    )
    for index, one in enumerate(found, start=1):
        if one is None:
            cells = ["unstable", *["\u2013"] * 6]
        else:
            cells = [f"{one.rise_time:.3f}", f"{one.settling_time:.3f}", f"{100.0 * one.overshoot:.1f} %"]
            cells += [f"{one.step_torque:.4g}", f"{one.push_rest:.4g}", f"{one.push_peak:.4g}"]
            cells.append("none" if one.friction_band == 0.0 else f"{one.friction_band:.4g}")
        table.add(index, *cells, chosen=chosen)
    console.print(table)
    one = found[chosen - 1]
    if one is None:
        return
    console.print(
        f"combination {chosen}: a step of the set-point beyond {limit / one.step_torque:.3g} rad asks for more than "
        f"the {limit:g} N m of the torque limit"
        + (
            f"; dry friction may hold it {one.friction_band:.3g} rad off (lqr_friction and lqi come nearer)"
            if one.friction_band > 0.0
            else ""
        )
    )


def print_worst_cases(
    console: Console, plant: PlantParameters, box: ParameterBox, found: Sequence[WorstCase], chosen: int
) -> None:
    """Print one line per row: the worst of each margin over all plants, and the worst plant."""
    headings = ("#", "not held", "gain up", "gain down", "phase margin", "delay margin", "modulus", "worst at")
    table = RowTable(f"Worst case over {found[0].plants} plants ({box.source})", headings, left={"worst at"})
    for index, one in enumerate(found, start=1):
        margins = one.margins
        cells = ["\u2013"] * 5
        if margins is not None and not one.unstable:
            cells = margin_cells(margins)
        held = f"{one.unstable}" if one.unstable else "none"
        table.add(index, held, *cells, _place(plant, one.where), chosen=chosen)
    console.print(table)
    ranges = ", ".join(
        f"{name} {low:.4g} to {high:.4g} {plant.specs[name].unit}" for name, (low, high) in box.bounds.items()
    )
    one = found[chosen - 1]
    if one.unstable:
        console.print(
            f"combination {chosen} is NOT safe over {ranges}: it does not hold {one.unstable} of {one.plants} plants, "
            f"such as {_place(plant, one.where)}",
            style="bold red",
        )
    else:
        console.print(f"combination {chosen} holds every one of {one.plants} plants over {ranges}")


def _place(plant: PlantParameters, where: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g} {plant.specs[name].unit}" for name, value in where.items())


def hidden_and_late(model: LinearModel) -> list[str]:
    """Return sentences on hidden states and delay that the design neglects."""
    lines = []
    if model.hidden:
        measured = "angle and velocity" if model.measured[0] == "theta" else "positions and velocities"
        lines.append(
            f"{' and '.join(model.hidden)} not measured: K is the best gain on {measured} alone, without "
            "the margins that an LQR on the whole state guarantees; the controller lqg estimates the rest"
        )
    if model.delay > 0.0:
        lines.append(f"transport delay {model.delay:g} s: counted in margins and periods, not in the eigenvalues")
    return lines
