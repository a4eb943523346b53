"""Worst-case margins of a gain over the plants that an identification permits: a box or an ellipsoid."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.analysis import Margins, bears_its_delay, closed_loop_poles, loop_margins
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.json_values import without_nan
from pendulum_msgs_py.parameters import suggestion
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant_file

__all__ = ["IDENTIFIED", "UNCERTAIN", "ParameterBox", "WorstCase", "parse_box", "uncertain_names", "worst_case"]

UNCERTAIN = ("inertia", "damping", "gravity", "angle_offset", "actuator_time_constant", "transport_delay")
"""Parameters of one joint's linear model that may be uncertain."""
_OF_JOINTS = ("damping", "time_constant", "transport_delay")
IDENTIFIED = "identified"
"""Selects the intervals of the plant file, with the correlations in the identification's JSON file if present."""

_MOST_CORNERED = 8
"""Most parameters of which all corners of the box are taken; of more as many are drawn."""
_INSIDE = 48
"""Plants drawn within a box, in addition to its corners, or on an ellipsoid."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterBox:
    """Ranges of a plant's parameters.

    Attributes:
        bounds: Lowest and highest value by parameter, in its unit.
        correlation: Of the errors, in the order of ``bounds``, shape (k, k); None permits every corner.
        source: Origin, as text.
    """

    bounds: Mapping[str, tuple[float, float]]
    correlation: Array | None = None
    source: str = "given"

    def plants(self, plant: PlantParameters) -> list[PlantParameters]:
        """Return the plant itself and others: corners and interior points, or the surface of the ellipsoid.

        With correlation, plants lie on the joint 95 % confidence ellipsoid of all parameters.

        Source:
            Johnson and Wichern, Applied Multivariate Statistical Analysis, 6th ed., 2007, section 5.4 (ellipsoid).
        """
        rng = np.random.default_rng(0)
        low, high = (np.array([pair[i] for pair in self.bounds.values()]) for i in (0, 1))
        if self.correlation is None:
            if low.size <= _MOST_CORNERED:
                corners = np.array(list(itertools.product(*self.bounds.values())))
            else:
                corners = np.where(rng.random((2**_MOST_CORNERED, low.size)) < 0.5, low, high)
            values = np.vstack([corners, rng.uniform(low, high, (_INSIDE, low.size))])
        else:
            # Standard errors from 95 % intervals of single parameters; the joint region is larger.
            half = 0.5 * (high - low) / float(scipy.special.ndtri(0.975))
            weights, axes = np.linalg.eigh(self.correlation)
            factor = axes * np.sqrt(np.maximum(weights, 0.0))
            ball = rng.standard_normal((2 * _INSIDE, low.size))
            ball /= np.linalg.norm(ball, axis=1, keepdims=True)
            # Along each axis too: the ellipsoid extends furthest there, and draws hardly ever hit it.
            ball = np.vstack([ball, np.eye(low.size), -np.eye(low.size)])
            reach = math.sqrt(float(scipy.special.chdtri(low.size, 0.05)))
            centre = np.array([plant.value(name) for name in self.bounds])
            values = centre + reach * (ball @ factor.T) * half
        found = [plant]
        for row in values:
            changes = dict(zip(self.bounds, map(float, row), strict=True))
            for name, value in changes.items():
                if name != "angle_offset":
                    # Physical bounds; an inertia must be positive.
                    least = 1e-3 * plant.value(name) if plant.specs[name].exclusive_minimum else 0.0
                    changes[name] = max(value, least)
            found.append(plant.with_values(changes))
        return found


@dataclass(frozen=True, slots=True)
class WorstCase:
    """A gain over many plants.

    Attributes:
        plants: Number of plants.
        unstable: Number of plants that the gain does not stabilise.
        margins: The worst of each margin; None if no plant is stable.
        where: Parameters of the plant with the smallest modulus margin, or of the first unstable one.
    """

    plants: int
    unstable: int
    margins: Margins | None
    where: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; infinities as None."""
        return without_nan(asdict(self))


def uncertain_names(plant: PlantParameters) -> Sequence[str]:
    """Return the names of the parameters that may be uncertain: those of the linear model."""
    if plant.is_pendulum:
        return UNCERTAIN
    return [name for name in plant.numbers if "." not in name or name.rpartition(".")[2] in _OF_JOINTS]


def worst_case(plants: Sequence[PlantParameters], K: ArrayLike, theta: float | None, names: Sequence[str]) -> WorstCase:
    """Return the worst margins of a gain (k,) of one motor over plants linearised at an angle [rad], None for upright.

    The plants have one structure; ``names`` are the parameters of the worst one to report.
    """
    unstable, found = 0, []
    lost: PlantParameters | None = None
    for plant in plants:
        model = linearise(plant, theta)
        held = float(closed_loop_poles(model, K)[0].real) < 0.0
        margins = loop_margins(model, K) if held else None
        if margins is None or (model.delay > 0.0 and not bears_its_delay(model, K)):
            unstable += 1
            lost = lost or plant
        else:
            found.append((margins, plant))
    worst = lost or min(found, key=lambda pair: pair[0].modulus)[1]
    where = {name: worst.value(name) for name in names}
    if not found:
        return WorstCase(len(plants), unstable, None, where)
    every = [margins for margins, _ in found]
    phases = [m for m in every if math.isfinite(m.phase)]
    least = min(phases, key=lambda m: abs(m.phase)) if phases else every[0]
    return WorstCase(
        len(plants),
        unstable,
        Margins(
            gain_up=min(m.gain_up for m in every),
            gain_down=max(m.gain_down for m in every),
            phase=least.phase,
            crossover=least.crossover,
            delay=min(m.delay for m in every),
            modulus=min(m.modulus for m in every),
        ),
        where,
    )


def parse_box(texts: Sequence[str], plant: PlantParameters, path: Path | None = None) -> ParameterBox:
    """Return the box of texts such as ``inertia=10%`` or ``transport_delay=0:0.01``.

    Args:
        texts: Per parameter a percentage to either side, or lowest and highest value in its unit; or ``identified``
            alone, for the intervals of the plant file.
        plant: Nominal plant.
        path: Its file; None for a preset.

    Raises:
        ParameterError: An invalid text, or a plant file without intervals.
    """
    if IDENTIFIED in texts:
        if len(texts) > 1:
            raise ParameterError(
                f"--uncertainty is {IDENTIFIED} and {len(texts) - 1} more; expected {IDENTIFIED} alone"
            )
        return _identified(path, uncertain_names(plant))
    allowed = uncertain_names(plant)
    bounds: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if name not in allowed:
            raise ParameterError(f"--uncertainty names {name!r}; {suggestion(name, (*allowed, IDENTIFIED))}")
        if name in bounds:
            raise ParameterError(f"--uncertainty names {name} twice; expected each parameter once")
        bounds[name] = _bounds(text, value, plant.value(name))
        low, high = bounds[name]
        positive = plant.specs[name].exclusive_minimum
        if name != "angle_offset" and (low < 0.0 or (positive and low <= 0.0)):
            least = "> 0" if positive else ">= 0"
            raise ParameterError(f"--uncertainty {text} reaches from {low:g} to {high:g}; expected values {least}")
    return ParameterBox(bounds)


def _bounds(text: str, value: str, own: float) -> tuple[float, float]:
    try:
        if value.endswith("%"):
            share = abs(own) * float(value[:-1]) / 100.0
            low, high = own - share, own + share
            if share < 0.0:
                low = math.nan
        else:
            low, high = (float(part) for part in value.split(":"))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high) and low <= high):
        raise ParameterError(f"--uncertainty is {text!r}; expected as inertia=10% or transport_delay=0:0.01")
    if own == 0.0 and value.endswith("%"):
        raise ParameterError(
            f"--uncertainty {text} is a share of 0, the plant's own value; expected lowest and highest value, such as "
            "transport_delay=0:0.01"
        )
    return low, high


def _identified(path: Path | None, allowed: Sequence[str]) -> ParameterBox:
    if path is None:
        raise ParameterError(f"--uncertainty {IDENTIFIED} needs --plant, a plant file that identify wrote")
    intervals = load_plant_file(path)[1].get("intervals", {})
    bounds = {name: (float(intervals[name][0]), float(intervals[name][1])) for name in allowed if name in intervals}
    if not bounds:
        raise ParameterError(f"plant file {path} has no interval of {', '.join(allowed)}; expected one of identify")
    correlation = _correlation(path.with_suffix(".json"), tuple(bounds))
    how = "correlated as in the identification" if correlation is not None else "each by itself"
    return ParameterBox(bounds, correlation, f"95 % intervals of {path.name}, {how}")


def _correlation(path: Path, names: Sequence[str]) -> Array | None:
    """Return the correlation of some parameters in an identification's JSON file, or None."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        order = list(document["covariance"]["names"])
        index = [order.index(name) for name in names]
        found = np.array(document["correlation"], dtype=np.float64)[np.ix_(index, index)]
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None
    plausible = np.all(np.isfinite(found)) and np.all(np.abs(found) <= 1.0 + 1e-9)
    return found if plausible and np.allclose(found, found.T, atol=1e-9) else None
