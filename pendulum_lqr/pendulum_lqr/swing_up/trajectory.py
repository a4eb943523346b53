"""Swing-up trajectories of a mechanism, by iterative LQR from random guesses, and their files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.swing_up.catch import MechanismCatch, deviation_of
from pendulum_lqr.swing_up.ilqr import IlqrPlan, IlqrProblem, IlqrWeights
from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import read_text
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "FORMAT",
    "MechanismTrajectory",
    "SwingUpSearch",
    "cheapest_swing_up",
    "load_trajectory",
    "search_swing_up",
    "trajectory_of",
    "write_trajectory",
]

Array = NDArray[np.float64]

FORMAT = "pendulum_trajectory/1"
_LARGEST_FILE = 50_000_000
_FIND = IlqrWeights(1.0, 0.05, 0.13, 1e-3, 0.007, 10.0)
_NEAR = 0.3
"""Largest final deviation of a guess that counts as upright, in shares of the caught region's level."""


@dataclass(frozen=True)
class MechanismTrajectory:
    """A motion from hanging at rest to upright.

    Attributes:
        plant: Name of the plant.
        joints: Names of its joints.
        times: Equidistant nodes, shape (N + 1,) [s].
        states: [q, v] there, q not wrapped, shape (N + 1, 2n).
        efforts: Of the m motors there, linear between nodes, shape (N + 1, m) [N m or N].
        how: Its origin: settings, seed, cost.
    """

    plant: str
    joints: tuple[str, ...]
    times: Array
    states: Array
    efforts: Array
    how: dict[str, Any] = field(default_factory=dict)

    @property
    def duration(self) -> float:
        """[s]."""
        return float(self.times[-1])

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return states (cubic between nodes) and efforts at given times; the last ones beyond its end."""
        from scipy.interpolate import CubicHermiteSpline

        n = self.states.shape[1] // 2
        clipped = np.clip(times, 0.0, self.duration)
        # Velocities are the slopes of positions; slopes of velocities come from their neighbours.
        slopes = np.column_stack([self.states[:, n:], np.gradient(self.states[:, n:], self.times, axis=0)])
        states = CubicHermiteSpline(self.times, self.states, slopes)(clipped)
        efforts = np.column_stack([np.interp(clipped, self.times, column) for column in self.efforts.T])
        return np.asarray(states, dtype=np.float64), efforts


@dataclass(frozen=True)
class SwingUpSearch:
    """Settings of a search: ``duration``, ``step`` of the nodes and ``shortest`` horizon of a guess in [s].

    ``find`` weights the first optimisation, from a random guess to upright; the LQR holds for the rest of the duration.
    """

    weights: IlqrWeights
    duration: float = 4.0
    step: float = 0.02
    shortest: float = 1.5
    find: IlqrWeights = _FIND
    iterations: int = 150


def search_swing_up(catch: MechanismCatch, search: SwingUpSearch, seed: int) -> MechanismTrajectory:
    """Return the locally optimal swing-up from the random guess of a seed.

    The guess is a sine of random height, period and horizon. Iterative LQR brings it upright, the LQR holds it there
    for the rest of the duration, and the whole is optimised again.

    Raises:
        DesignError: The guess does not end upright, or runs into an end stop.
    """
    rng = np.random.default_rng(seed)
    plant = catch.plant
    m = len(plant.coordinates.driven)
    n = len(plant.joints)
    still = (0.0,) * n
    none = (0.0,) * m
    horizon = rng.uniform(search.shortest, search.duration)
    t = np.arange(max(2, round(horizon / search.step))) * search.step
    heights = np.array(plant.effort_limits) * rng.uniform(1.0 / 60.0, 5.0 / 12.0, m)
    guess = heights * np.sin(2.0 * math.pi * (t[:, None] / rng.uniform(0.4, 1.6, m) + rng.random(m)))
    found = IlqrProblem(plant, search.step, search.find, catch.terminal).solve(still, still, none, guess, 120)
    problem = IlqrProblem(plant, search.step, search.weights, catch.terminal)
    found = problem.solve(still, still, none, found.efforts, search.iterations)
    if not catch.share(deviation_of(plant.coordinates, tuple(found.states[-1][: 2 * n]))) <= _NEAR:
        raise DesignError(f"guess {seed} of {plant.name!r} does not end upright")
    tail = _held(catch, tuple(found.states[-1]), max(0, round(search.duration / search.step) - len(t)), search)
    plan = problem.solve(still, still, none, np.vstack([found.efforts, tail]), 2 * search.iterations)
    lowest, highest = np.array(plant.stops).T
    if np.any((plan.states[:, :n] <= lowest) | (plan.states[:, :n] >= highest)):
        raise DesignError(f"guess {seed} of {plant.name!r} runs into an end stop")
    how = {
        "seed": seed,
        "cost": plan.cost,
        "search": {**asdict(search), "weights": list(search.weights), "find": list(search.find)},
    }
    return trajectory_of(plant, plan, search.step, how)


def trajectory_of(
    plant: PlantParameters, plan: IlqrPlan, step: float, how: dict[str, Any] | None = None
) -> MechanismTrajectory:
    """Return a plan with nodes a step apart [s] as a trajectory."""
    names = plant.coordinates.names
    q_v, u = np.hsplit(plan.states, [2 * len(names)])
    return MechanismTrajectory(
        plant.name, names, np.arange(len(plan.states), dtype=np.float64) * step, q_v.copy(), u.copy(), how or {}
    )


def cheapest_swing_up(
    catch: MechanismCatch, search: SwingUpSearch, seeds: Iterable[int]
) -> tuple[MechanismTrajectory, int]:
    """Return the cheapest swing-up of several seeds, and the number of successes; DesignError if none."""
    found = []
    tried = 0
    for seed in seeds:
        tried += 1
        try:
            found.append(search_swing_up(catch, search, seed))
        except DesignError:
            continue
    if not found:
        raise DesignError(f"none of {tried} guesses of {catch.plant.name!r} ends upright; expected more guesses")
    return min(found, key=lambda each: float(each.how["cost"])), len(found)


def _held(catch: MechanismCatch, z: Vector, count: int, search: SwingUpSearch) -> Array:
    """Return the efforts with which the LQR holds the plant from a state on."""
    plant = catch.plant
    n = len(plant.joints)
    along, spread = along_functions(n), plant.coordinates.spread
    q, v, u = z[:n], z[n : 2 * n], z[2 * n :]
    efforts = np.empty((count, len(u)))
    for k in range(count):
        following = catch.command(deviation_of(plant.coordinates, (*q, *v)))
        before, after = spread(u), spread(following)
        middle = tuple(0.5 * (a + b) for a, b in zip(before, after, strict=True))
        q, v = rk4_joints(plant.mechanism.forward, along, q, v, before, middle, after, search.step, plant.packed)
        u = following
        efforts[k] = u
    return efforts


def write_trajectory(path: Path, trajectory: MechanismTrajectory) -> None:
    """Write a trajectory as JSON with six decimals, atomically; ParameterError if it cannot be written."""

    def rows(values: Array) -> list[list[float]]:
        return [[round(float(value), 6) for value in row] for row in values]

    document = {
        "format": FORMAT,
        "plant": trajectory.plant,
        "joints": list(trajectory.joints),
        "step": float(trajectory.times[1] - trajectory.times[0]),
        "how": trajectory.how,
        "states": rows(trajectory.states),
        "efforts": rows(trajectory.efforts),
    }
    text = json.dumps(document)
    with writing(f"trajectory {path}", ParameterError):
        # One node per line, for readable differences.
        write_atomically(path, text.replace("], [", "],\n[") + "\n")


def load_trajectory(path: Path) -> MechanismTrajectory:
    """Read a trajectory; ParameterError if it is none, has values that are not finite, or shapes differ."""
    text = read_text(path, "trajectory", limit=_LARGEST_FILE)
    try:
        document = json.loads(text)
        given, plant = document.get("format"), document.get("plant")
        if given == FORMAT:
            states = np.array(document["states"], dtype=np.float64)
            efforts = np.array(document["efforts"], dtype=np.float64)
            joints = tuple(str(name) for name in document["joints"])
            step, how = float(document["step"]), dict(document.get("how", {}))
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ParameterError(f"{path} is no trajectory: {error}; expected a file of format {FORMAT}") from error
    if given != FORMAT:
        raise ParameterError(f"{path} has the format {given!r}; expected {FORMAT}")
    if not isinstance(plant, str):
        raise ParameterError(f"{path}: plant is {plant!r}; expected text")
    if states.ndim != 2 or efforts.ndim != 2 or len(states) != len(efforts) or states.shape[1] != 2 * len(joints):
        raise ParameterError(
            f"{path} has states of shape {states.shape} and efforts of shape {efforts.shape} for "
            f"{', '.join(joints)}; expected (N, {2 * len(joints)}) and (N, m)"
        )
    if not (np.isfinite(states).all() and np.isfinite(efforts).all() and math.isfinite(step) and step > 0.0):
        raise ParameterError(f"{path} has numbers that are not finite, or the step {step} s; expected one > 0")
    return MechanismTrajectory(plant, joints, np.arange(len(states), dtype=np.float64) * step, states, efforts, how)
