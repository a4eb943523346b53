"""The linear model of a plant of several joints about a position that it can hold, and its LQR.

::

    x = [q - q*, v],   x' = A x + B du,   A = [[0, I], [d q''/dq, d q''/dv]],   B = [0; d q''/d torque at driven joints]

by complex step through the mechanism's own equations, exact to rounding. Dry friction and end stops have no derivative
at rest and are not in it, as for one joint; neither is an actuator's lag.
"""

from __future__ import annotations

import cmath
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from pendulum_lqr.linear.design import DesignError, Gain, cost_matrices, riccati_gain
from pendulum_lqr.linear.model import LinearModel
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters

__all__ = ["holding_effort", "linearise_mechanism", "mechanism_lqr"]

_BALANCED = 1e-9
"""Share of the largest torque of gravity under which a joint counts as balanced."""


def holding_effort(plant: MechanismParameters, position: Sequence[float] | None = None) -> Vector:
    """Return the efforts of the driven joints that hold the plant at a position, m values [N m or N].

    Args:
        plant: The plant.
        position: n positions; None for upright [rad or m].

    Raises:
        ParameterError: The position has another length, is not finite, or a passive joint would fall from it.
    """
    q = _checked_position(plant, position)
    n = len(q)
    p = plant.packed
    weight = np.array(complex_step(lambda *x: (in_arithmetic(plant.mechanism.potential, cmath)(x, p),), q))[0]
    # The largest that gravity can do here, so that sin(pi), which is 1.2e-16, asks for nothing.
    still = (0.0,) * n
    around = [tuple(value + 0.5 * turn for value in q) for turn in (-np.pi, np.pi, 0.0, 1.0)]
    forces = [np.array(plant.mechanism.mass(at, p)) @ plant.acceleration(at, still, still) for at in around]
    scale = float(np.max(np.abs(forces)))
    driven = plant.coordinates.driven
    for index, joint in enumerate(plant.mechanism.joints):
        if index not in driven and abs(weight[index]) > _BALANCED * scale:
            raise ParameterError(
                f"{joint.name} is passive and would fall from {q[index]:.6g} {joint.unit} with {-weight[index]:.4g} "
                f"{joint.effort_unit}; expected a position at which gravity leaves it alone, such as "
                f"{', '.join(f'{value:.6g}' for value in plant.coordinates.goal)}"
            )
    return tuple(float(weight[index]) if abs(weight[index]) > _BALANCED * scale else 0.0 for index in driven)


def linearise_mechanism(plant: MechanismParameters, position: Sequence[float] | None = None) -> LinearModel:
    """Return the linear model about a position: A (2n, 2n), B (2n, m), E (2n, n) for a torque on any joint.

    Everything is measured: C is the identity. The model's ``delay`` is the longest of its actuators.

    Args:
        plant: The plant, with m > 0 driven joints.
        position: n positions that the driven joints can hold; None for upright [rad or m].

    Raises:
        ParameterError: As :func:`holding_effort`; or no joint is driven.
    """
    coordinates = plant.coordinates
    if not coordinates.driven:
        raise ParameterError(f"plant {plant.name!r} has no driven joint; expected an actuator at one of them")
    efforts = holding_effort(plant, position)
    q = _checked_position(plant, position)
    n = len(q)
    forward = in_arithmetic(plant.mechanism.forward, cmath)
    still = (0.0,) * n

    def flow(*x: complex) -> tuple[complex, ...]:
        return (*x[n : 2 * n], *forward(x[:n], x[n : 2 * n], x[2 * n :], plant.packed))

    jacobian = np.array(complex_step(flow, (*q, *still, *coordinates.spread(efforts))))
    names = coordinates.names
    return LinearModel(
        jacobian[:, : 2 * n].copy(),
        jacobian[:, [2 * n + index for index in coordinates.driven]],
        theta=q[-1],
        effort=efforts[0],
        C=np.eye(2 * n),
        E=jacobian[:, 2 * n :].copy(),
        delay=max(actuator.transport_delay for actuator in plant.actuators),
        states=(*names, *(f"{name}_dot" for name in names)),
        position=q,
        efforts=efforts,
    )


def mechanism_lqr(model: LinearModel, q: ArrayLike, r: ArrayLike) -> Gain:
    """Return the gain u = -K x that minimises the integral of x' Q x + u' R u; K has the shape (m, 2n).

    Args:
        model: Linear model of :func:`linearise_mechanism`; its delay is not counted.
        q: Weights of [q - q*, v], the diagonal (2n,) or the whole matrix (2n, 2n).
        r: Weight of the efforts, > 0: one for all, or m.

    Raises:
        DesignError: Weights out of domain, or a mode that the efforts cannot reach or that the cost does not see.

    Source:
        Anderson and Moore, Optimal Control, 1990, section 3.2.
    """
    size, m = model.B.shape
    costs = np.broadcast_to(np.asarray(r, dtype=np.float64), (m,)) if np.size(r) in {1, m} else np.asarray(r)
    if costs.shape != (m,) or not (np.isfinite(costs).all() and costs.min() > 0.0):
        raise DesignError(f"r is {np.asarray(r).tolist()}; expected one finite weight > 0, or {m}")
    Q, _ = cost_matrices(q, 1.0, size)
    return riccati_gain(model.A, model.B, Q, costs)


def _checked_position(plant: MechanismParameters, position: Sequence[float] | None) -> Vector:
    coordinates = plant.coordinates
    q = coordinates.goal if position is None else tuple(float(value) for value in position)
    if len(q) != len(coordinates.joints) or not np.isfinite(q).all():
        raise ParameterError(
            f"position is {list(q)}; expected {len(coordinates.joints)} finite numbers, for {coordinates.with_units}"
        )
    return q
