"""Minimum-time swing-up by dynamic programming, caught by LQR."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.catch import CatchingController
from pendulum_lqr.controllers.specs import CATCH_Q, CATCH_R, CATCH_SHARE
from pendulum_lqr.linear.model import acceleration_from_upright
from pendulum_lqr.swing_up.minimum_time import SIGN_VELOCITY, TimeToGo, minimum_time
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["TimeOptimal"]


class TimeOptimal(CatchingController):
    """Applies the torque whose successor has the least time to the catch's region; a feedback from every state."""

    SUMMARY = "swing-up in minimum time by dynamic programming, caught by LQR"
    PARAMETERS = (
        ParameterSpec("grid", 400, "-", "Grid points in angle and in velocity.", minimum=40, maximum=1000),
        CATCH_Q,
        CATCH_R,
        replace(CATCH_SHARE, default=0.9),
    )

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        # The table takes a second or two and is cached for the next design.
        super().__init__(plant, period, p)
        S = tuple(map(tuple, self.catch.gain.S.tolist()))
        self.table = _table(plant, self.effort_limit, S, self.catch.level, self.set_point, p["grid"])
        # Prediction horizon of a candidate torque [s].
        self.horizon = max(period, self.table.step)
        self._plant = plant
        self._substeps = max(2, math.ceil(self.horizon * plant.damping / plant.inertia / 0.5))

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m]."""
        angle, velocity = x[0], x[1]
        if self.catch.holds(angle, velocity):
            return self.catch.command(angle, velocity)
        limit = self.effort_limit
        forward = self.table.lookup(*self._ahead(angle, velocity, limit))
        backward = self.table.lookup(*self._ahead(angle, velocity, -limit))
        # Symmetric states (hanging at rest) have no better side: take one.
        return limit if forward <= backward else -limit

    def _ahead(self, angle: float, velocity: float, effort: float) -> tuple[float, float]:
        plant = self._plant
        h = self.horizon / self._substeps
        for _ in range(self._substeps):
            acceleration = acceleration_from_upright(plant, angle, velocity, effort, sign_velocity=SIGN_VELOCITY)
            angle += h * (velocity + 0.5 * h * acceleration)
            velocity += h * acceleration
        return angle, velocity

    def describe(self) -> str:
        """Return the time from hanging at rest, and the catch."""
        hanging = self._plant.angle_offset - math.pi
        return f"{self.table.time(hanging, 0.0):.3f} s from hanging to the catch, {self.catch.describe()}"


@lru_cache(maxsize=8)
def _table(
    plant: PlantParameters,
    limit: float,
    S: tuple[tuple[float, ...], ...],
    level: float,
    set_point: float,
    grid: int,
) -> TimeToGo:
    return minimum_time(
        plant,
        limit,
        (np.array(S), level),
        centre=set_point,
        angles=grid,
        velocities=grid + 1 - grid % 2,
    )
