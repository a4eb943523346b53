"""Equations of a series-elastic actuator (motor, gear train, spring) and its link, in output coordinates.

::

    i       = (u V - K_e N q_m') / R(T)                           V [V], K_e [V s/rad], N [-]
    J q_m'' = K_t N i - b_v q_m' - tau_f(q_m') - tau_s            J = J_r N^2 [kg m^2], K_t [N m/A], b_v [N m s/rad]
    M q''   = tau_s - G sin q - b_l q' + d                        M [kg m^2], G = m g l [N m], b_l [N m s/rad]
    tau_s   = (k + k_3 delta^2) delta + tau_h z                   k [N m/rad], k_3 [N m/rad^3], tau_h [N m]
    z'      = delta' (1 - z sgn delta') / delta_0  (Dahl)         delta = q_m - q [rad], delta_0 [rad]

q_m is the motor's angle at the output of the gears, q the link's (0 hanging down) [rad], u the PWM duty in [-1, 1], d a
torque on the link itself [N m]. Every function calls ``math`` only, so that each compiles alone with ``numba.njit``.

Sources: P. R. Dahl, "A solid friction model", Aerospace Corp. TOR-0158(3107-18)-1, 1968; Pratt and Williamson, "Series
elastic actuators", IROS 1995; Armstrong-Helouvry et al., Automatica 30(7), 1994 (dry friction).
"""

from __future__ import annotations

import math

__all__ = [
    "dahl_step",
    "dry_friction_step",
    "feedforward_pwm",
    "link_acceleration",
    "motor_acceleration",
    "shorted_winding_damping",
    "spring_deflection",
    "spring_torque",
    "winding_current",
    "winding_resistance_at",
]


def winding_resistance_at(temperature: float, resistance: float, coefficient: float) -> float:
    """Return R(T) = R (1 + alpha (T - 20)) [ohm]; R at 20 degC, T in degC, alpha about 0.004 / K for copper."""
    return resistance * (1.0 + coefficient * (temperature - 20.0))


def winding_current(
    pwm: float, motor_velocity: float, supply_voltage: float, back_emf_constant: float, gear_ratio: float,
    resistance: float,
) -> float:  # fmt: skip
    """Return i = (u V - K_e N q_m') / R [A]; the electrical time constant is far below the step."""
    return (pwm * supply_voltage - back_emf_constant * gear_ratio * motor_velocity) / resistance


def feedforward_pwm(
    torque: float, supply_voltage: float, torque_constant: float, gear_ratio: float, efficiency: float,
    nominal_resistance: float,
) -> float:  # fmt: skip
    """Return the duty for a torque at the output without an effort loop, u = tau R / (N V K_t eta) [-].

    It assumes a stalled motor with its winding at 20 degC, and counts on a share eta of the motor's torque.
    """
    return torque * nominal_resistance / (gear_ratio * supply_voltage * torque_constant * efficiency)


def shorted_winding_damping(
    torque_constant: float, back_emf_constant: float, gear_ratio: float, resistance: float
) -> float:
    """Return the damping of a motor with shorted winding (PWM 0), K_t K_e N^2 / R [N m s/rad]."""
    return torque_constant * back_emf_constant * gear_ratio * gear_ratio / resistance


def spring_torque(
    deflection: float, hysteresis_state: float, stiffness: float, hardening: float, hysteresis_torque: float
) -> float:
    """Return the torque of the spring on the link, (k + k_3 delta^2) delta + tau_h z [N m].

    An effort sensor that measures the deflection sees the first term only: pass ``hysteresis_torque`` 0 for it.
    """
    return (stiffness + hardening * deflection * deflection) * deflection + hysteresis_torque * hysteresis_state


def spring_deflection(torque: float, stiffness: float, hardening: float) -> float:
    """Return the deflection at which the spring carries a torque, without hysteresis [rad].

    The real root of k_3 delta^3 + k delta = tau (one, for k > 0 and k_3 >= 0), by the hyperbolic sine form of Cardano's
    formula, which loses no digits for small k_3.
    """
    if hardening == 0.0:
        return torque / stiffness
    scale = math.sqrt(stiffness / (3.0 * hardening))
    return 2.0 * scale * math.sinh(math.asinh(1.5 * torque / (stiffness * scale)) / 3.0)


def dahl_step(hysteresis_state: float, deflection_change: float, hysteresis_deflection: float) -> float:
    """Return the Dahl state z in [-1, 1] after a monotonic change of the deflection, exact for any size.

    z' = delta' (1 - z sgn delta') / delta_0 depends on the path alone: z+ = s + (z - s) exp(-|change| / delta_0) with s
    = sgn(change).
    """
    if deflection_change > 0.0:
        return 1.0 + (hysteresis_state - 1.0) * math.exp(-deflection_change / hysteresis_deflection)
    if deflection_change < 0.0:
        return -1.0 + (hysteresis_state + 1.0) * math.exp(deflection_change / hysteresis_deflection)
    return hysteresis_state


def motor_acceleration(
    current: float, motor_velocity: float, spring: float, torque_constant: float, gear_ratio: float,
    motor_damping: float, reflected_inertia: float,
) -> float:  # fmt: skip
    """Return q_m'' = (K_t N i - b_v q_m' - tau_s) / J [rad/s^2]; :func:`dry_friction_step` adds dry friction."""
    return (torque_constant * gear_ratio * current - motor_damping * motor_velocity - spring) / reflected_inertia


def dry_friction_step(velocity: float, friction: float, inertia: float, dt: float) -> float:
    """Return the velocity after dry friction [N m] acted on an inertia [kg m^2] for dt [s]; exactly 0 if held [rad/s].

    Implicit time stepping of Coulomb's law: friction removes at most the present momentum, so a stuck body does not
    chatter.

    Source:
        J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", 1988.
    """
    loss = friction * dt / inertia
    if velocity > loss:
        return velocity - loss
    if velocity < -loss:
        return velocity + loss
    return 0.0


def link_acceleration(
    position: float, velocity: float, spring: float, disturbance: float, inertia: float, damping: float, gravity: float
) -> float:
    """Return q'' = (tau_s + d - b_l q' - G sin q) / M [rad/s^2]."""
    return (spring + disturbance - damping * velocity - gravity * math.sin(position)) / inertia
