"""Success of a finished policy: the controller that will run, on plants drawn from its training's ranges."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_learning.body import can_exist, kicks_of, start_spread
from pendulum_learning.task import SwingUpTask
from pendulum_lqr.controller_interface.policy_runner import START_TIME
from pendulum_lqr.controllers.policy import LearnedPolicy
from pendulum_lqr.policies.policy import Policy
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.stepping.plants import JointPlant, make_plant

__all__ = ["HOLD", "UP", "Trial", "gymnasium_return", "is_up", "measured_success", "run_trial", "trials_of"]

UP = 0.3
"""Deviation from upright within which a joint that turns is up [rad]."""
HOLD = 1.0
"""Time at the end of a trial during which it must be up [s]."""
_MOST_DRAWS = 50


@dataclass(frozen=True)
class Trial:
    """One run of n joints.

    Attributes:
        position: Start, hanging at 0 [rad or m].
        velocity: Start [rad/s or m/s].
        kicks: Efforts on the joints at each step, shape (steps, n) [N m or N].
        travel: Largest deviation of joints that slide [m]; leaving it fails the trial.
    """

    plant: PlantParameters
    position: Vector
    velocity: Vector
    kicks: NDArray[np.float64]
    travel: float = math.inf


def trials_of(
    policy: Policy, task: SwingUpTask, count: int, seed: int, duration: float = 10.0, *, hanging: bool = False
) -> list[Trial]:
    """Return ``count`` trials of ``duration`` [s] with start, plant, delay and kicks from the ranges of training.

    Kicks last 50 ms, one each second, with up to the trained share of the effort limit, or of the largest torque of
    gravity at a joint without a motor. ``hanging`` starts at rest without kicks.
    """
    rng = np.random.default_rng(seed)
    found = []
    joints = policy.coordinates.joints
    furthest, fastest = start_spread(policy.plant, task.travel, policy.velocity_scale)
    largest = kicks_of(policy.plant)
    steps, width = round(duration / policy.period), max(1, round(0.05 / policy.period))
    for _ in range(count):
        plant = _drawn(policy, task, rng)
        kicks = np.zeros((steps, len(joints)))
        for second in range(1, math.ceil(duration)):
            first = round(second / policy.period)
            kicks[first : first + width] = rng.uniform(-1.0, 1.0, len(joints)) * task.kick * largest
        # From hanging if the joint turns, from the middle if it slides.
        position = tuple(
            float(rng.uniform(-far, far)) + (0.0 if joint.turns else joint.goal)
            for joint, far in zip(joints, furthest, strict=True)
        )
        velocity = tuple(float(rng.uniform(-speed, speed)) for speed in fastest)
        if hanging:
            position = velocity = (0.0,) * len(joints)
            kicks = np.zeros_like(kicks)
        found.append(Trial(plant, position, velocity, kicks, task.travel))
    return found


def _drawn(policy: Policy, task: SwingUpTask, rng: np.random.Generator) -> PlantParameters:
    plant = policy.plant
    for _ in range(_MOST_DRAWS):
        drawn = {name: float(rng.uniform(*pair)) for name, pair in policy.ranges.items() if "static" not in name}
        for name in [name for name in policy.ranges if name.endswith("static_friction")]:
            coulomb = name.replace("static", "coulomb")
            if coulomb in drawn:
                drawn[name] = plant.value(name) / plant.value(coulomb) * drawn[coulomb]
        delay = float(rng.uniform(0.0, task.delay))
        if plant.is_pendulum:
            return plant.with_values(**drawn, transport_delay=delay)
        drawn |= {f"{joint}.transport_delay": delay for joint in plant.coordinates.driven_names}
        with suppress(ParameterError):
            found = plant.with_values(drawn)
            if can_exist(found.mechanism, np.array([found.packed]))[0]:
                return found
    return plant


def plant_of(parameters: PlantParameters, period: float) -> JointPlant:
    """Return the simulated plant, whose states are tuples; ``period`` in [s]."""
    substeps = None if parameters.is_pendulum else max(1, round(period / 0.002))
    return make_plant(parameters, period, substeps=substeps)


def run_trial(policy: Policy, trial: Trial, start_time: float = START_TIME) -> tuple[NDArray[np.float64], str]:
    """Return n deviations from upright, n velocities, m efforts, shape (2 n + m, steps), and a reason to give up."""
    coordinates, plant = policy.coordinates, plant_of(trial.plant, policy.period)
    controller = LearnedPolicy(policy, 1, policy.effort_limit, start_time=start_time)
    state = plant.reset(trial.position, trial.velocity)
    rows = np.empty((2 * len(policy.joints) + len(coordinates.driven), len(trial.kicks)))
    for k, kick in enumerate(trial.kicks.tolist()):
        t, position, velocity = k * policy.period, state.position, state.velocity
        effort = controller.efforts(t, position, velocity)
        rows[:, k] = *coordinates.deviation(position), *velocity, *effort
        state = plant.step(effort, tuple(kick))
    return rows, controller.notice


def is_up(policy: Policy, trial: Trial, rows: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return at which steps of :func:`run_trial` turning joints are up and sliding ones never left their travel."""
    up = np.ones(rows.shape[1], dtype=np.bool_)
    for joint, row in zip(policy.coordinates.joints, np.abs(rows), strict=False):
        up &= row <= UP if joint.turns else bool(np.all(row <= trial.travel))
    return up


def measured_success(
    policy: Policy, trials: list[Trial], on_progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Return how many trials are up for the last second, and the median time at which they came up for good [s]."""
    passed, times, gave_up = 0, [], 0
    last = round(HOLD / policy.period)
    for number, trial in enumerate(trials):
        rows, notice = run_trial(policy, trial)
        down = np.flatnonzero(~is_up(policy, trial, rows))
        gave_up += bool(notice)
        if not down.size or down[-1] < rows.shape[1] - last:
            passed += 1
            times.append(0.0 if not down.size else policy.period * (down[-1] + 1.0))
        if on_progress is not None:
            on_progress(number + 1, len(trials))
    return {
        "trials": len(trials),
        "up": passed,
        "gave_up": gave_up,
        "median_time": float(np.median(times)) if times else None,
    }


def gymnasium_return(policy: Policy, episodes: int, seed: int) -> tuple[float, float]:
    """Return mean and standard deviation of the return over episodes of Gymnasium's own Pendulum-v1."""
    import gymnasium

    env = gymnasium.make("Pendulum-v1")
    returns = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=seed + episode)
        total, over = 0.0, False
        while not over:
            x = np.array([seen[0], seen[1], seen[2] / policy.velocity_scale[0]], dtype=np.float32)
            seen, reward, _, over, _ = env.step(policy.effort_limit[0] * policy.network.forward(x))
            total += float(reward)
        returns.append(total)
    env.close()
    return float(np.mean(returns)), float(np.std(returns, ddof=1))
