"""Swing-up by energy for plants whose one motor moves the hinge of an undriven pendulum.

::

    M_aa q_a'' + M_ap q_p'' + ... = u            a: the driven joint (cart, arm, shoulder), with goal q_a*
    M_pa q_a'' + M_pp q_p'' + ... = 0            p: the pendulum

With the driven joint at its goal, the pendulum's energy E = M_pp v_p^2 / 2 + U(q_a*, q_p) has E' = -M_pa q_a'' v_p. So

    q_a'' = k (E / E* - 1) M_pa v_p - w^2 (q_a - q_a*) - 2 d w q_a'

pumps towards the energy E* of upright, and returns the joint. The effort follows from the mechanism's equations, which
are affine in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pendulum_lqr.linear.design import DesignError
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["PUMPS", "EnergyPump", "PumpGains", "pump_gains"]

_BRAKES = 0.6
"""Share of the motor's limit assumed for braking before the end of the way; the rest holds the pendulum."""
_AT_STOPS = 0.9
"""Usable share of the way to an end stop."""
_HANGING = 0.05
"""Share of E* below which a pendulum at rest hangs, and is pushed whatever its velocity."""
_PUSH = 0.05
"""That push, relative to the acceleration w_0^2 of the pendulum's own frequency."""
_LEAST_COUPLING = 0.3
"""Share of the hanging coupling below which friction is not compensated: a cart cannot act on a level pole."""
_MOST_FRICTION = 0.015
"""Largest dry friction of the pendulum, relative to the torque of its level weight. The LQR's model has none, and more
of it keeps some mechanisms from rest (pendubot: 5 of 5 at 0.015, none at 0.02).
"""
_ANGLES = 32


@dataclass(frozen=True)
class PumpGains:
    """Dimensionless gains: one set suits all sizes of a mechanism.

    Attributes:
        gain: k, by the pendulum's frequency and by M_pp / M_pa of hanging [-].
        servo: Frequency of the driven joint's return, as a multiple of the pendulum's [-].
        damping: Its damping ratio [-].
        margin: Target energy beyond that of upright, relative [-].
        reach: Largest distance of the driven joint from its goal [rad or m], at most nine tenths of the way to its
            stops; 0 for these.
        carried: Turn of the pendulum's frame per turn of the driven joint that carries it [-].
    """

    gain: float
    servo: float
    damping: float
    margin: float = 0.0
    reach: float = 0.0
    carried: float = 0.0


PUMPS: dict[tuple[str, str], PumpGains] = {
    ("cart_pole", "cart"): PumpGains(1.8, 0.26, 0.5),
    ("furuta", "arm"): PumpGains(3.0, 0.3, 0.8, reach=2.0),
    ("double_pendulum", "shoulder"): PumpGains(0.5, 0.5, 0.5, reach=1.2, carried=1.0),
}
"""Supported mechanisms and driven joints, with their gains."""


def pump_gains(plant: PlantParameters) -> PumpGains:
    """Return the default gains of a plant; DesignError if it is not supported."""
    driven = plant.coordinates.driven_names
    key = (plant.mechanism.model, driven[0] if len(driven) == 1 else "")
    if key not in PUMPS:
        known = ", ".join(f"{name} with a motor at the {joint} alone" for name, joint in PUMPS)
        motors = f"motors at {', '.join(driven)}" if driven else "no motor"
        raise DesignError(
            f"energy_swing_up moves the hinge of a pendulum, and plant {plant.name!r} is a {plant.mechanism.model} "
            f"with {motors}; expected {known}, or another controller: ilqr, nmpc"
        )
    return PUMPS[key]


class EnergyPump:
    """The law above, for one plant.

    Args:
        plant: Plant.
        gains: Its gains.
        limit: Largest effort of the motor [N m or N].

    Attributes:
        reach: Largest distance of the driven joint from its goal, infinite if unbounded [rad or m].

    Raises:
        DesignError: No gravity, the driven joint does not move the pendulum, or dry friction would keep the LQR from
            holding it.

    Source:
        Astrom and Furuta, Swinging up a pendulum by energy control, Automatica 36(2), 2000; Spong, Energy based control
        of a class of underactuated mechanical systems, IFAC World Congress, 1996, for the partial linearisation.
    """

    def __init__(self, plant: PlantParameters, gains: PumpGains, limit: float) -> None:
        pump_gains(plant)
        (self._a,) = plant.coordinates.driven
        self._p = 1 - self._a
        self._goal = plant.coordinates.goal
        self.limit = limit
        self._packed = plant.packed
        self._forward: Callable[..., Vector] = plant.mechanism.forward
        self._mass = plant.mechanism.mass
        self._potential = plant.mechanism.potential
        self._deviation = plant.coordinates.deviation
        hanging = self._at(self._goal[self._p] + math.pi)
        self._lowest = self._potential(hanging, self._packed)
        self._top = self._potential(self._goal, self._packed) - self._lowest
        rows = self._mass(hanging, self._packed)
        inertia = rows[self._p][self._p]
        coupling = rows[self._p][self._a] - gains.carried * inertia
        if not (self._top > 0.0 and abs(coupling) > 1e-9 * inertia):
            names = plant.coordinates.names
            raise DesignError(
                f"{names[self._p]} of plant {plant.name!r} cannot be swung up by {names[self._a]}: its weight lifts "
                f"{self._top:.4g} J, its coupling is {coupling:.4g}; expected both other than 0"
            )
        weight, stuck = 0.5 * self._top, plant.joints[self._p].breakaway
        if stuck > _MOST_FRICTION * weight:
            name, unit = plant.coordinates.names[self._p], plant.coordinates.joints[self._p].effort_unit
            raise DesignError(
                f"energy_swing_up ends with an LQR that knows no dry friction, and {name} of plant {plant.name!r} is "
                f"passive with {stuck:g} {unit}; expected at most {_MOST_FRICTION * weight:.3g} {unit}, as of a "
                "preset's frictionless twin"
            )
        frequency = math.sqrt(weight / inertia)
        self._ratio = inertia / abs(coupling)
        self._carried = gains.carried
        self._gain = gains.gain * frequency * self._ratio / abs(coupling)
        self._stiffness = (gains.servo * frequency) ** 2
        self._damping = 2.0 * gains.damping * gains.servo * frequency
        self._lost = plant.joints[self._p].damping, plant.joints[self._p].coulomb_friction
        self._least_coupling = _LEAST_COUPLING * abs(coupling)
        self._coulomb = plant.joints[self._a].coulomb_friction
        self._push = _PUSH * frequency**2 * self._ratio + 2.0 * stuck / abs(coupling)
        self._rest = 0.01 * frequency
        self._slow = 0.05 * frequency
        self._brakes = _BRAKES * limit * self._least_answer()
        low, high = plant.stops[self._a]
        goal = self._goal[self._a]
        self.reach = min(gains.reach or math.inf, _AT_STOPS * min(goal - low, high - goal))

    def swing(self, position: Vector, velocity: Vector) -> tuple[float, float]:
        """Return the pendulum's angle from upright, wrapped [rad], and its velocity [rad/s]."""
        deviation = self._deviation(position)
        angle = wrap(deviation[self._p] + self._carried * deviation[self._a])
        return angle, velocity[self._p] + self._carried * velocity[self._a]

    def share(self, position: Vector, velocity: Vector) -> float:
        """Return the pendulum's energy as a share of that of upright [-]."""
        turned = position[self._a] - self._goal[self._a]
        q = self._at(position[self._p] + self._carried * turned)
        speed = velocity[self._p] + self._carried * velocity[self._a]
        kinetic = 0.5 * self._mass(q, self._packed)[self._p][self._p] * speed**2
        return float((kinetic + self._potential(q, self._packed) - self._lowest) / self._top)

    def effort(self, position: Vector, velocity: Vector, margin: float) -> float:
        """Return the limited pumping effort [N m or N]; ``margin`` beyond upright's energy, as a share of it [-]."""
        a, p = self._a, self._p
        error, speed = self._deviation(position)[a], velocity[a]
        rows = self._mass(position, self._packed)
        coupling = rows[p][a] - self._carried * rows[p][p]
        swing = velocity[p] + self._carried * speed
        share = self.share(position, velocity)
        wanted = self._gain * (share - 1.0 - margin) * coupling * swing
        wanted -= self._friction(velocity[p]) * coupling / max(coupling**2, self._least_coupling**2)
        if share < _HANGING and abs(swing) < self._rest:
            # Hanging at rest, either direction is suitable.
            wanted -= math.copysign(self._push, coupling * swing)
        wanted -= self._stiffness * error + self._damping * speed
        wanted = self._within_reach(wanted, error, speed)
        still = self._forward(position, velocity, (0.0, 0.0), self._packed)[a]
        pushed = self._forward(position, velocity, (1.0, 0.0) if a == 0 else (0.0, 1.0), self._packed)[a]
        effort = (wanted - still) / (pushed - still)
        if self._coulomb:
            # In the direction of motion, or at rest in the desired one.
            effort += math.copysign(self._coulomb, speed if abs(speed) > 1e-3 else wanted)
        return self.limit if effort > self.limit else max(effort, -self.limit)

    def _friction(self, speed: float) -> float:
        """Return the pendulum's friction, smooth about rest [N m]."""
        damping, coulomb = self._lost
        return damping * speed + coulomb * max(-1.0, min(1.0, speed / self._slow))

    def _within_reach(self, wanted: float, error: float, speed: float) -> float:
        """Return an acceleration that stays within the reach: it brakes as soon as necessary."""
        room = self.reach - (error if speed > 0.0 else -error)
        if 0.5 * speed * speed < self._brakes * room:
            return wanted
        brake = self._brakes if room <= 0.0 else max(self._brakes, 0.5 * speed * speed / room)
        return min(wanted, -brake) if speed > 0.0 else max(wanted, brake)

    def _at(self, position: float) -> Vector:
        """Return both positions with the driven joint at its goal."""
        return (self._goal[0], position) if self._a == 0 else (position, self._goal[1])

    def _least_answer(self) -> float:
        """Return the smallest acceleration of the driven joint per unit of effort."""
        smallest = math.inf
        for index in range(_ANGLES):
            rows = self._mass(self._at(2.0 * math.pi * index / _ANGLES), self._packed)
            determinant = rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]
            smallest = min(smallest, rows[self._p][self._p] / determinant)
        return smallest
