"""Compiled step of the environments, for one pendulum (lane) or many.

The lanes' state is one flat array of rows, like a block of the batch engine, with the same compiled equations.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches import vector_math
from pendulum_sim.batches.compiling import compile_tree, tuple_loader
from pendulum_sim.stepping.dry_friction import PACKED, link_acceleration_of
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import pack
from pendulum_sim.stepping.stability import check_stability

__all__ = ["ROWS", "lane_table", "step_kernel"]

ROWS = ("x", "v", "torque", "disturbance", "amplitude", "limit", "q_1", "q_2", "r", *PACKED)
"""Rows of the array; the integrator's coefficients follow."""


def lane_table(
    parameters: PlantParameters, method: str, h: float, lanes: int, amplitude: float, q: tuple[float, ...], r: float
) -> NDArray[np.float64]:
    """Return the rows of equal pendulums at rest hanging down, shape (rows, lanes).

    Raises:
        ParameterError: The method is unstable on this plant at that step.
    """
    integrator = get_integrator(method)
    check_stability(integrator, parameters, h, 1, h)
    coefficients = integrator.coefficients(parameters.damping / parameters.inertia, h)
    values = (*(0.0, 0.0, 0.0, 0.0, amplitude, parameters.effort_limit, *q, r), *pack(parameters), *coefficients)
    return np.repeat(np.array(values)[:, np.newaxis], lanes, axis=1)


@cache
def step_kernel(method: str, lanes: int, *, torques: bool = False) -> Any:
    """Return ``step(w, keys, counts, hold, h, substeps, actions, observations, rewards)`` for a number of pendulums."""
    plant_rows = len(PACKED)
    integrator = get_integrator(method)
    coefficient_rows = len(integrator.coefficients(1.0, 1e-3))
    step = compile_tree(integrator.step, vector=True)
    acceleration = compile_tree(link_acceleration_of(torques), vector=True)
    scramble, unit = compile_tree(noise.scramble), compile_tree(noise.unit_interval)
    wrap = compile_tree(vector_math.wrap)
    load_plant = tuple_loader(plant_rows, lanes)
    load_coefficients = tuple_loader(coefficient_rows, lanes)
    o_v, o_torque, o_disturbance, o_amplitude, o_limit, o_q_1, o_q_2, o_r, o_plant = (
        row * lanes for row in range(1, 10)
    )
    o_coefficients = len(ROWS) * lanes

    @numba.njit(fastmath={"contract"}, error_model="numpy")
    def run(
        w: Any, keys: Any, counts: Any, hold: int, h: float, substeps: int, actions: Any, observations: Any,
        rewards: Any,
    ) -> None:  # fmt: skip
        for j in range(lanes):
            index = np.uint64(counts[j] // hold)
            w[o_disturbance + j] = w[o_amplitude + j] * unit(scramble(keys[j], index))
            counts[j] += 1
        for j in range(lanes):
            limit = w[o_limit + j]
            effort = min(limit, max(-limit, actions[j]))
            deviation = wrap(w[j] - UPRIGHT)
            v = w[o_v + j]
            w[o_torque + j] = min(limit, max(-limit, effort + w[o_disturbance + j]))
            # Zero times the action: a non-finite action shows in the reward; the clamp would hide it.
            rewards[j] = 0.0 * actions[j] - (
                w[o_q_1 + j] * deviation * deviation + w[o_q_2 + j] * v * v + w[o_r + j] * effort * effort
            )
        for _ in range(substeps):
            for j in range(lanes):
                torque = w[o_torque + j]
                w[j], w[o_v + j] = step(
                    acceleration, w[j], w[o_v + j], torque, torque, torque, 0.0, h,
                    load_coefficients(w, o_coefficients + j), load_plant(w, o_plant + j),
                )  # fmt: skip
        for j in range(lanes):
            observations[2 * j] = wrap(w[j] - UPRIGHT)
            observations[2 * j + 1] = w[o_v + j]

    return keep_kernel(run, "step_kernel", integrator.step, lanes, torques)
