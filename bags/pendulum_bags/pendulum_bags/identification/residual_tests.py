"""Are the residuals noise? Whiteness, independence of the input, and windows that stand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.solver import residuals

__all__ = ["ResidualTests", "residual_tests"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ResidualTests:
    """Outcome of the residual tests.

    Args:
        autocorrelation: At lags 0, 1, 2, ... samples, shape (m,).
        cross_correlation: With the input, at lags -m to m samples (positive: the input leads), shape (2 m + 1,).
        bound: 99 % bound for each value under independence.
        white: Whether the Ljung-Box test accepts whiteness at 1 %.
        white_p: Its p-value.
        independent: Whether no cross-correlation with the past input exceeds its Bonferroni bound at 1 %.
        worst_cross: Largest absolute cross-correlation with the past input.
        samples: Number of residuals.
        outliers: Windows whose rms exceeds five times the median: (recording, start [s], end [s], rms [rad]).
        sentences: The outcome in words.
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


def residual_tests(fit: OutputErrorFit, *, lags: int = 25) -> ResidualTests:
    """Test the residuals of a fit, window by window (no product reaches across windows).

    Args:
        fit: The fit.
        lags: Largest lag [samples].

    Source:
        Ljung, System Identification, sec. 16.6; Ljung and Box, Biometrika 65, 1978.
    """
    parts = residuals(fit.model, fit.pieces, fit.chosen.solution.states)
    segments, inputs, rms = [], [], []
    labels: list[tuple[str, float, float]] = []
    for part, piece in zip(parts, fit.pieces, strict=True):
        drive = _input_at_samples(piece)
        for first, stop in piece.windows:
            r = part[first:stop]
            segments.append(r)
            inputs.append(drive[first:stop])
            rms.append(float(np.sqrt(np.mean(r**2))))
            time = piece.recording.time
            labels.append((piece.recording.name, float(time[first]), float(time[stop - 1])))
    lags = min(lags, min(len(s) for s in segments) - 2)
    auto = _correlation(segments, segments, lags)[lags:]
    cross = _correlation(inputs, segments, lags)
    samples = sum(len(s) for s in segments)
    states = 2 * len(segments)
    # The fitted window states and parameters take degrees of freedom, which shows as a small negative correlation.
    shift = (states + len(fit.chosen.free)) / samples
    statistic = (
        samples * (samples + 2) * float(np.sum((auto[1:] + shift) ** 2 / (samples - np.arange(1, lags + 1))))
    )
    white_p = float(stats.chi2.sf(statistic, lags))
    past = cross[lags:]
    # The input is coloured: its own correlation widens the bound of a sum over samples.
    own = _correlation(inputs, inputs, lags)[lags:]
    widening = float(np.sqrt(max(1.0 + 2.0 * np.sum(own[1:] * auto[1:]), 1.0)))
    limit = float(stats.norm.ppf(1.0 - 0.005 / past.size)) / np.sqrt(samples) * widening
    worst = float(np.max(np.abs(past)))
    independent = bool(worst <= limit)
    middle = float(np.median(rms))
    outliers = tuple(
        (*label, value)
        for label, value in zip(labels, rms, strict=True)
        if len(rms) > 3 and value > 5.0 * middle
    )
    white = white_p > 0.01
    sentences = []
    if white:
        sentences.append(
            f"The residuals are white (Ljung-Box p = {white_p:.2f}): the model explains all but noise."
        )
    else:
        sentences.append(
            f"The residuals are not white (lag-1 correlation {auto[1]:.2f}): the model misses some dynamics, and the "
            "intervals allow for it."
        )
    if not independent:
        sentences.append(
            f"The residuals correlate with past input by up to {worst:.2f} (bound {limit:.2f}): part of the response "
            "to the input is not in the model."
        )
    for name, start, end, value in outliers:
        sentences.append(
            f"{name}, {start:.2f} to {end:.2f} s, fits {value / middle:.0f} times worse than the median window: an "
            "outside force (a hand?), or a fault of the recording; the robust loss limits its weight."
        )
    bound = 2.576 / float(np.sqrt(samples))
    return ResidualTests(
        auto, cross, bound, white, white_p, independent, worst, samples, outliers, tuple(sentences)
    )


def _input_at_samples(piece: Piece) -> Array:
    recording = piece.recording
    if recording.input_time is None:
        return recording.input
    return np.asarray(np.interp(recording.time, recording.input_stamps, recording.input))


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
