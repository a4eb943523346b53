"""The frequency response of a plant in closed loop, from a known excitation.

Feedback correlates the torque with the plant's noise, which biases output over torque towards the inverse of the
controller. The joint input-output estimate is unbiased: it relates both to the excitation r, which is independent of
noise,

    G = S_yr / S_ur

A periodic excitation is averaged over its periods, without leakage; another is cut into windowed segments that overlap
by half. The spread between blocks gives the confidence: ``|G_hat - G|^2 / deviation^2`` follows F(2, 2 (blocks - 1)).

Source: Ljung, System Identification, 2nd ed., 1999, section 13.5; Pintelon and Schoukens, System Identification: A
Frequency Domain Approach, 2nd ed., 2012, sections 2.5 to 2.7 and 4.3 (distortion on lines that were not excited).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array, Complex
from pendulum_bags.frequency_response.record import Record
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS
from pendulum_lqr.disturbances.multisine import multisine_harmonics
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.parameters import validate

__all__ = ["estimate", "periodic_lines"]

TRANSIENT = 1.0
"""Shortest time left out at the beginning [s]; whole periods of a periodic excitation."""
SEGMENT = 4.0
"""Length of the segments of a non-periodic excitation [s]; shorter if fewer than eight would fit."""
_LEAST_BLOCKS = 3
_LEAST_SEGMENTS = 6
_TOP = 0.96
"""Share of the Nyquist frequency up to which lines are used."""
_WEAK = 0.02
"""Least strength of the excitation on a line relative to its strongest (not periodic)."""


def periodic_lines(disturbance: Mapping[str, Any]) -> tuple[float, NDArray[np.int64]] | None:
    """Return period [s] and excited multiples of 1/period of a multisine, or None for another disturbance."""
    if disturbance.get("kind") != "multisine":
        return None
    known = {spec.name for spec in DISTURBANCE_SPECS}
    try:
        values = validate(DISTURBANCE_SPECS, {k: v for k, v in disturbance.items() if k in known})
        return float(values["signal_period"]), multisine_harmonics(values)
    except ParameterError as error:
        raise DataError(f"the recording's multisine cannot be understood: {error}") from error


def estimate(record: Record) -> MeasuredResponse:
    """Return the response from torque to angle and velocity; a DataError if the record is short or weak."""
    if float(np.ptp(record.excitation)) <= 0.0:
        raise DataError(
            f"{record.label} was not excited: its disturbance is constant; expected one with many frequencies"
        )
    found = periodic_lines(record.disturbance)
    if found is not None:
        return _periodic(record, *found)
    return _segments(record)


def _periodic(record: Record, length: float, harmonics: NDArray[np.int64]) -> MeasuredResponse:
    size = round(length / record.period)
    if abs(size * record.period - length) > 1e-3 * record.period:
        raise DataError(
            f"{record.label}: a signal period of {length:g} s is {length / record.period:.3f} sampling periods of "
            f"{record.period:g} s; expected a whole number"
        )
    skip = int(np.ceil(TRANSIENT / length))
    blocks = record.torque.size // size - skip
    if blocks < _LEAST_BLOCKS:
        raise DataError(
            f"{record.label} lasts {record.duration:.1f} s, {record.duration / length:.1f} periods of {length:g} s; "
            f"expected at least {skip + _LEAST_BLOCKS}: {skip} until the transient has died away and {_LEAST_BLOCKS} "
            "to average"
        )
    used = harmonics[harmonics <= _TOP * 0.5 * size]
    if not used.size:
        raise DataError(f"{record.label}: no excited line lies below the Nyquist frequency {0.5 / record.period:g} Hz")

    def spectra(values: Array) -> Complex:
        # The last whole periods: a run in real time may start late into its first.
        return np.fft.rfft(values[-blocks * size :].reshape(blocks, size), axis=1) / size

    # All end at one sample, the newest of whole periods since the start.
    end = (skip + blocks) * size
    r, u = spectra(record.excitation[:end]), spectra(record.torque[:end])
    y = np.stack([spectra(output[:end]) for output in record.outputs])
    found = _joint(record, used / length, r[:, used], u[:, used], y[:, :, used], float(blocks))
    return replace(found, distortion=_distortion(y, harmonics), facts=_facts(record, "whole periods", blocks, length))


def _segments(record: Record) -> MeasuredResponse:
    start = round(TRANSIENT / record.period)
    total = record.torque.size - start
    size = int(min(round(SEGMENT / record.period), 2 * total // (_LEAST_SEGMENTS + 3)))
    if size * record.period < 0.5:
        raise DataError(
            f"{record.label} lasts {record.duration:.1f} s; expected at least "
            f"{TRANSIENT + 0.25 * (_LEAST_SEGMENTS + 3):.1f} s of disturbance"
        )
    half = size // 2
    count = (total - size) // half + 1
    # Half-overlapping Hann windows share 1/6 of their power: Welch 1967, Bendat and Piersol section 11.5.
    effective = count / (1.0 + 2.0 * (1.0 / 6.0) ** 2 * (count - 1) / count)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(size) + 0.5) / size)

    def spectra(values: Array) -> Complex:
        settled = values[start:]
        settled = settled - settled.mean()
        pieces = np.stack([settled[k * half : k * half + size] for k in range(count)])
        return np.fft.rfft(pieces * window, axis=1) / window.sum()

    r, u = spectra(record.excitation), spectra(record.torque)
    y = np.stack([spectra(output) for output in record.outputs])
    power = np.mean(np.abs(r) ** 2, axis=0)
    # The window leaks two lines around 0 into the mean, and neighbours share their noise: every second line is used.
    lines = np.arange(2, int(_TOP * half), 2)
    lines = lines[power[lines] > _WEAK**2 * power.max()]
    if not lines.size:
        raise DataError(f"{record.label}: the disturbance has no power below {0.5 * _TOP / record.period:g} Hz")
    length = size * record.period
    found = _joint(record, lines / length, r[:, lines], u[:, lines], y[:, :, lines], effective)
    return replace(found, facts=_facts(record, "windowed segments", count, length))


def _joint(record: Record, frequency: Array, r: Complex, u: Complex, y: Complex, blocks: float) -> MeasuredResponse:
    """Return the joint input-output estimate from the spectra of blocks, shapes (blocks, n), (outputs, blocks, n)."""
    cross_ur = np.sum(u * np.conj(r), axis=0)
    cross_yr = np.sum(y * np.conj(r)[None], axis=1)
    power_r = np.sum(np.abs(r) ** 2, axis=0)
    response = cross_yr / cross_ur
    residual = y - response[:, None, :] * u[None]
    variance = np.sum(np.abs(residual) ** 2, axis=1) / y.shape[1] * blocks / (blocks - 1.0)
    deviation = np.sqrt(variance * power_r * y.shape[1] / blocks) / np.abs(cross_ur)
    power_y = np.sum(np.abs(y) ** 2, axis=1)
    coherence = np.abs(cross_yr) ** 2 / np.maximum(power_y * power_r, 1e-300)
    # Rounding limits the certainty of noiseless runs.
    floor = 1e-9 * np.abs(response)
    return MeasuredResponse(
        record.label,
        record.period,
        frequency,
        response,
        np.maximum(deviation, floor),
        np.clip(coherence, 0.0, 1.0),
        cross_ur / power_r,
        blocks,
        joints=record.joints,
        driven=record.driven,
    )


def _distortion(y: Complex, harmonics: NDArray[np.int64]) -> tuple[float, float]:
    top = min(int(harmonics[-1]), y.shape[2] - 1)
    odd = np.setdiff1d(np.arange(1, top + 1, 2), harmonics)
    excited = harmonics[harmonics <= top]
    if odd.size < 2:
        return np.nan, np.nan
    # Only what repeats from period to period is distortion.
    mean = np.mean(y, axis=1)
    noise = np.mean(np.abs(y - mean[:, None, :]) ** 2, axis=1) / max(1, y.shape[1] - 1)
    there = np.mean(np.maximum(np.abs(mean[:, odd]) ** 2 - noise[:, odd], 0.0), axis=1)
    linear = np.mean(np.abs(mean[:, excited]) ** 2, axis=1)
    ratio = np.sqrt(there / linear)
    half = ratio.size // 2
    return float(np.max(ratio[:half])), float(np.max(ratio[half:]))


def _facts(record: Record, method: str, blocks: int, length: float) -> dict[str, Any]:
    deviations = record.outputs - record.outputs.mean(axis=1, keepdims=True)
    largest = np.max(np.abs(deviations), axis=1)
    effort = float(np.max(np.abs(record.torque)))
    extent: dict[str, Any] = {
        "rms_angle_rad": float(np.std(record.outputs[0])),
        "largest_angle_rad": float(largest[0]),
        "largest_torque_nm": effort,
    }
    if record.joints:
        extent = {
            "largest_deviation": {name: float(value) for name, value in zip(record.joints, largest)},  # noqa: B905
            "largest_effort": effort,
        }
    return {
        **record.facts,
        "method": method,
        "blocks": blocks,
        "block_length_s": length,
        "excitation": {k: v for k, v in record.disturbance.items() if isinstance(v, (int, float, str))},
        **extent,
    }
