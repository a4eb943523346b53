"""Figures of plants of several joints, each joint in its own unit."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter

import numpy as np

from pendulum_bags.comparison import Comparison
from pendulum_bags.comparison.statistics import rms
from pendulum_bags.figures.figure import Figure, Panel
from pendulum_bags.figures.numbers import quantity, ratio_in_words
from pendulum_bags.report.analysis_figures import coherent_up_to, spectrum_panels
from pendulum_bags.report.motion_figures import both_panel, difference_panels

__all__ = ["joint_differences", "joint_spectra", "joints_together"]


def joints_together(comparisons: Mapping[str, Comparison]) -> Figure:
    """Return position and velocity of each joint (at least one), and the effort of driven ones."""
    panels: list[Panel] = []
    spreads: list[str] = []
    for joint, comparison in comparisons.items():
        sim, hw = comparison.pairs[0].simulation.window, comparison.pairs[0].hardware.window
        unit = sim.unit
        panels.append(both_panel(f"{joint} [{unit}]", sim, hw, attrgetter("position")))
        panels.append(both_panel(f"velocity of {joint} [{unit}/s]", sim, hw, attrgetter("velocity")))
        if np.ptp(sim.effort) > 0.0 or np.ptp(hw.effort) > 0.0:
            label = f"{sim.effort_word} at {joint} [{sim.effort_unit}]"
            panels.append(both_panel(label, sim, hw, attrgetter("effort"), "step"))
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
        panel_height=170,
    )


def joint_differences(comparisons: Mapping[str, Comparison]) -> Figure | str:
    """Return the difference of each joint's motion under one disturbance, with and without its delay."""
    panels: list[Panel] = []
    words: list[str] = []
    for joint, comparison in comparisons.items():
        pair = comparison.pairs[0]
        if not pair.is_paired:
            return str(comparison.paired.get("reason", "the disturbances differ"))
        unit = pair.simulation.window.unit
        delay = 1e3 * pair.response.delay
        panels += difference_panels(
            [("as recorded", "difference", pair.difference), ("its delay taken out", "aligned", pair.aligned)],
            f"Δ {joint} [{unit}]",
            f"Δ velocity of {joint} [{unit}/s]",
        )
        before, after = (rms(one.position) for one in (pair.difference, pair.aligned))
        share = 100.0 * before / float(pair.difference.hardware.position.std())
        words.append(
            f"of {joint} {quantity(before, unit)} apart (rms, {share:.0f} % of the hardware's spread), with the delay "
            f"of {delay:.2f} ms taken out {quantity(after, unit)}"
        )
    return Figure(
        "joint_differences",
        "Difference under the same noise, joint by joint",
        f"The paths are, {'; '.join(words)}.",
        panels,
        section="Paired comparison",
        panel_height=165,
    )


def joint_spectra(comparisons: Mapping[str, Comparison]) -> Figure:
    """Return power spectra and coherence of each joint's velocity."""
    panels: list[Panel] = []
    words: list[str] = []
    for joint, comparison in comparisons.items():
        pair = comparison.pairs[0]
        panels += spectrum_panels(pair.spectra, pair.simulation.window.unit, f", {joint}")
        words.append(f"{joint} {coherent_up_to(pair.spectra)}")
    return Figure(
        "joint_spectra",
        "Spectra and coherence, joint by joint",
        f"Both velocities are coherent: {', '.join(words)}.",
        panels,
        stacked=False,
        section="Paired comparison",
        panel_height=210,
    )
