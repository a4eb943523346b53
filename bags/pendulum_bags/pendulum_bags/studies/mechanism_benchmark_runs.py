"""Runs of the public double-pendulum benchmark: its simulation, its six robustness tests, its knock-downs.

Order within a step of 2 ms, as in the public implementation: measurement (delayed by whole steps, with noise), command,
motor (response, noise, limit), kick, one step of Runge-Kutta. Friction is ``b v + c arctan(100 v)``; its robustness
tests also take b and c below zero, which drives the joint. Noise and kicks do not reach a passive joint.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.studies.mechanism_benchmark import criteria_of, score_v2, time_above_line
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.arithmetic import complex_step, in_arithmetic
from pendulum_msgs_py.dynamics.runge_kutta import along_functions, rk4_joints
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches.compiling import compile_tree

__all__ = [
    "DT",
    "DURATION",
    "KINDS",
    "Disturbances",
    "Trajectory",
    "Trial",
    "knock_downs",
    "make_stepper",
    "robustness_of",
    "robustness_trials",
    "simulate",
    "swing_up",
    "try_once",
]

DT = 0.002
"""Period of control and step of the integrator [s]."""
DURATION = 10.0
"""Length of a run [s]."""
VALUES = 21
"""Values of each disturbance."""
REPETITIONS = 10
"""Runs at each level of noise; more than half of them must succeed."""
KICK_RUNS = 50
"""Runs with kicks."""
TOLERANCE = (0.35, 0.35, 1.0, 1.0)
"""Largest deviation of the last state from upright that is a success [rad, rad, rad/s, rad/s]."""
KINDS = {
    "model": "model",
    "velocity_noise": "velocity noise",
    "torque_noise": "torque noise",
    "torque_response": "torque response",
    "delay": "delay",
    "kicks": "kicks",
}
"""The six tests of robustness and their names in tables; the score is the mean of their shares."""
UPTIME_DURATION = 60.0
"""Length of a run with knock-downs [s]."""
KNOCKS = 15
_KNOCK_LENGTH = 0.2
_KNOCK_GAINS = (10.0, 0.1, 1.0)
_KNOCK_DT = 0.001  # what its PID takes for the period, twice too short
_RELATIVE = {
    "m1r1": ("centre_1",),
    "I1": ("inertia_1",),
    "m2r2": ("centre_2",),
    "m2": ("mass_2",),
    "I2": ("inertia_2",),
}


class Trajectory(NamedTuple):
    """A run: states after k steps, and the efforts from there on.

    Attributes:
        times: Shape (N + 1,) [s].
        states: [shoulder, elbow, their velocities], shape (N + 1, 4).
        efforts: Applied torques of both joints, shape (N, 2) [N m].
    """

    times: Array
    states: Array
    efforts: Array

    @property
    def rows(self) -> tuple[Array, Array, Array]:
        """Times, states and efforts of the samples that have an effort, which are those that are scored."""
        count = len(self.efforts)
        return self.times[:count], self.states[:count], self.efforts


@dataclass(frozen=True)
class Disturbances:
    """Perturbations of a run.

    Attributes:
        values: Parameters of the plant that differ from the controller's model, by name.
        damping: b of each joint, below zero too [N m s/rad].
        coulomb: c of each joint, in c arctan(100 v), below zero too [N m].
        velocity_noise: Standard deviation of the noise on measured velocities [rad/s].
        torque_noise: Standard deviation of the noise on the motor's torque [N m].
        response: r in applied = last + r (commanded - last).
        delay: Age of the measurement [s].
        kicks: Torque of each step on the driven joint, beyond the limit too; empty for none [N m].
    """

    values: dict[str, float] = field(default_factory=dict)
    damping: Vector = (0.0, 0.0)
    coulomb: Vector = (0.0, 0.0)
    velocity_noise: float = 0.0
    torque_noise: float = 0.0
    response: float = 1.0
    delay: float = 0.0
    kicks: tuple[float, ...] = ()


@dataclass(frozen=True)
class Trial:
    """One run of a test of robustness: its kind, its level (runs of one level are counted together) and its seed."""

    kind: str
    level: str
    disturbances: Disturbances
    seed: int


Stepper = Callable[[Vector, Vector, Vector, Vector, Vector], tuple[Vector, Vector]]


def _smooth_friction(v: Any, torque: Any, p: Any) -> Any:
    """Return the torque less c arctan(100 v) on each joint; p is (its own parameters, c)."""
    c = p[1]
    return torque[0] - c[0] * math.atan(100.0 * v[0]), torque[1] - c[1] * math.atan(100.0 * v[1])


def make_stepper(plant: PlantParameters, *, compiled: bool = True) -> Stepper:
    """Return ``(q, v, torque, p, coulomb) -> (q, v)`` after one step of a double pendulum in the benchmark."""
    bare, along = plant.mechanism.forward, along_functions(2)
    step: Any = rk4_joints
    loaded: Any = _smooth_friction
    if compiled:
        import numba

        made_of = (bare, along, rk4_joints, _smooth_friction)
        inner, along, step, loaded = (compile_tree(each, inline=True) for each in made_of)

        @numba.njit(forceinline=True)
        def forward(q: Any, v: Any, torque: Any, p: Any) -> Any:
            return inner(q, v, loaded(v, torque, p), p[0])

        @numba.njit
        def advance(q: Any, v: Any, torque: Any, p: Any, coulomb: Any) -> Any:
            return step(forward, along, q, v, torque, torque, torque, DT, (p, coulomb))

        return keep_kernel(advance, "benchmark_step", bare)

    def plain(q: Any, v: Any, torque: Any, p: Any) -> Any:
        return bare(q, v, loaded(v, torque, p), p[0])

    return lambda q, v, torque, p, coulomb: step(plain, along, q, v, torque, torque, torque, DT, (p, coulomb))


def simulate(
    plant: PlantParameters,
    stepper: Stepper,
    answer: Callable[[float, Vector], Sequence[float]],
    steps: int,
    disturbances: Disturbances | None = None,
    seed: int = 0,
    limits: Vector = (),
) -> Trajectory:
    """Return a run from hanging at rest.

    Args:
        plant: The plant of the controller's model; differences from it are in ``disturbances``.
        stepper: Of :func:`make_stepper`.
        steps: Steps of 2 ms.
        limits: Of both joints [N m]; by default the plant's own, 0 where it is passive.
    """
    what = disturbances or Disturbances()
    true = plant.with_values(what.values) if what.values else plant
    # The mechanism's own table of parameters ends with the joints' damping, which a plant file would not take below 0.
    p = (*true.packed[:-2], *what.damping)
    limit_1, limit_2 = limits or plant.coordinates.spread(plant.effort_limits)
    driven = plant.coordinates.driven[0]
    rng = np.random.default_rng(seed)
    age = int(what.delay / DT)
    # By steps, so that more noise of one kind leaves the others unchanged.
    noise = what.velocity_noise * rng.standard_normal((steps, 2)) if what.velocity_noise else None
    shake = what.torque_noise * rng.standard_normal((steps, 2)) if what.torque_noise else None
    q: Vector = (0.0, 0.0)
    v: Vector = (0.0, 0.0)
    last_1 = last_2 = 0.0
    t = 0.0
    times, states, efforts = [t], [(*q, *v)], []
    for k in range(steps):
        measured = states[max(0, k - age)]
        if noise is not None:
            measured = (measured[0], measured[1], measured[2] + float(noise[k, 0]), measured[3] + float(noise[k, 1]))
        u_1, u_2 = answer(t, measured)
        if what.response != 1.0:
            u_1, u_2 = last_1 + what.response * (u_1 - last_1), last_2 + what.response * (u_2 - last_2)
        if shake is not None:
            u_1, u_2 = u_1 + float(shake[k, 0]), u_2 + float(shake[k, 1])
        u_1, u_2 = min(limit_1, max(-limit_1, u_1)), min(limit_2, max(-limit_2, u_2))
        if what.kicks and (index := int(t / DT)) < len(what.kicks):
            u_1, u_2 = (u_1 + what.kicks[index], u_2) if driven == 0 else (u_1, u_2 + what.kicks[index])
        last_1, last_2 = u_1, u_2
        q, v = stepper(q, v, (u_1, u_2), p, what.coulomb)
        t += DT
        times.append(t)
        states.append((*q, *v))
        efforts.append((u_1, u_2))
    return Trajectory(np.array(times), np.array(states), np.array(efforts))


def swing_up(
    plant: PlantParameters, stepper: Stepper, controller: Controller
) -> tuple[Trajectory, dict[str, float], float]:
    """Return the undisturbed run of 10 s, its criteria and its score v2."""
    controller.reset()
    run = simulate(plant, stepper, _answering(plant, controller), round(DURATION / DT))
    times, states, efforts = run.rows
    criteria = criteria_of(plant, times, states, efforts)
    return run, criteria, score_v2(criteria, float(times[-1]))


def robustness_trials(plant: PlantParameters, seed: int = 1) -> list[Trial]:
    """Return the 722 runs of the six tests of robustness, each with a seed of its own."""
    trials: list[Trial] = []

    def add(kind: str, level: str, disturbances: Disturbances) -> None:
        trials.append(Trial(kind, level, disturbances, seed * 1_000_000 + len(trials)))

    for value in np.linspace(0.0, 1e-4, VALUES):
        add("model", f"Ir {value:.3g}", Disturbances(values={"rotor_inertia": float(value)}))
    for name, keys in _RELATIVE.items():
        for share in np.linspace(0.75, 1.25, VALUES):
            changes = {key: float(share) * plant.value(key) for key in keys}
            add("model", f"{name} x {share:.3g}", Disturbances(values=changes))
    for joint in (0, 1):
        for value in np.linspace(-0.1, 0.1, VALUES):
            damping = tuple(float(value) if joint == each else 0.0 for each in (0, 1))
            add("model", f"b{joint + 1} {value:.3g}", Disturbances(damping=damping))
        for value in np.linspace(-0.2, 0.2, VALUES):
            coulomb = tuple(float(value) if joint == each else 0.0 for each in (0, 1))
            add("model", f"cf{joint + 1} {value:.3g}", Disturbances(coulomb=coulomb))
    for value in np.linspace(0.0, 0.5, VALUES):
        for _ in range(REPETITIONS):
            add("velocity_noise", f"{value:.3g} rad/s", Disturbances(velocity_noise=float(value)))
    for value in np.linspace(0.0, 1.1, VALUES):
        for _ in range(REPETITIONS):
            add("torque_noise", f"{value:.3g} N m", Disturbances(torque_noise=float(value)))
    for value in np.linspace(0.1, 2.0, VALUES):
        add("torque_response", f"{value:.3g}", Disturbances(response=float(value)))
    for value in np.linspace(0.0, 0.04, VALUES):
        add("delay", f"{value:.3g} s", Disturbances(delay=float(value)))
    rng = np.random.default_rng(seed)
    for each in range(KICK_RUNS):
        add("kicks", f"{each}", Disturbances(kicks=_kicks(rng)))
    return trials


def try_once(plant: PlantParameters, stepper: Stepper, controller: Controller, trial: Trial) -> bool:
    """Return whether a run ends upright: within 0.35 rad and 1 rad/s of each joint."""
    controller.reset()
    # 5000 sums of 2 ms stay below 10 s, so the public loop takes one step more.
    steps = round(DURATION / DT) + 1
    run = simulate(plant, stepper, _answering(plant, controller), steps, trial.disturbances, trial.seed)
    end = run.states[-1]
    distance = np.abs(np.array([wrap(float(end[0] - UPRIGHT)), wrap(float(end[1])), end[2], end[3]]))
    return bool(np.all(distance < np.array(TOLERANCE)))


def robustness_of(trials: Sequence[Trial], successes: Sequence[bool]) -> dict[str, float]:
    """Return the shares of successes by kind: of runs, or where they are noisy of levels that more than half hold."""
    shares = {}
    for kind in KINDS:
        levels: dict[str, list[bool]] = {}
        for trial, success in zip(trials, successes, strict=True):
            if trial.kind == kind:
                levels.setdefault(trial.level, []).append(success)
        held = [float(np.mean(runs)) > 0.5 for runs in levels.values()]
        shares[kind] = float(np.mean(held)) if held else math.nan
    return shares


def knock_downs(
    plant: PlantParameters, stepper: Stepper, controller: Controller, seed: int
) -> tuple[Trajectory, float]:
    """Return a run of 60 s with 15 knock-downs and its score v3, the share of time above the line.

    About each 3.75 s, at random, both joints get 6 N m for 0.2 s, and a PID with gravity compensation drives them to a
    random position.
    """
    controller.reset()
    rng = np.random.default_rng(seed)
    knocks = _KnockDowns(plant, controller, rng)
    limit = max(plant.effort_limits)
    steps = round(UPTIME_DURATION / DT)
    run = simulate(plant, stepper, knocks.answer, steps, limits=(limit, limit))
    times, states, _ = run.rows
    return run, time_above_line(plant, times, states) / UPTIME_DURATION


class _KnockDowns:
    """The interrupted controller, as in the public tester of global policies."""

    def __init__(self, plant: PlantParameters, controller: Controller, rng: np.random.Generator) -> None:
        self._answer = _answering(plant, controller)
        self._plant = plant
        self._goals = rng.uniform(-math.pi, math.pi, (KNOCKS, 2))
        mean = UPTIME_DURATION / (KNOCKS + 1)
        self._moments = np.linspace(mean, UPTIME_DURATION - mean, KNOCKS) + rng.uniform(-1.0, 1.0, KNOCKS)
        self._limit = max(plant.effort_limits)
        self._count = 0
        self._active = False
        self._timer = self._last = 0.0
        # Sums and last errors persist from one knock-down to the next: the first derivative of a later one is a jump.
        self._sums = [0.0, 0.0]
        self._errors: list[tuple[float, float]] = []

    def answer(self, t: float, x: Vector) -> Vector:
        """Return the torques of both joints [N m]."""
        if not self._active and self._count < KNOCKS and t >= self._moments[self._count]:
            self._active, self._timer = True, 0.0
            self._count += 1
        if self._active and self._timer > _KNOCK_LENGTH:
            self._active = False
        if self._active:
            self._timer += t - self._last
            self._last = t
            return self._drive(x)
        self._last = t
        return self._answer(t, x)

    def _drive(self, x: Vector) -> Vector:
        goal = self._goals[self._count - 1]
        errors = (float(goal[0]) - x[0], float(goal[1]) - x[1])
        self._errors.append(errors)
        kp, ki, kd = _KNOCK_GAINS
        weight = _gravity(self._plant, x)
        torques = []
        for i in (0, 1):
            self._sums[i] += errors[i]
            slope = (errors[i] - self._errors[-2][i]) / _KNOCK_DT if len(self._errors) > 2 else 0.0
            wanted = kp * errors[i] + ki * self._sums[i] * _KNOCK_DT + kd * slope
            torques.append(min(self._limit, max(-self._limit, wanted)) + weight[i])
        return torques[0], torques[1]


def _gravity(plant: PlantParameters, x: Vector) -> Vector:
    potential, p = in_arithmetic(plant.mechanism.potential, cmath), plant.packed
    return tuple(complex_step(lambda *q: (potential(q, p),), x[:2])[0])


def _answering(plant: PlantParameters, controller: Controller) -> Callable[[float, Vector], Vector]:
    spread = plant.coordinates.spread
    n = len(plant.joints)
    return lambda t, x: spread(controller.efforts(t, x[:n], x[n:]))


def _kicks(rng: np.random.Generator) -> tuple[float, ...]:
    """Return one profile on the driven joint: three bells of 0.5 to 5 N m, 0.05 to 0.1 s wide.

    Drawn as six bells at least 1 s apart, shuffled between both joints.
    """
    count, apart = 6, 1.0
    room = (DURATION - (count + 1) * apart) / count
    moments = np.cumsum(apart + room * rng.random(count))
    mine = rng.permutation(moments)[:3]
    widths = rng.uniform(0.05, 0.1, 3)
    heights = rng.uniform(-4.5, 4.5, 3)
    heights += 0.5 * np.sign(heights)
    t = np.arange(0.0, DURATION, DT)
    profile = sum(
        height * np.exp(-((t - moment) ** 2) / (2.0 * width**2))
        for height, moment, width in zip(heights, mine, widths, strict=True)
    )
    return tuple(float(value) for value in np.asarray(profile))
