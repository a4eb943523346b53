"""The loop of a rigid plant, for the compiler's process, from the interpreted integrators and equations."""

from __future__ import annotations

from typing import Any

from pendulum_msgs_py.contract.rules import within
from pendulum_msgs_py.loops.plant_kernel import plant_loop
from pendulum_msgs_py.loops.primitives import compiled
from pendulum_msgs_py.loops.trees import compile_tree, tuple_loader
from pendulum_sim.simulator.loop_plant import LAYOUT, MOST_COEFFICIENTS
from pendulum_sim.stepping.dry_friction import PACKED, link_acceleration_of
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import advance_rigid

__all__ = ["rigid_loop"]


def rigid_loop(method: str, torques: str = "") -> Any:
    """Return the compiled loop of a rigid plant with an integrator; ``torques`` if its link has some of its own."""
    integrator = get_integrator(method)
    step = compile_tree(integrator.step, exact=True)
    coefficients_of = compile_tree(integrator.coefficients, exact=True)
    acceleration = compile_tree(link_acceleration_of(bool(torques)), exact=True)
    advance = compile_tree(advance_rigid, exact=True)
    clamp = compile_tree(within, exact=True)
    load_plant = tuple_loader(len(PACKED), 1)
    load_coefficients = tuple_loader(len(integrator.coefficients(1.0, 1e-3)), 1)

    @compiled
    def one_period(p: Any, effort: Any) -> None:
        last = p.waits - 1
        for index in range(last):
            p.line[index] = p.line[index + 1]
        p.line[last] = clamp(effort, p.limit)
        plant = load_plant(p.packed, 0)
        theta, theta_dot, torque = p.theta, p.theta_dot, p.torque
        for index in range(p.segments):
            theta, theta_dot, torque = advance(
                step, coefficients_of, acceleration, theta, theta_dot, torque,
                p.line[1] if p.newer[index] else p.line[0], 0.0, p.length[index],
                load_coefficients(p.coefficients, index * MOST_COEFFICIENTS), plant, p.dry != 0,
            )  # fmt: skip
        p.theta, p.theta_dot, p.torque = theta, theta_dot, torque
        p.steps += 1

    return plant_loop(LAYOUT, one_period)
