"""Figures of the analysis: equivalence, alignment, spectra, distributions, effort, timing, pooled runs."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.comparison.alignment import Alignment
from pendulum_bags.comparison.equivalence import EquivalenceTest, Verdict
from pendulum_bags.comparison.spectra import Spectra
from pendulum_bags.comparison.statistics import kolmogorov_smirnov, quantile_pairs
from pendulum_bags.figures.figure import Figure, Mark, Panel, Trace
from pendulum_bags.figures.numbers import quantity, ratio_in_words
from pendulum_bags.report.data import ReportData
from pendulum_bags.runs.correlation import effective_size
from pendulum_bags.runs.series import Series

__all__ = [
    "alignment",
    "coherent_up_to",
    "distributions",
    "effort",
    "equivalence",
    "pooled_runs",
    "spectra",
    "spectrum_panels",
    "timing",
]


def _relative(test: EquivalenceTest) -> tuple[float, float, float]:
    """Return estimate and interval in units of the margin."""
    interval = test.interval
    values = (interval.estimate, interval.low, interval.high)
    if not math.isfinite(test.low) or math.isclose(test.low, -test.high):
        return values[0] / test.high, values[1] / test.high, values[2] / test.high
    scale = math.log(test.high)
    return tuple(math.log(max(value, 1e-9)) / scale for value in values)  # type: ignore[return-value]


def equivalence(verdict: Verdict) -> Figure:
    """Return every test of a verdict against its margin."""
    tests = list(verdict.tests)[::-1]
    measured = [test for test in tests if math.isfinite(test.interval.estimate)]
    traces = []
    for outcome in ("equivalent", "not equivalent", "undecided"):
        rows = [i for i, test in enumerate(tests) if test.outcome.value == outcome and test in measured]
        if rows:
            middle, low, high = (np.array(v) for v in zip(*(_relative(tests[i]) for i in rows), strict=True))
            traces.append(Trace(middle, np.array(rows, dtype=float), outcome, outcome, "interval", low, high))
    closest = max(measured, key=lambda test: abs(_relative(test)[0]))
    sentence = (
        f"{verdict.sentence} The quantity nearest to (or farthest beyond) its margin is the {closest.quantity}: "
        f"{quantity(closest.interval.estimate, closest.unit.replace('-', ''))}, {closest.interval.title} "
        f"{quantity(closest.interval.low)} to {quantity(closest.interval.high)}, resting on "
        f"{closest.interval.blocks} independent blocks."
    )
    names = [test.quantity if test in measured else f"{test.quantity}: not measured" for test in tests]
    reach = max(1.3, *(abs(value) * 1.08 for test in measured for value in _relative(test)))
    panel = Panel(
        "difference [margins]",
        "",
        traces,
        marks=[Mark(-1.0, "x"), Mark(1.0, "x"), Mark(0.0, "x")],
        y_ticks=names,
        x_range=(-reach, reach),
        y_range=(-0.6, len(tests) - 0.4),
    )
    return Figure(
        "equivalence",
        "Equivalence tests",
        sentence,
        [panel],
        section="Verdict",
        panel_height=60 + 34 * len(tests),
    )


def _lags(found: Alignment, label: str, role: str, title: str) -> Panel:
    return Panel(
        "lag of the hardware [ms]",
        "correlation [−]",
        [Trace(1e3 * found.lags, found.curve, label, role)],
        marks=[Mark(1e3 * found.delay, "x", f"{1e3 * found.delay:.2f} ms")],
        title=title,
        x_range=(-100.0, 100.0),
    )


def alignment(data: ReportData) -> Figure:
    """Return the cross-correlations from which clocks and delay were taken."""
    pair = data.comparison.pairs[0]
    response = pair.response
    panels = [_lags(response, "velocities", "hw", "Response")]
    text = ""
    if pair.clock is not None:
        clock = pair.clock
        panels.insert(0, _lags(clock, "disturbances", "noise", "Clock"))
        same = "are one signal" if pair.is_paired else "are not one signal"
        if pair.is_paired and clock.correlation < 0.98:
            same = "are one signal, but for samples that a plant skipped or repeated"
        shift = quantity(1e3 * clock.delay, "ms")
        text = f"The recorded disturbances {same}: correlation {clock.correlation:.3f} at {shift}. "
    sentence = (
        f"{text}The cross-correlation of the velocities peaks at a shift of {1e3 * response.delay:.2f} ms, with "
        f"{response.correlation:.3f} there and {response.correlation_at_zero:.3f} as recorded."
    )
    if data.comparison.is_paired:
        delay = 1e3 * data.comparison.delay
        result = f"is {delay:.2f} ms" if math.isfinite(delay) else "cannot be determined: there is no peak"
        sentence += f" The tested delay, at one phase of the noise samples and so without their hold, {result}."
    return Figure(
        "alignment",
        "Alignment of clocks and delay",
        sentence,
        panels,
        stacked=False,
        section="Paired comparison",
    )


def spectrum_panels(result: Spectra, unit: str = "rad", of: str = "") -> list[Panel]:
    """Return power spectra and coherence of both velocities; ``of`` ends the titles, such as ``, elbow``."""
    frequency = result.frequency[1:]
    return [
        Panel(
            "frequency [Hz]",
            f"velocity PSD [({unit}/s)²/Hz]",
            [
                Trace(frequency, result.first[1:], "simulation", "sim"),
                Trace(frequency, result.second[1:], "hardware", "hw"),
            ],
            x_log=True,
            y_log=True,
            title=f"Power spectral density{of}",
        ),
        Panel(
            "frequency [Hz]",
            "coherence [−]",
            [Trace(frequency, result.coherence[1:], "coherence", "difference")],
            marks=[Mark(result.threshold, "y", "5 % level of independent signals")],
            x_log=True,
            y_range=(0.0, 1.02),
            title=f"Coherence{of}",
        ),
    ]


def coherent_up_to(result: Spectra) -> str:
    """Return up to where both velocities are coherent, as text."""
    reach = result.coherent_up_to
    return f"up to {reach:.0f} Hz" if reach > result.frequency[1] else "at no frequency"


def spectra(data: ReportData) -> Figure:
    """Return power spectra and coherence of the velocities."""
    pair = data.comparison.pairs[0]
    result = pair.spectra
    step = result.frequency[2] - result.frequency[1]
    power = [float(np.sum(one[1:]) * step) for one in (result.first, result.second)]
    sentence = (
        f"The hardware's velocity has {quantity(power[1] / power[0])} times the power of the simulation's; the two are "
        f"coherent {coherent_up_to(result)} ({result.segments:.1f} independent segments)."
    )
    return Figure(
        "spectra",
        "Spectra and coherence",
        sentence,
        spectrum_panels(result),
        stacked=False,
        section="Paired comparison",
        panel_height=230,
    )


def distributions(data: ReportData) -> Figure:
    """Return quantile plots and distribution functions of angle and velocity."""
    pair = data.comparison.pairs[0]
    sim, hw = pair.simulation.window, pair.hardware.window
    panels, words = [], []
    for name, title, unit, shift in (
        ("position", "angle", "θ − π [rad]", math.pi),
        ("velocity", "velocity", "θ′ [rad/s]", 0.0),
    ):
        first, second = getattr(sim, name) - shift, getattr(hw, name) - shift
        a, b = quantile_pairs(first, second)
        ends = np.array([min(a[0], b[0]), max(a[-1], b[-1])])
        panels.append(
            Panel(
                f"simulation {unit}",
                f"hardware {unit}",
                [Trace(ends, ends, "equal", "reference"), Trace(a, b, "quantiles", "hw", "points")],
                title=f"Quantiles of the {title}",
            )
        )
        panels.append(
            Panel(
                unit,
                "share below [−]",
                [
                    Trace(*_distribution(first), "simulation", "sim", "step"),
                    Trace(*_distribution(second), "hardware", "hw", "step"),
                ],
                title=f"Distribution of the {title}",
            )
        )
        found = kolmogorov_smirnov(first, second)
        words.append(
            f"{title}: D = {found.distance:.3f}, p = {found.p_value:.2g} with {found.sizes[0]:.0f} and "
            f"{found.sizes[1]:.0f} effective samples of {sim.t.size} and {hw.t.size}"
        )
    sentence = f"Kolmogorov-Smirnov distances, counted with effective sample sizes: {'; '.join(words)}."
    return Figure(
        "distributions",
        "Distributions",
        sentence,
        panels,
        stacked=False,
        section="Paired comparison",
        panel_height=220,
    )


def _distribution(values: Array) -> tuple[Array, Array]:
    levels = np.linspace(0.0, 1.0, min(400, values.size))
    return np.quantile(values, levels), levels


def effort(data: ReportData) -> Figure:
    """Return what the controllers spent: integral of squared torque and mechanical work over time."""
    pair = data.comparison.pairs[0]
    runs = [("simulation", "sim", pair.simulation.window), ("hardware", "hw", pair.hardware.window)]
    heat = [(label, role, series.t, _cumulative(series, series.effort**2)) for label, role, series in runs]
    work = [
        (label, role, series.t, _cumulative(series, series.effort * series.velocity)) for label, role, series in runs
    ]
    panels = [
        Panel("time since the noise began [s]", text, [Trace(t, y, label, role) for label, role, t, y in curves])
        for text, curves in (("∫u² dt [N² m² s]", heat), ("∫u θ′ dt [J]", work))
    ]
    ratio = float(heat[1][3][-1] / heat[0][3][-1]) if heat[0][3][-1] > 0.0 else float("nan")
    sign = "takes energy out of" if work[1][3][-1] < 0.0 else "puts energy into"
    whose = "recorded input" if data.comparison.of_files else "controller"
    sentence = (
        f"The {whose} on hardware spends ∫u² dt = {quantity(float(heat[1][3][-1]), 'N² m² s')}, "
        f"{ratio_in_words(ratio)} than in simulation; it {sign} the hardware "
        f"({quantity(float(work[1][3][-1]), 'J')})."
    ).replace("equal within half a per cent than", "within half a per cent of what it spends")
    return Figure("effort", "Effort and energy", sentence, panels, section="Paired comparison", panel_height=150)


def _cumulative(series: Series, values: Array) -> Array:
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(series.t)
    return np.concatenate(([0.0], np.cumsum(steps)))


def timing(data: ReportData) -> Figure:
    """Return the intervals between states, as stamped and as they arrived at the recorder."""
    pair = data.comparison.pairs[0]
    panels, words = [], []
    for label, role, run in (("simulation", "sim", pair.simulation), ("hardware", "hw", pair.hardware)):
        # Rounded to nanoseconds: an axis would enlarge rounding errors of equal intervals.
        stamped, arrived = np.round(1e3 * np.diff(run.window.t), 6), np.round(1e3 * run.arrival, 6)
        traces = [Trace(*_distribution(arrived), "arrival at the recorder", role, "step")] if arrived.size else []
        traces.append(Trace(*_distribution(stamped), "stamps", "difference", "step"))
        panels.append(Panel("interval [ms]", "share below [−]", traces, title=label.capitalize()))
        late = float(np.quantile(arrived, 0.99)) if arrived.size else float("nan")
        missed = run.missed_deadlines
        words.append(
            f"{label} {run.rate_hz:.1f} Hz, {missed} missed deadline{'s' if missed != 1 else ''}, "
            f"99 % of the intervals at the recorder below {late:.1f} ms"
        )
    sentence = f"During the noise: {'; '.join(words)}."
    return Figure("timing", "Timing of the states", sentence, panels, stacked=False, section="Timing", panel_height=200)


_OF_EACH_RUN: tuple[tuple[str, str, Callable[[Array], float]], ...] = (
    ("std of θ [rad]", "position", lambda values: float(values.std(ddof=1))),
    ("mean of θ − π [rad]", "position", lambda values: float(values.mean()) - math.pi),
    ("std of θ′ [rad/s]", "velocity", lambda values: float(values.std(ddof=1))),
    ("largest |u| [N m]", "effort", lambda values: float(np.abs(values).max())),
)


def pooled_runs(data: ReportData) -> Figure | str:
    """Return spreads and means of every run, where there are several."""
    pairs = data.comparison.pairs
    if len(pairs) < 2:
        return "needs at least two runs"
    number = np.arange(1, len(pairs) + 1, dtype=float)
    panels = []
    for unit, name, function in _OF_EACH_RUN:
        traces = [
            Trace(number, np.array([function(getattr(run.window, name)) for run in runs]), label, role, "points")
            for label, role, runs in (
                ("simulation", "sim", [pair.simulation for pair in pairs]),
                ("hardware", "hw", [pair.hardware for pair in pairs]),
            )
        ]
        # Integer ticks only.
        panels.append(Panel("run", unit, traces, x_range=(0.5, number.size + 0.5), x_step=math.ceil(number.size / 10)))
    spreads = [pair.hardware.window.position.std(ddof=1) for pair in pairs]
    total = sum(effective_size(pair.hardware.window.position) for pair in pairs)
    sentence = (
        f"Over {len(pairs)} runs the spread of the hardware's angle lies between {quantity(min(spreads), 'rad')} and "
        f"{quantity(max(spreads), 'rad')}; together they hold {total:.0f} effective samples of it."
    )
    return Figure("pooled_runs", "All runs", sentence, panels, stacked=False, section="Repeated runs", panel_height=200)
