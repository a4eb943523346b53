"""The table of figures: a new figure is one function and one line."""

from __future__ import annotations

from collections.abc import Callable

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.figure import Figure
from pendulum_bags.report import (
    analysis_figures,
    certified_figures,
    model_figures,
    motion_figures,
    trial_figures,
)
from pendulum_bags.report.data import ReportData

__all__ = ["FIGURES", "comparison_figures", "make_figures"]

Maker = Callable[[ReportData], Figure | str]

FIGURES: tuple[tuple[str, Maker], ...] = (
    ("Equivalence tests", lambda data: analysis_figures.equivalence(data.comparison.verdict)),
    ("Gap per frequency", certified_figures.gap),
    ("Gains that carry over", certified_figures.gains),
    ("LQR weights that carry over", certified_figures.weights),
    ("Simulation and hardware together", motion_figures.both_together),
    ("Torque and noise", motion_figures.torque_and_noise),
    ("Difference under the same noise", motion_figures.paired_difference),
    ("Alignment of clocks and delay", analysis_figures.alignment),
    ("Spectra and coherence", analysis_figures.spectra),
    ("Distributions", analysis_figures.distributions),
    ("Effort and energy", analysis_figures.effort),
    ("All runs", analysis_figures.pooled_runs),
    ("Simulation under noise", motion_figures.simulation_under_noise),
    ("Hardware under noise", motion_figures.hardware_under_noise),
    ("Original and interpolated hardware data", motion_figures.interpolation),
    ("Difference over time", motion_figures.unpaired_difference),
    ("Ramps up and down", motion_figures.ramps),
    ("Torque over sin θ", model_figures.gravity_fit),
    ("Effort over velocity", trial_figures.effort_over_velocity),
    ("Effort over acceleration", trial_figures.effort_over_acceleration),
    ("Trials by hand", trial_figures.effort_over_time),
    ("Dynamic phase", trial_figures.dynamic_phase),
    ("Static phase", trial_figures.static_phase),
    ("Effort over sin θ, static", trial_figures.effort_over_sine),
    ("Timing of the states", analysis_figures.timing),
    ("Overdamped phase plot", model_figures.overdamped_phase),
    ("Replay of a real pendulum", model_figures.replay),
)
"""Title and maker, in the order of the report; a maker returns the reason in words where the data do not allow it."""


def make_figures(data: ReportData) -> tuple[list[Figure], list[tuple[str, str]]]:
    """Return the figures that the data allow, and (title, reason) of those that they do not."""
    made: list[Figure] = []
    missing: list[tuple[str, str]] = []
    for title, maker in FIGURES:
        result = maker(data)
        if isinstance(result, str):
            missing.append((title, result))
        else:
            made.append(result)
    return made, missing


def comparison_figures(comparison: Comparison) -> list[Figure]:
    """Return the figures of a comparison alone."""
    return make_figures(ReportData(comparison, comparison.to_json()))[0]
