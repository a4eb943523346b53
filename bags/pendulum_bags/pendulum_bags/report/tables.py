"""Tables of the report: plants, statistics of the difference, tests, metrics, eigenvalues, model, provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pendulum_bags.comparison import Comparison
from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.identification.thesis_figures import GRAVITY, INERTIA, UNITS, TrialSet
from pendulum_bags.pages.layer_page import evidence_table
from pendulum_bags.report.data import ReportData
from pendulum_bags.verdict import Layer, LayerResult, Mark
from pendulum_bags.verdict.same_run import seen_note
from pendulum_lqr.design_command.design_cli import THESIS_WEIGHTS
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise, sort_poles
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS

__all__ = ["make_tables", "parameter_rows", "tests_table", "typeset"]


def make_tables(data: ReportData) -> list[Table]:
    """Return all tables that the data allow, in the order of the report."""
    regressions = [table for trials in data.trials for table in _regression(trials)]
    own = (_plants(data), tests_table(data.comparison), _paired(data), _unpaired(data), _metrics(data))
    layers = [evidence_table(result) for result in data.answer.layers if _is_further(result)]
    return [one for one in (*own, _eigenvalues(data), _model(data)) if one is not None] + layers + regressions


def _is_further(result: LayerResult) -> bool:
    return result.layer is not Layer.SAME_RUN and result.mark is not Mark.NOT_MEASURED and bool(result.evidence)


_PLANT_NAMES = {"sim": "simulation", "hw": "hardware", "sim_500hz": "simulation, own noise"}
_PLANT_ROWS = (
    ("noise recorded [s]", "duration_s", 3),
    ("sampling rate [Hz]", "rate_hz", 4),
    ("missed deadlines", "missed_deadlines", 6),
    ("noise sample held for [s]", "noise_hold_time", 3),
    ("std of θ [rad]", "std_theta", 4),
    ("std of θ′ [rad/s]", "std_theta_dot", 4),
    ("largest |u| [N m]", "max_abs_u", 4),
    ("rms of u [N m]", "rms_u", 4),
    ("samples", "samples", 8),
    ("effective samples of θ", "effective_samples", 3),
)


def _plants(data: ReportData) -> Table:
    plants = data.comparison.plants
    rows = [
        (label, *(_cell(plant.get(key), digits) for plant in plants.values()))
        for label, key, digits in _PLANT_ROWS
        if not (data.comparison.of_files and all(plant.get(key) is None for plant in plants.values()))
    ]
    sim, hw = plants["sim"], plants["hw"]
    runs = len(data.comparison.pairs)
    pooled = f"All samples of {runs} runs, so that a run counts by their number. " if runs > 1 else ""
    sentence = (
        f"{pooled}The torque is at most "
        f"{quantity(max(sim['max_abs_u'], hw['max_abs_u']), 'N m')}; "
        f"{int(sim['missed_deadlines'])} deadlines were missed in simulation and {int(hw['missed_deadlines'])} on "
        f"hardware. {seen_note(data.comparison)}"
    )
    return Table("Plants under noise", sentence, ("", *(_PLANT_NAMES[name] for name in plants)), rows, "Verdict")


def tests_table(comparison: Comparison) -> Table:
    """Return every test of a comparison against its margin."""
    rows = []
    for test in comparison.verdict.tests:
        interval = test.interval
        margin = (
            f"{quantity(test.low)} to {quantity(test.high)}"
            if math.isfinite(test.low)
            else f"below {quantity(test.high)}"
        )
        more = (
            "–" if test.more_runs == 0 else ("more runs hardly help" if test.more_runs is None else str(test.more_runs))
        )
        rows.append(
            (
                test.quantity + (f" [{test.unit}]" if test.unit != "-" else ""),
                quantity(interval.estimate),
                f"{quantity(interval.low)} to {quantity(interval.high)}",
                margin,
                test.outcome.value,
                quantity(test.smallest_margin),
                more,
            )
        )
    head = (
        "quantity",
        "estimate",
        comparison.verdict.tests[0].interval.title,
        "margin",
        "result",
        "smallest margin that would hold",
        "runs to add",
    )
    verdict = comparison.verdict
    sentence = (
        f"Two one-sided tests each, of long-run values, intervals by block jackknife. {comparison.looks.sentence} "
        f"{comparison.what_of}Ratios are hardware per simulation; "
        "distances are root mean "
        f"squares, per standard deviation of the hardware's motion where they are in %. Compared with "
        f"{verdict.margins.whose}."
    )
    if looks := comparison.looks.number:
        often = "once" if looks == 1 else f"{looks} times"
        sentence += (
            f" The experiment tested the data {often}, and could have tested more data after that. The intervals are "
            "wider for this."
        )
    return Table("Tests against the margins", sentence, head, rows, "Verdict")


def _statistics(block: Mapping[str, Any], title: str, sentence: str, section: str) -> Table:
    names = list(block["position"])
    rows = [(name, _cell(block["position"][name], 4), _cell(block["velocity"][name], 4)) for name in names]
    return Table(title, sentence, ("", "Δθ [rad]", "Δθ′ [rad/s]"), rows, section)


def _paired(data: ReportData) -> Table | None:
    block = data.comparison.paired
    if "position" not in block:
        return None
    sentence = (
        f"Hardware minus simulation under one disturbance, at the slower plant's stamps: "
        f"rms {quantity(block['rms_position'], 'rad')} and {quantity(block['rms_velocity'], 'rad/s')}."
    )
    return _statistics(block, "Statistics of the paired difference", sentence, "Paired comparison")


def _unpaired(data: ReportData) -> Table:
    block = data.comparison.unpaired
    position, velocity = block["position"], block["velocity"]
    small = abs(position["mean"]) < 0.01 and abs(velocity["mean"]) < 0.05
    sentence = (
        "As the thesis concludes, the mean differences of position and velocity are close to zero "
        "(below 0.01 rad and 0.05 rad/s)."
        if small
        else f"Unlike in the thesis, the means are not close to zero: {quantity(position['mean'], 'rad')} and "
        f"{quantity(velocity['mean'], 'rad/s')}."
    )
    return _statistics(block, "Statistics of the difference", sentence, "The thesis's analysis")


def _metrics(data: ReportData) -> Table:
    noisy = data.run.get("disturbance", {}).get("kind") in _RANDOM
    rows = [
        (
            f"{_metric_name(row['metric'], noisy=noisy)} [{row['unit'].replace('^2', '²')}]",
            _cell(row["sim"], 4),
            _cell(row["hw"], 4),
            row["meaning"],
        )
        for row in data.comparison.metrics
    ]
    ratio = {row["metric"]: (row["sim"], row["hw"]) for row in data.comparison.metrics}
    rough = ratio.get("smoothness", (None, None))
    sentence = (
        f"The torque changes at {quantity(rough[0], 'N m/s')} (rms) in simulation and {quantity(rough[1], 'N m/s')} "
        "on hardware."
        if rough[0] is not None and rough[1] is not None
        else "Metrics of the regulation."
    )
    return Table(
        "Metrics of the regulation",
        sentence,
        ("metric", "simulation", "hardware", "meaning"),
        rows,
        "Paired comparison",
        folded=True,
    )


_RANDOM = ("uniform", "gaussian", "multisine", "prbs", "from_bag")


def _metric_name(metric: str, *, noisy: bool) -> str:
    return "mean error at the end" if noisy and metric == "steady_state_error" else metric.replace("_", " ")


def _eigenvalues(data: ReportData) -> Table | None:
    if data.plant is None or data.plant.drivetrain is not None:
        return None
    model = linearise(data.plant)
    open_loop = sort_poles(np.linalg.eigvals(model.A).astype(complex))
    rows = [("none", "–", "–", "–", _poles(open_loop), "–")]
    for number, (q, r) in enumerate(THESIS_WEIGHTS, start=1):
        gain = output_lqr(model, q, r)
        values = (f"{q[0]:g}", f"{q[1]:g}", f"{r:g}", _poles(gain.poles), ", ".join(f"{k:.6f}" for k in gain.K))
        rows.append((str(number), *values))
    chosen = data.run.get("controller", {})
    ran = [*chosen.get("q", ()), chosen.get("r")]
    used = next((number for number, (q, r) in enumerate(THESIS_WEIGHTS, start=1) if ran == [*q, r]), None)
    unstable = float(np.max(open_loop.real))
    sentence = f"Upright, the plant runs away at {unstable:.6f} s⁻¹ without control; " + (
        f"this run used combination {used}." if used else "this run used other weights than these."
    )
    head = ("#", "Q₁₁ [rad⁻²]", "Q₂₂ [s² rad⁻²]", "R [(N m)⁻²]", "eigenvalues [s⁻¹]", "K [N m/rad, N m s/rad]")
    return Table("Eigenvalues of the linearised system", sentence, head, rows, "Model")


def _poles(poles: Any) -> str:
    return ", ".join(
        f"{pole.real:.6f}".replace("-", "−") if abs(pole.imag) < 1e-12 else f"{pole:.6g}"
        for pole in np.atleast_1d(poles)
    )


def _model(data: ReportData) -> Table | None:
    plant = data.plant
    if plant is None:
        return None
    sentence = f"Simulation and design of the controller use the plant {plant.name!r}: M θ″ + b θ′ + G sin θ = u + d."
    head = ("parameter", "value", "unit", "meaning")
    return Table("Parameters of the model", sentence, head, parameter_rows(PLANT_SPECS, plant), "Model", folded=True)


def parameter_rows(specs: Sequence[ParameterSpec], values: object) -> list[tuple[str, ...]]:
    """Return name, value, unit and meaning of parameters, which are attributes of an object."""
    return [
        (spec.name, quantity(getattr(values, spec.name), "", 6), typeset(spec.unit), typeset(spec.description))
        for spec in specs
    ]


def _regression(trials: TrialSet) -> list[Table]:
    result = trials.result
    first = result.kind == "inertia_damping"
    section = INERTIA if first else GRAVITY
    rows = [
        (
            f"trial {number}, {name}",
            quantity(float(trial.values[i]), "", 5),
            quantity(float(trial.errors[i])),
            quantity(float(trial.t[i])),
            quantity(float(trial.p[i])),
            quantity(float(trial.intervals[i, 0]), "", 5),
            quantity(float(trial.intervals[i, 1]), "", 5),
            f"{trial.r_squared:.5f}",
        )
        for number, trial in enumerate(result.trials, start=1)
        for i, name in enumerate(trial.names)
    ]
    head = ("coefficient", "value", "standard error", "t", "p", "95 % from", "to", "R² (uncentred)")
    averages = [
        (
            f"{name} [{UNITS[name]}]",
            quantity(value, "", 5),
            *(quantity(end, "", 5) for end in result.intervals[name]),
        )
        for name, value in result.average.items()
    ]
    number = "1" if first else "2"
    return [
        Table(f"Regression of experiment {number}", " ".join(result.sentences), head, rows, section),
        Table(
            f"Coefficients of experiment {number}",
            f"Means over {len(result.trials)} trials, with the intervals of those means.",
            ("coefficient", "mean", "95 % from", "to"),
            averages,
            section,
        ),
    ]


_TYPESET = {
    "^2": "²",
    "^3": "³",
    "ohm": "Ω",
    "degC": "°C",
    "1/K": "K⁻¹",
    "tau_h": "τ_h",
    ">=": "≥",
    "theta'": "θ′",
    "theta": "θ",
    "tau_C": "τ_C",
    "tau_S": "τ_S",
    "1/s": "s⁻¹",
}


def typeset(text: str) -> str:
    """Return a unit or a meaning as it is printed, not as a terminal shows it."""
    for plain, printed in _TYPESET.items():
        text = text.replace(plain, printed)
    return "–" if text == "-" else text


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "–"
    if isinstance(value, int) or (isinstance(value, float) and value.is_integer() and abs(value) < 1e6):
        return f"{int(value)}".replace("-", "−")
    return quantity(float(value), "", digits)
