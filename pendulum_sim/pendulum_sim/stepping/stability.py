"""Whether an integrator is stable on a plant at a step, by the eigenvalues of its own map of the linear model.

Near its equilibria a rigid pendulum is ``theta'' = tau / M_c - lambda theta' -+ omega^2 theta`` with lambda = b_c / M_c
and omega^2 = |G_c| / M_c. Hanging, both eigenvalues of a step must decay; upright one pole grows, and one eigenvalue
may. The step that simulates is evaluated itself.

Source: Hairer and Wanner, "Solving Ordinary Differential Equations II", IV.2 (stability of one-step methods).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.integrators import Integrator, PlantTuple, get_integrator

__all__ = ["MOST_GROWTH", "check_stability", "growth_of_map", "growth_rate", "stable_substeps"]

Array = NDArray[np.float64]
MOST_GROWTH = 0.1
"""Growth that counts as stable [1/s]: some methods add energy to an undamped pendulum, far more slowly."""
_MOST_SUBSTEPS = 10_000
_PART = 65_536
_DIFFERENCE = 1e-5
"""Half the step of finite differences [rad, rad/s]."""


def growth_rate(
    integrator: Integrator,
    damping_rates: ArrayLike,
    stiffness_rates: ArrayLike,
    h: float,
    coefficients: Sequence[Array],
) -> Array:
    """Return the growth of a decaying motion when integrated [1/s], below 0 if stable; not for ``adaptive``.

    lambda [1/s], omega^2 [1/s^2] and the method's coefficients for step h [s] are scalars or have shape (B,).
    """
    rates = np.asarray(damping_rates, dtype=np.float64)
    stiffness = np.abs(np.asarray(stiffness_rates, dtype=np.float64))
    if max(rates.size, stiffness.size) > _PART:
        # Parts fit the processor's cache.
        rates, stiffness, *wide = np.broadcast_arrays(rates, stiffness, *coefficients)
        parts = [slice(first, first + _PART) for first in range(0, rates.size, _PART)]
        return np.concatenate(
            [growth_rate(integrator, rates[at], stiffness[at], h, [c[at] for c in wide]) for at in parts]
        )
    worst = np.full(np.broadcast_shapes(rates.shape, stiffness.shape), -np.inf)
    with np.errstate(all="ignore"):
        for sign, which in ((1.0, -1), (-1.0, 0)):
            sizes = _eigenvalue_sizes(integrator, rates, sign * stiffness, h, coefficients)
            # Hanging, the larger of the two must not grow; upright, the smaller.
            size = sizes[which]
            worst = np.fmax(worst, np.where(np.isfinite(size), np.log(size) / h, np.inf))
    return worst


def _eigenvalue_sizes(
    integrator: Integrator, rates: Array, stiffness: Array, h: float, coefficients: Sequence[Array]
) -> tuple[Array, Array]:
    def linear(theta: float, theta_dot: float, torque: float, direction: float, plant: PlantTuple) -> float:  # noqa: ARG001
        return -rates * theta_dot - stiffness * theta  # type: ignore[return-value]  # whole arrays at once

    def step(theta: float, theta_dot: float) -> tuple[Array, Array]:
        x, v = integrator.step(linear, theta, theta_dot, 0.0, 0.0, 0.0, 0.0, h, tuple(coefficients), ())  # type: ignore[arg-type]
        return np.asarray(x), np.asarray(v)

    (a, c), (b, d) = step(1.0, 0.0), step(0.0, 1.0)
    half_trace = 0.5 * (a + d)
    root = np.sqrt(np.asarray(half_trace * half_trace - (a * d - b * c), dtype=np.complex128))
    sizes = np.abs(half_trace - root), np.abs(half_trace + root)
    return np.minimum(*sizes), np.maximum(*sizes)


def check_stability(
    integrator: Integrator, parameters: PlantParameters, dt: float, substeps: int, longest_step: float
) -> None:
    """Raise a ParameterError, with a stable alternative, if a method is unstable on a rigid plant.

    ``longest_step`` is the longest sub-step of a period dt that a delay may cut [s].
    """
    if integrator.name == "adaptive" or _is_stable(integrator, parameters, longest_step):
        return
    enough = stable_substeps(integrator, parameters, dt)
    etd4 = get_integrator("etd4")
    ways = [f"substeps >= {enough}"] if enough else []
    ways += ["method etd4"] if integrator is not etd4 and _is_stable(etd4, parameters, longest_step) else []
    raise ParameterError(
        f"method {integrator.name!r} is unstable on plant {parameters.name!r} (damping "
        f"{parameters.damping / parameters.inertia:.4g} 1/s) at a step of {longest_step * 1e3:.4g} ms "
        f"(dt {dt * 1e3:.4g} ms, substeps {substeps}); expected {' or '.join(ways) or 'a shorter dt'}"
    )


def growth_of_map(step: Callable[[Array], Array], x: Array, h: float, growing: int = 0) -> float:
    """Return the growth [1/s] of what should decay under a nearly linear map over h [s] around a state, shape (n,).

    ``growing`` poles truly grow there.
    """
    n = len(x)
    jacobian = np.empty((n, n))
    with np.errstate(all="ignore"):
        for k in range(n):
            shift = _DIFFERENCE * np.eye(n)[k]
            jacobian[:, k] = (step(x + shift) - step(x - shift)) / (2.0 * _DIFFERENCE)
        if not np.isfinite(jacobian).all():
            return math.inf
        sizes = np.sort(np.abs(np.linalg.eigvals(jacobian)))
    size = float(sizes[-1 - growing])
    return math.log(size) / h if size > 0.0 else -math.inf


def stable_substeps(integrator: Integrator, parameters: PlantParameters, dt: float) -> int:
    """Return the smallest stable number of sub-steps of a period; 0 if none up to 10 000 is."""
    count = 1
    while count <= _MOST_SUBSTEPS and not _is_stable(integrator, parameters, dt / count):
        count = max(count + 1, math.ceil(1.02 * count))
    while count > 1 and count <= _MOST_SUBSTEPS and _is_stable(integrator, parameters, dt / (count - 1)):
        count -= 1
    return count if count <= _MOST_SUBSTEPS else 0


def _is_stable(integrator: Integrator, parameters: PlantParameters, h: float) -> bool:
    rate = parameters.damping / parameters.inertia
    coefficients = [np.float64(value) for value in integrator.coefficients(rate, h)]
    stiffness = parameters.gravity / parameters.inertia
    return bool(growth_rate(integrator, rate, stiffness, h, coefficients) <= MOST_GROWTH)
