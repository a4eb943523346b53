"""The uncertainty of a plant: shares of its parameters, given or identified, and plants drawn from them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.joint_run import identified_names
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, load_plant_file

__all__ = [
    "THESIS_UNCERTAINTY",
    "VARIED",
    "Uncertainty",
    "parse_uncertainty",
    "uncertain_names",
    "uncertainty_of",
]

VARIED = ("inertia", "damping", "gravity", "coulomb_friction")
"""Parameters of one joint that may be uncertain."""

_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of a plant's parameters.

    Attributes:
        shares: Standard deviation of each parameter as a share of its value, 0 to 1; others are known.
        correlation: Of the parameters in the order of ``shares``; empty where they are independent.
    """

    shares: Mapping[str, float] = field(default_factory=dict)
    correlation: Sequence[Sequence[float]] = ()
    source: str = "given"

    def __post_init__(self) -> None:
        """Refuse what makes no distribution."""
        for name, value in self.shares.items():
            if not (math.isfinite(value) and 0.0 <= value <= 1.0):
                raise ParameterError(f"uncertainty of {name} is {value}; expected a share from 0 to 1")
        self._factor()

    def check(self, plant: PlantParameters) -> None:
        """Refuse names that are none of a plant's uncertain parameters."""
        names = uncertain_names(plant)
        for name in self.shares:
            if name not in names:
                raise ParameterError(f"uncertainty of {name!r} is unknown; expected one of {', '.join(names)}")

    def draw(self, plant: PlantParameters, count: int, generator: np.random.Generator) -> dict[str, Array]:
        """Return log-normal values of all uncertain parameters, shape (count,) each; reproducible by the generator.

        For one joint all of ``VARIED`` are drawn, so that a further parameter leaves the others unchanged; those of
        several joints are independent.
        """
        self.check(plant)
        if plant.is_pendulum:
            return self.scatter(plant, generator.standard_normal((len(VARIED), count)), correlated=True)
        return self.scatter(plant, generator.standard_normal((len(self.shares), count)), correlated=False)

    def variations(self, plant: PlantParameters, drawn: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
        """Return what the batch engine varies: static friction of one joint follows its Coulomb friction."""
        if not plant.is_pendulum:
            return {name: drawn[name] for name in self.shares}
        found = {name: drawn[name] for name in VARIED}
        ratio = (plant.static_friction or 0.0) / plant.coulomb_friction if plant.coulomb_friction > 0.0 else 0.0
        if ratio > 0.0:
            found["static_friction"] = ratio * drawn["coulomb_friction"]
        else:
            del found["coulomb_friction"]
        return found

    def scatter(self, plant: PlantParameters, normals: Array, *, correlated: bool) -> dict[str, Array]:
        """Return plants for standard normal numbers, shape (k, n): log-normal about the plant's values.

        The k parameters are ``VARIED`` of one joint, else those of ``shares``.
        """
        varied = VARIED if plant.is_pendulum else tuple(self.shares)
        factor, variances = self._factor(correlated=correlated)
        logarithms = np.zeros_like(normals)
        names = list(self.shares)
        rows = [varied.index(name) for name in names]
        for row, weights, variance in zip(rows, factor, variances, strict=True):
            # Sums in a stated order: a matrix product may round otherwise on another machine.
            for weight, source in zip(weights, rows, strict=True):
                if weight != 0.0:
                    logarithms[row] += weight * normals[source]
            logarithms[row] -= 0.5 * variance
        return {name: plant.value(name) * np.exp(logarithms[row]) for row, name in enumerate(varied)}

    def _factor(self, *, correlated: bool = True) -> tuple[Array, Array]:
        """Return L with L L' = covariance of the logarithms, and its diagonal."""
        shares = np.array([self.shares[name] for name in self.shares], dtype=np.float64)
        size = shares.size
        correlation = np.eye(size)
        if correlated and len(self.correlation):
            correlation = np.array(self.correlation, dtype=np.float64)
            if correlation.shape != (size, size) or not np.allclose(correlation, correlation.T, atol=1e-9):
                raise ParameterError(
                    f"correlation has shape {correlation.shape}; expected a symmetric one of {size} x {size}"
                )
        with np.errstate(invalid="ignore", divide="ignore"):
            covariance = np.log1p(correlation * np.outer(shares, shares))
        known = shares == 0.0
        covariance[known, :] = covariance[:, known] = 0.0
        factor = np.zeros((size, size))
        open_ = np.flatnonzero(~known)
        try:
            factor[np.ix_(open_, open_)] = np.linalg.cholesky(covariance[np.ix_(open_, open_)])
        except np.linalg.LinAlgError:
            raise ParameterError(
                f"correlation {np.round(correlation, 4).tolist()} of {', '.join(self.shares)} is not positive definite"
            ) from None
        return factor, np.diag(covariance)


THESIS_UNCERTAINTY = Uncertainty({"inertia": 0.3, "damping": 0.05, "gravity": 0.05})
"""Approximate uncertainty of the plant of the thesis."""


def uncertain_names(plant: PlantParameters) -> Sequence[str]:
    """Return the names of the parameters that may be uncertain: of one joint ``VARIED``, else what is identified."""
    return VARIED if plant.is_pendulum else identified_names(plant)


def _share_of_interval(interval: Sequence[float], value: float) -> float:
    """Return the standard deviation of a 95 % interval, as a share of the value, 1 at most."""
    low, high = interval
    return float(min(1.0, abs((high - low) / (2.0 * _NORMAL_95 * value)))) if value else 0.0


def parse_uncertainty(text: str, plant: str) -> Uncertainty:
    """Return the uncertainty that a text names.

    Args:
        text: ``identified`` for the intervals in the plant file; one share for all parameters, such as ``0.05``; or
            ``NAME=SHARE,...``, such as ``inertia=0.3`` or ``cart_mass=0.1,pole.damping=0.5``. Empty for none.

    Raises:
        ParameterError: An unknown name, an invalid share, or a file without intervals.
    """
    if text.strip() == "identified":
        return uncertainty_of(plant)
    parameters = load_mechanism(plant)
    names = uncertain_names(parameters)
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if len(parts) == 1:
        with suppress(ValueError):
            share = float(parts[0])
            parts = [f"{name}={share}" for name in names if parameters.value(name) != 0.0]
    shares: dict[str, float] = {}
    for part in parts:
        name, _, value = (piece.strip() for piece in part.partition("="))
        try:
            shares[name] = float(value)
        except ValueError:
            raise ParameterError(
                f"uncertainty has {part!r}; expected identified, one share, or NAME=SHARE, such as {names[0]}=0.05"
            ) from None
    found = Uncertainty(shares)
    found.check(parameters)
    return found


def uncertainty_of(plant_file: str) -> Uncertainty:
    """Return an identification's uncertainty, for one joint the covariance next to the file, or a ParameterError."""
    plant, provenance = load_plant_file(plant_file)
    intervals = provenance.get("intervals", {}) if Path(plant_file).suffix else {}
    names = VARIED if plant.is_pendulum else intervals
    known = {name: _share_of_interval(intervals[name], plant.value(name)) for name in names if name in intervals}
    shares = {name: share for name, share in known.items() if share > 0.0}
    if not shares:
        raise ParameterError(f"plant {plant_file} has no intervals; expected the file of an identification")
    path = Path(plant_file).with_suffix(".json")
    if not plant.is_pendulum or not path.is_file():
        return Uncertainty(shares, source=f"intervals of {plant_file}, taken for independent")
    try:
        covariance = json.loads(path.read_text(encoding="utf-8"))["covariance"]
        order, matrix = list(covariance["names"]), np.array(covariance["matrix"], dtype=np.float64)
        rows = [order.index(name) for name in shares]
        found = matrix[np.ix_(rows, rows)]
        values = np.array([plant.value(name) for name in shares])
        deviations = np.sqrt(np.diag(found))
        correlation = found / np.outer(deviations, deviations)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise ParameterError(
            f"{path} has no covariance of {', '.join(shares)} ({error}); expected the JSON that identify --out wrote"
        ) from error
    shares = {name: float(min(1.0, share)) for name, share in zip(shares, deviations / values, strict=True)}
    return Uncertainty(shares, correlation.tolist(), f"covariance of {path}")
