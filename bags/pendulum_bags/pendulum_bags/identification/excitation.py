"""Excitation design: the torque over time that tells most about chosen parameters within given limits.

Candidates (multisine of random phase, chirp, pseudo-random binary sequence) are simulated on a prior plant, scaled
until torque, speed and angle limits are just kept, and judged by the Fisher information of the angle, with
windows as the fit cuts them, their initial states and all other parameters as nuisance. The best is improved by
small random changes.
Source: Goodwin and Payne, Dynamic System Identification, 1977, ch. 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.covariance import without
from pendulum_bags.identification.model import BOUNDS, INDEX, from_plant
from pendulum_bags.identification.problem import prepare, simulate
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["KINDS", "Excitation", "Limits", "design_excitation"]

KINDS = ("multisine", "chirp", "prbs")
NUISANCE = ("angle_offset", "transport_delay")
"""Parameters that a fit will also have to find."""


@dataclass(frozen=True)
class Limits:
    """What the excitation must not exceed.

    Args:
        effort: Torque [N m].
        speed: Joint speed [rad/s].
        angle: Distance from hanging down [rad].
    """

    effort: float
    speed: float
    angle: float

    def __post_init__(self) -> None:
        """Check that all are positive."""
        for name, unit in (("effort", "N m"), ("speed", "rad/s"), ("angle", "rad")):
            if not getattr(self, name) > 0.0:
                raise DataError(f"limit of {name} is {getattr(self, name)} {unit}; expected > 0")


@dataclass(frozen=True)
class Excitation:
    """A designed excitation.

    Args:
        kind: One of ``KINDS``.
        time: Start of each held value, shape (n,) [s].
        effort: shape (n,) [N m].
        position, velocity: Predicted motion, shape (n,) [rad], [rad/s].
        predicted: Half width of the predicted 95 % interval by parameter, in its unit.
        relative: The same, relative to the parameter.
        score: Mean log of the relative half widths; less is better.
    """

    kind: str
    time: Array
    effort: Array
    position: Array
    velocity: Array
    predicted: dict[str, float]
    relative: dict[str, float]
    score: float

    def write(self, path: str | Path) -> Path:
        """Write ``time,torque`` as CSV, as the disturbance node plays it with ``kind:=from_bag``."""
        target = Path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        table = np.stack((self.time, self.effort), axis=1)
        np.savetxt(target, table, delimiter=",", fmt="%.9g", header="time,torque", comments="")
        return target


@dataclass(frozen=True)
class _Problem:
    plant: PlantParameters
    time: Array
    limits: Limits
    parameters: tuple[str, ...]
    noise: float


def design_excitation(
    plant: PlantParameters,
    limits: Limits,
    *,
    parameters: Sequence[str] = ("inertia", "damping", "gravity", "coulomb_friction"),
    kinds: Sequence[str] = KINDS,
    duration: float = 20.0,
    period: float = 0.01,
    noise: float = 1e-3,
    seed: int = 0,
    trials: int = 60,
) -> Excitation:
    """Return the best excitation found; a function of its arguments alone.

    Args:
        plant: Prior guess of the plant, rigid.
        limits: Of torque, speed and angle.
        parameters: What to learn.
        kinds: Signals to consider.
        duration: [s].
        period: Torque is held that long, and the angle sampled so often [s].
        noise: Standard deviation of the angle sensor [rad].
        seed: Of the random search.
        trials: Candidates over all kinds; as many again improve the best.

    Raises:
        DataError: for unknown kinds or parameters, or a duration shorter than 50 samples.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise DataError(f"kind is {kind!r}; expected one of {', '.join(KINDS)}, or best")
    for name in parameters:
        if name not in BOUNDS or name == "input_gain":
            raise DataError(
                f"parameter is {name!r}; expected some of {', '.join(n for n in BOUNDS if n != 'input_gain')}"
            )
    if not parameters or not kinds:
        raise DataError("parameters or kinds is empty; expected at least one of each")
    if not (period > 0.0 and duration >= 50.0 * period):
        raise DataError(f"duration is {duration} s at a period of {period} s; expected at least 50 periods")
    if not noise > 0.0:
        raise DataError(f"noise is {noise} rad; expected > 0")
    problem = _Problem(
        plant, np.arange(round(duration / period), dtype=np.float64) * period, limits, tuple(parameters), noise
    )
    rng = np.random.default_rng(seed)
    best: tuple[Excitation, Array] | None = None
    for trial in range(max(trials, len(kinds))):
        kind = kinds[trial % len(kinds)]
        genes = rng.uniform(0.0, 1.0, 24)
        found = _evaluate(problem, kind, genes)
        if found is not None and (best is None or found.score < best[0].score):
            best = found, genes
    if best is None:
        raise DataError("no candidate keeps the limits on the prior plant; widen speed or angle")
    for step in range(trials):
        spread = 0.25 * (1.0 - step / trials) + 0.02
        genes = np.mod(best[1] + spread * rng.standard_normal(24) * (rng.uniform(size=24) < 0.4), 1.0)
        found = _evaluate(problem, best[0].kind, genes)
        if found is not None and found.score < best[0].score:
            best = found, genes
    return best[0]


def _evaluate(problem: _Problem, kind: str, genes: Array) -> Excitation | None:
    """Scale a candidate to the limits and judge it; None if even a tenth of the torque exceeds them."""
    shape = _shape(kind, problem.time, genes, problem.plant)
    low, high = 0.0, 1.0
    if not _keeps(problem, shape):
        for _ in range(6):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if _keeps(problem, middle * shape) else (low, middle)
        if low <= 0.0:
            return None
        shape = low * shape
    return _judge(problem, kind, shape)


def _shape(kind: str, time: Array, genes: Array, plant: PlantParameters) -> Array:
    """Return a signal of peak 1 from numbers in [0, 1)."""
    duration = float(time[-1] - time[0])
    own = np.sqrt(max(plant.gravity, 1e-9) / plant.inertia) / (2.0 * np.pi)
    rate = plant.damping / plant.inertia / (2.0 * np.pi)
    # Up to above resonance, or to the corner of an overdamped plant, but not where nothing answers.
    top = float(np.clip((1.0 + 4.0 * genes[0]) * max(own, min(rate, 2.0), 0.2), 0.5, 0.2 / (time[1] - time[0])))
    bottom = max(1.0 / duration, 0.1 * own * (0.2 + genes[1]))
    if kind == "multisine":
        frequency = np.unique(np.round(np.geomspace(bottom, top, 10) * duration)) / duration
        phase = 2.0 * np.pi * genes[2 : 2 + frequency.size]
        weight = 0.2 + genes[12 : 12 + frequency.size]
        signal = (weight * np.sin(2.0 * np.pi * np.outer(time, frequency) + phase)).sum(axis=1)
    elif kind == "chirp":
        ratio = top / bottom
        signal = np.sin(2.0 * np.pi * bottom * duration / np.log(ratio) * (ratio ** (time / duration) - 1.0))
    else:
        held = max(time[1] - time[0], (0.1 + 0.9 * genes[2]) / max(own, 0.2))
        bits = np.random.default_rng(int(genes[3] * 2**31)).integers(0, 2, int(duration / held) + 2)
        signal = 2.0 * bits[(time / held).astype(int)] - 1.0
    # Rise and fall gently: a step at either end is wear without information.
    edge = np.clip(np.minimum(time, time[-1] - time) / (0.02 * duration), 0.0, 1.0)
    peak = float(np.max(np.abs(signal * edge)))
    return np.asarray(signal * edge / max(peak, 1e-12))


def _motion(problem: _Problem, effort: Array) -> tuple[Array, Array]:
    recording = Recording(problem.time, np.zeros_like(problem.time), None, effort, hold="zero")
    piece = replace(prepare(recording, None), states=np.zeros((1, 2)))
    result = simulate(from_plant(problem.plant), piece)
    return result.theta, result.omega


def _windowed(problem: _Problem, effort: Array, theta: Array, omega: Array, free: Sequence[int]) -> Array:
    """Return the sensitivities as a fit sees them: windows of 1 s, the initial state of each projected out."""
    recording = Recording(problem.time, theta, None, effort, hold="zero")
    piece = prepare(recording, 1.0)
    first = piece.windows[:, 0]
    piece = replace(piece, states=np.stack((theta[first], omega[first]), axis=1))
    result = simulate(from_plant(problem.plant), piece, free=free)
    parts = [result.jacobian[first:stop] for first, stop in piece.windows]
    return np.concatenate([without(part[:, -2:], part[:, :-2]) for part in parts])


def _keeps(problem: _Problem, shape: Array) -> bool:
    theta, omega = _motion(problem, problem.limits.effort * shape)
    return bool(np.max(np.abs(theta)) <= problem.limits.angle and np.max(np.abs(omega)) <= problem.limits.speed)


def _judge(problem: _Problem, kind: str, shape: Array) -> Excitation:
    effort = problem.limits.effort * shape
    others = [n for n in ("inertia", "damping", "gravity", "coulomb_friction") if n not in problem.parameters]
    names = [*problem.parameters, *others, *(n for n in NUISANCE if n not in problem.parameters)]
    theta, omega = _motion(problem, effort)
    jacobian = _windowed(problem, effort, theta, omega, [INDEX[name] for name in names])
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    singular = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = (singular[2].T / np.maximum(singular[1], 1e-9) ** 2) @ singular[2]
    error = problem.noise * np.sqrt(np.diag(inverse)) / scale
    predicted = {name: 1.96 * float(error[i]) for i, name in enumerate(problem.parameters)}
    model = from_plant(problem.plant)
    # A parameter that is 0 in the prior has no relative error: take its share of gravity instead.
    size = {n: abs(model[n]) or 0.05 * max(problem.plant.gravity, 1e-3) for n in problem.parameters}
    relative = {name: predicted[name] / size[name] for name in problem.parameters}
    score = float(np.mean([np.log(max(value, 1e-12)) for value in relative.values()]))
    return Excitation(kind, problem.time, effort, theta, omega, predicted, relative, score)
