"""Sensors: what is measured of a state, and whether the sample arrives.

In this order: jitter of the sampling instant moves the angle along its velocity, bias and Gaussian noise are added, the
value is rounded, the sample may be lost. All are off by default. Each has its own generator, so that switching one on
does not change the others' numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.values import JointSample, Vector
from pendulum_msgs_py.parameters import ParameterSpec, validate

__all__ = ["SENSOR_SPECS", "Sensors", "quantise"]

_QUANTITIES = (("position", "rad"), ("velocity", "rad/s"), ("effort", "N m"))

SENSOR_SPECS: tuple[ParameterSpec, ...] = (
    *(
        ParameterSpec(f"{name}_step", 0.0, unit, f"Step to which the {name} is rounded; 0 for none.", minimum=0.0)
        for name, unit in _QUANTITIES
    ),
    *(
        ParameterSpec(f"{name}_noise", 0.0, unit, f"Standard deviation of noise on the {name}.", minimum=0.0)
        for name, unit in _QUANTITIES
    ),
    *(ParameterSpec(f"{name}_bias", 0.0, unit, f"Constant error of the {name}.") for name, unit in _QUANTITIES),
    ParameterSpec("jitter", 0.0, "s", "Standard deviation of the sampling instant about its stamp.", minimum=0.0),
    ParameterSpec("drop_rate", 0.0, "-", "Share of samples that never arrive.", minimum=0.0, maximum=1.0),
)
"""Parameters of the sensors; a node declares them with the prefix ``sensor.``."""


def quantise(value: float, step: float) -> float:
    """Return the nearest multiple of a step, or the value for a step of 0."""
    return round(value / step) * step if step > 0.0 else value


class Sensors:
    """Sensors of position, velocity and effort, equal at each joint, in its units.

    ``generator`` is spawned, never drawn from; parameters are named as in ``SENSOR_SPECS``.

    Raises:
        ParameterError: A name is unknown or a value outside its domain.
    """

    def __init__(self, generator: np.random.Generator | None = None, **parameters: Any) -> None:
        self.parameters: Mapping[str, Any] = validate(SENSOR_SPECS, parameters, where="sensors")
        if generator is None:
            generator = np.random.default_rng(0)
        *noise, self._jitter_generator, self._drop_generator = generator.spawn(len(_QUANTITIES) + 2)
        # (bias, noise, step, generator); None where a quantity is measured exactly.
        self._channels = [
            channel if any(channel[:3]) else None
            for channel in (
                (self.parameters[f"{name}_bias"], self.parameters[f"{name}_noise"], self.parameters[f"{name}_step"], g)
                for (name, _), g in zip(_QUANTITIES, noise, strict=True)
            )
        ]
        self._jitter = self.parameters["jitter"]
        self._drop_rate = self.parameters["drop_rate"]
        self.ideal = not (any(self._channels) or self._jitter or self._drop_rate)
        self.dropped = 0

    def measure(self, stamp_ns: int, position: Vector, velocity: Vector, effort: Vector) -> JointSample | None:
        """Return the measurement of a state, or None for a lost sample; units of each joint."""
        if self.ideal:
            return JointSample(stamp_ns, position, velocity, effort)
        if self._jitter:
            # All joints are sampled at one instant.
            shift = self._jitter_generator.normal(0.0, self._jitter)
            position = tuple(q + v * shift for q, v in zip(position, velocity, strict=True))
        measured = [
            values if channel is None else tuple(_distort(value, *channel) for value in values)
            for values, channel in zip((position, velocity, effort), self._channels, strict=True)
        ]
        if self._drop_rate and self._drop_generator.random() < self._drop_rate:
            self.dropped += 1
            return None
        return JointSample(stamp_ns, *measured)


def _distort(value: float, bias: float, noise: float, step: float, generator: np.random.Generator) -> float:
    value += bias
    if noise:
        value += generator.normal(0.0, noise)
    return quantise(value, step)
