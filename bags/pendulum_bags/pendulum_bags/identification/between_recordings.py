"""What the recordings of a fit say one by one: whether they are of one machine, and how far they differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pendulum_bags.distributions import f_quantile, student_quantile

__all__ = ["Alone", "excluding", "half_width"]

_SURE = 3.0
"""Standard errors to each side within which a parameter of a recording lies."""

_FEWEST = 3
"""Recordings that tell how far recordings differ: two of unlike motions differ by what the model lacks in each."""

_MANY = 1e6
"""Degrees of freedom of the recordings' own errors, which already count how few windows they come from."""


@dataclass(frozen=True)
class Alone:
    """One recording, fitted without the others: values, and standard errors of those that have one, by parameter."""

    name: str
    values: Mapping[str, float]
    errors: Mapping[str, float]


def excluding(alone: Sequence[Alone], ratios: Mapping[str, float], unit: Callable[[str], str]) -> str | None:
    """Return that two recordings exclude each other: they are of two machines, or of one with two loads.

    Up to the ``ratios`` of its parameters, what differs may be one machine's: what the model lacks moves it.
    """
    for name, ratio in ratios.items():
        rows = [
            (one.values[name] - _SURE * one.errors[name], one.values[name], one.values[name] + _SURE * one.errors[name])
            for one in alone
            if name in one.errors
        ]
        labels = [one.name for one in alone if name in one.errors]
        if len(rows) < 2:
            continue
        small, large = min(range(len(rows)), key=lambda i: rows[i][2]), max(range(len(rows)), key=lambda i: rows[i][0])
        if rows[small][2] < rows[large][0] and rows[large][1] > ratio * rows[small][1]:
            listing = " and ".join(f"{rows[i][0]:.4g} to {rows[i][2]:.4g} ({labels[i]})" for i in (small, large))
            return (
                f"The recordings exclude each other: fitted alone, {name} is {listing} {unit(name)}; a common fit "
                "describes neither. Expected recordings of one machine with one load: fit them one by one."
            )
    return None


def half_width(name: str, alone: Sequence[Alone], error: float, freedom: float) -> tuple[float, float]:
    """Return half of the 95 % interval of a parameter of the common fit, and its standard error.

    What differs from recording to recording is part of the error, with as few degrees of freedom as there are
    recordings. It is the most that differs with a confidence of 75 %: where three recordings happen to agree, an
    estimate would be 0. Means of 20 000 draws lie within it in 97 to 98 % where nothing differs, in 94 to 95 % where
    that is as large as the recordings' errors, and at 5 times them in 93 % of three recordings. Two are too few.

    Source:
        DerSimonian and Laird, Controlled Clinical Trials 7, 1986, and Viechtbauer, Statistics in Medicine 26, 2007 (the
        component and its bound); Satterthwaite, Biometrics Bulletin 2, 1946 (degrees of freedom).
    """
    half = float(student_quantile(0.975, freedom)) * error
    rows = np.array([(one.values[name], one.errors[name]) for one in alone if one.errors.get(name, 0.0) > 0.0])
    if len(rows) < _FEWEST:
        return half, error
    values, weights = rows[:, 0], 1.0 / rows[:, 1] ** 2
    total, squares = weights.sum(), np.sum(weights**2)
    few = len(rows) - 1
    # The quarter quantile of a chi-square distribution.
    least = few * float(f_quantile(0.25, few, 1e9))
    excess = float(weights @ (values - weights @ values / total) ** 2) - least
    if not excess > 0.0:
        return half, error
    own, between = 1.0 / total, excess / (total - squares / total) * squares / total**2
    both = (own + between) ** 2 / (own**2 / _MANY + between**2 / few)
    wide = float(np.sqrt(own + between))
    return max(half, float(student_quantile(0.975, both)) * wide), max(error, wide)
