"""How a finished policy does: the very controller that will run, on plants drawn from what it was trained for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.learning.task import SwingUpTask
from pendulum_lqr.controllers.policy import START_TIME, LearnedPolicy
from pendulum_lqr.policy import Policy
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.plants import make_plant

__all__ = ["Trial", "gymnasium_return", "measured_success", "run_trial", "trials_of"]

UP = 0.3
"""Deviation from upright within which a pendulum is up [rad]."""
HOLD = 1.0
"""Time at the end of a trial for which it has to be up [s]."""


@dataclass(frozen=True)
class Trial:
    """One run from a start to its end.

    Attributes:
        plant: What runs.
        theta: Start, 0 hanging [rad].
        theta_dot: Start [rad/s].
        kicks: Torque on the link at each step, shape (n,) [N m].
    """

    plant: PlantParameters
    theta: float
    theta_dot: float
    kicks: NDArray[np.float64]


def trials_of(policy: Policy, task: SwingUpTask, count: int, seed: int, duration: float = 10.0) -> list[Trial]:
    """Return trials with start, plant, delay and kicks all drawn anew, each from the ranges of training.

    Kicks last 50 ms and come each second, with up to the trained share of the torque limit.
    """
    rng = np.random.default_rng(seed)
    found = []
    steps, width = round(duration / policy.period), max(1, round(0.05 / policy.period))
    for _ in range(count):
        changes = {name: float(rng.uniform(*pair)) for name, pair in policy.ranges.items() if name != "static_friction"}
        if "coulomb_friction" in changes:
            ratio = policy.plant.static_friction / policy.plant.coulomb_friction
            changes["static_friction"] = ratio * changes["coulomb_friction"]
        changes["transport_delay"] = float(rng.uniform(0.0, task.delay))
        kicks = np.zeros(steps)
        for second in range(1, math.ceil(duration)):
            first = round(second / policy.period)
            kicks[first : first + width] = rng.uniform(-1.0, 1.0) * task.kick * policy.effort_limit[0]
        speed = 0.7 * policy.velocity_scale[0]
        start = float(rng.uniform(-math.pi, math.pi)), float(rng.uniform(-speed, speed))
        found.append(Trial(policy.plant.with_values(**changes), *start, kicks))
    return found


def run_trial(policy: Policy, trial: Trial, start_time: float = START_TIME) -> tuple[NDArray[np.float64], str]:
    """Return angle from upright, velocity and torque at each step, shape (3, n), and why it gave up, if it did."""
    controller = LearnedPolicy(policy, 1, policy.effort_limit[0], start_time=start_time)
    plant = make_plant(trial.plant, policy.period)
    state = plant.reset(trial.theta, trial.theta_dot)
    rows = np.empty((3, trial.kicks.size))
    for k, kick in enumerate(trial.kicks):
        x = (from_upright(state.theta), state.theta_dot)
        effort = controller.command(k * policy.period, x)
        rows[:, k] = *x, effort
        state = plant.step(effort, float(kick))
    return rows, controller.notice


def measured_success(
    policy: Policy, trials: list[Trial], on_progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Return how many trials end upright for the last second, and when they came up for good, median [s]."""
    passed, times, gave_up = 0, [], 0
    last = round(HOLD / policy.period)
    for number, trial in enumerate(trials):
        rows, notice = run_trial(policy, trial)
        down = np.flatnonzero(np.abs(rows[0]) > UP)
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
            seen, reward, _, over, _ = env.step(policy.effort_limit[0] * policy.network.answer(x))
            total += float(reward)
        returns.append(total)
    env.close()
    return float(np.mean(returns)), float(np.std(returns, ddof=1))
