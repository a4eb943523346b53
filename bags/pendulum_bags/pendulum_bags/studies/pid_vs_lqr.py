"""PID against LQR: both controllers on both plants, the same noise and the same step, over many seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.metrics import METRICS, Episode, metrics_of
from pendulum_bags.distributions import mean_interval
from pendulum_bags.figures.figure import Figure, Mark, Panel, Trace
from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.studies.results import episode_of_run, group_runs
from pendulum_bags.studies.study_file import Study

__all__ = ["COMPARED", "analyse", "print_table"]

COMPARED = ("ise", "itae", "effort_energy", "smoothness", "max_effort")
"""Metrics taken from each run; smaller is better in all of them."""
OF_THE_MEAN = ("overshoot", "settling_time", "rise_time")
"""Metrics of the response to the step, taken from the mean over seeds, in which the noise has averaged out."""
_RESAMPLES = 500


def analyse(folder: Path, study: Study, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row for each plant and controller, and a paired test for each plant; write the figures."""
    records = _by_place(records)
    runs = {run.number: run for run in study.runs}
    responses: dict[tuple[str, str], list[Episode]] = {}
    for record in records:
        if record["status"] == "done":
            run = runs[record["number"]]
            assert run.spec is not None
            key = (str(record["labels"]["plant"]), str(record["labels"]["controller"]))
            responses.setdefault(key, []).append(episode_of_run(folder / "runs" / run.name, run.spec))
    rows = []
    for group in group_runs(records):
        key = (str(group.labels["plant"]), str(group.labels["controller"]))
        if key not in responses:
            continue
        row: dict[str, Any] = {"plant": key[0], "controller": key[1], "runs": len(group.seeds), "failed": group.failed}
        for name in COMPARED:
            mean, low, high = group.mean(name)
            worst, seed = group.worst(name)
            row[name] = {"mean": mean, "low": low, "high": high, "worst": worst, "worst_seed": seed}
        row.update(_mean_response(responses[key]))
        rows.append(row)
    paired = _paired(records)
    sentences = _sentences(paired)
    write_figures(_figures(paired, responses, sentences), folder / "figures")
    return {"rows": rows, "paired": paired, "sentences": sentences}


def print_table(console: Console, result: Mapping[str, Any]) -> None:
    """Print the table."""
    rows = result["rows"]
    headings = (f"{row['plant']} {row['controller']}\n{row['runs']} runs" for row in rows)
    table = number_table("PID and LQR: mean over seeds, 95 % interval, worst seed", "", *headings)
    units = {metric.name: metric.unit for metric in METRICS}
    for name in (*OF_THE_MEAN, *COMPARED):
        cells = []
        for row in rows:
            value = row[name]
            text = f"{_text(value['mean'])}\n{_text(value['low'])} to {_text(value['high'])}"
            worst = f"\nworst {value['worst']:.4g} (seed {value['worst_seed']})" if "worst" in value else ""
            cells.append(text + worst)
        table.add_row(f"{name} \\[{units[name]}]", *cells)
    console.print(table)
    for sentence in result["sentences"]:
        console.print(f"- {sentence}", markup=False)


def _text(value: float | None) -> str:
    return "never" if value is None else f"{value:.4g}"


def _mean_response(episodes: Sequence[Episode]) -> dict[str, Any]:
    errors = np.stack([episode.error for episode in episodes])
    first = episodes[0]

    def measure(rows: Array) -> dict[str, float]:
        mean = rows.mean(axis=0)
        # The step itself is known; its first sample carries the sensor's noise.
        return metrics_of(Episode(first.t, mean, first.velocity, first.effort, float(errors[:, 0].mean())))

    centre = measure(errors)
    generator = np.random.default_rng(0)
    draws = [measure(errors[generator.integers(0, len(errors), len(errors))]) for _ in range(_RESAMPLES)]
    found: dict[str, Any] = {}
    for name in OF_THE_MEAN:
        # A mean may be infinite: never settled.
        low, high = np.percentile([draw[name] for draw in draws], (2.5, 97.5), method="nearest")
        found[name] = {
            key: float(value) if math.isfinite(value) else None
            for key, value in (("mean", centre[name]), ("low", low), ("high", high))
        }
    return found


def _by_place(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the records with "plant" naming all conditions that the controllers share, at least the plant."""
    axes = [
        axis
        for axis in ("disturbance", "set_point", "start")
        if len({str(record["labels"][axis]) for record in records}) > 1
    ]
    found = []
    for record in records:
        labels = record["labels"]
        place = ", ".join([str(labels["plant"]), *(_condition(axis, labels[axis]) for axis in axes)])
        found.append({**record, "labels": {**labels, "plant": place}})
    return found


def _condition(axis: str, value: object) -> str:
    if axis == "disturbance":
        return str(value)
    return f"{axis.replace('_', '-')} {f'{value:g} rad' if isinstance(value, float) else value}"


def _paired(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Compare the controllers seed by seed, under the same noise."""
    values: dict[tuple[str, str], dict[tuple[int, int], Mapping[str, Any]]] = {}
    for record in records:
        if record["status"] == "done":
            labels = record["labels"]
            key = (labels["plant"], labels["controller"])
            values.setdefault(key, {})[(labels["seed"], labels["repeat"])] = record["metrics"]
    controllers = list(dict.fromkeys(controller for _, controller in values))
    found: list[dict[str, Any]] = []
    if len(controllers) != 2:
        return found
    one, other = controllers
    for plant in dict.fromkeys(plant for plant, _ in values):
        first, second = values.get((plant, one), {}), values.get((plant, other), {})
        common = sorted(first.keys() & second.keys())
        if len(common) < 2:
            continue
        for name in COMPARED:
            ratio = np.log([second[seed][name] / first[seed][name] for seed in common])
            mean, low, high = mean_interval(ratio)
            found.append(
                {
                    "plant": plant,
                    "metric": name,
                    "of": other,
                    "per": one,
                    "ratio": math.exp(mean),
                    "low": math.exp(low),
                    "high": math.exp(high),
                    "seeds": len(common),
                }
            )
    return found


def _sentences(paired: Sequence[Mapping[str, Any]]) -> list[str]:
    said = []
    for pair in paired:
        if pair["metric"] not in {"ise", "effort_energy", "smoothness"}:
            continue
        if pair["low"] > 1.0 and pair["ratio"] >= 2.0:
            verdict = f"{pair['ratio']:.1f} times"
        elif pair["low"] > 1.0 or pair["high"] < 1.0:
            verdict = f"{100.0 * abs(pair['ratio'] - 1.0):.1f} % {'more' if pair['ratio'] > 1.0 else 'less'} than"
        else:
            verdict = "not distinguishable from"
        said.append(
            f"On {pair['plant']}, {pair['metric']} of {pair['of']} is {verdict} that of {pair['per']}: ratio "
            f"{pair['ratio']:.3f} (95 % interval {pair['low']:.3f} to {pair['high']:.3f}, {pair['seeds']} pairs)."
        )
    return said


def _figures(
    paired: Sequence[Mapping[str, Any]], responses: Mapping[tuple[str, str], Sequence[Episode]], said: Sequence[str]
) -> list[Figure]:
    roles = {0: "sim", 1: "hw", 2: "aligned", 3: "difference"}
    panels: list[Panel] = []
    for plant in dict.fromkeys(plant for plant, _ in responses):
        traces = []
        for index, ((_, controller), episodes) in enumerate(
            (key, value) for key, value in responses.items() if key[0] == plant
        ):
            errors = 1e3 * np.stack([episode.error for episode in episodes])
            t = episodes[0].t
            role = roles[index % len(roles)]
            low, high = np.percentile(errors, (5.0, 95.0), axis=0)
            legend = "" if panels else f"{controller}: mean of {len(episodes)} seeds"
            traces.append(Trace(t, errors.mean(axis=0), legend, role))
            traces.append(Trace(t, low, "" if panels or index else "5 to 95 % of the seeds", "reference"))
            traces.append(Trace(t, high, "", "reference"))
        panels.append(Panel("time [s]", "theta - set-point [mrad]", traces, title=plant))
    figures = [
        Figure("pid_vs_lqr_step", "Step under noise", " ".join(said), panels, section="pid_vs_lqr", panel_height=230)
    ]
    panels = []
    for plant in dict.fromkeys(pair["plant"] for pair in paired):
        pairs = [pair for pair in paired if pair["plant"] == plant]
        trace = Trace(
            np.array([pair["ratio"] for pair in pairs]),
            np.arange(len(pairs), dtype=float),
            "" if panels else f"{pairs[0]['of']} per {pairs[0]['per']}, paired, 95 % interval",
            "sim",
            kind="interval",
            low=np.array([pair["low"] for pair in pairs]),
            high=np.array([pair["high"] for pair in pairs]),
        )
        ticks = [pair["metric"] for pair in pairs]
        panels.append(Panel("ratio [-]", "", [trace], [Mark(1.0, "x")], title=plant, y_ticks=ticks, x_log=True))
    if panels:
        title = "One controller's metrics in units of the other's"
        figures.append(Figure("pid_vs_lqr_ratio", title, " ".join(said), panels, section="pid_vs_lqr"))
    return figures
