"""Choices of an identification, and what is known of the pendulum beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pendulum_bags.identification.model import FRICTION_MODELS
from pendulum_msgs_py.errors import DataError

__all__ = ["DEFAULTS", "GRAVITY", "Geometry", "Options", "default_window"]

GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s^2]."""


@dataclass(frozen=True)
class Geometry:
    """What is known of the pendulum from scales and rulers; None where unknown.

    Args:
        mass: Moving mass [kg].
        length: Joint axis to centre of mass [m].
        inertia: About the joint axis [kg m^2].
    """

    mass: float | None = None
    length: float | None = None
    inertia: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("mass", "kg"), ("length", "m"), ("inertia", "kg m^2")):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise DataError(f"{name} is {value} {unit}; expected > 0")

    @property
    def gravity(self) -> float | None:
        """Gravity coefficient m g l [N m]."""
        return None if self.mass is None or self.length is None else self.mass * GRAVITY * self.length

    @property
    def least_inertia(self) -> float | None:
        """Inertia about the joint that no body of this mass and centre can undercut, m l^2 [kg m^2]."""
        return None if self.mass is None or self.length is None else self.mass * self.length**2


@dataclass(frozen=True)
class Options:
    """Choices of a fit; the defaults are meant to serve unseen data.

    Args:
        window: Length of the shooting windows [s]; None: that of :func:`default_window`.
        friction: ``auto`` or one of ``FRICTION_MODELS``.
        geometry: Known mass, length, inertia.
        fix_scale: Whether a known m g l fixes the scale of torque (else it is only checked against).
        angle_offset, torque_offset: Whether each is fitted.
        multi_start: Whether to search from several starts.
        folds: Most folds of the cross-validation.
    """

    window: float | None = None
    friction: str = "auto"
    geometry: Geometry = Geometry()
    fix_scale: bool = False
    angle_offset: bool = True
    torque_offset: bool = True
    multi_start: bool = True
    folds: int = 6

    def __post_init__(self) -> None:
        if self.window is not None and not (np.isfinite(self.window) and self.window > 0.0):
            raise DataError(f"window is {self.window} s; expected > 0")
        if self.friction != "auto" and self.friction not in FRICTION_MODELS:
            raise DataError(f"friction is {self.friction!r}; expected auto or one of {', '.join(FRICTION_MODELS)}")
        if self.fix_scale and self.geometry.gravity is None:
            raise DataError("the scale is to be fixed by geometry, but mass or length is missing; expected both")


DEFAULTS = Options()
"""Everything found unaided."""


def default_window(input_kind: str, seconds: float) -> float | None:
    """Return the length of the shooting windows [s] by input and duration [s]; None for whole recordings.

    Long windows show slow errors (offsets, drag), short ones keep a simulation near the truth from which friction and
    a wrong start carry it away. A torque gets 1 s. A voltage, whose back-EMF damps what is wrong at first, gets 5 s
    where there are twelve of them, and not less than 2 s. The position loop of a servo keeps all of a recording near.
    """
    if input_kind == "voltage":
        return min(max(seconds / 12.0, 2.0), 5.0)
    return None if input_kind == "position_goal" else 1.0
