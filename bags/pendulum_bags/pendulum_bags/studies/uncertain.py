"""The uncertainty of a plant: shares of its parameters, given or identified, and plants drawn from them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import load_yaml
from pendulum_msgs_py.plants.plant_parameters import PRESETS, PlantParameters

__all__ = [
    "THESIS_UNCERTAINTY",
    "VARIED",
    "Uncertainty",
    "batch_variations",
    "parse_uncertainty",
    "share_of_interval",
    "uncertainty_of",
]

VARIED = ("inertia", "damping", "gravity", "coulomb_friction")
"""Parameters that may be uncertain."""

_NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of a plant's parameters.

    Attributes:
        shares: Standard deviation of each parameter as a share of its value, 0 to 1; others are known.
        correlation: Of the parameters in the order of ``shares``; empty where they are independent.
        source: Where this comes from, as text.
    """

    shares: Mapping[str, float] = field(default_factory=dict)
    correlation: Sequence[Sequence[float]] = ()
    source: str = "given"

    def __post_init__(self) -> None:
        """Refuse what makes no distribution."""
        for name, value in self.shares.items():
            if name not in VARIED:
                raise ParameterError(f"uncertainty of {name!r} is unknown; expected one of {', '.join(VARIED)}")
            if not (math.isfinite(value) and 0.0 <= value <= 1.0):
                raise ParameterError(f"uncertainty of {name} is {value}; expected a share from 0 to 1")
        self._factor()

    def draw(self, plant: PlantParameters, count: int, generator: np.random.Generator) -> dict[str, Array]:
        """Return values of every parameter of ``VARIED``, shape (count,) each; reproducible by the generator."""
        return self.scatter(plant, generator.standard_normal((len(VARIED), count)), correlated=True)

    def scatter(self, plant: PlantParameters, normals: Array, *, correlated: bool) -> dict[str, Array]:
        """Return plants for standard normal numbers of shape (len(VARIED), n): log-normal about the plant's values.

        A plant of negative inertia is no plant. Mean and deviation are those of the value, not of its logarithm.

        Args:
            plant: The nominal plant.
            normals: One row for each of ``VARIED``.
            correlated: False takes the parameters for independent.
        """
        factor, variances = self._factor(correlated=correlated)
        logarithms = np.zeros_like(normals)
        names = list(self.shares)
        rows = [VARIED.index(name) for name in names]
        for row, weights, variance in zip(rows, factor, variances, strict=True):
            # Sums in a stated order: a matrix product may round otherwise on another machine.
            for weight, source in zip(weights, rows, strict=True):
                if weight != 0.0:
                    logarithms[row] += weight * normals[source]
            logarithms[row] -= 0.5 * variance
        return {name: getattr(plant, name) * np.exp(logarithms[row]) for row, name in enumerate(VARIED)}

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


def batch_variations(plant: PlantParameters, drawn: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
    """Return what the batch engine varies: static friction follows Coulomb friction in its proportion."""
    found = {name: drawn[name] for name in VARIED}
    ratio = (plant.static_friction or 0.0) / plant.coulomb_friction if plant.coulomb_friction > 0.0 else 0.0
    if ratio > 0.0:
        found["static_friction"] = ratio * drawn["coulomb_friction"]
    else:
        # Nothing varies; the plant's own static friction stays.
        del found["coulomb_friction"]
    return found


def share_of_interval(interval: Sequence[float], value: float) -> float:
    """Return the standard deviation that a 95 % interval stands for, as a share of the value, 1 at most."""
    low, high = interval
    return float(min(1.0, abs((high - low) / (2.0 * _NORMAL_95 * value)))) if value else 0.0


def parse_uncertainty(text: str, plant: str) -> Uncertainty:
    """Return the uncertainty that a text names: ``identified``, or shares such as ``inertia=0.3,damping=0.05``.

    Args:
        text: The text; empty for none.
        plant: Preset or plant file, for ``identified``.
    """
    if text.strip() == "identified":
        return uncertainty_of(plant)
    shares: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        try:
            shares[name.strip()] = float(value)
        except ValueError:
            raise ParameterError(
                f"uncertainty has {part!r}; expected identified, or NAME=SHARE, such as damping=0.05"
            ) from None
    return Uncertainty(shares)


def uncertainty_of(plant_file: str) -> Uncertainty:
    """Return an identification's uncertainty: its covariance, from the JSON next to the plant file, else its intervals.

    Raises:
        ParameterError: The file has no intervals.
    """
    if plant_file in PRESETS:
        raise ParameterError(f"plant {plant_file!r} is a preset; expected the file of an identification")
    entries = load_yaml(plant_file, "plant file").get("parameters", {})
    shares: dict[str, float] = {}
    for name in VARIED:
        entry = entries.get(name)
        if isinstance(entry, dict) and "interval" in entry and entry.get("value"):
            shares[name] = share_of_interval(entry["interval"], entry["value"])
    if not shares:
        raise ParameterError(f"plant file {plant_file} has no intervals; expected those of an identification")
    beside = Path(plant_file).with_suffix(".json")
    if not beside.is_file():
        return Uncertainty(shares, source=f"intervals of {plant_file}, taken for independent")
    try:
        covariance = json.loads(beside.read_text(encoding="utf-8"))["covariance"]
        names, matrix = list(covariance["names"]), np.array(covariance["matrix"], dtype=np.float64)
        rows = [names.index(name) for name in shares]
        found = matrix[np.ix_(rows, rows)]
        values = np.array([float(entries[name]["value"]) for name in shares])
        deviations = np.sqrt(np.diag(found))
        correlation = found / np.outer(deviations, deviations)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise ParameterError(
            f"{beside} has no covariance of {', '.join(shares)} ({error}); expected the JSON that identify --out wrote"
        ) from error
    shares = {name: float(min(1.0, share)) for name, share in zip(shares, deviations / values, strict=True)}
    return Uncertainty(shares, correlation.tolist(), f"covariance of {beside}")
