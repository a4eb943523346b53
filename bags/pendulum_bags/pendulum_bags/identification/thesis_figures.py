"""Figures of the thesis's two identification experiments: trials by hand, and staircases against gravity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.figures.figure import Figure, Panel, Trace, thinned
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.identification.thesis import ThesisResult, static_holds
from pendulum_bags.runs.datasets import Recording

__all__ = [
    "GRAVITY",
    "INERTIA",
    "UNITS",
    "TrialSet",
    "dynamic_phase",
    "effort_over_acceleration",
    "effort_over_sine",
    "effort_over_time",
    "effort_over_velocity",
    "static_phase",
    "thesis_figures",
]

INERTIA = "Experiment 1: inertia and damping"
GRAVITY = "Experiment 2: gravity"
UNITS = {"inertia": "kg m²", "damping": "N m s/rad", "gravity": "N m"}
ROLES = 6
"""Looks there are for trials; a seventh looks like the first."""


@dataclass(frozen=True)
class TrialSet:
    """The trials of one experiment and their regression.

    Args:
        result: Regressions and average.
        recordings: One for each trial, cut to the trial.
        names: One for each trial; by default they are counted.
    """

    result: ThesisResult
    recordings: Sequence[Recording]
    names: Sequence[str] = ()

    def named(self, word: str) -> Sequence[str]:
        """Return the name of each trial, or the word and its number."""
        return self.names or [f"{word} {number}" for number in range(1, len(self.recordings) + 1)]


def thesis_figures(trials: TrialSet) -> list[Figure | str]:
    """Return the figures of either experiment, and in words why there is none."""
    if trials.result.kind == "inertia_damping":
        return [effort_over_velocity(trials), effort_over_acceleration(trials), effort_over_time(trials)]
    return [dynamic_phase(trials), static_phase(trials), effort_over_sine(trials)]


def _found(trials: TrialSet) -> str:
    result = trials.result
    words = [
        f"{name} {quantity(value, UNITS[name], 4)} ({quantity(result.intervals[name][0])} to "
        f"{quantity(result.intervals[name][1])})"
        for name, value in result.average.items()
    ]
    return f"{' and '.join(words)}, mean of {len(result.trials)} trials with 95 % interval"


def _cloud(trials: TrialSet, column: int, label: str, name: str, title: str) -> Figure:
    panels = []
    for title_of_trial, trial in zip(trials.named("Trial"), trials.result.trials, strict=True):
        x = trial.regressors[:, column]
        step = max(1, x.size // 600)
        ends = np.array([x.min(), x.max()])
        fit = trial.values[column] * ends
        points = Trace(x[::step], trial.response[::step], "measured", "hw", "points")
        panels.append(
            Panel(label, "effort [N m]", [points, Trace(ends, fit, "its part of the fit", "fit")], title=title_of_trial)
        )
    return Figure(
        name, title, f"The regression gives {_found(trials)}.", panels, stacked=False, section=INERTIA, panel_height=180
    )


def effort_over_velocity(trials: TrialSet) -> Figure:
    """Return effort over velocity, trial by trial."""
    return _cloud(trials, 0, "θ′ [rad/s]", "effort_over_velocity", "Effort over velocity")


def effort_over_acceleration(trials: TrialSet) -> Figure:
    """Return effort over acceleration, trial by trial."""
    return _cloud(trials, 1, "θ″ [rad/s²]", "effort_over_acceleration", "Effort over acceleration")


def effort_over_time(trials: TrialSet) -> Figure:
    """Return measured and fitted effort over time, trial by trial."""
    panels = []
    for title, trial, recording in zip(trials.named("Trial"), trials.result.trials, trials.recordings, strict=True):
        t = recording.time - recording.time[0]
        traces = [
            Trace(*thinned(t, trial.response, 1000), "measured", "hw"),
            Trace(*thinned(t, trial.regressors @ trial.values, 1000), "fitted", "fit"),
        ]
        panels.append(Panel("time [s]", "effort [N m]", traces, title=title))
    lowest = min(trial.r_squared for trial in trials.result.trials)
    sentence = f"The fit explains at least {100.0 * lowest:.2f} % of the squared effort of each trial."
    return Figure("trials", "Trials by hand", sentence, panels, stacked=False, section=INERTIA, panel_height=180)


def dynamic_phase(trials: TrialSet) -> Figure:
    """Return position, velocity and effort of the staircases over time."""
    rows: dict[str, list[Trace]] = {"θ [rad]": [], "θ′ [rad/s]": [], "effort [N m]": []}
    for i, (label, recording) in enumerate(zip(trials.named("trial"), trials.recordings, strict=True)):
        start, role = float(recording.time[0]), f"trial {i % ROLES + 1}"
        rows["θ [rad]"].append(Trace(recording.time - start, recording.position, label, role))
        if recording.velocity is not None:
            rows["θ′ [rad/s]"].append(Trace(recording.time - start, recording.velocity, label, role))
        rows["effort [N m]"].append(Trace(recording.input_stamps - start, recording.input, label, role))
    panels = [Panel("time since the trial began [s]", label, traces) for label, traces in rows.items() if traces]
    reach = [
        float(np.degrees(value)) for one in trials.recordings for value in (one.position.min(), one.position.max())
    ]
    sentence = f"The staircases reach from {min(reach):.1f}° to {max(reach):.1f}°, up and back on both sides."
    return Figure("dynamic_phase", "Dynamic phase", sentence, panels, section=GRAVITY, panel_height=150)


def static_phase(trials: TrialSet) -> Figure | str:
    """Return the effort of the holds at 10, 90 and -10 degrees, all trials, both ways."""
    panels = []
    for degrees in (10.0, 90.0, -10.0):
        traces = []
        for i, (name, recording) in enumerate(zip(trials.named("trial"), trials.recordings, strict=True)):
            holds = static_holds(recording)
            nearest = sorted(holds, key=lambda hold: abs(np.degrees(hold.position) - degrees))[:2]
            for hold in (hold for hold in nearest if abs(np.degrees(hold.position) - degrees) < 5.0):
                inside = (recording.input_stamps >= hold.start) & (recording.input_stamps <= hold.stop)
                t = recording.input_stamps[inside] - hold.start
                role = f"trial {i % ROLES + 1}" if hold.upward else "reference"
                traces.append(
                    Trace(t, recording.input[inside], f"{name}, going up" if hold.upward else "coming down", role)
                )
        if traces:
            panels.append(Panel("time in the hold [s]", "effort [N m]", traces, title=f"Hold at {degrees:.0f}°"))
    if not panels:
        return "the staircases have no hold at 10, 90 or −10 degrees"
    hysteresis = trials.result.hysteresis
    sentence = f"Going up takes {quantity(hysteresis, 'N m')} more effort than coming down, on average: hysteresis."
    return Figure("static_phase", "Static phase", sentence, panels, stacked=False, section=GRAVITY, panel_height=200)


def effort_over_sine(trials: TrialSet) -> Figure:
    """Return the mean effort of each hold over the sine of its angle, with the fit."""
    traces = [
        Trace(trial.regressors[:, 0], trial.response, name, f"trial {i % ROLES + 1}", "points")
        for i, (name, trial) in enumerate(zip(trials.named("trial"), trials.result.trials, strict=True))
    ]
    ends = np.array([-1.0, 1.0])
    gravity = trials.result.sign * trials.result.average["gravity"]
    traces.append(Trace(ends, gravity * ends, "mean of the fits", "fit"))
    panel = Panel("sin θ [−]", "mean effort of a hold [N m]", traces)
    sentence = f"The regression gives {_found(trials)}."
    return Figure("effort_over_sine", "Effort over sin θ, static", sentence, [panel], section=GRAVITY, panel_height=280)
