"""The overdamped phase plot with its fixed points."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from pendulum_msgs_py.atomic_write import writing
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import (
    FixedPoint,
    fixed_points,
    is_overdamped,
    overdamped_velocity,
    total_damping,
)
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["overdamped_points", "plot_overdamped_phase", "save_figure"]

_STABLE, _UNSTABLE, _LINE = "#1b7f5c", "#c4472f", "#2b6cb0"


def overdamped_points(parameters: PlantParameters, torque: float = 0.0) -> list[tuple[FixedPoint, float]]:
    """Return the fixed points of an overdamped plant under a torque [N m], by angle, with the slope of x' over x [1/s].

    Raises:
        ParameterError: The plant has no gravity, or is not overdamped.
    """
    if parameters.gravity <= 0.0:
        raise ParameterError(f"gravity is {parameters.gravity} N m; expected > 0")
    if not is_overdamped(parameters):
        raise ParameterError(
            f"plant {parameters.name!r} is not overdamped: its damping is {total_damping(parameters):g} N m s/rad, "
            "expected more than 2 sqrt(M G), as of thesis and x5_9; its phase portrait is drawn by "
            "python -m pendulum_lqr design --figures"
        )
    slope = parameters.gravity / total_damping(parameters)
    points = sorted(fixed_points(parameters, torque), key=lambda point: point.theta)
    return [(point, -slope * math.cos(point.theta - parameters.angle_offset)) for point in points]


def plot_overdamped_phase(parameters: PlantParameters, torque: float = 0.0) -> Figure:
    """Draw x' = (u_0 - G sin x) / b over x from -2 pi to 2 pi, with fixed points and direction of flow; u_0 in [N m].

    It includes offsets, and a series-elastic plant's motor damping and torque gain.

    Source:
        Thesis, phase plot of the overdamped pendulum.
    """
    points = [point for point, _ in overdamped_points(parameters, torque)]
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    x = np.linspace(-2.0 * math.pi, 2.0 * math.pi, 801)
    speed = overdamped_velocity(parameters, x, torque)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.plot(x, speed, color=_LINE, linewidth=1.8)
    arrows = np.arange(-1.875 * math.pi, 2.0 * math.pi, 0.25 * math.pi)
    flow = overdamped_velocity(parameters, arrows, torque)
    moving = np.abs(flow) > 0.25 * parameters.gravity / total_damping(parameters)
    for marker, chosen in ((">", moving & (flow > 0.0)), ("<", moving & (flow < 0.0))):
        axes.plot(arrows[chosen], np.zeros(chosen.sum()), marker, color="0.35", markersize=6)
    for kind, colour, fill in ((True, _STABLE, _STABLE), (False, _UNSTABLE, "white")):
        angles = [point.theta + turn for point in points if point.stable is kind for turn in (-math.tau, 0.0, math.tau)]
        inside = [angle for angle in angles if abs(angle) <= 2.0 * math.pi + 1e-9]
        label = "stable fixed point" if kind else "unstable fixed point"
        axes.plot(inside, np.zeros(len(inside)), "o", markersize=10, color=colour, markerfacecolor=fill, label=label)
    axes.set_xticks([k * math.pi for k in range(-2, 3)], [r"$-2\pi$", r"$-\pi$", "0", r"$\pi$", r"$2\pi$"])
    axes.set_xlim(-2.05 * math.pi, 2.05 * math.pi)
    axes.set_xlabel(r"$\theta$ [rad]")
    axes.set_ylabel(r"$\dot\theta$ [rad/s]")
    axes.set_title(rf"Overdamped pendulum, $b\,\dot\theta + G\,\sin\theta = u_0$, $u_0$ = {torque:g} N m")
    if points:
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure as .png, .svg or .pdf; a ParameterError for other endings or if that fails."""
    path = Path(path)
    if path.suffix.lower() not in {".png", ".svg", ".pdf"}:
        raise ParameterError(f"figure {path} ends in {path.suffix!r}; expected .png, .svg or .pdf")
    with writing(f"figure {path}", ParameterError):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
    return path
