"""One page per identification: measured against simulated, residuals, tables, and the sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure as Canvas

from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.table import Table
from pendulum_bags.identification.model import UNITS
from pendulum_bags.identification.problem import simulate
from pendulum_bags.identification.selection import CHOICE
from pendulum_bags.identification.thesis import ThesisResult, trial_part
from pendulum_bags.identification.thesis_figures import TrialSet, thesis_figures
from pendulum_bags.pages.sheet import Sentence, write_sheet
from pendulum_bags.runs.datasets import Recording, distinct_names

if TYPE_CHECKING:
    from pendulum_bags.identification.result import IdentificationResult

__all__ = ["write_page", "write_thesis_page"]

_MEASURED, _SIMULATED = "#444444", "#c2410c"


def write_page(result: IdentificationResult, folder: str | Path) -> Path:
    """Write figures and ``index.html`` of an output-error fit into a folder and return the page's path."""
    target = Path(folder)
    figures = _save(_fit_figures(result), target / "figures")
    chosen = result.fit.chosen
    parameters = []
    for name in (*chosen.free, "natural_frequency"):
        value = result.model[name] if name in UNITS else result.model.natural_frequency
        interval = result.uncertainty.intervals.get(name)
        ends = interval.text if interval else "at the edge of its domain"
        parameters.append((name, f"{value:.5g}", ends, result.model.units.get(name, "rad/s")))
    models = []
    for one in result.fit.candidates:
        held_out = "-" if one.validation is None else f"{1e3 * one.validation.rms:.3f}"
        mark = " (chosen)" if one is chosen else ""
        models.append((f"{one.friction}{mark}", held_out, f"{1e3 * one.training_rms:.3f}"))
    held = [(n, f"{1e3 * s.rms:.3f}", f"{1e3 * s.mean_absolute:.3f}") for n, s in result.held_out.items()]
    names = result.uncertainty.names
    correlation = [
        (name, *(f"{value:+.2f}" for value in row))
        for name, row in zip(names, result.uncertainty.correlation, strict=True)
    ]
    tables = [
        Table("Parameters", "", ("parameter", "value", "95 % interval", "unit"), parameters),
        Table("Friction models", CHOICE, ("model", "held-out rms [mrad]", "training rms [mrad]"), models),
        Table("Other recordings", "", ("recording", "rms [mrad]", "mean absolute [mrad]"), held),
        Table("Correlation", "", ("", *names), correlation),
    ]
    kicker = f"Friction model {chosen.friction}, {result.created}"
    return write_sheet(
        target / "index.html",
        "Identification",
        _told([result.verdict, *result.sentences()]),
        tables,
        figures,
        kicker=kicker,
    )


def write_thesis_page(result: ThesisResult, recordings: Sequence[Recording], folder: str | Path) -> Path:
    """Write figures and ``index.html`` of the two regressions into a folder and return the page's path."""
    target = Path(folder)
    trials = TrialSet(result, list(map(trial_part, recordings)), [one.trial for one in result.trials])
    drawn = thesis_figures(trials)
    figures = write_figures([one for one in drawn if isinstance(one, Figure)], target / "figures", ("png",))
    rows = [
        (name, f"{value:.5g}", f"{result.intervals[name][0]:.5g} to {result.intervals[name][1]:.5g}", UNITS[name])
        for name, value in result.average.items()
    ]
    return write_sheet(
        target / "index.html",
        f"Regression: {result.kind.replace('_', ' and ')}",
        _told(result.sentences),
        [Table("Average over trials", "", ("coefficient", "value", "95 % interval", "unit"), rows)],
        figures,
        listings=[(one.trial, one.summary) for one in result.trials],
        notes=[f"No figure: {one}." for one in drawn if isinstance(one, str)],
    )


def _told(sentences: Sequence[str]) -> list[Sentence]:
    from pendulum_bags.identification.result import ALARMS

    return [Sentence(sentence, alarming=sentence.startswith(ALARMS)) for sentence in sentences]


def _fit_figures(result: IdentificationResult) -> dict[str, Canvas]:
    """Return the figures of an output-error fit: by recording, residual tests, friction models."""
    figures: dict[str, Canvas] = {}
    names = distinct_names([piece.recording for piece in result.fit.pieces])
    states = result.fit.chosen.solution.states
    for i, (name, piece, state) in enumerate(zip(names, result.fit.pieces, states, strict=True)):
        recording = piece.recording
        simulated = simulate(result.model, piece, state)
        figure = Canvas(figsize=(9.0, 5.2), layout="constrained")
        top, middle, low = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.5))
        top.plot(recording.time, recording.position, color=_MEASURED, linewidth=1.0, label="measured")
        # NaN before each window breaks the line where the simulation starts anew.
        theta = simulated.theta.copy()
        theta[piece.windows[1:, 0]] = np.nan
        top.plot(recording.time, theta, color=_SIMULATED, linewidth=0.9, label="simulated")
        top.set_ylabel("angle [rad]")
        top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        top.set_title(name)
        middle.plot(recording.time, 1e3 * (simulated.theta - recording.position), color=_SIMULATED, linewidth=0.7)
        middle.axhline(0.0, color="black", linewidth=0.5)
        middle.set_ylabel("residual [mrad]")
        low.plot(recording.input_stamps, recording.input, color=_MEASURED, linewidth=0.7)
        low.set_ylabel({"effort": "effort [N m]", "voltage": "input [V]"}.get(recording.input_kind, "input"))
        low.set_xlabel("time [s]")
        figures[f"fit_{i + 1}"] = figure
    figures["residuals"] = _residual_figure(result)
    figures["friction_models"] = _candidate_figure(result)
    return figures


def _residual_figure(result: IdentificationResult) -> Canvas:
    tests = result.tests
    figure = Canvas(figsize=(9.0, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.stem(np.arange(len(tests.autocorrelation)), tests.autocorrelation, basefmt=" ")
    left.set_xlabel("lag [samples]")
    left.set_ylabel("autocorrelation of the residual")
    half = len(tests.cross_correlation) // 2
    right.stem(np.arange(-half, half + 1), tests.cross_correlation, basefmt=" ")
    right.set_xlabel("lag [samples], positive: the input leads")
    right.set_ylabel("correlation with the input")
    for axes in (left, right):
        axes.axhspan(-tests.bound, tests.bound, color="#94a3b8", alpha=0.4, linewidth=0.0)
    return figure


def _candidate_figure(result: IdentificationResult) -> Canvas:
    figure = Canvas(figsize=(9.0, 2.6), layout="constrained")
    axes = figure.subplots()
    names = [c.friction for c in result.fit.candidates]
    place = np.arange(len(names))
    axes.bar(
        place - 0.2,
        [1e3 * c.training_rms for c in result.fit.candidates],
        0.4,
        color=_MEASURED,
        label="training",
    )
    axes.bar(place + 0.2, [1e3 * c.score for c in result.fit.candidates], 0.4, color=_SIMULATED, label="held out")
    axes.set_xticks(place, [f"{n} (chosen)" if n == result.fit.chosen.friction else n for n in names])
    axes.set_ylabel("angle rms [mrad]")
    axes.legend()
    return figure


def _save(figures: Mapping[str, Canvas], folder: Path) -> list[Path]:
    """Write figures as PNG files and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        paths.append(path)
    return paths
