"""One page per identification: measured against simulated, residuals, tables, and the sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Canvas

from pendulum_bags.arrays import Array
from pendulum_bags.figures.figure import Figure
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.table import Table
from pendulum_bags.identification.joint_fit import JointFit
from pendulum_bags.identification.model import UNITS
from pendulum_bags.identification.problem import simulate
from pendulum_bags.identification.result import ALARMS, IdentificationResult, PendulumResult
from pendulum_bags.identification.thesis import ThesisResult, trial_part
from pendulum_bags.identification.thesis_figures import TrialSet, thesis_figures
from pendulum_bags.pages.html import encoded, render_plain
from pendulum_bags.runs.datasets import Recording, distinct_names
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import DataError

__all__ = ["write_page", "write_thesis_page"]

_MEASURED, _SIMULATED = "#444444", "#c2410c"


@dataclass(frozen=True)
class _Sentence:
    """A sentence at the top of a page, highlighted if ``alarming``."""

    text: str
    alarming: bool = False


def write_page(result: IdentificationResult, folder: str | Path) -> Path:
    """Write figures and ``index.html`` of an output-error fit into a folder and return the page's path."""
    target = Path(folder)
    figures = _save(_fit_figures(result), target / "figures")
    names = result.uncertainty.names
    rows = zip(names, result.uncertainty.correlation, strict=True)
    correlation = [(name, *(f"{value:+.2f}" for value in row)) for name, row in rows]
    return _write_sheet(
        target / "index.html",
        "Identification",
        _marked([result.verdict, *result.sentences()]),
        [*result.tables(), Table("Correlation", "", ("", *names), correlation)],
        figures,
        kicker=f"{result.choice}, {result.created}",
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
    return _write_sheet(
        target / "index.html",
        f"Regression: {result.kind.replace('_', ' and ')}",
        _marked(result.sentences),
        [Table("Average over trials", "", ("coefficient", "value", "95 % interval", "unit"), rows)],
        figures,
        listings=[(one.trial, one.summary) for one in result.trials],
        notes=[f"No figure: {one}." for one in drawn if isinstance(one, str)],
    )


def _marked(sentences: Sequence[str]) -> list[_Sentence]:
    return [_Sentence(sentence, alarming=sentence.startswith(ALARMS)) for sentence in sentences]


@dataclass(frozen=True)
class _Motion:
    """One recording of n joints, its simulation NaN at the start of each window, and what drives it."""

    name: str
    time: Array
    measured: Array
    simulated: Array
    input_time: Array
    input: Array
    input_label: str


def _motions(result: IdentificationResult) -> Iterator[_Motion]:
    fit = result.fit
    if isinstance(fit, JointFit):
        unit = fit.model.coordinates.drive_unit
        for name, part, errors in zip(result.training, fit.data, fit.residuals, strict=True):
            simulated, log = part.position + errors, part.recording
            simulated[:, 0] = np.nan
            motion = part.time[part.inside], part.position[part.inside], simulated[part.inside]
            yield _Motion(name, *motion, log.time, log.effort, f"effort [{unit}]")
        return
    names = distinct_names([piece.recording for piece in fit.pieces])
    for name, piece, state in zip(names, fit.pieces, fit.chosen.solution.states, strict=True):
        recording = piece.recording
        theta = simulate(fit.model, piece, state).theta
        # NaN before each window breaks the line where the simulation starts again.
        theta[piece.windows[1:, 0]] = np.nan
        motion = recording.time, recording.position[:, None], theta[:, None]
        label = {"effort": "effort [N m]", "voltage": "input [V]"}.get(recording.input_kind, "input")
        yield _Motion(name, *motion, recording.input_stamps, recording.input, label)


def _fit_figures(result: IdentificationResult) -> dict[str, Canvas]:
    """Return the figures of an output-error fit: by recording, and of one joint residual tests and friction models."""
    figures: dict[str, Canvas] = {}
    joints = result.explained.joints
    for i, motion in enumerate(_motions(result)):
        figure = Canvas(figsize=(9.0, 1.7 + 3.5 * len(joints)), layout="constrained")
        axes = figure.subplots(2 * len(joints) + 1, 1, sharex=True, height_ratios=[*(3, 2) * len(joints), 1.5])
        for k, joint in enumerate(joints):
            top, middle = axes[2 * k : 2 * k + 2]
            measured, simulated = motion.measured[:, k], motion.simulated[:, k]
            top.plot(motion.time, measured, color=_MEASURED, linewidth=1.0, label="measured")
            top.plot(motion.time, simulated, color=_SIMULATED, linewidth=0.9, label="simulated")
            top.set_ylabel(f"{joint.name if len(joints) > 1 else 'angle'} [{joint.unit}]")
            middle.plot(motion.time, 1e3 * (simulated - measured), color=_SIMULATED, linewidth=0.7)
            middle.axhline(0.0, color="black", linewidth=0.5)
            middle.set_ylabel(f"residual [m{joint.unit}]")
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        axes[0].set_title(motion.name)
        axes[-1].plot(motion.input_time, motion.input, color=_MEASURED, linewidth=0.7)
        axes[-1].set_ylabel(motion.input_label)
        axes[-1].set_xlabel("time [s]")
        figures[f"fit_{i + 1}"] = figure
    if isinstance(result, PendulumResult):
        figures["residuals"] = _residual_figure(result)
        figures["friction_models"] = _candidate_figure(result)
    return figures


def _residual_figure(result: PendulumResult) -> Canvas:
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


def _candidate_figure(result: PendulumResult) -> Canvas:
    figure = Canvas(figsize=(9.0, 2.6), layout="constrained")
    axes = figure.subplots()
    names = [c.label for c in result.fit.candidates]
    place = np.arange(len(names))
    axes.bar(place - 0.2, [1e3 * c.training_rms for c in result.fit.candidates], 0.4, color=_MEASURED, label="training")
    axes.bar(place + 0.2, [1e3 * c.score for c in result.fit.candidates], 0.4, color=_SIMULATED, label="held out")
    axes.set_xticks(place, [f"{n} (chosen)" if n == result.fit.chosen.label else n for n in names])
    axes.set_ylabel("angle rms [mrad]")
    axes.legend()
    return figure


def _save(figures: Mapping[str, Canvas], folder: Path) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures.items():
        path = folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        paths.append(path)
    return paths


def _write_sheet(
    path: Path,
    title: str,
    sentences: Sequence[_Sentence],
    tables: Sequence[Table],
    pictures: Sequence[Path],
    *,
    kicker: str = "",
    listings: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Write a page and return its path; a DataError if it cannot be written.

    The first sentence is above everything, the first PNG picture under it. Tables with rows are between the first
    picture and the others. ``kicker`` is a line above the heading; ``listings`` are heading and text of another
    program's output; ``notes`` are sentences before the pictures.
    """
    text = render_plain(
        "sheet.html.j2",
        title=title,
        kicker=kicker,
        sentences=sentences,
        tables=[table for table in tables if table.rows],
        listings=listings,
        notes=notes,
        pictures=[(one.stem.replace("_", " "), encoded(one.read_bytes())) for one in pictures],
    )
    with writing(f"page {path}", DataError):
        write_atomically(path, text)
    return path
