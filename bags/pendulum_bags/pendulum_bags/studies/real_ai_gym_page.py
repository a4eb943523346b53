"""The study of the public contests as sentences, tables, figures and a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pendulum_bags.distributions import Interval
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.table import Table
from pendulum_bags.pages.layer_page import write_layer_page
from pendulum_bags.ranking.ranking import Ranking
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.studies.real_ai_gym import SIMULATED, TOLERANCE, Comparison, Trial
from pendulum_bags.studies.real_ai_gym_policies import BOARD_TOLERANCE, BoardRow, PredictionRow

__all__ = ["Study", "study_tables", "study_text", "to_json", "write_study"]

_NOTES = """Intervals are of 95 %. Those of regret, scores and Spearman's correlation cover trials repeated on the
machine as it was at the contest, by Student's t; that of Pearson's covers other controllers, that of MMRV both. None
covers another machine, another day or another training of a controller.
In simulation a controller has one result, taken as known. At IROS 2024 the trials had perturbations, trial i of each
controller the same, so that controllers are compared trial by trial; the simulation's swing-up had none. Score v2 has
harder norms of the torque in simulation: the rows by the machine's norms are without them.
A controller on the machine may be another training under the same name (AR-EAPO of ICRA 2025 is, on a model with
friction): the study judges what the published simulation would have selected, not its physics alone."""


class Study(NamedTuple):
    """All results: trials, comparisons and, of the published controllers, rows of the board and predictions."""

    trials: Sequence[Trial]
    found: Sequence[Comparison]
    board: Sequence[BoardRow] = ()
    predictions: Sequence[PredictionRow] = ()


def study_text(study: Study) -> list[str]:
    """Return what the study shows, as sentences: scores reproduced, how often the simulation picks the best, limits."""
    trials, found = study.trials, study.found
    computed = [one for one in trials if one.computed is not None]
    differing = [one for one in computed if abs(one.score - one.published) > TOLERANCE]
    largest = max((abs(one.score - one.published) for one in computed if one not in differing), default=0.0)
    few = dict.fromkeys(f"{one.contest.name} ({one.robot})" for one in found if one.ranking is None)
    equal, unknown = len(computed) - len(differing), len(trials) - len(computed)
    text = [
        (
            f"{equal} of {len(computed)} scores computed from trajectories equal the published ones (largest "
            f"difference {largest:.1g}); {unknown} without one are taken as published."
        )
    ]
    text += [
        f"{one.robot}, {one.contest.name}, {one.controller}, trial {one.number}: computed {one.score:.3f}, published "
        f"{one.published:.3f}, {one.reason or 'for a cause that is not known'}."
        for one in differing
    ]
    for criterion in SIMULATED:
        ranked = [one.ranking for one in found if one.ranking is not None and one.criterion == criterion]
        if not ranked:
            continue
        wrong = [pair for one in ranked for pair in one.wrong]
        text.append(
            f"By {criterion} the simulation's pick is the best on the machine in "
            f"{sum(one.pick == one.best for one in ranked)} of {len(ranked)} contests, a random pick in "
            f"{sum(1.0 / len(one.names) for one in ranked):.1f}; of {sum(one.pairs for one in ranked)} pairs "
            f"{len(wrong)} are in the wrong order, {sum(pair.sure for pair in wrong)} of them surely."
        )
    if study.board:
        same = sum(abs(one.computed - one.published) <= BOARD_TOLERANCE for one in study.board)
        text.append(
            f"{same} of {len(study.board)} controllers of the simulation's board score here within {BOARD_TOLERANCE} "
            "of what was published."
        )
    return [*text, f"Not ranked, with fewer than 3 controllers: {', '.join(few) or 'none'}.", _NOTES]


def study_tables(study: Study) -> list[Table]:
    """Return the tables: comparisons, pairs in the wrong order, and what the published controllers do."""
    rows, wrong = [], []
    for one in study.found:
        if (ranking := one.ranking) is None:
            continue
        of = (f"{one.contest.name}, {one.robot}", one.criterion)
        spearman = _text(Interval(ranking.spearman, *ranking.spearman_ends), 2)
        counts, chance = f"{len(one.trials)}, {sum(one.trials.values())}", f"{100.0 * ranking.chance:.0f}"
        picks = (f"{name} {_text(_mean(ranking, name))}" for name in (ranking.pick, ranking.best))
        figures = (_text(ranking.srcc, 2), _text(ranking.mmrv))
        rows.append((*of, counts, spearman, chance, *figures, *picks, _text(ranking.regret)))
        wrong += [
            (*of, pair.picked, pair.better, f"{pair.sim:.3f}", f"{pair.hw:.3f}", "yes" if pair.sure else "no")
            for pair in ranking.wrong
        ]
    head = ("contest", "by", "controllers, trials", "Spearman", "by chance [%]", "Pearson", "MMRV", "simulation picks",
            "best on machine", "regret")  # fmt: skip
    sentence = (
        "Few controllers: by chance, a share of all orders has a Spearman correlation as large. Scores are of 0 to 1."
    )
    pairs = ("contest", "by", "simulation prefers", "machine prefers", "in simulation by", "on machine by", "sure")
    sure = "Sure: beyond the scatter of the trials, at most 5 % of them falsely in the mean (Benjamini and Hochberg)."
    tables = [
        Table("Would the simulation have picked the best controller?", sentence, head, rows),
        Table("Pairs in the wrong order", sure, pairs, wrong),
    ]
    return [*tables, *(_policy_tables(study) if study.board or study.predictions else ())]


def _policy_tables(study: Study) -> list[Table]:
    elsewhere = list(study.board[0].elsewhere) if study.board else []
    board = [
        (
            f"{one.controller}, {one.robot}",
            f"{one.published:.4f}",
            f"{one.computed:.4f}",
            *(f"{one.elsewhere[plant]:.3f}" for plant in elsewhere),
        )
        for one in study.board
    ]
    predictions = [
        (
            f"{one.robot}, {one.plant}",
            f"{one.difference:.1g}",
            f"{np.mean(one.machine):.3f}",
            *(
                f"{np.mean(one.predicted[kind]):.3f}" if kind in one.predicted else "-"
                for kind in ((True, True), (True, False), (False, True), (False, False))
            ),
        )
        for one in study.predictions
    ]
    return [
        Table(
            "Controllers of the simulation's board, simulated again",
            "Published score v2, that of a run here in the contests' plant, and in each further plant the score by "
            "the machine's norms, without perturbations and the machine's loop.",
            ("controller", "published", "here", *(f"in {plant}" for plant in elsewhere)),
            board,
        ),
        Table(
            "What a plant predicts of MC-PILCO on the machine",
            "Its published file gives the torques that its trials logged, up to the rms difference shown. Mean score "
            "of the trials, and of as many simulated ones with the same perturbations: with the plant's friction and "
            "the machine's loop (commands act a control period of 30 ms later, velocities are differences of positions "
            "over one), or without one or both.",
            ("robot, plant", "difference [N m]", "machine", "friction and loop", "friction", "loop", "neither"),
            predictions,
        ),
    ]


def _text(of: Interval, digits: int = 3) -> str:
    return f"{of.value:.{digits}f}" + (
        f" ({of.low:.{digits}f} to {of.high:.{digits}f})" if math.isfinite(of.low) else ""
    )


def _mean(ranking: Ranking, name: str) -> Interval:
    return ranking.means[list(ranking.names).index(name)]


def study_figures(trials: Sequence[Trial], found: Sequence[Comparison]) -> list[Figure]:
    """Draw the scores on the machine in the order of the simulation, a figure for each of its criteria."""
    figures = []
    sentence = (
        "Controllers from the simulation's worst (bottom) to its best (top), with its result; on the machine mean "
        "score with 95 % interval over trials, and the trials. A right order rises to the right."
    )
    for number, criterion in enumerate(SIMULATED, start=1):
        title = f"Scores on the machines in the order of the simulation's {criterion}"
        own = [one for one in found if one.criterion == criterion]
        if panels := [_panel(one, one.ranking, trials) for one in own if one.ranking is not None]:
            figures.append(Figure(f"scores_{number}", title, sentence, panels, panel_height=125))
    return figures


def _panel(one: Comparison, ranking: Ranking, trials: Sequence[Trial]) -> Panel:
    names = [ranking.names[i] for i in np.argsort(ranking.sim, kind="stable")]
    mean, low, high = np.array([(m.value, m.low, m.high) for m in (_mean(ranking, name) for name in names)]).T
    own = [t for t in trials if (t.contest, t.robot) == (one.contest, one.robot) and t.controller in names]
    at = np.array([names.index(t.controller) + 0.25 for t in own])
    traces = [
        Trace(np.array([t.score for t in own]), at, "trial", "reference", "points"),
        Trace(mean, np.arange(len(names), dtype=float), "mean, 95 %", "stable", "interval", low, high),
    ]
    ticks = [f"{name} {ranking.sim[list(ranking.names).index(name)]:.2f}" for name in names]
    # Stacked panels share the label of the x axis.
    title, x_label = f"{one.contest.name}, {one.robot}: score {one.contest.version}", "score on the machine [-]"
    return Panel(x_label, "", traces, title=title, y_ticks=ticks, y_range=(-0.5, len(names) - 0.4))


def to_json(study: Study) -> dict[str, Any]:
    """Return the study as JSON values."""
    trials, found = study.trials, study.found
    predictions = [
        {
            **one._asdict(),
            "predicted": [{"friction": f, "loop": p, "scores": v} for (f, p), v in one.predicted.items()],
        }
        for one in study.predictions
    ]
    return {
        "text": study_text(study),
        "board": [one._asdict() for one in study.board],
        "predictions": predictions,
        "comparisons": [
            {**one._asdict(), "contest": one.contest._asdict(), "ranking": one.ranking and one.ranking.to_json()}
            for one in found
        ],
        "trials": [{**one._asdict(), "contest": one.contest.name, "version": one.contest.version} for one in trials],
    }


def write_study(folder: Path, study: Study) -> Path:
    """Write numbers, figures and page into a folder; return the page."""
    write_json(folder / "real_ai_gym.json", to_json(study))
    figures, tables, text = study_figures(study.trials, study.found), study_tables(study), study_text(study)
    write_figures(figures, folder / "figures")
    title = "Would the contests' simulation have picked the right controller?"
    return write_layer_page(folder / "real_ai_gym.html", title, [], figures, tables, text)
