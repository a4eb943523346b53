"""Closed loop of a controller and the simulator's plant, for the tests of this package."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.disturbances.disturbance import Disturbance
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.plants.plant_parameters import PlantParameters


class Run(NamedTuple):
    """Record of a closed loop: times [s], angle from upright [rad], velocity [rad/s], torque [N m]."""

    t: NDArray[np.float64]
    angle: NDArray[np.float64]
    velocity: NDArray[np.float64]
    effort: NDArray[np.float64]

    @property
    def swing_up_time(self) -> float:
        """First time within 0.1 rad and 0.1 rad/s of upright, as the public benchmark defines it [s]."""
        there = (np.abs(self.angle) < 0.1) & (np.abs(self.velocity) < 0.1)
        return float(self.t[np.argmax(there)]) if there.any() else math.inf


Simulate = Callable[..., Run]


def run_closed_loop(
    plant: PlantParameters,
    controller: Controller,
    *,
    theta: float,
    theta_dot: float = 0.0,
    duration: float = 5.0,
    period: float = 0.01,
    disturbance: Disturbance | None = None,
) -> Run:
    from pendulum_sim.stepping.plants import make_pendulum

    simulated = make_pendulum(plant, period)
    state = simulated.reset(theta, theta_dot)
    controller.reset()
    rows = []
    for k in range(round(duration / period)):
        x = (from_upright(state.theta), state.theta_dot)
        effort = controller.command(k * period, x)
        rows.append((k * period, *x, effort))
        torque = effort + (disturbance(round(k * period * 1e9)) if disturbance else 0.0)
        state = simulated.step(torque)
    return Run(*np.array(rows).T)


@pytest.fixture(scope="session")
def simulate() -> Simulate:
    return run_closed_loop
