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
from pendulum_bags.identification.covariance import information
from pendulum_bags.identification.joint_fit import WeightedErrors, prepare_windows
from pendulum_bags.identification.joint_model import DELAY, LAG, JointModel
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.model import BOUNDS, from_plant
from pendulum_bags.identification.problem import prepare, simulate
from pendulum_bags.identification.solver import angle_motions
from pendulum_bags.runs.datasets import Recording
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, common_delay

__all__ = ["KINDS", "Excitation", "Limits", "design_excitation"]

KINDS = ("multisine", "chirp", "prbs")
_OF_ONE: tuple[str, ...] = ("inertia", "damping", "gravity", "coulomb_friction")
_FRICTION = "coulomb_friction"
_LEAD = 100
"""Samples at rest before the excitation of several joints."""
_COASTING = 0.6
"""Time for which a slide must stay within its travel after the excitation [s]."""
NUISANCE = ("angle_offset", "transport_delay")
"""Parameters that a fit will also have to find."""


@dataclass(frozen=True)
class Limits:
    """What the excitation must not exceed.

    Args:
        effort: Torque [N m].
        speed: Joint speed [rad/s].
        angle: Distance from hanging down [rad].
        travel: Of several joints, distance of a slide from its middle [m].
    """

    effort: float
    speed: float
    angle: float
    travel: float = 0.3

    def __post_init__(self) -> None:
        """Check that all are positive."""
        for name, unit in (("effort", "N m"), ("speed", "rad/s"), ("angle", "rad"), ("travel", "m")):
            if not getattr(self, name) > 0.0:
                raise DataError(f"limit of {name} is {getattr(self, name)} {unit}; expected > 0")

    def of(self, plant: PlantParameters) -> Array:
        """Return the largest distance of each joint from hanging, shape (n,) [rad or m]; a wheel may turn freely."""
        free = {"m": self.travel, "rad": np.inf}
        return np.array([self.angle if joint.turns else free[joint.unit] for joint in plant.coordinates.joints])


@dataclass(frozen=True)
class Excitation:
    """A designed excitation.

    Args:
        kind: One of ``KINDS``.
        time: Start of each held value, shape (n,) [s].
        effort: shape (n,) [N m or N].
        position, velocity: Predicted motion, shape (n,) [rad], [rad/s]; of several joints (n, joints).
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
    nuisance: tuple[str, ...]
    sizes: tuple[float, ...]
    joint: int = 0


def design_excitation(
    plant: PlantParameters,
    limits: Limits,
    *,
    parameters: Sequence[str] = (),
    kinds: Sequence[str] = KINDS,
    duration: float = 20.0,
    period: float = 0.01,
    noise: float = 1e-3,
    seed: int = 0,
    trials: int = 60,
    joint: str = "",
) -> Excitation:
    """Return the best excitation found; a function of its arguments alone.

    Args:
        plant: Prior guess of the plant, rigid.
        limits: Of torque, speed and angle.
        parameters: What to learn; none for inertia, damping, gravity and Coulomb friction, or of several joints for
            what their motion can tell apart and friction that is not 0.
        kinds: Signals to consider.
        duration: [s].
        period: Torque is held that long, and the angle sampled so often [s].
        noise: Standard deviation of the position sensors [rad or m].
        seed: Of the random search.
        trials: Candidates over all kinds; as many again improve the best.
        joint: Driven joint of several that is excited; by default the first.

    Raises:
        DataError: for unknown kinds or parameters, or a duration shorter than 50 samples.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise DataError(f"kind is {kind!r}; expected one of {', '.join(KINDS)}, or best")
    if plant.coordinates.volts:
        raise DataError(f"plant {plant.name!r} is driven in volts; expected one that is driven by an effort")
    nuisance: tuple[str, ...]
    if plant.is_pendulum:
        known, usual, nuisance = [name for name in BOUNDS if name != "input_gain"], _OF_ONE, (*_OF_ONE, *NUISANCE)
    else:
        model = JointModel.of(plant)
        known = [*model.fitted()]
        usual = tuple(name for name in known if not name.endswith(_FRICTION) or plant.value(name) > 0.0)
        nuisance = (*known, *(name for group in model.own_offsets for name in group))
    parameters = tuple(parameters) or usual
    for name in parameters:
        if name not in known:
            raise DataError(f"parameter is {name!r}; expected some of {', '.join(known)}")
    driven = plant.coordinates.driven_names
    if not driven or (joint and joint not in driven):
        raise DataError(f"joint is {joint or 'none'}; expected one that is driven: {', '.join(driven) or 'none is'}")
    if not kinds:
        raise DataError("kinds is empty; expected at least one")
    if not (period > 0.0 and duration >= 50.0 * period):
        raise DataError(f"duration is {duration} s at a period of {period} s; expected at least 50 periods")
    if not noise > 0.0:
        raise DataError(f"noise is {noise} rad; expected > 0")
    problem = _Problem(
        plant,
        np.arange(round(duration / period), dtype=np.float64) * period,
        limits,
        parameters,
        noise,
        nuisance,
        tuple(_size(plant, name) for name in parameters),
        plant.coordinates.driven[driven.index(joint) if joint else 0],
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


def _size(plant: PlantParameters, name: str) -> float:
    """Return what the error of a parameter is a share of; of one that is 0 in a pendulum, a share of its gravity."""
    if plant.is_pendulum:
        return abs(from_plant(plant)[name]) or 0.05 * max(plant.gravity, 1e-3)
    return JointModel.of(plant).size(name)


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
    own, rate = _rates(plant)
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


def _rates(plant: PlantParameters) -> tuple[float, float]:
    """Return the fastest frequency of free swings about hanging, and the fastest decay [Hz]."""
    if plant.is_pendulum:
        own = np.sqrt(max(plant.gravity, 1e-9) / plant.inertia) / (2.0 * np.pi)
        return float(own), plant.damping / plant.inertia / (2.0 * np.pi)
    poles = linearise(plant, (0.0,) * len(plant.joints)).poles / (2.0 * np.pi)
    return max(float(np.max(np.abs(poles.imag))), 1e-5), float(np.max(-poles.real, initial=0.0))


def _motion(problem: _Problem, effort: Array) -> tuple[Array, Array]:
    """Return positions and velocities, shape (n, joints), of a plant that hangs at first."""
    time, count = problem.time, len(problem.plant.joints)
    if problem.plant.is_pendulum:
        piece = replace(prepare(_recorded(problem, effort), None), states=np.zeros((1, 2)))
        result = simulate(from_plant(problem.plant), piece)
        return result.theta[:, None], result.omega[:, None]
    # All of it is one window, which begins a little after the recording: both begin at rest.
    lead = time[1] * np.arange(-_LEAD, 0)
    whole = replace(problem, time=np.concatenate([lead, time]) - lead[0])
    padded = _joint_recording(whole, np.concatenate([np.zeros(_LEAD), effort]), np.zeros((time.size + _LEAD, count)))
    data, model = prepare_windows(padded, float(whole.time[-1]) + 1.0), _joint_model(problem.plant)
    path = model.motions(model.vector[None], data, np.zeros((1, 1, 2 * count)))[0, 0][data.inside[0]]
    return path[-time.size :, :count], path[-time.size :, count:]


def _sensitivities(problem: _Problem, effort: Array, position: Array, velocity: Array, names: Sequence[str]) -> Array:
    """Return those of the positions as a fit sees them, shape (samples, k): initial states of windows projected out."""
    plant, count, found = problem.plant, position.shape[1], np.hstack((position, velocity))
    if plant.is_pendulum:
        piece, own = prepare(_recorded(problem, effort, position[:, 0]), 1.0), from_plant(plant)
        seen = information([own], angle_motions(own, [piece], np.inf), [found[piece.windows[:, 0]]], names)
    else:
        # As long as those of a fit, which are a sixth of the data.
        window = float(np.clip(problem.time[-1] / 6.0, 0.5, 5.0))
        data, model = prepare_windows(_joint_recording(problem, effort, position), window), _joint_model(plant)
        states = found[np.searchsorted(problem.time, data.time[:, 0] - 1e-9)]
        seen = information([model], [WeightedErrors(data, np.repeat([1.0, 0.0], count))], [states], names)
    return np.concatenate([part for part, _ in seen.windows])


def _recorded(problem: _Problem, effort: Array, position: Array | None = None) -> Recording:
    theta = np.zeros_like(problem.time) if position is None else position
    return Recording(problem.time, theta, None, effort, hold="zero")


def _joint_recording(problem: _Problem, effort: Array, position: Array) -> JointRecording:
    efforts = np.zeros_like(position)
    efforts[:, problem.joint] = effort
    return JointRecording("the excitation", problem.time, position, efforts, ("zero",) * position.shape[1])


def _joint_model(plant: PlantParameters) -> JointModel:
    lags = [actuator.time_constant for actuator in plant.actuators]
    return JointModel.of(plant).with_changes({DELAY: common_delay(plant), LAG: lags[0]})


def _keeps(problem: _Problem, shape: Array) -> bool:
    position, velocity = _motion(problem, problem.limits.effort * shape)
    slides = np.array([joint.unit == "m" for joint in problem.plant.coordinates.joints])
    # A slide coasts on when the effort has ended, while the recording does.
    after = position[-1:] + _COASTING * velocity[-1:] * slides
    within = np.abs(np.concatenate([position, after])) <= problem.limits.of(problem.plant)
    return bool(np.all(within) and np.max(np.abs(velocity)) <= problem.limits.speed)


def _judge(problem: _Problem, kind: str, shape: Array) -> Excitation:
    effort, parameters = problem.limits.effort * shape, problem.parameters
    position, velocity = _motion(problem, effort)
    names = [*dict.fromkeys((*parameters, *problem.nuisance))]
    jacobian = _sensitivities(problem, effort, position, velocity, names)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    singular = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = (singular[2].T / np.maximum(singular[1], 1e-9) ** 2) @ singular[2]
    error = problem.noise * np.sqrt(np.diag(inverse)) / scale
    predicted = {name: 1.96 * float(error[i]) for i, name in enumerate(parameters)}
    relative = {name: predicted[name] / size for name, size in zip(parameters, problem.sizes, strict=True)}
    score = float(np.mean([np.log(max(value, 1e-12)) for value in relative.values()]))
    if position.shape[1] == 1:
        position, velocity = position[:, 0], velocity[:, 0]
    return Excitation(kind, problem.time, effort, position, velocity, predicted, relative, score)
