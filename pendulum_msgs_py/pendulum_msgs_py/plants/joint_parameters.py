"""Parameters of one joint: friction, offsets, end stops, and an actuator with or without a drivetrain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Annotated

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES, PERIODIC
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.friction_terms import TERM_PARAMETERS, term_fields
from pendulum_msgs_py.plants.quantities import Quantity, check_fields, specs_of

__all__ = [
    "DRIVETRAIN_SPECS",
    "OF_A_PENDULUM",
    "Actuator",
    "JointParameters",
    "Motor",
    "SeriesElasticParameters",
    "actuator_specs",
    "joint_specs",
    "motor_specs",
]


_LARGEST_EFFORT = 1e4
"""More than any robot's joint gives [N m or N]: beyond it the unit is wrong."""
OF_A_PENDULUM = ("torque_offset", "angle_offset", *TERM_PARAMETERS)
"""Quantities that only the pendulum's equation has."""


@dataclass(frozen=True)
class SeriesElasticParameters:
    """Motor, gear train and spring of a series-elastic actuator.

    Source: HEBI X5-9 datasheet values; friction and hysteresis from public logs of X5 actuators.
    """

    gear_ratio: Annotated[float, Quantity("-", "Motor turns per output turn, N.", positive=True)] = 1742.222
    torque_constant: Annotated[
        float, Quantity("N m/A", "Torque per winding current at the motor, K_t.", positive=True)
    ] = 6.26e-3
    back_emf_constant: Annotated[float, Quantity("V s/rad", "Voltage per motor speed, K_e.")] = 6.241e-3
    winding_resistance: Annotated[
        float, Quantity("ohm", "Winding resistance at 20 degrees Celsius, R.", positive=True)
    ] = 9.99
    winding_temperature: Annotated[float, Quantity("degC", "Winding temperature at the start.", signed=True)] = 22.0
    resistance_temperature_coefficient: Annotated[float, Quantity("1/K", "Relative change of R per kelvin.")] = 0.004
    supply_voltage: Annotated[float, Quantity("V", "Supply voltage, V.", positive=True)] = 36.0
    efficiency: Annotated[
        float, Quantity("-", "Share of motor torque that a command counts on at the output.", positive=True)
    ] = 0.65
    reflected_inertia: Annotated[
        float, Quantity("kg m^2", "Rotor inertia seen at the output, J_r N^2.", positive=True)
    ] = 0.19
    motor_damping: Annotated[
        float, Quantity("N m s/rad", "Viscous friction of motor and gears at the output, b_v.")
    ] = 1.4
    motor_coulomb_friction: Annotated[
        float, Quantity("N m", "Dry friction of motor and gears at the output, tau_C.")
    ] = 0.3
    motor_static_friction: Annotated[
        float, Quantity("N m", "Dry friction at which the motor starts to slide, tau_S.")
    ] = 0.39
    motor_stribeck_velocity: Annotated[
        float, Quantity("rad/s", "Velocity over which tau_S falls to tau_C.", positive=True)
    ] = 0.01
    stiffness: Annotated[float, Quantity("N m/rad", "Spring stiffness at small deflection, k.", positive=True)] = 100.0
    stiffness_hardening: Annotated[
        float, Quantity("N m/rad^3", "Growth of the stiffness with the deflection squared.")
    ] = 0.0
    hysteresis_torque: Annotated[float, Quantity("N m", "Half width of the spring's hysteresis loop, tau_h.")] = 0.05
    hysteresis_deflection: Annotated[
        float, Quantity("rad", "Deflection over which the loop turns round.", positive=True)
    ] = 2e-4

    def __post_init__(self) -> None:
        check_fields(self, DRIVETRAIN_SPECS)
        # A static friction below the sliding one would feed energy in.
        if self.motor_static_friction < self.motor_coulomb_friction:
            raise ParameterError(
                f"motor_static_friction is {self.motor_static_friction} N m; "
                f"expected >= motor_coulomb_friction = {self.motor_coulomb_friction} N m"
            )


DRIVETRAIN_SPECS = specs_of(SeriesElasticParameters)
"""Quantities of a plant file's section ``drivetrain``."""


@dataclass(frozen=True)
class Motor:
    """A DC motor with gears that is commanded by its voltage u; the current settles at once.

    ::

        effort = N k_t (u - N k_e v) / R = gain u - damping v,   gain = N k_t / R,   damping = N^2 k_t k_e / R

    With an inductance L the effort of u lags by L/R. The back EMF does not, which is the same to first order as long as
    damping L/R, an inertia, is small beside the joint's; a plant where it is not is refused.
    """

    resistance: Annotated[float, Quantity("ohm", "Winding resistance, with that of the amplifier, R.", positive=True)]
    torque_constant: Annotated[float, Quantity("N m/A", "Motor torque per current, k_t.", positive=True)]
    voltage_limit: Annotated[
        float, Quantity("V", "Largest voltage of the amplifier.", positive=True, example=10.0, largest=_LARGEST_EFFORT)
    ]
    back_emf_constant: Annotated[
        float | None, Quantity("V s/rad", "Voltage per motor speed, k_e; by default the torque constant's value.")
    ] = None
    gear_ratio: Annotated[float, Quantity("gear_unit", "Motor turns per motion of the joint, N.", positive=True)] = 1.0
    inductance: Annotated[float, Quantity("H", "Winding inductance, L; 0 for none.")] = 0.0
    dead_band: Annotated[float, Quantity("V", "Voltage at standstill that gives no torque; 0 for none.")] = 0.0

    @property
    def gain(self) -> float:
        """Effort per volt at standstill [N m/V or N/V]."""
        return self.gear_ratio * self.torque_constant / self.resistance

    @property
    def damping(self) -> float:
        """Effort of the back EMF per velocity [N m s/rad or N s/m]."""
        constant = self.torque_constant if self.back_emf_constant is None else self.back_emf_constant
        return self.gain * self.gear_ratio * constant

    def stall_effort(self, voltage: float) -> float:
        """Return the effort of a voltage [V] at standstill, beyond the dead band [N m or N]."""
        band = self.dead_band
        return self.gain * (voltage - min(band, max(-band, voltage)) if band > 0.0 else voltage)


@dataclass(frozen=True)
class Actuator:
    """The actuator of one joint; ``effort_unit`` is the joint's.

    With a ``motor`` its commands are volts; the effort limit is then the motor's at standstill, and an inductance
    determines the time constant.
    """

    effort_limit: Annotated[
        float,
        Quantity("effort_unit", "Largest effort of the actuator.", positive=True, example=1.0, largest=_LARGEST_EFFORT),
    ]
    time_constant: Annotated[float, Quantity("s", "First-order lag between command and effort; 0 for none.")] = 0.0
    transport_delay: Annotated[float, Quantity("s", "Time between a command and its first effect.")] = 0.0
    motor: Motor | None = None

    def __post_init__(self) -> None:
        motor = self.motor
        if motor is not None and motor.resistance > 0.0:
            object.__setattr__(self, "effort_limit", abs(motor.stall_effort(motor.voltage_limit)))
            if motor.inductance > 0.0:
                object.__setattr__(self, "time_constant", motor.inductance / motor.resistance)

    @property
    def command_limit(self) -> float:
        """Largest command, in volts with a motor, else an effort."""
        return self.effort_limit if self.motor is None else self.motor.voltage_limit


if TYPE_CHECKING:

    @dataclass(frozen=True, kw_only=True)
    class _FrictionTerms:
        load_friction: float = 0.0

else:
    _FrictionTerms = term_fields()


@dataclass(frozen=True)
class JointParameters(_FrictionTerms):
    """Friction, offsets, end stops and actuator of one joint; units such as ``effort_unit`` are the joint's.

    A static friction of None equals the Coulomb friction; other None are absent. ``OF_A_PENDULUM`` and the drivetrain
    are a pendulum's only.
    """

    damping: Annotated[float, Quantity("damping_unit", "Viscous friction, b_c.")] = 0.0
    coulomb_friction: Annotated[float, Quantity("effort_unit", "Dry friction while sliding fast, tau_C.")] = 0.0
    static_friction: Annotated[
        float | None, Quantity("effort_unit", "Dry friction at which sliding starts, tau_S >= tau_C.")
    ] = None
    stribeck_velocity: Annotated[
        float, Quantity("velocity_unit", "Velocity over which tau_S falls to tau_C.", positive=True)
    ] = 0.01
    torque_offset: Annotated[
        float, Quantity("effort_unit", "Constant torque that the sensor of effort misses.", signed=True)
    ] = 0.0
    angle_offset: Annotated[float, Quantity("unit", "Measured angle when hanging at rest.", signed=True)] = 0.0
    quadratic_drag: Annotated[float, Quantity("drag_unit", "Drag by the square of the velocity, c in c v |v|.")] = 0.0
    torque_cos_2: Annotated[
        float, Quantity("effort_unit", "Torque by the cosine of twice the link's angle, as of cogging.", signed=True)
    ] = 0.0
    torque_sin_2: Annotated[
        float, Quantity("effort_unit", "Torque by the sine of twice the link's angle, as of cogging.", signed=True)
    ] = 0.0
    torque_cos_3: Annotated[
        float,
        Quantity("effort_unit", "Torque by the cosine of three times the link's angle, as of cogging.", signed=True),
    ] = 0.0
    torque_sin_3: Annotated[
        float,
        Quantity("effort_unit", "Torque by the sine of three times the link's angle, as of cogging.", signed=True),
    ] = 0.0
    lower_stop: Annotated[float | None, Quantity("unit", "Lowest position, at an end stop.", signed=True)] = None
    upper_stop: Annotated[float | None, Quantity("unit", "Highest position, at an end stop.", signed=True)] = None
    actuator: Actuator | None = None
    drivetrain: SeriesElasticParameters | None = None

    @property
    def breakaway(self) -> float:
        """Dry friction at which sliding starts [N m or N]."""
        return self.coulomb_friction if self.static_friction is None else self.static_friction

    @property
    def torques(self) -> tuple[float, ...]:
        """Values of ``JOINT_TORQUES``, 0 for none."""
        return tuple(getattr(self, name) for name in JOINT_TORQUES)

    @property
    def total_damping(self) -> float:
        """Viscous friction and, of a motor in volts, back EMF [N m s/rad or N s/m]."""
        motor = None if self.actuator is None else self.actuator.motor
        return self.damping if motor is None else self.damping + motor.damping


@cache
def joint_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of a joint's quantities in its units."""
    specs = _in_units_of(joint, JointParameters)
    return specs if joint.turns else tuple(spec for spec in specs if spec.name not in PERIODIC)


@cache
def actuator_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of its actuator's quantities in its units."""
    return _in_units_of(joint, Actuator)


@cache
def motor_specs(joint: Joint) -> tuple[ParameterSpec, ...]:
    """Return the table of its motor's quantities in its units."""
    return _in_units_of(joint, Motor)


def _in_units_of(joint: Joint, kind: type) -> tuple[ParameterSpec, ...]:
    return tuple(replace(spec, unit=getattr(joint, spec.unit, spec.unit)) for spec in specs_of(kind))
