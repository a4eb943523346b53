"""A ranking as a layer of the verdict, a figure, a page and a table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from pendulum_bags.distributions import Interval
from pendulum_bags.figures.figure import Figure, Panel, Trace
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.table import Table
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.pages.layer_page import write_layer_page
from pendulum_bags.ranking.ranking import Ranking
from pendulum_bags.runs.case import UNKNOWN, Case
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.verdict import Evidence, Layer, LayerResult, Mark, name_in, write_layer

__all__ = [
    "REGRET_MARGIN",
    "Words",
    "print_ranking",
    "ranking_figure",
    "ranking_tables",
    "same_choice",
    "write_ranking",
]

REGRET_MARGIN = 0.1
"""Regret that does not matter, as a share of the hardware's best cost."""
_SHOWN_PAIRS = 8
_UNKNOWN_SEEDS = (
    "No seeds are given, and both sides may share their disturbances: the upper limit of the regret is taken at 0.25 % "
    "instead of 2.5 %. A table with a column seed, another for each disturbance, narrows it."
)


@dataclass(frozen=True)
class Words:
    """What a ranking is called by, which depends on how its runs were made.

    ``more`` records more; ``in_frequency`` compares the plants in frequency, empty where that was done; ``cost`` is a
    sentence.
    """

    more: str = "record more seeds: --seeds 10"
    in_frequency: str = "experiment frequency_response"
    cost: str = "Cost: mean of q11 e² + q22 v² + r u², that of the thesis's LQR unless other weights were asked for."


def same_choice(ranking: Ranking, words: Words = Words(), case: Case = UNKNOWN) -> LayerResult:
    """Return layer 4: yes where the regret is small, no where large, undecided where its runs scatter or are few.

    A pick that fails on the hardware in any run is a no, whatever it costs.
    """
    regret = ranking.regret_share
    share = [regret.value, regret.low, regret.high]
    fails = ""
    if ranking.pick_failed:
        fails = f"which fails on the hardware in {ranking.pick_failed} of {ranking.pick_runs} runs"
    if fails or share[1] > REGRET_MARGIN:
        mark = Mark.NO
    elif share[2] <= REGRET_MARGIN:
        mark = Mark.YES
    else:
        mark = Mark.UNDECIDED
    sure = [pair for pair in ranking.wrong if pair.sure]
    srcc = f"{ranking.srcc.value:.3f}" if np.isfinite(ranking.srcc.value) else "nothing that can be told"
    if np.isfinite(ranking.srcc.low):
        srcc += f" ({ranking.srcc.low:.3f} to {ranking.srcc.high:.3f})"
    what = "Scores" if ranking.of_scores else "Costs"
    low, high = ranking.spearman_ends
    ends_of_ranks = f" ({low:.2f} to {high:.2f} over the runs)" if np.isfinite(low) else ""
    sentence = (
        f"The simulation picks {ranking.pick}, {fails or _regret_words(ranking)}. {what} correlate with {srcc}, ranks "
        f"with {ranking.spearman:.2f}{ends_of_ranks}; "
        f"{len(ranking.wrong)} of {ranking.pairs} pairs are in the wrong order, {len(sure)} of them surely."
    )
    if sure:
        sentence += f" The dearest: {sure[0].picked} before {sure[0].better}, because {sure[0].reason}."
    sentence += f" {ranking.few}" if ranking.few else ""
    sentence += f" {_UNKNOWN_SEEDS}" if ranking.unknown_seeds and not ranking.no_interval else ""
    unit = "of the cost"
    ends = [100.0 * end if np.isfinite(end) else None for end in share]
    note = fails.removeprefix("which ") or ranking.no_interval or _unbounded(ranking)
    evidence = (
        Evidence(
            "regret of the simulation's pick",
            "%",
            ends[0],
            ends[1],
            ends[2],
            f"at most {100.0 * REGRET_MARGIN:g} %",
            mark,
            note,
        ),
        Evidence("SRCC (Pearson)", "", ranking.srcc.value, ranking.srcc.low, ranking.srcc.high, "", mark),
        Evidence("rank correlation (Spearman)", "", ranking.spearman, *ranking.spearman_ends, "", mark),
        Evidence("MMRV", unit, ranking.mmrv.value, ranking.mmrv.low, ranking.mmrv.high, "", mark),
        Evidence("pairs surely in the wrong order", "", float(len(sure)), None, None, f"of {ranking.pairs}", mark),
        *(Evidence("fails on one side only", "", None, mark=Mark.NO, note=name) for name in ranking.failures),
    )
    steps = (words.more,) if mark is Mark.UNDECIDED else ()
    if mark is Mark.NO:
        where = f"compare the plants in frequency, where {ranking.pick} works"
        steps = (f"{where}: {words.in_frequency}",) if words.in_frequency else ()
    percent = [100.0 * value for value in share]
    dearer = f"{percent[0]:.0f} % {'below' if ranking.of_scores else 'dearer than'} {ranking.best}"
    if np.isinf(share[0]):
        dearer = fails or f"though {_unbounded(ranking)}"
    reason = {
        Mark.YES: f"the simulation's pick is on the hardware at most {percent[2]:.0f} % worse than the best of "
        f"{len(ranking.names)}",
        Mark.NO: f"the simulation would have picked {ranking.pick}, {dearer}",
        Mark.UNDECIDED: f"the regret of the simulation's pick has no interval: {ranking.no_interval}"
        if ranking.no_interval
        else f"the regret of the simulation's pick, {percent[1]:.0f} to {percent[2]:.0f} %, is not measured well "
        "enough",
    }[mark]
    return LayerResult(Layer.SAME_CHOICE, mark, sentence, evidence, steps, reason, case=case)


def _regret_words(ranking: Ranking) -> str:
    share = ranking.regret_share
    same = "which is the best on the hardware too" if ranking.pick == ranking.best else f"not {ranking.best}"
    if np.isinf(share.value):
        return f"{same}: a regret without bound, since {_unbounded(ranking)}"
    interval = f"95 % interval {100.0 * share.low:.1f} to {100.0 * share.high:.1f} %"
    if ranking.no_interval:
        interval = f"no interval: {ranking.no_interval}"
    size = f"{ranking.regret.value:.3g}, " if ranking.of_scores else ""
    return f"{same}: a regret of {size}{100.0 * share.value:.1f} % ({interval})"


def _unbounded(ranking: Ranking) -> str:
    """Return why a share of the best's cost is infinite, empty where it is not."""
    return f"{ranking.best} costs nothing on the hardware" if np.isinf(ranking.regret_share.value) else ""


def ranking_figure(ranking: Ranking) -> Figure:
    """Draw the cost on the hardware over that in simulation."""
    sim, hw = np.array(ranking.sim), np.array(ranking.hw)
    able = np.isfinite(sim) & np.isfinite(hw)
    wrong = {name for pair in ranking.wrong if pair.sure for name in (pair.picked, pair.better)}
    astray = np.array([name in wrong for name in ranking.names]) & able
    span = np.array([min(sim[able].min(), hw[able].min()), max(sim[able].max(), hw[able].max())])
    traces = [Trace(span, span, "equal cost", "reference")]
    for chosen, label, role in (
        (able & ~astray, "in order", "certified"),
        (astray, "in a pair surely in the wrong order", "not certified"),
    ):
        if chosen.any():
            traces.append(Trace(sim[chosen], hw[chosen], label, role, "points"))
    for name, label, role in (
        (ranking.pick, "simulation's pick", "own alone"),
        (ranking.best, "best on hardware", "unstable"),
    ):
        at = [i for i, other in enumerate(ranking.names) if other == name and able[i]]
        traces.append(Trace(sim[at], hw[at], label, role, "points"))
    failed = int(np.sum(~able))
    sentence = f"{int(able.sum())} controllers; SRCC {ranking.srcc.value:.3f}, MMRV {ranking.mmrv.value:.3g}." + (
        f" {failed} more failed on a side and are not drawn." if failed else ""
    )
    what = "score" if ranking.of_scores else "cost"
    log = bool(np.all(span > 0.0)) and not ranking.of_scores
    panel = Panel(f"{what} in simulation [-]", f"{what} on hardware [-]", traces, x_log=log, y_log=log)
    return Figure(
        "ranking", f"{what.capitalize()}s of the controllers on both sides", sentence, [panel], panel_height=360
    )


def ranking_rows(ranking: Ranking) -> list[tuple[str, ...]]:
    """Return a row for each contender, best on the hardware first: rank and cost on both sides."""
    costs = -np.array(ranking.sim) if ranking.of_scores else np.array(ranking.sim)
    order = np.argsort(np.argsort(costs, kind="stable"), kind="stable")
    means = ranking.means or [Interval(np.nan, np.nan, np.nan)] * len(ranking.names)
    return [
        (name, str(i + 1), str(int(order[i]) + 1), _cost(hw, mean), _cost(sim))
        for i, (name, sim, hw, mean) in enumerate(zip(ranking.names, ranking.sim, ranking.hw, means, strict=True))
    ]


def _head(ranking: Ranking) -> tuple[str, ...]:
    what = "score" if ranking.of_scores else "cost"
    return "controller", "rank on hardware", "rank in simulation", f"{what} on hardware (95 %)", f"{what} in simulation"


def _cost(value: float, mean: Interval | None = None) -> str:
    if not np.isfinite(value):
        return "failed"
    ends = f" ({mean.low:.4g} to {mean.high:.4g})" if mean and np.isfinite(mean.low) else ""
    return f"{value:.4g}{ends}"


def _pair_rows(ranking: Ranking) -> list[tuple[str, ...]]:
    return [
        (
            pair.picked,
            pair.better,
            f"{pair.sim:.3g}" if np.isfinite(pair.sim) else "the other fails",
            f"{pair.hw:.3g}" if np.isfinite(pair.hw) else "fails",
            "yes" if pair.sure else "no",
            pair.reason,
        )
        for pair in ranking.wrong[:_SHOWN_PAIRS]
    ]


def ranking_tables(ranking: Ranking, words: Words = Words()) -> list[Table]:
    """Return the table of the contenders, and that of the pairs in the wrong order."""
    tables = [Table("Controllers", words.cost, _head(ranking), ranking_rows(ranking))]
    if ranking.wrong:
        tables.append(
            Table(
                "Pairs in the wrong order",
                f"The {min(_SHOWN_PAIRS, len(ranking.wrong))} dearest of {len(ranking.wrong)}, sure ones first.",
                (
                    "simulation prefers",
                    "hardware prefers",
                    "better in simulation by",
                    "dearer on hardware by",
                    "sure",
                    "reason",
                ),
                _pair_rows(ranking),
            )
        )
    return tables


def write_ranking(
    folder: Path,
    ranking: Ranking,
    formats: Sequence[str] = ("png", "pdf"),
    words: Words = Words(),
    notes: Sequence[str] = (),
    *,
    emulated: bool = False,
    case: Case = UNKNOWN,
) -> Path:
    """Write numbers, layer, figure and page, with notes at its end, into a folder; return the page."""
    folder.mkdir(parents=True, exist_ok=True)
    layer = name_in(same_choice(ranking, words, case), emulated=emulated)
    write_json(folder / "ranking.json", ranking.to_json())
    write_layer(folder, layer)
    figures = [name_in(ranking_figure(ranking), emulated=emulated)]
    write_figures(figures, folder / "figures", formats)
    tables = ranking_tables(ranking, words)
    return write_layer_page(
        folder / "ranking.html", "Ranking of controllers", [layer], figures, tables, notes, emulated=emulated
    )


def print_ranking(console: Console, ranking: Ranking, words: Words = Words()) -> None:
    """Print contenders, wrong pairs and the layer's sentence."""
    table = number_table("Both sides", *_head(ranking))
    for row in ranking_rows(ranking):
        table.add_row(*row)
    console.print(table)
    layer = same_choice(ranking, words)
    console.print(f"{layer.layer.title}: {layer.mark.value}", style="bold")
    console.print(layer.sentence, markup=False)
    console.print(
        f"MMRV {ranking.mmrv.value:.3g} (95 % interval {ranking.mmrv.low:.3g} to {ranking.mmrv.high:.3g}), in units of "
        f"the {'score' if ranking.of_scores else 'cost'}.",
        markup=False,
    )
