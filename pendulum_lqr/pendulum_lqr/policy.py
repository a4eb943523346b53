"""A learned policy: what it is for, what it sees, and its network.

A policy sees the last ``history`` samples of its joints and answers with a torque for each::

    sample_k = [cos(x_k), sin(x_k), theta_dot_k / velocity_scale, u_(k-1) / effort_limit]
    y_k = bounded(network([sample_(k-history+1), ..., sample_k])),  |y_k| <= 1
    u_k = u_(k-1) + clamp(effort_limit y_k - u_(k-1), effort_rate period)

with x the angle from upright, in [-pi, pi); a policy may see a part of these, or x itself. Before the
first sample there was the first sample, at zero torque. All vectors hold one value for each joint, in the order of
``joints``; training and controller share this module, so that they agree.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import DRIVETRAIN_SPECS, PLANT_SPECS, PlantParameters

__all__ = [
    "ACTIVATIONS",
    "DEFAULT_SIGNALS",
    "MODEL",
    "OUTPUTS",
    "SIGNALS",
    "Network",
    "Policy",
    "fingerprint",
    "plant_problem",
    "require_plant",
]

Floats = NDArray[np.float32]

MODEL = "rigid_pendulum"
"""Equation of motion that policies of this version are for."""
SIGNALS = ("angle", "cos", "sin", "velocity", "effort")
"""What a sample may hold of each joint, in this order; ``effort`` is the torque of the last answer."""
DEFAULT_SIGNALS = SIGNALS[1:]
"""What policies of our own training see: an angle jumps where cosine and sine do not."""
ACTIVATIONS = ("tanh", "relu")
OUTPUTS = ("clip", "tanh")
_SAME = 1e-3


@dataclass(frozen=True)
class Network:
    """Dense layers with one activation between them, and an output within [-1, 1].

    Attributes:
        weights: One matrix a layer, shape (out, in).
        biases: One vector a layer, shape (out,).
        activation: One of ``ACTIVATIONS``.
        output: How the last layer is bounded, one of ``OUTPUTS``.

    Raises:
        DataError: Shapes do not go together, or a value is not finite.
    """

    weights: tuple[Floats, ...]
    biases: tuple[Floats, ...]
    activation: str = "tanh"
    output: str = "clip"

    def __post_init__(self) -> None:
        """Check everything that the arithmetic relies on."""
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
        """Values that go into each layer, and those that come out of the last one."""
        return (self.weights[0].shape[1], *(weight.shape[0] for weight in self.weights))

    def answer(self, observations: Floats) -> Floats:
        """Return the bounded output for observations of shape (..., in), shape (..., out).

        What is not finite on its way stays so, for the caller to see.
        """
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
    """A network with everything that says where it may be used.

    Attributes:
        network: The network.
        name: Its name, for logs.
        task: What it was trained for.
        joints: Names of the joints, n of them; every vector below has n values.
        period: Time between two answers [s].
        plant: The plant at the centre of training.
        ranges: Lowest and highest value of each parameter of the plant that differed in training, by name.
        effort_limit: Largest torque [N m].
        effort_rate: Largest change of the torque; inf for none [N m/s].
        velocity_scale: Velocity that the network sees as 1 [rad/s].
        angle_box: Largest deviation from upright that training visited; pi for all angles [rad].
        velocity_box: Largest speed that training visited [rad/s].
        signals: What it sees of each joint, a part of ``SIGNALS`` in their order.
        history: Samples that it sees.
        provenance: How it came about: settings, seed, versions, what was measured; plain JSON values.

    Raises:
        DataError: The parts do not go together.
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
        """Check vectors, signals and sizes."""
        n = len(self.joints)
        if n < 1 or len(set(self.joints)) != n:
            raise DataError(f"joints are {list(self.joints)}; expected one name or more, no two the same")
        if not self.period > 0.0:
            raise DataError(f"period is {self.period} s; expected > 0")
        for what, values, unit in (
            ("effort_limit", self.effort_limit, "N m"),
            ("effort_rate", self.effort_rate, "N m/s"),
            ("velocity_scale", self.velocity_scale, "rad/s"),
            ("angle_box", self.angle_box, "rad"),
            ("velocity_box", self.velocity_box, "rad/s"),
        ):
            if len(values) != n or not all(value > 0.0 for value in values):
                raise DataError(f"{what} is {list(values)} {unit}; expected {n} value(s) > 0, one for each joint")
        if not self.signals or [name for name in SIGNALS if name in self.signals] != list(self.signals):
            raise DataError(f"signals are {list(self.signals)}; expected some of {', '.join(SIGNALS)}, in this order")
        if self.history < 1:
            raise DataError(f"history is {self.history}; expected >= 1")
        known = {spec.name for spec in PLANT_SPECS}
        for name, (low, high) in self.ranges.items():
            if name not in known or not low <= getattr(self.plant, name) <= high:
                raise DataError(f"range of {name} is {low} to {high}; expected a parameter whose value lies in it")
        sizes = self.network.sizes
        if (sizes[0], sizes[-1]) != (self.observation_size, n):
            raise DataError(
                f"network takes {sizes[0]} values and gives {sizes[-1]}; expected {self.observation_size} "
                f"({self.history} samples of {len(self.signals)} signals of {n} joint(s)) and {n}"
            )

    @property
    def sample_size(self) -> int:
        """Values of a sample."""
        return len(self.signals) * len(self.joints)

    @property
    def observation_size(self) -> int:
        """Values that the network sees."""
        return self.history * self.sample_size


def fingerprint(plant: PlantParameters) -> str:
    """Return 64 hexadecimal digits that two plants share if all their parameters are the same, names apart."""
    entry = json.loads(describe_plants([plant]))[0]
    del entry["name"]
    return hashlib.sha256(json.dumps(entry, sort_keys=True).encode()).hexdigest()


def plant_problem(policy: Policy, plant: PlantParameters) -> str:
    """Return in words why a policy is not for a plant, or nothing where it is.

    Each parameter has to lie within the range that was trained, or be that of the policy's plant within 0.1 %. A larger
    torque limit is no obstacle: the policy keeps its own.
    """
    if (plant.drivetrain is None) != (policy.plant.drivetrain is None):
        own, other = ("rigid" if one.drivetrain is None else "series elastic" for one in (policy.plant, plant))
        return f"it was trained on a plant that is {own}, and this one is {other}"
    found = []
    for spec in PLANT_SPECS:
        centre, value = float(getattr(policy.plant, spec.name)), float(getattr(plant, spec.name))
        low, high = policy.ranges.get(spec.name, (centre, centre))
        if spec.name == "effort_limit":
            high = float("inf")
        slack = _SAME * max(abs(low), abs(centre))
        if not low - slack <= value <= high + slack:
            unit = "" if spec.unit == "-" else f" {spec.unit}"
            trained = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
            found.append(f"{spec.name} is {value:.6g}{unit}, trained {trained}")
    if policy.plant.drivetrain is not None and plant.drivetrain is not None:
        for spec in DRIVETRAIN_SPECS:
            own_value = float(getattr(policy.plant.drivetrain, spec.name))
            value = float(getattr(plant.drivetrain, spec.name))
            if abs(value - own_value) > _SAME * abs(own_value):
                found.append(f"drivetrain.{spec.name} is {value:.6g}, trained {own_value:.6g}")
    return "; ".join(found)


def require_plant(policy: Policy, plant: PlantParameters) -> None:
    """Refuse a plant that a policy is not for.

    Raises:
        ParameterError: The plant is another; the message says in what.
    """
    problem = plant_problem(policy, plant)
    if problem:
        raise ParameterError(
            f"policy {policy.name!r} was trained for plant {policy.plant.name!r} ({fingerprint(policy.plant)[:12]}), "
            f"not for {plant.name!r}: {problem}; expected a plant within what it was trained for"
        )
