"""Controllers: time per answer, design time beside python-control, and swing-up beside the public benchmark."""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # as the nodes do, before numpy
# isort: on

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.controller import controller_names, make_controller
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controllers.playback import Playback
from pendulum_lqr.linear.design import continuous_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.swing_up.trajectory_optimisation import swing_up_trajectory
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant, pendulum_plant
from pendulum_sim.stepping.plants import make_pendulum
from tests.benchmarks import Peer, Row, measured, peer

__all__ = ["rows"]

PERIOD = 0.01
SWING_UP = ("energy_swing_up", "time_optimal", "tvlqr", "nmpc")
PUBLISHED = {"energy shaping": 2.91, "fastest (SAC)": 2.04}
"""Swing-up times of the public benchmark [s], on its own plant."""
BENCHMARK_PLANT = pendulum_plant(
    inertia=0.57288 * 0.5**2,
    damping=0.10,
    gravity=0.57288 * 0.5 * 9.81,
    effort_limit=2.5,
    name="public benchmark",
)
"""Mass, length, damping and torque limit of software/python/examples/benchmark_controller.py there."""
TRIALS = 20


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    yield from _answer_times()
    yield from _design_times()
    yield from _swing_up_times()
    yield from _robustness()


def _answer_times() -> Iterator[Row]:
    for name in controller_names():
        if name == "policy":  # in the area `learn`, with a trained one
            continue
        plant = load_plant("dfki" if name in SWING_UP else "thesis")
        controller = _playback(plant) if name == "playback" else make_controller(name, plant, PERIOD)
        steps = 200 if name == "nmpc" else 1500
        start = 0.0 if name in SWING_UP else math.pi + 0.2
        angle, _, times = _run(plant, controller, start, steps)
        if name != "playback":
            assert abs(angle[-1]) < (4.0 if name == "nmpc" else 0.05), f"{name} ended at {angle[-1]} rad"
        median, p99 = np.percentile(times, [50, 99])
        yield measured(
            f"{name}: time per answer, median",
            float(median),
            "us",
            at_most=20.0 if name == "lqr" else None,
            note=f"p99 {p99:.3g} us",
        )


def _design_times() -> Iterator[Row]:
    model = linearise(load_plant("thesis"))
    ours = continuous_lqr(model, (100.0, 0.01), 0.1).K

    def theirs() -> float:
        import control

        K = control.lqr(model.A, model.B, np.diag([100.0, 0.01]), np.array([[0.1]]))[0]
        assert np.allclose(K[0], ours, rtol=1e-6)
        return _best(lambda: control.lqr(model.A, model.B, np.diag([100.0, 0.01]), np.array([[0.1]])))

    yield measured(
        "design of an LQR, refusals included",
        _best(lambda: continuous_lqr(model, (100.0, 0.01), 0.1)),
        "us",
        peer=peer("python-control", theirs),
        less_is_better=True,
    )


def _swing_up_times() -> Iterator[Row]:
    dfki = load_plant("dfki")
    shortest = swing_up_trajectory(dfki, dfki.effort_limit).duration
    bound = f"no controller can be faster than about {shortest:.2f} s with {dfki.effort_limit:g} N m"
    for name in SWING_UP:
        yield measured(
            f"{name}: swing-up of dfki with {dfki.effort_limit:g} N m",
            _swing_up_time(dfki, name),
            "s",
            peer=Peer("published energy shaping", PUBLISHED["energy shaping"]),
            at_most=2.91,
            note=bound if name == "time_optimal" else "",
        )
    plant = BENCHMARK_PLANT
    yield measured(
        f"time_optimal: swing-up of the benchmark's own plant with {plant.effort_limit:g} N m",
        _swing_up_time(plant, "time_optimal"),
        "s",
        peer=Peer("published fastest (SAC)", PUBLISHED["fastest (SAC)"]),
        at_most=2.04,
    )


def _robustness() -> Iterator[Row]:
    dfki = load_plant("dfki")
    for name in SWING_UP[:3]:
        controller = make_controller(name, dfki, PERIOD)
        rng = np.random.default_rng(0)
        passed = 0
        for trial in range(TRIALS):
            start = rng.uniform([-math.pi, -2.0 * math.pi], [math.pi, 2.0 * math.pi])
            passed += _succeeds(dfki, controller, start[0], start[1])
            kicks = np.random.default_rng(trial).uniform(-1.0, 1.0, 1000)
            passed += _succeeds(dfki, controller, 0.0, 0.0, lambda k, w=kicks: w[k] if k % 100 < 5 else 0.0)
            factors = rng.uniform(0.75, 1.25, 4)
            other = dfki.with_values(
                inertia=dfki.inertia * factors[0],
                damping=dfki.damping * factors[1],
                gravity=dfki.gravity * factors[2],
                coulomb_friction=dfki.coulomb_friction * factors[3],
                static_friction=dfki.static_friction * factors[3],
            )
            passed += _succeeds(other, controller, 0.0, 0.0)
        yield measured(
            f"{name}: swing-ups that succeed from random starts, under kicks, with parameters off by up to 25 %",
            100.0 * passed / (3 * TRIALS),
            "%",
            at_least=100.0,
        )


def _playback(plant: PlantParameters) -> Playback:
    times = PERIOD * np.arange(1500)
    return Playback(times, np.sin(times), plant.effort_limit)


def _run(
    plant: PlantParameters,
    controller: Controller,
    theta: float,
    steps: int,
    theta_dot: float = 0.0,
    kick: Callable[[int], float] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return angle [rad], velocity [rad/s] and time per answer [us] of a closed loop."""
    simulated = make_pendulum(plant, PERIOD)
    state = simulated.reset(theta, theta_dot)
    controller.reset()
    angle, velocity, times = np.empty(steps), np.empty(steps), np.empty(steps)
    for k in range(steps):
        x = (from_upright(state.theta), state.theta_dot)
        start = time.perf_counter_ns()
        effort = controller.command(k * PERIOD, x)
        times[k] = (time.perf_counter_ns() - start) / 1e3
        angle[k], velocity[k] = x
        state = simulated.step(effort + (kick(k) if kick else 0.0))
    return angle, velocity, times


def _swing_up_time(plant: PlantParameters, name: str) -> float:
    """Return the first time within 0.1 rad and 0.1 rad/s of upright, as the benchmark defines it [s]."""
    angle, velocity, _ = _run(plant, make_controller(name, plant, PERIOD), 0.0, 600)
    there = (np.abs(angle) < 0.1) & (np.abs(velocity) < 0.1)
    assert there[-1], f"{name} did not stay upright: {angle[-1]} rad"
    return float(PERIOD * np.argmax(there))


def _succeeds(plant: PlantParameters, controller: Controller, theta: float, theta_dot: float, kick: Any = None) -> bool:
    angle, velocity, _ = _run(plant, controller, theta, 1000, theta_dot, kick)
    return bool(np.any((np.abs(angle) < 0.1) & (np.abs(velocity) < 0.1)))


def _best(call: Callable[[], object], repeats: int = 30) -> float:
    """Return the median time of a call [us]."""
    durations = []
    for _ in range(repeats):
        start = time.perf_counter_ns()
        call()
        durations.append(time.perf_counter_ns() - start)
    return float(np.median(durations)) / 1e3
