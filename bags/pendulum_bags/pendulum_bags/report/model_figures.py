"""Figures of the model: overdamped phase plot, torque over sin(theta), replay of real recordings."""

from __future__ import annotations

import math

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.report.data import ReportData
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.plants.equilibrium import overdamped_velocity

__all__ = ["gravity_fit", "overdamped_phase", "replay"]


def overdamped_phase(data: ReportData) -> Figure | str:
    """Return theta' over theta of the overdamped limit b theta' + G sin theta = u0, with its fixed points."""
    plant = data.plant
    if plant is None:
        return "no plant file of the run can be read"
    theta = np.linspace(-math.pi / 2, 2.0 * math.pi, 601)
    half = 0.5 * plant.gravity
    traces = [
        Trace(theta, overdamped_velocity(plant, theta), "u₀ = 0", "sim"),
        Trace(theta, overdamped_velocity(plant, theta, half), f"u₀ = {half:.3g} N m", "own"),
        Trace(theta[[0, -1]], np.zeros(2), "", "reference"),
        Trace(np.array([0.0, 2.0 * math.pi]), np.zeros(2), "stable fixed point", "stable", "points"),
        Trace(np.array([math.pi]), np.zeros(1), "unstable fixed point", "unstable", "points"),
    ]
    slope = plant.gravity / plant.damping
    sentence = (
        f"Without torque the overdamped pendulum rests at 0 (stable) and at π (unstable), from where it falls with a "
        f"rate of {quantity(slope, 's⁻¹')}; a constant torque below G = {quantity(plant.gravity, 'N m', 4)} only "
        "shifts both."
    )
    panel = Panel("θ [rad]", "θ′ [rad/s]", traces)
    return Figure("overdamped_phase", "Overdamped phase plot", sentence, [panel], section="Model", panel_height=260)


def _fit(theta: Array, velocity: Array, torque: Array) -> tuple[Array, float]:
    """Return (G, b, offset) of torque = G sin(theta) + b theta' + offset by least squares, and R^2."""
    columns = np.stack((np.sin(theta), velocity, np.ones_like(theta)), axis=1)
    solution, *_ = np.linalg.lstsq(columns, torque, rcond=None)
    rest = torque - columns @ solution
    spread = float(np.sum((torque - torque.mean()) ** 2))
    return solution, 1.0 - float(rest @ rest) / spread if spread > 0.0 else 0.0


def gravity_fit(data: ReportData) -> Figure | str:
    """Return measured torque over sin(theta) during the ramps, with the least-squares line."""
    panels, words = [], []
    for label, role, runs in (
        ("simulation", "sim", data.comparison.pairs[0].simulation),
        ("hardware", "hw", data.comparison.pairs[0].hardware),
    ):
        start, stop = runs.event_time("ramp_up"), runs.event_time("regulation")
        if start is None or stop is None or runs.measured is None:
            continue
        move = runs.whole.between(start, stop)
        torque = runs.measured.held_at(move.t)
        if float(np.ptp(torque)) == 0.0:
            continue
        (gravity, damping, offset), quality = _fit(move.position, move.velocity, torque)
        sine = np.sin(move.position)
        ends = np.array([float(sine.min()), float(sine.max())])
        step = max(1, move.t.size // 400)
        panels.append(
            Panel(
                "sin θ [−]",
                "torque − b θ′ [N m]",
                [
                    Trace(sine[::step], (torque - damping * move.velocity)[::step], label, role, "points"),
                    Trace(ends, gravity * ends + offset, "least squares", "fit"),
                ],
                title=label.capitalize(),
            )
        )
        words.append(
            f"{label}: G = {quantity(gravity, 'N m', 4)}, b = {quantity(damping, 'N m s/rad', 4)}, "
            f"offset {quantity(offset, 'N m')}, R² = {quality:.3f}"
        )
    if not panels:
        return "needs ramps with measured torque"
    gives = "; ".join(words)
    sentence = f"Least squares of the measured torque on sin θ, θ′ and a constant over the way up gives {gives}."
    if len(panels) == 2 and "strategy" in run_record(data.comparison.pairs[0].hardware.metadata):
        # 11.8 next to 0.002 would suggest a wrong model.
        sentence += (
            " G is comparable, b is not: the simulation's torque overcomes the motor's damping as well, while the "
            "spring of a series-elastic actuator measures only what reaches the link."
        )
    return Figure(
        "gravity_fit",
        "Torque over sin θ",
        sentence,
        panels,
        stacked=False,
        section="Dynamic phase",
        panel_height=230,
    )


def replay(data: ReportData) -> Figure | str:
    """Return measured and simulated angle of a real pendulum under its recorded input."""
    if not data.replays:
        return "no recording of a real pendulum is at hand"
    return data.replays[0].figure()
