"""Equations of a series-elastic actuator (motor, gear train, spring) and its link, in output coordinates.

::

    i       = (u V - K_e N q_m') / R(T)
    J q_m'' = K_t N i - b_v q_m' - tau_f(q_m') - tau_s            J = J_r N^2
    M q''   = tau_s - G sin q - b_l q' + d
    tau_s   = (k + k_3 delta^2) delta + tau_h z,                  delta = q_m - q
    z'      = delta' (1 - z sgn delta') / delta_0                 (Dahl)

q_m is the motor's angle at the output side of the gears, q the link's, u the PWM duty in [-1, 1], d a torque on the
link itself. Every function is a leaf (it calls ``math`` only), so that each compiles alone with ``numba.njit``.

Sources: P. R. Dahl, "A solid friction model", Aerospace Corp. TOR-0158(3107-18)-1, 1968; Pratt and Williamson,
"Series elastic actuators", IROS 1995; Armstrong-Helouvry et al., Automatica 30(7), 1994 (dry friction).
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
    """Return the winding's resistance R(T) = R (1 + alpha (T - 20)) [ohm].

    Args:
        temperature: Winding temperature T [degC].
        resistance: R at 20 degrees Celsius [ohm].
        coefficient: alpha, about 0.004 for copper [1/K].
    """
    return resistance * (1.0 + coefficient * (temperature - 20.0))


def winding_current(
    pwm: float,
    motor_velocity: float,
    supply_voltage: float,
    back_emf_constant: float,
    gear_ratio: float,
    resistance: float,
) -> float:
    """Return the winding current i = (u V - K_e N q_m') / R [A]; inductance is far below the step size.

    Args:
        pwm: Duty u in [-1, 1] [-].
        motor_velocity: q_m', at the output side of the gears [rad/s].
        supply_voltage: V [V].
        back_emf_constant: K_e [V s/rad].
        gear_ratio: N [-].
        resistance: R at the present temperature [ohm].
    """
    return (pwm * supply_voltage - back_emf_constant * gear_ratio * motor_velocity) / resistance


def feedforward_pwm(
    torque: float,
    supply_voltage: float,
    torque_constant: float,
    gear_ratio: float,
    efficiency: float,
    nominal_resistance: float,
) -> float:
    """Return the duty for a torque command without an effort loop, u = tau R / (N V K_t eta) [-].

    It assumes a stalled motor with its winding at 20 degrees Celsius, and commands 1 / eta more than the output
    needs.

    Args:
        torque: Commanded torque tau at the output [N m].
        supply_voltage: V [V].
        torque_constant: K_t [N m/A].
        gear_ratio: N [-].
        efficiency: eta, share of the motor's torque that is expected at the output [-].
        nominal_resistance: R at 20 degrees Celsius [ohm].
    """
    return torque * nominal_resistance / (gear_ratio * supply_voltage * torque_constant * efficiency)


def shorted_winding_damping(
    torque_constant: float, back_emf_constant: float, gear_ratio: float, resistance: float
) -> float:
    """Return the damping of a motor whose winding is shorted (PWM 0), K_t K_e N^2 / R [N m s/rad].

    Args:
        torque_constant: K_t [N m/A].
        back_emf_constant: K_e [V s/rad].
        gear_ratio: N [-].
        resistance: R at the present temperature [ohm].
    """
    return torque_constant * back_emf_constant * gear_ratio * gear_ratio / resistance


def spring_torque(
    deflection: float, hysteresis_state: float, stiffness: float, hardening: float, hysteresis_torque: float
) -> float:
    """Return the torque that the spring passes to the link, (k + k_3 delta^2) delta + tau_h z [N m].

    An effort sensor that measures the deflection sees the first term only: pass ``hysteresis_torque`` 0 for it.

    Args:
        deflection: delta = q_m - q [rad].
        hysteresis_state: Dahl state z in [-1, 1] [-].
        stiffness: k [N m/rad].
        hardening: k_3 [N m/rad^3]; 0 for a linear spring.
        hysteresis_torque: tau_h, half width of the loop [N m].
    """
    return (stiffness + hardening * deflection * deflection) * deflection + hysteresis_torque * hysteresis_state


def spring_deflection(torque: float, stiffness: float, hardening: float) -> float:
    """Return the deflection at which the spring carries a torque, hysteresis aside [rad].

    The real root of k_3 delta^3 + k delta = tau (one, for k > 0 and k_3 >= 0), by the hyperbolic sine form of
    Cardano's formula, which loses no digits where k_3 is small.

    Args:
        torque: tau [N m].
        stiffness: k [N m/rad], > 0.
        hardening: k_3 [N m/rad^3], >= 0.
    """
    if hardening == 0.0:
        return torque / stiffness
    scale = math.sqrt(stiffness / (3.0 * hardening))
    return 2.0 * scale * math.sinh(math.asinh(1.5 * torque / (stiffness * scale)) / 3.0)


def dahl_step(hysteresis_state: float, deflection_change: float, hysteresis_deflection: float) -> float:
    """Return the Dahl state z after the deflection changed monotonically; exact for any size of change [-].

    z' = delta' (1 - z sgn delta') / delta_0 depends on the path alone:
    z+ = s + (z - s) exp(-|change| / delta_0) with s = sgn(change).

    Args:
        hysteresis_state: z before [-].
        deflection_change: Change of delta [rad].
        hysteresis_deflection: delta_0 [rad], > 0.
    """
    if deflection_change > 0.0:
        return 1.0 + (hysteresis_state - 1.0) * math.exp(-deflection_change / hysteresis_deflection)
    if deflection_change < 0.0:
        return -1.0 + (hysteresis_state + 1.0) * math.exp(deflection_change / hysteresis_deflection)
    return hysteresis_state


def motor_acceleration(
    current: float,
    motor_velocity: float,
    spring: float,
    torque_constant: float,
    gear_ratio: float,
    motor_damping: float,
    reflected_inertia: float,
) -> float:
    """Return q_m'' = (K_t N i - b_v q_m' - tau_s) / J, dry friction aside [rad/s^2].

    Dry friction is a set-valued law that no derivative can hold still: apply :func:`dry_friction_step` to the
    velocity after the step.

    Args:
        current: Winding current i [A].
        motor_velocity: q_m' at the output side [rad/s].
        spring: Torque tau_s that the spring passes to the link [N m].
        torque_constant: K_t [N m/A].
        gear_ratio: N [-].
        motor_damping: b_v [N m s/rad].
        reflected_inertia: J = J_r N^2 [kg m^2].
    """
    return (torque_constant * gear_ratio * current - motor_damping * motor_velocity - spring) / reflected_inertia


def dry_friction_step(velocity: float, friction: float, inertia: float, dt: float) -> float:
    """Return the velocity after dry friction acted for a step; exactly 0 where friction can hold it [rad/s].

    The implicit (time-stepping) form of Coulomb's law: friction takes away at most the momentum that is there, so a
    stuck body rests instead of chattering.

    Args:
        velocity: Velocity that all other torques would give [rad/s].
        friction: Magnitude of dry friction [N m], >= 0.
        inertia: Inertia that slides [kg m^2], > 0.
        dt: Step [s].

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
    """Return q'' = (tau_s + d - b_l q' - G sin q) / M [rad/s^2].

    Args:
        position: q, 0 hanging down [rad].
        velocity: q' [rad/s].
        spring: tau_s [N m].
        disturbance: Torque d on the link itself, such as a hand [N m].
        inertia: Link inertia M [kg m^2].
        damping: Link damping b_l (bearing and air) [N m s/rad].
        gravity: G = m g l [N m].
    """
    return (spring + disturbance - damping * velocity - gravity * math.sin(position)) / inertia
