"""Identification from recordings to the judged result: fit, residuals, intervals, geometry, held-out scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone

import numpy as np
from threadpoolctl import threadpool_limits

from pendulum_bags.identification.explained import explained, undetermined_fit
from pendulum_bags.identification.geometry import check_geometry
from pendulum_bags.identification.options import DEFAULTS, Options
from pendulum_bags.identification.output_error import OutputErrorFit, fit_output_error
from pendulum_bags.identification.problem import prepare
from pendulum_bags.identification.readings import DOUBTFUL_SHARE
from pendulum_bags.identification.residual_tests import residual_tests
from pendulum_bags.identification.result import IdentificationResult, fingerprint
from pendulum_bags.identification.solver import solve
from pendulum_bags.identification.uncertainty import assess
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.runs.datasets import Recording, distinct_names
from pendulum_msgs_py.errors import DataError

__all__ = ["identify"]


# BLAS splits long sums by the cores that it finds, and a fit magnifies the last digits: on one core, a recording has
# the same result on every worker.
@threadpool_limits.wrap(limits=1, user_api="blas")
def identify(
    recordings: Sequence[Recording],
    options: Options = DEFAULTS,
    *,
    held_out: Sequence[Recording] = (),
    profiles: int = 2,
) -> IdentificationResult:
    """Identify a pendulum by output error and judge the result.

    Args:
        recordings: Data to fit; all of one pendulum, with one kind of input.
        options: Choices; the defaults serve unseen data.
        held_out: Recordings to score only.
        profiles: For how many weak parameters to compute profile intervals.
    """
    _check_distinct(recordings, held_out)
    if recordings and all(r.input_kind == "effort" and not np.any(r.input) for r in recordings):
        # A column of zeros is no drive: a gain or a delay of it could be anything.
        recordings = [replace(r, input_kind="none", meta={**r.meta, "no_torque": True}) for r in recordings]
        held_out = [replace(r, input_kind="none") if not np.any(r.input) else r for r in held_out]
    fit = fit_output_error(recordings, options)
    tests = residual_tests(fit)
    account = explained(fit, tests.outliers)
    explains = account.share <= DOUBTFUL_SHARE
    uncertainty = assess(fit, tests, profiles=0 if account.refusal is not None else profiles, explains=explains)
    if account.refusal is None and (lost := undetermined_fit(fit, uncertainty)) is not None:
        account = replace(account, refusal=lost)
    geometry = check_geometry(fit.model, uncertainty, options.geometry)
    scores = {}
    for name, recording in zip(distinct_names(held_out), held_out, strict=True):
        if recording.input_kind == "position_goal":
            scores[name] = free_run(fit.model, recording, fitted=False)
        else:
            scores[name] = window_score(fit.model, recording, fit.window)
    created = datetime.now(timezone.utc).isoformat(timespec="seconds")
    moved = {
        name: found
        for name, recording in zip(scores, held_out, strict=True)
        if (found := _moved_zero(fit, recording, scores[name].rms)) is not None
    }
    return IdentificationResult(fit, uncertainty, tests, geometry, scores, created, account, moved)


def _moved_zero(fit: OutputErrorFit, recording: Recording, rms: float) -> tuple[float, float] | None:
    """Return how far the zero of a recording lies from that of the fit [rad] and its rms with it, if that is better."""
    if recording.input_kind == "position_goal":
        return None
    piece = prepare(recording, fit.window)
    found = solve(fit.model, [piece], ("angle_offset",), scale=fit.scale, tolerance=1e-5, max_iterations=20)
    own = window_score(found.model, recording, fit.window).rms
    return (found.model["angle_offset"] - fit.model["angle_offset"], own) if own < 0.8 * rms else None


def _check_distinct(recordings: Sequence[Recording], held_out: Sequence[Recording]) -> None:
    """Refuse data that count twice: intervals would be too narrow, a held-out score too good."""
    prints = [fingerprint(recording)["sha256"] for recording in (*recordings, *held_out)]
    names = distinct_names([*recordings, *held_out])
    for i, own in enumerate(prints):
        j = prints.index(own)
        if j == i or j >= len(recordings):
            continue
        if i < len(recordings):
            raise DataError(f"{names[i]} has the same samples as {names[j]}; expected each recording once")
        raise DataError(f"{names[i]} took part in the fit as {names[j]}; expected another recording to hold out")
