"""Task of single and vector environments: plant, spaces, reward, starts and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.mechanism_plant import check_stable_step
from pendulum_sim.stepping.plant import check_step
from pendulum_sim.stepping.plants import JointPlant, make_plant

__all__ = ["EPISODE_TIME", "STARTS", "Array", "EnvironmentTask"]

STARTS = ("bottom", "top", "random")
EPISODE_TIME = 5.0
"""Default time after which an episode is truncated, as long as the thesis's runs [s]."""
Array = NDArray[np.float64]


class EnvironmentTask:
    """Plant, spaces, reward, starts and noise from the environments' arguments, checked by ParameterErrors."""

    def __init__(
        self,
        plant: str | PlantParameters,
        *,
        dt: float = 2e-3,
        method: str = "auto",
        substeps: int = 1,
        start: str = "top",
        disturbance: float = 0.0,
        hold: int = 1,
        q: Sequence[float] | None = None,
        r: float | None = None,
        episode_time: float = EPISODE_TIME,
    ) -> None:
        parameters = plant if isinstance(plant, PlantParameters) else load_mechanism(plant)
        check_step(dt, substeps)
        if method != "auto":
            get_integrator(method)
        if not parameters.is_pendulum:
            check_stable_step(parameters, dt / substeps)
        if not parameters.coordinates.driven:
            raise ParameterError(f"plant {parameters.name!r} has no driven joint; expected an actuator at one of them")
        _check_start_name(start)
        coordinates = parameters.coordinates
        if not (math.isfinite(disturbance) and disturbance >= 0.0):
            raise ParameterError(
                f"disturbance is {disturbance} {coordinates.drive_unit}; expected a finite number >= 0"
            )
        if hold < 1:
            raise ParameterError(f"hold is {hold} steps; expected >= 1")
        if not episode_time > 0.0:
            raise ParameterError(f"episode_time is {episode_time} s; expected > 0")
        self.parameters, self.dt, self.method, self.substeps = parameters, dt, method, substeps
        self.start, self.disturbance, self.hold = start, float(disturbance), hold
        self.joints = n = len(parameters.joints)
        self.last = math.inf if math.isinf(episode_time) else max(1, math.ceil(episode_time / dt - 1e-9))
        weights, cost = parameters.weights
        self.q, self.r = _checked_weights(weights if q is None else q, cost if r is None else r, n)
        self.limits = np.array(parameters.command_limits)
        self._r = np.full(len(self.limits), self.r)
        self.goal = np.array(coordinates.goal)
        if start != "random":
            parameters.check_start(tuple(self.goal) if start == "top" else (0.0,) * n)
        self.turns = np.array([joint.turns for joint in coordinates.joints])
        self._low, self._high = self._range_of_starts()
        high = np.full(2 * n, np.inf)
        high[:n][self.turns] = np.pi
        if parameters.is_pendulum and parameters.drivetrain is None and parameters.damping > 0.0:
            # Where b |theta'| exceeds the sum of all other torques, the pendulum slows down.
            torques = parameters.effort_limit + parameters.gravity + abs(parameters.torque_offset) + disturbance
            high[1] = max(20.0, 1.1 * torques / parameters.damping)
        self.observation_space = spaces.Box(-high, high, dtype=np.float64)
        limits = self.limits.astype(np.float32)
        self.action_space = spaces.Box(-limits, limits, dtype=np.float32)

    def make_plant(self) -> JointPlant:
        """Return the simulated plant."""
        substeps = self.substeps if self.substeps > 1 else None
        return make_plant(self.parameters, self.dt, method=self.method, substeps=substeps)

    def observe(self, position: Array, velocity: Array) -> Array:
        """Return x of shape (..., 2n)."""
        deviation = position - self.goal
        wrapped = np.where(self.turns, (deviation + np.pi) % (2.0 * np.pi) - np.pi, deviation)
        return np.concatenate([wrapped, velocity], axis=-1)

    def reward(self, x: Array, effort: Array) -> Array:
        """Return the rewards of states (..., 2n) and efforts (..., m)."""
        cost: Array = (x * x) @ self.q + (effort * effort) @ self._r
        return -cost

    def begin(
        self, options: Mapping[str, Any], generator: np.random.Generator, count: int, state: Array | None = None
    ) -> tuple[Array, list[int]]:
        """Return starts x, shape (count, 2n), drawn unless given as ``state``, and the keys of the episodes' noise."""
        x = self._draw(options.get("start", self.start), generator, count) if state is None else state
        return x, [noise.stream_key(int(seed)) for seed in generator.integers(2**63, size=count)]

    def _draw(self, start: object, generator: np.random.Generator, count: int) -> Array:
        _check_start_name(start)
        if start == "random":
            return generator.uniform(self._low, self._high, (count, 2 * self.joints))
        x = np.zeros((count, 2 * self.joints))
        if start == "bottom":
            x[:, : self.joints] = -self.goal
        return x

    def _range_of_starts(self) -> tuple[Array, Array]:
        """Return the ends of x of random starts: of a turn, or between stops with a margin."""
        low, high = np.full(2 * self.joints, -1.0), np.ones(2 * self.joints)
        for i, (own, goal) in enumerate(zip(self.parameters.joints, self.goal, strict=True)):
            # Without a stop on one side: half a turn or 1 m from the other, or from 0.
            reach = math.pi if self.turns[i] else 1.0
            first, last = own.lower_stop, own.upper_stop
            if first is None and last is None:
                low[i], high[i] = -reach, reach
                continue
            if first is None:
                first = min(-reach, (last or 0.0) - reach)
            if last is None:
                last = max(reach, first + reach)
            middle, half = 0.5 * (first + last) - goal, 0.45 * (last - first)
            low[i], high[i] = middle - half, middle + half
        return low, high

    def given(self, options: Mapping[str, Any], count: int) -> Array | None:
        """Return the starts of the option ``state`` as observed, shape (count, 2n), or None.

        Raises:
            ParameterError: They have another shape, or are not finite.
        """
        if options.get("state") is None:
            return None
        x = np.asarray(options["state"], dtype=np.float64)
        size = 2 * self.joints
        if x.shape not in {(size,), (count, size)} or not np.isfinite(x).all():
            rows = f", or {count} rows of them" if count > 1 else ""
            raise ParameterError(f"start state has shape {x.shape}; expected {size} finite numbers{rows}")
        return np.broadcast_to(x, (count, size))

    def efforts(self, actions: Array) -> Array:
        """Return clamped actions (..., m)."""
        if not np.isfinite(actions).all():
            raise ParameterError(f"action is {np.squeeze(actions).tolist()}; expected finite numbers")
        # np.clip takes three times as long.
        clamped: Array = np.minimum(np.maximum(actions, -self.limits), self.limits)
        return clamped

    def noise(self, key: int, count: int) -> list[float]:
        """Return the disturbance of each driven joint in a step, as the batch engine draws it."""
        first = count // self.hold * len(self.limits)
        return [self.disturbance * noise.unit_interval(noise.scramble(key, first + i)) for i in range(len(self.limits))]


def check_reset_options(options: Mapping[str, Any], known: Sequence[str]) -> None:
    """Refuse unknown options."""
    unknown = set(options) - set(known)
    if unknown:
        expected = f"{', '.join(known[:-1])} or {known[-1]}"
        raise ParameterError(f"reset option {min(unknown)!r} is unknown; expected {expected}")


def _check_start_name(start: object) -> None:
    if start not in STARTS:
        raise ParameterError(f"start is {start!r}; expected one of {', '.join(STARTS)}")


def _checked_weights(q: object, r: float, joints: int) -> tuple[Array, float]:
    weights = np.asarray(q, dtype=np.float64)
    if weights.shape != (2 * joints,) or not (np.isfinite(weights) & (weights >= 0.0)).all():
        raise ParameterError(
            f"q is {q}; expected {2 * joints} finite numbers >= 0, the weights of each deviation and each velocity"
        )
    if not (math.isfinite(r) and r >= 0.0):
        raise ParameterError(f"r is {r}; expected a finite number >= 0")
    return weights, float(r)
