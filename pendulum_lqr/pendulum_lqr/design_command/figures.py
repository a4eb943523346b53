"""Figures of a design: poles, root locus, Bode plot, step response, phase portrait with region of attraction.

Figures are made without pyplot: no global state, no display.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pendulum_lqr.linear.analysis import LoopReport, analyse, closed_loop_poles, loop_transfer
from pendulum_lqr.linear.design import Gain
from pendulum_lqr.linear.model import (
    LinearModel,
    RigidPlant,
    equilibrium_effort,
    low_frequency,
    state_derivative,
)
from pendulum_lqr.linear.roa import Region, region_of_attraction, rigid_rollout
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "bode_figure",
    "design_figures",
    "phase_portrait_figure",
    "pole_map_figure",
    "region_to_show",
    "release_figure",
    "root_locus_figure",
    "step_figure",
]

Array = NDArray[np.float64]

INK, MUTED, GRID = "#1f2a37", "#6b7280", "#e5e7eb"
COLOURS = ("#2563eb", "#dc2626", "#059669", "#d97706", "#7c3aed", "#0891b2")


def _figure(rows: int = 1, height: float = 4.4) -> tuple[Figure, list[Axes]]:
    style: Any = {
        "font.size": 10,
        "axes.edgecolor": MUTED,
        "axes.labelcolor": INK,
        "xtick.color": MUTED,
        "ytick.color": MUTED,
        "text.color": INK,
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(7.2, height), dpi=150, layout="constrained")
        axes = figure.subplots(rows, 1, squeeze=False, sharex=True)[:, 0]
    for ax in axes:
        ax.grid(visible=True, color=GRID, linewidth=0.8)
        ax.set_axisbelow(True)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    return figure, list(axes)


def _legend_below(ax: Axes) -> None:
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=3, frameon=False, fontsize=9)


def _s_plane(ax: Axes, values: NDArray[np.complex128], decades: bool) -> None:
    """Label the s-plane and shade its unstable half; logarithmic real axis for poles decades apart."""
    sizes = np.abs(values.real)
    sizes = sizes[sizes > 0.0]
    if decades:
        threshold = 10.0 ** math.floor(math.log10(max(float(np.min(sizes)), 1e-2)))
        ax.set_xscale("symlog", linthresh=threshold, linscale=0.5)
        ax.set_xlim(-3.0 * float(sizes.max()), 3.0 * max(threshold, float(values.real.max())))
    else:
        reach = 1.25 * float(np.max(np.abs(values.real)))
        ax.set_xlim(-reach, 0.35 * reach)
    height = 1.3 * max(float(np.max(np.abs(values.imag))), 1e-9)
    if height < 1e-6:
        height = 1.0
        ax.set_yticks([0.0])
    ax.set_ylim(-height, height)
    right = ax.get_xlim()[1]
    ax.axvspan(0.0, right, color="#fee2e2", alpha=0.6, zorder=0, linewidth=0)
    ax.text(right, 0.97 * height, "unstable ", ha="right", va="top", color="#b91c1c", fontsize=9)
    ax.axhline(0.0, color=MUTED, linewidth=0.8)
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    ax.set_xlabel("real part [1/s]")
    ax.set_ylabel("imaginary part [rad/s]")


def _spread(poles: NDArray[np.complex128]) -> bool:
    """Return whether poles are so far apart that they need a logarithmic axis."""
    sizes = np.abs(poles)
    return bool(np.max(sizes) > 50.0 * np.min(sizes))


def pole_map_figure(model: LinearModel, gains: Mapping[str, Array]) -> Figure:
    """Return the map of open-loop poles and of the closed-loop poles of several gains K, shape (2,), by label."""
    figure, (ax,) = _figure()
    open_loop = model.poles
    poles = {label: closed_loop_poles(model, K) for label, K in gains.items()}
    _s_plane(ax, np.concatenate([open_loop, *poles.values()]), _spread(open_loop))
    ax.plot(
        open_loop.real,
        open_loop.imag,
        "o",
        mfc="white",
        mec=INK,
        ms=9,
        mew=1.5,
        label="without feedback",
        zorder=4,
    )
    for index, (label, values) in enumerate(poles.items()):
        # Gains of one table often share a pole: different sizes keep all visible.
        ax.plot(
            values.real,
            values.imag,
            "x",
            color=COLOURS[index % len(COLOURS)],
            ms=13 - 1.6 * index,
            mew=2.2,
            label=label,
            zorder=5 + index,
        )
    ax.set_title("Poles", loc="left", fontweight="bold")
    _legend_below(ax)
    return figure


def root_locus_figure(model: LinearModel, K: Array) -> Figure:
    """Return the poles of A - k B K for k from 0 to 3, with k = 0 and k = 1 marked."""
    figure, (ax,) = _figure()
    factors = np.concatenate([[0.0], np.logspace(-3, math.log10(3.0), 1500)])
    branches = np.array([closed_loop_poles(model, factor * np.asarray(K)) for factor in factors])
    _s_plane(ax, branches.ravel(), _spread(model.poles))
    ax.plot(branches.real.ravel(), branches.imag.ravel(), ".", color=COLOURS[0], ms=3, label="0 < k < 3", zorder=3)
    for factor, marker, text in ((0.0, "o", "k = 0: no feedback"), (1.0, "x", "k = 1: the design")):
        poles = closed_loop_poles(model, factor * np.asarray(K))
        ax.plot(poles.real, poles.imag, marker, color=INK, mfc="white", ms=9, mew=2, label=text, zorder=5)
    ax.set_title("Root locus of the feedback k K x", loc="left", fontweight="bold")
    _legend_below(ax)
    return figure


def bode_figure(model: LinearModel, K: Array) -> Figure:
    """Return the Bode plot of the loop cut at the plant's input, with its margins, for a stabilising gain."""
    report = analyse(model, K)
    margins = report.margins
    assert margins is not None
    centre = margins.crossover if math.isfinite(margins.crossover) else abs(model.poles[0])
    omega = np.logspace(math.log10(centre) - 2.5, math.log10(centre) + 3.0, 800)
    loop = loop_transfer(model, K, omega)
    figure, (top, bottom) = _figure(2, 5.6)
    top.semilogx(omega, 20.0 * np.log10(np.abs(loop)), color=COLOURS[0], linewidth=1.8)
    top.axhline(0.0, color=MUTED, linewidth=0.9)
    top.set_ylabel("|L| [dB]")
    top.set_title("Loop L(s) = K (sI - A)\u207b\u00b9 B and its margins", loc="left", fontweight="bold")
    phase = np.degrees(np.unwrap(np.angle(loop)))
    # The unstable pole starts the phase at -180 degrees, not at +180.
    phase -= 360.0 * round((phase[0] + 180.0) / 360.0)
    bottom.semilogx(omega, phase, color=COLOURS[0], linewidth=1.8)
    bottom.axhline(-180.0, color=COLOURS[1], linewidth=0.9, linestyle="--")
    bottom.set_ylabel("phase [deg]")
    bottom.set_xlabel("angular frequency [rad/s]")
    if math.isfinite(margins.phase):
        at = float(np.interp(margins.crossover, omega, phase))
        for ax in (top, bottom):
            ax.axvline(margins.crossover, color=MUTED, linewidth=0.9, linestyle=":")
        bottom.annotate(
            "",
            xy=(margins.crossover, at),
            xytext=(margins.crossover, -180.0),
            arrowprops={"arrowstyle": "<->", "color": COLOURS[2], "lw": 1.6},
        )
        bottom.text(
            1.15 * margins.crossover,
            0.5 * (at - 180.0),
            f"phase margin {math.degrees(margins.phase):.1f}\u00b0\ndelay margin {margins.delay * 1e3:.0f} ms",
            color=COLOURS[2],
            va="center",
            fontsize=9,
        )
    up = "any factor" if math.isinf(margins.gain_up) else f"{margins.gain_up:.3g}"
    top.text(
        0.98,
        0.93,
        f"gain may grow by {up}\nand shrink to {margins.gain_down:.3f}\nmodulus margin {margins.modulus:.3f}",
        transform=top.transAxes,
        ha="right",
        va="top",
        fontsize=9,
        color=COLOURS[2],
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )
    return figure


def step_figure(model: LinearModel, gains: Mapping[str, Array], report: LoopReport) -> Figure:
    """Return angle and torque after a step of the set-point by 0.1 rad, linear; ``report`` sets the time scale."""
    figure, (top, bottom) = _figure(2, 5.2)
    horizon = 6.0 * report.time_constant if math.isfinite(report.time_constant) else 5.0
    times = np.linspace(0.0, horizon, 800)
    _, _, holding = low_frequency(model)
    for index, (label, K) in enumerate(gains.items()):
        colour = COLOURS[index % len(COLOURS)]
        A = model.A - model.B @ np.atleast_2d(K) @ model.C
        # The holding torque of the new set-point is fed forward, linearised.
        drive = model.B * (float(K[0]) + holding) * 0.1
        _, x = scipy.signal.step((A, drive, model.C, np.zeros((2, 1))), T=times)
        effort = -(x @ np.asarray(K)) + (float(K[0]) + holding) * 0.1
        style = ("-", "--", "-.", ":")[index % 4]
        top.plot(times, x[:, 0], color=colour, linewidth=1.8, linestyle=style, label=label)
        bottom.plot(times, effort, color=colour, linewidth=1.8, linestyle=style)
    top.axhline(0.1, color=MUTED, linewidth=0.9, linestyle="--")
    top.set_ylabel("angle [rad]")
    bottom.set_ylabel("torque [N m]")
    bottom.set_xlabel("time [s]")
    top.set_title("Step of the set-point by 0.1 rad (linear model, gravity fed forward)", loc="left", fontweight="bold")
    top.legend(frameon=False, fontsize=9, loc="lower right")
    return figure


def release_figure(plant: PlantParameters, model: LinearModel, gains: Mapping[str, Array]) -> Figure:
    """Return the driven efforts and each joint after a release off upright, linear.

    The joint that has to be balanced, the last with a goal, starts 0.05 off.
    """
    joints, driven = plant.coordinates.joints, plant.coordinates.driven
    figure, axes = _figure(len(joints) + 1, 2.0 + 1.6 * len(joints))
    start = np.zeros(model.A.shape[0])
    start[max(i for i, joint in enumerate(joints) if joint.goal)] = 0.05
    for index, (label, K) in enumerate(gains.items()):
        gain = np.atleast_2d(K) @ model.C
        A = model.A - model.B @ gain
        # Until the slowest motion is over.
        times = np.linspace(0.0, 6.0 / max(-float(np.linalg.eigvals(A).real.max()), 1e-3), 800)
        step, x = scipy.linalg.expm(A * times[1]), np.empty((times.size, start.size))
        x[0] = start
        for k in range(1, times.size):
            x[k] = step @ x[k - 1]
        colour, style = COLOURS[index % len(COLOURS)], ("-", "--", "-.", ":")[index % 4]
        for i in range(len(joints)):
            axes[i].plot(times, x[:, i], color=colour, linewidth=1.8, linestyle=style, label=label)
        axes[-1].plot(times, -(x @ gain.T), color=colour, linewidth=1.8, linestyle=style)
    for ax, joint in zip(axes, joints, strict=False):
        ax.set_ylabel(f"{joint.name} [{joint.unit}]")
    axes[-1].set_ylabel(f"{', '.join(joints[i].name for i in driven)} [{plant.coordinates.drive_unit}]")
    axes[-1].set_xlabel("time [s]")
    axes[0].set_title("Released 0.05 off upright (linear model)", loc="left", fontweight="bold")
    axes[0].legend(frameon=False, fontsize=9, loc="upper right")
    return figure


def phase_portrait_figure(plant: RigidPlant, gain: Gain, effort_limit: float, region: Region) -> Figure:
    """Return the closed loop's phase portrait, with the sampled and the proven region of attraction."""
    figure, (ax,) = _figure(height=5.2)
    ax.grid(visible=False)
    angles, velocities = region.angles, region.velocities
    ax.contourf(angles, velocities, region.attracted.astype(float), levels=[0.5, 1.5], colors=["#dbeafe"], zorder=0)
    x, v = np.meshgrid(np.linspace(angles[0], angles[-1], 60), np.linspace(velocities[0], velocities[-1], 60))
    u = np.clip(equilibrium_effort(plant, UPRIGHT) - gain.K[0] * x - gain.K[1] * v, -effort_limit, effort_limit)
    acceleration = state_derivative(plant, x + UPRIGHT, v, u)[1]
    ax.streamplot(x, v, v, acceleration, color="#94a3b8", linewidth=0.7, density=1.3, arrowsize=0.8, zorder=1)
    ax.plot(region.ellipse[:, 0], region.ellipse[:, 1], color=COLOURS[1], linewidth=2.0, zorder=3)
    ax.plot([0.0], [0.0], "o", color=INK, ms=6, zorder=4)
    ax.fill_between([], [], color="#dbeafe", label=f"attracted, by simulation (torque limit {effort_limit:g} N m)")
    ax.plot([], [], color=COLOURS[1], linewidth=2.0, label=f"proven: x'Sx \u2264 {region.level:.4g}")
    ax.plot([], [], "o", color=INK, ms=6, label="upright")
    ax.set_xlim(angles[0], angles[-1])
    ax.set_ylim(velocities[0], velocities[-1])
    ax.set_xlabel("angle from upright [rad]")
    ax.set_ylabel("velocity [rad/s]")
    ax.set_title("Closed loop and its region of attraction", loc="left", fontweight="bold")
    _legend_below(ax)
    return figure


def region_to_show(
    plant: RigidPlant, model: LinearModel, gain: Gain, effort_limit: float, *, points: int = 91
) -> Region:
    """Return the region of attraction of a loop with two states, over relevant speeds."""
    # Those of a free fall, unless damping stops the pendulum much earlier.
    span = 1.2 * math.sqrt(4.0 * max(plant.gravity, 1e-6) / plant.inertia)
    if plant.damping > 0.0:
        span = min(span, 3.0 * effort_limit / plant.damping)
    # At its limit the torque no longer accelerates the plant: its own slow pole sets the time.
    slowest = analyse(model, gain.K).time_constant
    duration = min(max(10.0 * slowest, 10.0 / max(float(model.poles[0].real), 1e-6), 4.0), 100.0)
    rollout = rigid_rollout(plant, gain, effort_limit, duration)
    return region_of_attraction(plant, gain, effort_limit, rollout, velocity_span=span, points=points)


def design_figures(
    plant: PlantParameters,
    model: LinearModel,
    rows: Sequence[tuple[str, Gain]],
    chosen: int,
    effort_limit: float,
) -> dict[str, Figure]:
    """Return all figures of a design table by file name.

    Plants of several joints have a release in place of a step, since a passive joint takes no set-point, and with
    several motors no Bode plot; a phase portrait needs two states.
    """
    gains = {label: gain.K for label, gain in rows}
    gain = rows[chosen][1]
    figures = {"pole_map": pole_map_figure(model, gains), "root_locus": root_locus_figure(model, gain.K)}
    if model.B.shape[1] == 1:
        figures["bode"] = bode_figure(model, gain.K)
    if not plant.is_pendulum:
        return {**figures, "release": release_figure(plant, model, gains)}
    figures["step_response"] = step_figure(model, gains, analyse(model, gain.K))
    # Plane and proof need two states.
    if model.theta == UPRIGHT and not model.hidden:
        region = region_to_show(plant, model, gain, effort_limit)
        figures["phase_portrait"] = phase_portrait_figure(plant, gain, effort_limit, region)
    return figures
