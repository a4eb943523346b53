"""A figure of plants of several joints: all of them under noise, simulation and hardware together."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.numbers import quantity, ratio_in_words
from pendulum_bags.report.motion_figures import TIME

__all__ = ["joints_together"]


def joints_together(comparisons: Mapping[str, Comparison]) -> Figure:
    """Return position and velocity of each joint, and the effort of those that were driven.

    Args:
        comparisons: The comparison of each joint, at least one.
    """
    panels: list[Panel] = []
    spreads: list[str] = []
    for joint, comparison in comparisons.items():
        sim, hw = comparison.pairs[0].simulation.window, comparison.pairs[0].hardware.window
        unit = sim.unit
        rows = [(f"{joint} [{unit}]", "position", "line"), (f"velocity of {joint} [{unit}/s]", "velocity", "line")]
        if np.ptp(sim.effort) > 0.0 or np.ptp(hw.effort) > 0.0:
            rows.append((f"{'force' if sim.slides else 'torque'} at {joint} [{sim.effort_unit}]", "effort", "step"))
        panels += [
            Panel(
                TIME,
                label,
                [
                    Trace(one.t, getattr(one, name), title, role, kind)  # type: ignore[arg-type]
                    for one, title, role in ((sim, "simulation", "sim"), (hw, "hardware", "hw"))
                ],
            )
            for label, name, kind in rows
        ]
        ours, theirs = float(sim.position.std(ddof=1)), float(hw.position.std(ddof=1))
        spreads.append(
            f"that of {joint} is {quantity(theirs, unit)} against {quantity(ours, unit)} "
            f"({ratio_in_words(theirs / ours)})"
        )
    sentence = f"Standard deviation of the hardware's positions against the simulation's: {'; '.join(spreads)}."
    return Figure(
        "joints_together",
        "Simulation and hardware together, joint by joint",
        sentence,
        panels,
        section="Paired comparison",
        panel_height=150,
    )
