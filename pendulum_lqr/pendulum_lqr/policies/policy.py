"""A learned policy: task, observation and network, shared by training and controller.

A policy sees the last ``history`` samples of its joints and returns an effort for each driven one::

    sample_k = [cos(x_k), sin(x_k), q_k / angle_box, q'_k / velocity_scale, u_(k-1) / effort_limit]
    y_k = bounded(network([sample_(k-history+1), ..., sample_k])),  |y_k| <= 1
    u_k = u_(k-1) + clamp(effort_limit y_k - u_(k-1), effort_rate period)

with x the angle from upright of each turning joint, in [-pi, pi), q the deviation of each slide, u of each driven
joint; a policy may see some of these, or x itself. Samples before the first equal the first, at zero effort. Vectors
have one value per joint, in the order of ``joints``, those of efforts one per driven joint.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.joint_parameters import DRIVETRAIN_SPECS
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "ACTIVATIONS",
    "DEFAULT_SIGNALS",
    "MODELS",
    "OUTPUTS",
    "SIGNALS",
    "Network",
    "Policy",
    "default_signals",
    "fingerprint",
    "model_of",
    "plant_problem",
    "require_plant",
    "sample_layout",
]

Floats = NDArray[np.float32]

MODELS = ("rigid_pendulum", "mechanism")
"""The pendulum, or a plant file's mechanism of several joints."""
SIGNALS = ("angle", "cos", "sin", "position", "velocity", "effort")
"""Signals of a sample, in this order: angle, cosine and sine of turning joints, position of slides, velocity of all,
and of driven joints the ``effort`` of the last command.
"""
DEFAULT_SIGNALS = ("cos", "sin", "velocity", "effort")
"""Signals of this project's training: cosine and sine, because an angle jumps."""
ACTIVATIONS = ("tanh", "relu")
OUTPUTS = ("clip", "tanh")
_SAME = 1e-3


@dataclass(frozen=True)
class Network:
    """Dense layers with one activation between them, and an output within [-1, 1].

    Attributes:
        weights: One matrix per layer, shape (out, in).
        biases: One vector per layer, shape (out,).
        activation: One of ``ACTIVATIONS``.
        output: Bound of the last layer, one of ``OUTPUTS``.

    Raises:
        DataError: Shapes do not match, or a value is not finite.
    """

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]
    activation: str = "tanh"
    output: str = "clip"

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise DataError(f"activation is {self.activation!r}; expected one of {', '.join(ACTIVATIONS)}")
        if self.output not in OUTPUTS:
            raise DataError(f"output is {self.output!r}; expected one of {', '.join(OUTPUTS)}")
        if not self.weights or len(self.weights) != len(self.biases):
            raise DataError(f"network has {len(self.weights)} weights and {len(self.biases)} biases; expected pairs")
        width: int | None = None
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            fits = weight.ndim == 2 and bias.shape == weight.shape[:1] and width in {None, weight.shape[1]}
            if not fits:
                raise DataError(
                    f"layer {number} has a weight of shape {weight.shape} and a bias of shape {bias.shape}; expected "
                    f"(out, {'in' if width is None else width}) and (out,)"
                )
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise DataError(f"layer {number} has a weight that is not finite")
            width = weight.shape[0]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of inputs of each layer, and of outputs of the last one."""
        return (self.weights[0].shape[1], *(weight.shape[0] for weight in self.weights))

    def forward(self, observations: Floats) -> Floats:
        """Return the bounded output (..., out) for observations (..., in); NaN and infinity pass through."""
        x = observations
        last = len(self.weights) - 1
        with np.errstate(over="ignore", invalid="ignore"):
            for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
                x = x @ weight.T + bias
                if number < last:
                    x = np.tanh(x) if self.activation == "tanh" else np.maximum(x, 0.0)
        return np.tanh(x) if self.output == "tanh" else np.clip(x, -1.0, 1.0)


@dataclass(frozen=True)
class Policy:
    """A network with the conditions of its use.

    Attributes:
        network: Network.
        name: For logs.
        task: Task of its training.
        joints: Names of the n joints, m of them driven; vectors of efforts have m values, the others n.
        period: Time between two commands [s].
        plant: Nominal plant of the training.
        ranges: Lowest and highest value of each plant parameter varied in training, by name.
        effort_limit: Largest effort of each driven joint [N m or N].
        effort_rate: Largest change of it; inf for none [N m/s or N/s].
        velocity_scale: Velocity that the network sees as 1 [rad/s or m/s].
        angle_box: Largest deviation from upright in training; pi for all angles [rad or m].
        velocity_box: Largest speed in training [rad/s or m/s].
        signals: Signals of each joint, some of ``SIGNALS`` in their order.
        history: Number of samples.
        provenance: Settings, seed, versions, results of the training; plain JSON values.

    Raises:
        DataError: The parts do not match.
    """

    network: Network
    name: str
    task: str
    joints: tuple[str, ...]
    period: float
    plant: PlantParameters
    ranges: Mapping[str, tuple[float, float]]
    effort_limit: tuple[float, ...]
    effort_rate: tuple[float, ...]
    velocity_scale: tuple[float, ...]
    angle_box: tuple[float, ...]
    velocity_box: tuple[float, ...]
    signals: tuple[str, ...] = DEFAULT_SIGNALS
    history: int = 1
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.joints)
        if n < 1 or len(set(self.joints)) != n:
            raise DataError(f"joints are {list(self.joints)}; expected one name or more, no two the same")
        own = self.coordinates.names
        # The joint of a pendulum may have any name; of several, the order matters.
        if n != len(own) or (n > 1 and self.joints != own):
            raise DataError(f"joints are {list(self.joints)}; expected {', '.join(own)}, as plant {self.plant.name!r}")
        if not self.period > 0.0:
            raise DataError(f"period is {self.period} s; expected > 0")
        m = len(self.coordinates.driven)
        for what, values, unit, count in (
            ("effort_limit", self.effort_limit, "N m", m),
            ("effort_rate", self.effort_rate, "N m/s", m),
            ("velocity_scale", self.velocity_scale, "rad/s", n),
            ("angle_box", self.angle_box, "rad", n),
            ("velocity_box", self.velocity_box, "rad/s", n),
        ):
            if len(values) != count or count == 0 or not all(value > 0.0 for value in values):
                which = "joint" if count == n else "driven joint"
                raise DataError(f"{what} is {list(values)} {unit}; expected {count} value(s) > 0, one for each {which}")
        if not self.signals or [name for name in SIGNALS if name in self.signals] != list(self.signals):
            raise DataError(f"signals are {list(self.signals)}; expected some of {', '.join(SIGNALS)}, in this order")
        if self.history < 1:
            raise DataError(f"history is {self.history}; expected >= 1")
        known = self.plant.numbers
        for name, (low, high) in self.ranges.items():
            if name not in known or not low <= known[name] <= high:
                raise DataError(f"range of {name} is {low} to {high}; expected a parameter whose value lies in it")
        sizes = self.network.sizes
        if (sizes[0], sizes[-1]) != (self.observation_size, m):
            raise DataError(
                f"network takes {sizes[0]} values and gives {sizes[-1]}; expected {self.observation_size} "
                f"({self.history} samples of {', '.join(self.signals)} of {n} joint(s)) and {m}"
            )

    @property
    def coordinates(self) -> Coordinates:
        """Joints of the plant, and which of them are driven."""
        return self.plant.coordinates

    @property
    def layout(self) -> tuple[tuple[str, int], ...]:
        """Signal and joint of each value of a sample."""
        return sample_layout(self.signals, self.coordinates)

    @property
    def observation_size(self) -> int:
        """Number of inputs of the network."""
        return self.history * len(self.layout)


def model_of(plant: PlantParameters) -> str:
    """Return a plant's entry of ``MODELS``."""
    return MODELS[not plant.is_pendulum]


def default_signals(coordinates: Coordinates) -> tuple[str, ...]:
    """Return the signals of this project's training: ``DEFAULT_SIGNALS``, and positions if a joint slides."""
    if all(joint.turns for joint in coordinates.joints):
        return DEFAULT_SIGNALS
    return tuple(name for name in SIGNALS if name in {*DEFAULT_SIGNALS, "position"})


def sample_layout(signals: Sequence[str], coordinates: Coordinates) -> tuple[tuple[str, int], ...]:
    """Return signal and joint index of each value of a sample, signal by signal; DataError if no joint has a signal."""
    found = []
    for signal in signals:
        own = [
            (signal, i) for i, joint in enumerate(coordinates.joints) if _has(joint, i in coordinates.driven, signal)
        ]
        if not own:
            raise DataError(
                f"signals hold {signal!r}, which none of the joints {', '.join(coordinates.names)} has; expected it of "
                "a plant with such a joint"
            )
        found += own
    return tuple(found)


def _has(joint: Joint, driven: bool, signal: str) -> bool:
    if signal == "effort":
        return driven
    return signal == "velocity" or joint.turns != (signal == "position")


def fingerprint(plant: PlantParameters) -> str:
    """Return 64 hexadecimal digits that identify a plant's parameters, without names."""
    entry = json.loads(describe_plants([plant]))[0]
    del entry["name"]
    return hashlib.sha256(json.dumps(entry, sort_keys=True).encode()).hexdigest()


def plant_problem(policy: Policy, plant: PlantParameters) -> str:
    """Return why a policy is not for a plant, or an empty string.

    Each parameter must lie within the trained range, or within 0.1 % of the policy's plant. A larger effort limit is
    accepted, because the policy applies its own; so is an end stop beyond its box.
    """
    own = policy.plant
    if not own.is_pendulum or not plant.is_pendulum:
        mine, other = _kind_of(own), _kind_of(plant)
        if mine != other:
            return f"it was trained on {mine}, and this one is {other}"
    elif (plant.drivetrain is None) != (own.drivetrain is None):
        rigid, other = ("rigid" if one.drivetrain is None else "series elastic" for one in (own, plant))
        return f"it was trained on a plant that is {rigid}, and this one is {other}"
    trained, runs = own.numbers, plant.numbers
    units = {name: spec.unit for name, spec in plant.specs.items()}
    found = []
    for name in (*trained, *(name for name in runs if name not in trained)):
        joint, _, key = name.rpartition(".")
        if key in {"lower_stop", "upper_stop"}:
            reach = policy.angle_box[policy.coordinates.names.index(joint)]
            free = runs.get(name, math.inf) * (1.0 if key == "upper_stop" else -1.0)
            if name in runs and free < (1.0 - _SAME) * reach:
                found.append(f"{name} is {runs[name]:.6g} {units[name]}, trained to move {reach:.6g} {units[name]}")
            continue
        if name not in trained or name not in runs:
            found.append(f"{name} is {'given' if name in runs else 'not given'}, and was not so in training")
            continue
        centre, value = trained[name], runs[name]
        low, high = policy.ranges.get(name, (centre, centre))
        if key == "effort_limit":
            high = float("inf")
        slack = _SAME * max(abs(low), abs(centre))
        if not low - slack <= value <= high + slack:
            unit = "" if units[name] == "-" else f" {units[name]}"
            span = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
            found.append(f"{name} is {value:.6g}{unit}, trained {span}")
    if own.drivetrain and plant.drivetrain:
        for spec in DRIVETRAIN_SPECS:
            own_value = float(getattr(own.drivetrain, spec.name))
            value = float(getattr(plant.drivetrain, spec.name))
            if abs(value - own_value) > _SAME * abs(own_value):
                found.append(f"drivetrain.{spec.name} is {value:.6g}, trained {own_value:.6g}")
    return "; ".join(found)


def _kind_of(plant: PlantParameters) -> str:
    if plant.is_pendulum:
        return "a plant of one joint"
    return f"a {plant.mechanism.model} driven at {', '.join(plant.coordinates.driven_names) or 'no joint'}"


def require_plant(policy: Policy, plant: PlantParameters) -> None:
    """Raise ParameterError, with the difference, for a plant that a policy is not for."""
    problem = plant_problem(policy, plant)
    if problem:
        raise ParameterError(
            f"policy {policy.name!r} was trained for plant {policy.plant.name!r} ({fingerprint(policy.plant)[:12]}), "
            f"not for {plant.name!r}: {problem}; expected a plant within what it was trained for"
        )
