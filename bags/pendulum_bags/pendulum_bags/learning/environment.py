"""Many pendulums that a policy learns on, each with a plant, a delay and noise of its own; compiled.

The equations are the simulator's own (:mod:`pendulum_sim.dry_friction`, Runge-Kutta of order four). The torque that
answers a state begins to act after the delay; until then the one before it acts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pendulum_bags.learning.task import SwingUpTask
from pendulum_lqr.policy import DEFAULT_SIGNALS
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.compiling import compile_tree, tuple_loader
from pendulum_sim.dry_friction import PACKED, acceleration_with_friction, actuator_torque, advance_dry
from pendulum_sim.integrators import get_integrator
from pendulum_sim.plant import pack

__all__ = ["SwingUp", "velocity_scale"]

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

_KICK_TIME = 0.05
_GROWTH = 0.8
"""Largest product of the damping rate and the step, far inside of where Runge-Kutta is stable [-]."""
_PRIVILEGED = 8


def velocity_scale(plant: PlantParameters) -> float:
    """Return half of the speed after a fall from upright without friction, 1 at least [rad/s]."""
    return max(1.0, math.sqrt(plant.gravity / plant.inertia))


class SwingUp:
    """N pendulums under one policy.

    Args:
        count: N.
        plant: The plant at the centre; rigid.
        ranges: Lowest and highest value of each parameter that differs.
        task: Everything else that differs.
        generator: Draws plants, starts, delays, noise and kicks.

    Raises:
        ParameterError: The plant is series elastic.
    """

    action_size, privileged_size = 1, _PRIVILEGED

    def __init__(
        self,
        count: int,
        plant: PlantParameters,
        ranges: Mapping[str, tuple[float, float]],
        task: SwingUpTask,
        generator: np.random.Generator,
    ) -> None:
        if plant.drivetrain is not None:
            raise ParameterError(
                f"plant {plant.name!r} is series elastic; expected a rigid one, such as the plant that `identify` fits"
            )
        self.count = count
        self.plant, self.task, self._ranges = plant, task, dict(ranges)
        self._generator = generator
        self.observation_size = task.history * len(DEFAULT_SIGNALS)
        self.limit = plant.effort_limit
        self.scale = velocity_scale(plant)
        self.step_limit = 2.0 * plant.effort_limit * task.period / task.rate_time
        fastest = max(pair[1] for pair in (ranges.get("damping", (0.0, plant.damping)),))
        lightest = ranges.get("inertia", (plant.inertia, plant.inertia))[0]
        self._longest_step = min(0.01, _GROWTH * lightest / fastest if fastest > 0.0 else 0.01)
        self._advance = _kernel()
        # Columns: angle, velocity, torque of the actuator, torque that acts, torque on its way, when that arrives.
        self.motion = np.zeros((count, 6))
        self.parameters = np.repeat(np.array([pack(plant)], dtype=np.float64), count, axis=0)
        self.delay, self.effort, self.push = np.zeros(count), np.zeros(count), np.zeros(count)
        self._zero = np.zeros(count)
        self._kick_left, self._left = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        self._steps = max(1, round(task.episode / task.period))
        self._samples = np.zeros((count, self.observation_size), dtype=np.float32)
        self.restart(np.ones(count, dtype=np.bool_))
        # Not all end at once.
        self._left[:] = generator.integers(1, self._steps + 1, count)

    def observe(self) -> tuple[Floats, Floats]:
        """Return the samples, shape (N, history 4), and the true state, plant and delay, shape (N, 8)."""
        x, v = self.motion[:, 0], self.motion[:, 1]
        inertia, damping, gravity, coulomb = (self.parameters[:, k] for k in range(4))
        extra = np.stack(
            [
                np.cos(x), np.sin(x), v / self.scale, self.push / self.limit, self.delay / (2.0 * self.task.period),
                gravity / self.limit - self.plant.gravity / self.limit, inertia / self.plant.inertia - 1.0,
                (coulomb - self.plant.coulomb_friction + damping - self.plant.damping) / self.limit,
            ], axis=1,
        )  # fmt: skip
        return self._samples.copy(), extra.astype(np.float32)

    def step(self, actions: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Answer with torques, actions times the limit, rate-limited; return rewards and whose time is over."""
        task, draw = self.task, self._generator
        change = self.limit * actions[:, 0].astype(np.float64) - self.effort
        change = np.clip(change, -self.step_limit, self.step_limit)
        self.effort = self.effort + change
        self._kick()
        late = np.maximum(0.0, self.delay + task.jitter * draw.standard_normal(self.count))
        self._advance(self.motion, self.parameters, self.effort, late, self.push, task.period, self._longest_step)
        self._sample()
        x, v = wrap(self.motion[:, 0]), self.motion[:, 1]
        near = np.exp(-((x / 0.25) ** 2) - (v / (0.5 * self.scale)) ** 2)
        u = self.effort / self.limit
        reward = (
            0.5 * np.cos(x) + near - 0.05 * u * u - 0.2 * (change / self.step_limit) ** 2 * 0.25
            - 0.02 * np.maximum(0.0, np.abs(v) / self.scale - 2.5) ** 2
        )  # fmt: skip
        self._left -= 1
        return (0.05 * reward).astype(np.float32), self._left <= 0

    def restart(self, which: NDArray[np.bool_]) -> None:
        """Start new episodes in some of them: half anywhere, a quarter hanging, a quarter near upright."""
        rows = np.flatnonzero(which)
        if not rows.size:
            return
        draw, size, task = self._generator, rows.size, self.task
        for name, (low, high) in self._ranges.items():
            if name != "static_friction":
                self.parameters[rows, PACKED.index(name)] = draw.uniform(low, high, size)
        coulomb = PACKED.index("coulomb_friction")
        if self.plant.coulomb_friction > 0.0:
            ratio = self.plant.static_friction / self.plant.coulomb_friction
            self.parameters[rows, coulomb + 1] = ratio * self.parameters[rows, coulomb]
        self.parameters[rows, PACKED.index("torque_offset")] = draw.uniform(-1.0, 1.0, size) * task.offset * self.limit
        self._zero[rows] = draw.uniform(-1.0, 1.0, size) * task.offset
        self.delay[rows] = draw.uniform(0.0, 1.0, size) * task.delay
        kind = draw.uniform(0.0, 1.0, size)
        angle = np.where(kind < 0.5, draw.uniform(-math.pi, math.pi, size), np.where(kind < 0.75, math.pi, 0.0))
        self.motion[rows] = 0.0
        self.motion[rows, 0] = angle + 0.05 * draw.standard_normal(size)
        self.motion[rows, 1] = np.where(kind < 0.5, 0.7 * self.scale, 0.1) * draw.standard_normal(size)
        self.effort[rows], self.push[rows] = 0.0, 0.0
        self._kick_left[rows], self._left[rows] = 0, self._steps
        first = self._measure(rows)
        self._samples[rows] = np.tile(first, (1, task.history))

    def state(self) -> dict[str, NDArray[Any]]:
        """Return what a checkpoint keeps."""
        return {
            "motion": self.motion, "parameters": self.parameters, "delay": self.delay, "effort": self.effort,
            "push": self.push, "zero": self._zero, "kick_left": self._kick_left, "left": self._left,
            "samples": self._samples,
        }  # fmt: skip

    def restore(self, kept: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a checkpoint."""
        for name, array in self.state().items():
            array[...] = kept[name]

    def _kick(self) -> None:
        draw, task = self._generator, self.task
        begins = draw.uniform(0.0, 1.0, self.count) < task.kick_rate * task.period
        torque = draw.uniform(-1.0, 1.0, self.count) * task.kick * self.limit
        begins &= self._kick_left == 0
        self._kick_left[begins] = max(1, round(_KICK_TIME / task.period))
        self.push = np.where(begins, torque, np.where(self._kick_left > 0, self.push, 0.0))
        self._kick_left = np.maximum(0, self._kick_left - 1)

    def _measure(self, rows: NDArray[np.intp] | slice) -> Floats:
        x, v = self.motion[rows, 0], self.motion[rows, 1]
        noise = self._generator.standard_normal((x.size, 2))
        angle = x + self._zero[rows] + self.task.angle_noise * noise[:, 0]
        velocity = v + self.task.velocity_noise * noise[:, 1]
        sample = np.stack([np.cos(angle), np.sin(angle), velocity / self.scale, self.effort[rows] / self.limit], axis=1)
        return sample.astype(np.float32)

    def _sample(self) -> None:
        size = len(DEFAULT_SIGNALS)
        self._samples[:, :-size] = self._samples[:, size:].copy()
        self._samples[:, -size:] = self._measure(slice(None))


@cache
def _kernel() -> Any:
    integrator = get_integrator("rk4")
    step, coefficients_of = compile_tree(integrator.step), compile_tree(integrator.coefficients)
    acceleration, advance = compile_tree(acceleration_with_friction), compile_tree(advance_dry)
    lagged = compile_tree(actuator_torque)
    load_plant = tuple_loader(len(PACKED), 1)

    @numba.njit(error_model="numpy")
    def run(motion: Any, parameters: Any, efforts: Any, late: Any, pushes: Any, period: float, longest: float) -> None:
        for j in range(motion.shape[0]):
            plant = load_plant(parameters[j], 0)
            c = coefficients_of(plant[1] / plant[0], longest)
            # The angle is that from upright; the equations count from hanging.
            theta, v, torque = motion[j, 0] + np.pi, motion[j, 1], motion[j, 2]
            held, pending, arrives = motion[j, 3], motion[j, 4], motion[j, 5]
            first = min(max(arrives, 0.0), period)
            # No answer overtakes the one before it, and none is later than two periods.
            comes = min(max(late[j], arrives), 2.0 * period)
            second = min(max(comes, first), period)
            for part in range(3):
                start = 0.0 if part == 0 else (first if part == 1 else second)
                end = first if part == 0 else (second if part == 1 else period)
                command = held if part == 0 else (pending if part == 1 else efforts[j])
                if end <= start:
                    continue
                count = int(np.ceil((end - start) / longest - 1e-9))
                h = (end - start) / count
                for _ in range(count):
                    theta, v = advance(
                        step, coefficients_of, acceleration, theta, v, torque, command, pushes[j], h, c, plant
                    )
                    torque = lagged(torque, command, h, plant[9])
            motion[j, 0], motion[j, 1], motion[j, 2] = theta - np.pi, v, torque
            if comes >= period:
                motion[j, 3] = pending
                motion[j, 4], motion[j, 5] = efforts[j], comes - period
            else:
                motion[j, 3], motion[j, 4], motion[j, 5] = efforts[j], efforts[j], 0.0

    return run
