"""The table of figures: a new figure is one function and one line."""

from __future__ import annotations

from collections.abc import Callable

from threadpoolctl import threadpool_limits

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.figure import Figure
from pendulum_bags.frequency_response.figures import certified_gains_figure, certified_weights_figure, gap_figure
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.identification import thesis_figures
from pendulum_bags.identification.thesis_figures import TrialSet
from pendulum_bags.report import analysis_figures, model_figures, motion_figures
from pendulum_bags.report.data import ReportData
from pendulum_lqr.responses.certificate import Certifier

__all__ = ["FIGURES", "comparison_figures", "make_figures"]

Maker = Callable[[ReportData], Figure | str]


def _of_experiment(number: int, draw: Callable[[TrialSet], Figure | str]) -> Maker:
    kind = {1: "inertia_damping", 2: "gravity"}[number]

    def make(data: ReportData) -> Figure | str:
        trials = next((one for one in data.trials if one.result.kind == kind), None)
        return f"needs the trials of experiment {number}" if trials is None else draw(trials)

    return make


def _certified(draw: Callable[[Analysis, Certifier], Figure]) -> Maker:
    def make(data: ReportData) -> Figure | str:
        found = data.certified
        if found is None or found.certifier is None:
            return "needs the hardware's measured response (python -m pendulum_bags experiment frequency_response)"
        # Thousands of small matrices: BLAS threads only slow them down.
        with threadpool_limits(1):
            return draw(found, found.certifier)

    return make


FIGURES: tuple[tuple[str, Maker], ...] = (
    ("Equivalence tests", lambda data: analysis_figures.equivalence(data.comparison.verdict)),
    ("Gap per frequency", _certified(lambda found, certifier: gap_figure(certifier, None, found.designs))),
    ("Gains that carry over", _certified(lambda found, certifier: certified_gains_figure(certifier, found.designs))),
    (
        "LQR weights that carry over",
        _certified(lambda found, certifier: certified_weights_figure(certifier, found.model)),
    ),
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
    ("Effort over velocity", _of_experiment(1, thesis_figures.effort_over_velocity)),
    ("Effort over acceleration", _of_experiment(1, thesis_figures.effort_over_acceleration)),
    ("Trials by hand", _of_experiment(1, thesis_figures.effort_over_time)),
    ("Dynamic phase", _of_experiment(2, thesis_figures.dynamic_phase)),
    ("Static phase", _of_experiment(2, thesis_figures.static_phase)),
    ("Effort over sin θ, static", _of_experiment(2, thesis_figures.effort_over_sine)),
    ("Timing of the states", analysis_figures.timing),
    ("Overdamped phase plot", model_figures.overdamped_phase),
    ("Replay of a real pendulum", model_figures.replay),
)
"""Title and maker, in the order of the report; a maker returns the reason as text where the data do not allow it."""


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
