"""Figures of the motion under noise: each plant, both together, their difference, the thesis's interpolation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.pairs import Difference
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.figures.figure import Figure, Kind, Panel, Trace
from pendulum_bags.figures.numbers import quantity, ratio_in_words
from pendulum_bags.report.data import ReportData
from pendulum_bags.runs.run_data import RunData, noise_hold_time
from pendulum_bags.runs.series import Series

__all__ = [
    "both_panel",
    "both_together",
    "difference_panels",
    "hardware_under_noise",
    "interpolation",
    "paired_difference",
    "ramps",
    "simulation_under_noise",
    "torque_and_noise",
    "unpaired_difference",
]

ANGLE = "θ − π [rad]"
VELOCITY = "θ′ [rad/s]"
TORQUE = "torque [N m]"
TIME = "time since the noise began [s]"


def _deviation(series: Series) -> Array:
    return np.asarray(series.position - np.pi)


def _under_noise(run: RunData, role: str, name: str, title: str) -> Figure:
    window = run.window
    whose = "recorded" if run.of_file else "controller"
    torque = [Trace(window.t, window.effort, f"{whose} torque u", role, "step")]
    if run.disturbance is not None:
        torque.insert(0, Trace(run.disturbance.t, run.disturbance.value, "noise d", "noise", "step"))
    hold = noise_hold_time(run)
    held = f", each sample held for {1e3 * hold:.3g} ms" if hold else ""
    sentence = (
        f"Under uniform noise{held}, the angle stays within {quantity(float(np.abs(_deviation(window)).max()), 'rad')} "
        f"of upright (standard deviation {quantity(float(window.position.std(ddof=1)), 'rad')}, "
        f"of the velocity {quantity(float(window.velocity.std(ddof=1)), 'rad/s')}), and the {whose} torque is at most "
        f"{quantity(float(np.abs(window.effort).max()), 'N m')}."
    )
    panels = [
        Panel(TIME, ANGLE, [Trace(window.t, _deviation(window), "", role)]),
        Panel(TIME, VELOCITY, [Trace(window.t, window.velocity, "", role)]),
        Panel(TIME, TORQUE, torque),
    ]
    return Figure(name, title, sentence, panels, section="Plants under noise", panel_height=150)


def simulation_under_noise(data: ReportData) -> Figure:
    """Return the simulation under noise: the thesis's own protocol where it was run."""
    run = data.comparison.own[0]
    own = run is not data.comparison.pairs[0].simulation
    title = "Simulation under noise" + (", by the thesis's own protocol" if own else "")
    return _under_noise(run, "own alone" if own else "sim", "simulation_under_noise", title)


def hardware_under_noise(data: ReportData) -> Figure:
    """Return the hardware under noise."""
    run = data.comparison.pairs[0].hardware
    return _under_noise(run, "hw alone", "hardware_under_noise", "Hardware under noise")


def both_panel(label: str, sim: Series, hw: Series, values: Callable[[Series], Array], kind: Kind = "line") -> Panel:
    """Return one quantity of both plants over time."""
    sides = ((sim, "simulation", "sim"), (hw, "hardware", "hw"))
    return Panel(TIME, label, [Trace(one.t, values(one), title, role, kind) for one, title, role in sides])


def both_together(data: ReportData) -> Figure:
    """Return both plants in one figure."""
    pair = data.comparison.pairs[0]
    sim, hw = pair.simulation.window, pair.hardware.window
    ratio = float(hw.position.std() / sim.position.std())
    fit = 100.0 * (1.0 - float(rms(pair.difference.position) / pair.difference.hardware.position.std()))
    shared = "the same noise" if pair.is_paired else "noise of their own"
    follows = f", and the simulated angle fits the measured one to {fit:.0f} %" if pair.is_paired else ""
    sentence = (
        f"Under {shared}, the spread of the hardware's angle is {quantity(float(hw.position.std(ddof=1)), 'rad')} "
        f"against {quantity(float(sim.position.std(ddof=1)), 'rad')} in simulation ({ratio_in_words(ratio)}){follows}."
    )
    panels = [
        both_panel(ANGLE, sim, hw, _deviation),
        both_panel(VELOCITY, sim, hw, attrgetter("velocity")),
        both_panel(
            f"{'recorded' if pair.hardware.of_file else 'controller'} torque u [N m]",
            sim,
            hw,
            attrgetter("effort"),
            "step",
        ),
    ]
    return Figure(
        "both_together",
        "Simulation and hardware together",
        sentence,
        panels,
        section="Paired comparison",
        panel_height=165,
    )


def torque_and_noise(data: ReportData) -> Figure | str:
    """Return the controllers' torques with the noise, unscaled and scaled to its size."""
    pair = data.comparison.pairs[0]
    noise = pair.hardware.disturbance or pair.simulation.disturbance
    if noise is None:
        return "no disturbance was recorded"
    if data.comparison.of_files:
        return "whether the recorded input holds the disturbance is not known"
    sim, hw = pair.simulation.window, pair.hardware.window
    largest = float(np.abs(noise.value).max())
    reach = max(float(np.abs(sim.effort).max()), float(np.abs(hw.effort).max()))
    factor = reach / largest if largest > 0.0 else 1.0
    used = [
        Trace(sim.t, sim.effort, "simulation u", "sim", "step"),
        Trace(hw.t, hw.effort, "hardware u", "hw", "step"),
    ]
    sentence = (
        f"The noise reaches {quantity(largest, 'N m')}; the controllers respond with at most {quantity(reach, 'N m')}, "
        f"which is {100.0 * factor:.0f} % of it: the plant's damping, not the controller, absorbs the rest. "
        f"Below, the noise is scaled by {factor:.3g}."
    )
    panels = [
        Panel(TIME, TORQUE, [Trace(noise.t, scale * noise.value, "noise d", "noise", "step"), *used], title=title)
        for scale, title in ((1.0, "Unscaled"), (factor, "Noise scaled to the controllers' torque"))
    ]
    return Figure("torque_and_noise", "Torque and noise", sentence, panels, section="Paired comparison")


def interpolation(data: ReportData) -> Figure:
    """Return the hardware's samples and their cubic interpolation at the simulation's stamps."""
    hardware = data.comparison.pairs[0].hardware.window
    difference = data.comparison.thesis
    start = float(difference.t[0])
    stop = min(start + 0.4, float(difference.t[-1]))
    few = hardware.between(start - 1e-9, stop + 1e-9)
    inside = (difference.t >= start) & (difference.t <= stop)
    between = difference.hardware.position[inside] - np.pi
    beyond = float(max(between.max() - _deviation(few).max(), _deviation(few).min() - between.min(), 0.0))
    sentence = (
        f"The hardware's {hardware.t.size} samples ({hardware.rate:.0f} Hz) become {difference.t.size} at the "
        f"simulation's stamps; between samples the spline leaves their range by at most {quantity(beyond, 'rad')} here."
    )
    times = difference.t[inside]
    panels = [
        Panel(
            TIME,
            label,
            [
                Trace(times, smooth, "cubic interpolation", "hw"),
                Trace(few.t, samples, "hardware samples", "difference", "points"),
            ],
        )
        for label, smooth, samples in (
            (ANGLE, between, _deviation(few)),
            (VELOCITY, difference.hardware.velocity[inside], few.velocity),
        )
    ]
    return Figure(
        "interpolation",
        "Original and interpolated hardware data",
        sentence,
        panels,
        section="The thesis's analysis",
    )


def difference_panels(
    differences: Sequence[tuple[str, str, Difference]], position: str = "Δθ [rad]", velocity: str = "Δθ′ [rad/s]"
) -> list[Panel]:
    """Return differences over time, each with its legend and role, under labels for position and velocity."""
    return [
        Panel(TIME, label, [Trace(one.t, getattr(one, name), text, role) for text, role, one in differences])
        for name, label in (("position", position), ("velocity", velocity))
    ]


def unpaired_difference(data: ReportData) -> Figure:
    """Return the thesis's difference over time."""
    difference = data.comparison.thesis
    statistics = difference.statistics()
    position, velocity = statistics["position"], statistics["velocity"]
    holds = data.summary.get("unpaired", {}).get("noise_hold_time", {})
    sim, hw = holds.get("sim"), holds.get("hw")
    warning = ""
    if sim and hw and abs(sim - hw) > 1e-6:
        warning = (
            f" The simulation held each noise sample for {1e3 * sim:.3g} ms, the hardware for {1e3 * hw:.3g} ms: "
            "much of this difference is the noise's, not the plant's."
        )
    sentence = (
        f"Hardware minus simulation has mean {quantity(position['mean'], 'rad')} and standard deviation "
        f"{quantity(position['std'], 'rad')} in angle, {quantity(velocity['mean'], 'rad/s')} and "
        f"{quantity(velocity['std'], 'rad/s')} in velocity.{warning}"
    )
    return Figure(
        "unpaired_difference",
        "Difference over time",
        sentence,
        difference_panels([("hardware − simulation", "difference", difference)]),
        section="The thesis's analysis",
    )


def paired_difference(data: ReportData) -> Figure | str:
    """Return the difference under one disturbance, as recorded and with the delay taken out."""
    pair = data.comparison.pairs[0]
    if not pair.is_paired:
        return str(data.comparison.paired.get("reason", "the disturbances differ"))
    before, after = (rms(one.position) for one in (pair.difference, pair.aligned))
    delay = 1e3 * pair.response.delay
    sentence = (
        f"As recorded, the paths are {quantity(before, 'rad')} apart (rms), which is "
        f"{100.0 * before / float(pair.difference.hardware.position.std()):.0f} % of the hardware's spread; with the "
        f"response delay of {delay:.2f} ms taken out, {quantity(after, 'rad')}."
    )
    differences = [
        ("as recorded", "difference", pair.difference),
        (f"delay of {delay:.1f} ms taken out", "aligned", pair.aligned),
    ]
    return Figure(
        "paired_difference",
        "Difference under the same noise",
        sentence,
        difference_panels(differences),
        section="Paired comparison",
    )


def ramps(data: ReportData) -> Figure | str:
    """Return the moves up and down: position, velocity and torque over time, both plants."""
    pair = data.comparison.pairs[0]
    runs = [("simulation", "sim", pair.simulation), ("hardware", "hw", pair.hardware)]
    moves: dict[str, list[tuple[str, str, Series, float]]] = {"up": [], "down": []}
    for label, role, run in runs:
        for way, (begin, end) in {"up": ("ramp_up", "regulation"), "down": ("ramp_down", "done")}.items():
            start = run.event_time(begin)
            if start is None:
                continue
            stop = run.event_time(end)
            if stop is None:
                stop = 0.0 if way == "up" else float(run.whole.t[-1])
            if stop - start > 20.0 * run.whole.period:
                moves[way].append((label, role, run.whole.between(start, stop), start))
    if not moves["up"] and not moves["down"]:
        return "the recordings have no ramp"
    panels = []
    for way, parts in moves.items():
        for text, name in (("θ [rad]", "position"), (VELOCITY, "velocity")):
            traces = [
                Trace(series.t - start, getattr(series, name), label, role) for label, role, series, start in parts
            ]
            if traces:
                panels.append(
                    Panel(
                        f"time since the ramp {way} began [s]",
                        text,
                        traces,
                        title=f"{text[:2].strip()} {way}",
                    )
                )
    speeds = {label: float(np.median(np.abs(series.velocity))) for label, _, series, _ in moves["up"] or moves["down"]}
    spans = [series.duration for parts in moves.values() for *_, series, _ in parts]
    last = [f"{label} {quantity(float(series.position[-1]), 'rad', 5)}" for label, _, series, _ in moves["up"]]
    reached = f" The way up ends at {' and '.join(last)}." if last else ""
    typical = " and ".join(f"{quantity(speed, 'rad/s')} ({label})" for label, speed in speeds.items())
    sentence = f"A ramp takes {max(spans):.1f} s; the median speed is {typical}.{reached}"
    return Figure(
        "ramps",
        "Ramps up and down",
        sentence,
        panels,
        stacked=False,
        section="Dynamic phase",
        panel_height=180,
    )
