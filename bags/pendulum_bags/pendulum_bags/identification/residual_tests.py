"""Are the residuals noise? Whiteness, independence of the input, and windows that stand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.distributions import chi_square_tail, student_quantile
from pendulum_bags.identification.missing import missing_torques
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.readings import errors_by_window
from pendulum_bags.identification.selection import effective_samples, implausible_rival
from pendulum_bags.identification.solver import residuals
from pendulum_bags.runs.datasets import distinct_names

__all__ = ["INCOMPLETE", "ResidualTests", "residual_tests"]

INCOMPLETE = "MODEL INCOMPLETE"
"""How the sentence begins that no interval covers what the model lacks."""


_LAGS = 25
"""Largest lag of a correlation [samples]."""

_NOTHING = 1e-4
"""Error of a fit over that of straight lines below which nothing is missing, whatever what is left looks like."""


@dataclass(frozen=True)
class ResidualTests:
    """Outcome of the residual tests.

    Args:
        autocorrelation: At lags 0, 1, 2, ... samples, shape (m,).
        cross_correlation: With the input, at lags -m to m samples (positive: the input leads), shape (2 m + 1,).
        bound: 99 % bound for each value under independence.
        white: Whether the Ljung-Box test accepts whiteness at 1 %.
        white_p: Its p-value.
        independent: Whether the residuals depend on no past input, at 1 % over all lags.
        worst_cross: Largest absolute cross-correlation with the past input.
        samples: Number of residuals.
        outliers: Windows whose rms exceeds five times the median: (recording, start and end from its
            first sample [s], rms [rad]).
        sentences: The outcome in words.
        incomplete: Whether they depend on the input, look like a torque, or ask for a friction that was left out:
            then the model lacks something, and the first sentence says what.
    """

    autocorrelation: Array
    cross_correlation: Array
    bound: float
    white: bool
    white_p: float
    independent: bool
    worst_cross: float
    samples: int
    outliers: tuple[tuple[str, float, float, float], ...]
    sentences: tuple[str, ...]
    incomplete: bool = False


def residual_tests(fit: OutputErrorFit) -> ResidualTests:
    """Test the residuals of a fit up to ``_LAGS`` samples; no product reaches across windows.

    Whether they depend on the input or on the motion is asked by sums over blocks that are longer than the residuals
    are correlated: correlated noise alone does not make such a dependence.

    Source:
        Ljung, System Identification, sec. 16.6; Ljung and Box, Biometrika 65, 1978; Carlstein, Annals of Statistics
        14, 1986 (blocks).
    """
    parts = residuals(fit.model, fit.pieces, fit.chosen.solution.states)
    segments, inputs, rms = [], [], []
    labels: list[tuple[str, float, float]] = []
    names = distinct_names([piece.recording for piece in fit.pieces])
    for name, part, piece in zip(names, parts, fit.pieces, strict=True):
        recording, time = piece.recording, piece.recording.time
        drive = np.interp(time, recording.input_stamps, recording.input)
        for first, stop in piece.windows:
            r = part[first:stop]
            segments.append(r)
            inputs.append(drive[first:stop])
            rms.append(float(np.sqrt(np.mean(r**2))))
            labels.append((name, float(time[first] - time[0]), float(time[stop - 1] - time[0])))
    lags = min(_LAGS, min(len(s) for s in segments) - 2)
    auto = _correlation(segments, segments, lags)[lags:]
    cross = _correlation(inputs, segments, lags)
    samples = sum(len(s) for s in segments)
    states = 2 * len(segments)
    # The fitted window states and parameters take degrees of freedom, which shows as a small negative correlation.
    shift = (states + len(fit.chosen.free)) / samples
    statistic = samples * (samples + 2) * float(np.sum((auto[1:] + shift) ** 2 / (samples - np.arange(1, lags + 1))))
    white_p = chi_square_tail(statistic, lags)
    white = white_p > 0.01
    memory = samples / effective_samples(segments)
    block = int(np.clip(np.ceil(4.0 * memory), 8, max(8, min(len(s) for s in segments) // 2)))
    worst = float(np.max(np.abs(cross[lags:])))
    independent = not any(_depends(inputs, segments, lag, block, lags + 1) for lag in range(lags + 1))
    explained, lines = errors_by_window(parts, fit.pieces)
    # A ten thousandth of the motion is what an integration leaves over: it is no torque of a pendulum.
    if float(np.sqrt(np.mean(explained**2))) < _NOTHING * float(np.sqrt(np.mean(lines**2))):
        independent = True
        missing: Sequence[str] = ()
    elif fit.pieces[0].recording.input_kind == "position_goal":
        missing = ()
    else:
        shown = missing_torques(fit.model, fit.pieces, parts, fit.free)
        missing = [words for words in shown if words not in fit.chosen.gains]
    # Windows at rest fit to the last digit, and would make every motion stand out.
    moving = [value for value in rms if value > 1e-6 * max(rms)]
    middle = float(np.median(moving)) if moving else 0.0
    outliers = tuple(
        (*label, value) for label, value in zip(labels, rms, strict=True) if len(rms) > 3 and value > 5.0 * middle > 0.0
    )
    said = _sentences(white, white_p, float(auto[1]) if lags else 0.0, worst, independent, missing)
    left_out = _left_out(fit)
    if left_out is not None:
        said.insert(0, left_out)
    if outliers:
        said.append(_outlier_sentence(_stretches(outliers), middle))
    bound = 2.576 / float(np.sqrt(samples))
    return ResidualTests(
        auto,
        cross,
        bound,
        white,
        white_p,
        independent,
        worst,
        samples,
        outliers,
        tuple(said),
        incomplete=not independent or bool(missing) or left_out is not None,
    )


Outlier: TypeAlias = tuple[str, float, float, float]


def _stretches(outliers: Sequence[Outlier]) -> list[list[Outlier]]:
    stretches: list[list[Outlier]] = []
    for one in outliers:
        last = stretches[-1][-1] if stretches else None
        if last is not None and last[0] == one[0] and one[1] - last[2] < 0.5 * (one[2] - one[1]):
            stretches[-1].append(one)
        else:
            stretches.append([one])
    return stretches


def _outlier_sentence(stretches: Sequence[Sequence[Outlier]], middle: float) -> str:
    places: dict[str, list[str]] = {}
    for stretch in stretches:
        places.setdefault(stretch[0][0], []).append(f"{stretch[0][1]:.2f} to {stretch[-1][2]:.2f} s after its start")
    listing = "; ".join(f"{name}, {', '.join(spans)}" for name, spans in places.items())
    times = [one[3] / middle for stretch in stretches for one in stretch]
    worse = f"{min(times):.0f} to {max(times):.0f}" if round(min(times)) != round(max(times)) else f"{times[0]:.0f}"
    return (
        f"{listing}: the fit is {worse} times worse there than in the median window, as with an outside force, a fault "
        "of the recording, or a motion that shows more of what the model lacks; the robust loss limits the weight."
    )


def _sentences(
    white: bool, white_p: float, lag_1: float, worst: float, independent: bool, missing: Sequence[str]
) -> list[str]:
    said = []
    if missing or not independent:
        of = []
        if not independent:
            of.append(f"depends on the past input (correlation up to {worst:.2f})")
        if missing:
            of.append(f"looks like {', or '.join(missing[:3])}")
        said.append(
            f"{INCOMPLETE}: what the fit leaves over {' and '.join(of)}. The pendulum does something that no candidate "
            "model has. The parameters stand in for it and may be off by far more than their "
            "intervals say: an interval covers noise, the choice among the candidates and the scatter between parts of "
            "the data, never what all candidates lack."
        )
    if white:
        said.append(f"The residuals are white (Ljung-Box p = {white_p:.2f}): noise is all that is left over.")
    else:
        said.append(
            f"The residuals are not white (lag-1 correlation {lag_1:.2f}): the sensor's error is correlated, torques "
            "act that were not recorded, or the model misses some dynamics. The intervals allow for the first two; no "
            "interval covers the third."
        )
    return said


def _left_out(fit: OutputErrorFit) -> str | None:
    """Return that a friction was left out as implausible which the data clearly speak for, or None."""
    rival = implausible_rival(fit.candidates, fit.chosen)
    if rival is None:
        return None
    sliding, excess = (rival.as_searched.model[name] for name in ("coulomb_friction", "stribeck_excess"))
    times = f", {1.0 + excess / sliding:.1f} times the sliding one" if sliding > 1e-3 * excess else " and none sliding"
    return (
        f"{INCOMPLETE}: a static friction of {sliding + excess:.3g} N m{times}, would fit far better "
        f"({1e3 * rival.training_rms:.3g} mrad in place of {1e3 * fit.chosen.training_rms:.3g} mrad), but more than "
        "three times is seldom friction and mostly stands in for something else (play, a cogging torque, a cable). It "
        "was not taken, and the other parameters may be off by far more than their intervals say. If the joint does "
        f"stick so hard, say `--friction {rival.friction}`."
    )


def _depends(signals: Sequence[Array], segments: Sequence[Array], lag: int, block: int, tests: int) -> bool:
    """Return whether residuals depend on an earlier signal, at 1 % over all ``tests`` (Bonferroni)."""
    mean = float(np.mean(np.concatenate(signals)))
    sums = []
    for signal, segment in zip(signals, segments, strict=True):
        product = (signal[: signal.size - lag] - mean) * (segment[lag:] - np.mean(segment))
        edges = np.arange(0, product.size, block)
        sums.append(np.add.reduceat(product, edges))
    values = np.concatenate(sums)
    scale = float(np.sqrt(values @ values))
    if values.size < 3 or scale <= 0.0:
        return False
    return bool(abs(values.sum()) / scale > student_quantile(1.0 - 0.005 / tests, values.size - 1))


def _correlation(first: Sequence[Array], second: Sequence[Array], lags: int) -> Array:
    """Return the pooled correlation of first(t - lag) with second(t) at lags -m to m, means removed."""
    mean_a = float(np.mean(np.concatenate(first)))
    mean_b = float(np.mean(np.concatenate(second)))
    total = np.zeros(2 * lags + 1)
    power_a = power_b = 0.0
    for a, b in zip(first, second, strict=True):
        x, y = a - mean_a, b - mean_b
        power_a += float(x @ x)
        power_b += float(y @ y)
        for lag in range(-lags, lags + 1):
            total[lag + lags] += float(x[: len(x) - lag] @ y[lag:]) if lag >= 0 else float(x[-lag:] @ y[:lag])
    return total / max(np.sqrt(power_a * power_b), 1e-300)
