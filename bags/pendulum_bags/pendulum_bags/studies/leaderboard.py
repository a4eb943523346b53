"""Swing-up and balance of every registered controller on each rigid plant: the public leaderboards' scores."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.in_process import RunArrays, simulate_plant
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.studies.mechanism_benchmark import Criterion, bounded_share, weighted_share
from pendulum_lqr.controller_interface.controller import controller_names
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.stepping.sensors import Sensors

__all__ = [
    "COSTS",
    "EXCLUDED",
    "HARDWARE",
    "PERTURBATIONS",
    "Entry",
    "contenders",
    "costs_of",
    "entry_of",
    "evaluate",
    "model_errors",
    "push_trains",
    "scores",
]

HARDWARE = "hw"
"""Name of the emulated machine on the board."""

EXCLUDED = {
    "playback": "plays a recording of another run",
    "policy": "is named by its file",
    "lqr_tracking": "follows a moving reference",
}
GOAL_ANGLE, GOAL_VELOCITY = 0.1, 0.5
"""Region that counts as up: angle from upright [rad], velocity [rad/s]."""
HOLD_TIME = 1.0
"""Time that a run must have been up at its end [s]: longer than falling through the region takes."""

PATIENCE = 8.0
"""Wall time of the plain run beyond which the perturbations, 25 more runs, are left out; the board shows a dash [s]."""


COSTS = (
    Criterion("time", "time", "s", 10.0, 0.2),
    Criterion("max_torque", "largest torque", "N m", 2.0, 0.1),
    Criterion("energy", "energy", "J", 100.0, 0.1),
    Criterion("torque_integral", "torque integral", "N m s", 20.0, 0.1),
    Criterion("torque_squared", "torque cost", "N^2 m^2 s", 40.0, 0.1),
    Criterion("smoothness", "smoothness", "N m", 4.0, 0.2),
    Criterion("velocity", "velocity cost", "rad^2/s", 100.0, 0.2),
)
"""Costs of a run, with norms and weights of the dfki underactuated-robotics leaderboards (weights sum to 1)."""


@dataclass(frozen=True)
class Entry:
    """One line of the board.

    Attributes:
        reason: Why it is not scored, or empty.
        scores: By version, v1 to v3.
        wall: Duration of the plain run [s].
        motion: Time [s], angle from upright [rad], applied torque [N m], thinned, shape (3, n); for plots.
    """

    plant: str
    controller: str
    reason: str
    success: bool
    costs: Mapping[str, float]
    scores: Mapping[str, float]
    robustness: Mapping[str, float]
    wall: float
    motion: Array


def costs_of(arrays: RunArrays) -> tuple[bool, float, dict[str, float]]:
    """Return success, share of time spent up, and costs; ``time`` is the final entry into the goal region."""
    t = (arrays.stamp_ns - arrays.stamp_ns[0]) / NANOSECONDS
    duration = float(t[-1])
    up = (np.abs(wrap(arrays.position - UPRIGHT)) < GOAL_ANGLE) & (np.abs(arrays.velocity) < GOAL_VELOCITY)
    below = np.flatnonzero(~up)
    entered = 0.0 if not below.size else float(t[min(below[-1] + 1, t.size - 1)])
    success = bool(up[-1]) and duration - entered >= HOLD_TIME
    tau, dt = arrays.applied, np.diff(t)
    return (
        success,
        float(up.mean()),
        {
            "time": entered if success else duration,
            "max_torque": float(np.abs(tau).max()),
            "energy": float(np.sum(np.abs(tau * arrays.velocity[:-1]) * dt)),
            "torque_integral": float(np.sum(np.abs(tau) * dt)),
            "torque_squared": float(np.sum(tau * tau * dt)),
            "smoothness": float(np.std(np.diff(tau))),
            "velocity": float(np.sum(arrays.velocity[:-1] ** 2 * dt)),
        },
    )


def scores(success: bool, uptime: float, costs: Mapping[str, float]) -> dict[str, float]:
    """Return the three versions of the public leaderboards' score; 1 is perfect, v1 may fall below 0.

    v1 = success (1 - sum w x / n); v2 = success (1 - mean tanh(pi x / n)); v3 = time spent up per length of the run.
    """
    v1, v2 = 1.0 - weighted_share(costs, COSTS), 1.0 - bounded_share(costs, COSTS)
    return {"v1": success * v1, "v2": success * v2, "v3": uptime}


Variation = tuple[PlantParameters, Mapping[str, Any], Mapping[str, float]]
"""Plant, disturbance, sensors."""


def model_errors(plant: PlantParameters) -> list[PlantParameters]:
    """Return plants by which a model may be wrong: inertia with gravity, or damping, by 10 and 25 %."""
    changed = []
    for share in (0.75, 0.9, 1.1, 1.25):
        changed.append(plant.with_values(inertia=share * plant.inertia, gravity=share * plant.gravity))
        changed.append(plant.with_values(damping=share * plant.damping))
    return changed


def push_trains(plant: PlantParameters, duration: float) -> list[dict[str, Any]]:
    """Return disturbances that push once, after half of ``duration`` [s], with shares of the largest torque."""
    return [
        {
            "kind": "pulse_train",
            "amplitude": share * plant.effort_limit,
            "frequency": 4.0 / duration,
            "pulse_width": 0.1,
            "start_time": 0.5 * duration,
            "hold_time": 0.0,
            "duration": 0.7 * duration,
        }
        for share in (0.1, 0.2, 0.4, 0.6)
    ]


PERTURBATIONS: Mapping[str, Callable[[PlantParameters, float], Sequence[Variation]]] = {
    "model_error": lambda plant, _: [(one, {}, {}) for one in model_errors(plant)],
    "noise": lambda plant, _: [
        (plant, {}, {"position_noise": a, "velocity_noise": 10.0 * a}) for a in (0.001, 0.003, 0.01, 0.03)
    ],
    "delay": lambda plant, _: [
        (plant.with_values(transport_delay=delay), {}, {}) for delay in (0.002, 0.005, 0.01, 0.02, 0.04)
    ],
    "torque_response": lambda plant, _: [
        (plant.with_values(actuator_time_constant=lag), {}, {}) for lag in (0.005, 0.01, 0.02, 0.05)
    ],
    "pushes": lambda plant, duration: [(plant, push, {}) for push in push_trains(plant, duration)],
}
"""Kind of perturbation -> the plants, disturbances and sensors that it tries, in runs of some length [s]."""


Run = Callable[[], RunArrays]


def entry_of(
    plant: str,
    controller: str,
    run: Run,
    perturbed: Iterable[tuple[str, Sequence[Run]]],
    patience: float = math.inf,
) -> Entry:
    """Return the line of a controller.

    Args:
        perturbed: Kind and runs of each perturbation; not evaluated where the plain run fails.
        patience: Duration of the plain run beyond which no perturbation is tried [s].
    """
    began = time.perf_counter()
    try:
        arrays = run()
    except (PendulumError, ArithmeticError) as error:
        wall = time.perf_counter() - began
        return Entry(plant, controller, str(error), False, {}, {}, {}, wall, np.empty((3, 0)))
    success, uptime, costs = costs_of(arrays)
    wall = time.perf_counter() - began
    held: dict[str, float] = {}
    if success and wall < patience:
        held = {kind: float(np.mean([_succeeds(one) for one in runs])) for kind, runs in perturbed}
    return Entry(plant, controller, "", success, costs, scores(success, uptime, costs), held, wall, motion_of(arrays))


def _succeeds(run: Run) -> bool:
    try:
        return costs_of(run())[0]
    except (PendulumError, ArithmeticError):
        return False


def evaluate(
    plant: str,
    controller: str,
    *,
    parameters: Mapping[str, Any] | None = None,
    duration: float = 10.0,
    robustness: bool = True,
) -> Entry:
    """Return the line of a controller for ``duration`` [s] from hanging to upright, on its own plant."""
    true = load_plant(plant)
    # Hanging at rest is an equilibrium of an energy controller.
    spec: dict[str, Any] = {
        "plant": plant,
        "design_plant": plant,
        "controller": controller,
        "controller_parameters": parameters or {},
        "theta": 0.01,
        "duration": duration,
        "method": "etd4",
    }

    def perturbed() -> Iterator[tuple[str, Sequence[Run]]]:
        for kind, vary in PERTURBATIONS.items() if robustness else ():
            runs = []
            for changed, disturbance, noise in vary(true, duration):
                sensors = Sensors(np.random.default_rng(1), **noise)
                runs.append(partial(simulate_plant, RunSpec(**{**spec, "disturbance": disturbance}), changed, sensors))
            yield kind, runs

    return entry_of(plant, controller, lambda: simulate_plant(RunSpec(**spec), true), perturbed(), PATIENCE)


def motion_of(arrays: RunArrays) -> Array:
    """Return time, angle from upright and torque of a run, thinned for a plot, shape (3, n)."""
    step = max(1, len(arrays.applied) // 500)
    t = (arrays.stamp_ns[:-1] - arrays.stamp_ns[0]) / NANOSECONDS
    return np.stack([t, wrap(arrays.position[:-1] - UPRIGHT), arrays.applied])[:, ::step]


def contenders() -> list[str]:
    """Return the controllers of the board."""
    return [name for name in controller_names() if name not in EXCLUDED]
