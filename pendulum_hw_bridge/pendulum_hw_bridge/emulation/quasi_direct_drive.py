"""Drivetrain of an emulated machine of several joints: a strong motor with low gear ratio and current loop.

An X5-9 turns at 1.5 rad/s and brakes with 11.8 N m s/rad, too slow to swing up several joints. Quasi-direct drives
command torque through the current, with a lag of 1 ms. A motor of the plant file has an amplifier in place of it, whose
duty is a share of the supply voltage. Source of the magnitudes: B. Katz, A low cost modular actuator
for dynamic robots, 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.plants.joint_parameters import Motor, SeriesElasticParameters

__all__ = ["QuasiDirectDrive"]


@dataclass(frozen=True)
class QuasiDirectDrive:
    """Constants of drives and encoders of one machine; the plant file has the effort limits.

    Attributes:
        gear_ratio: Motor turns per turn of the joint [-].
        pinion_radius: For a slide: travel per turn of the gears' output [m/rad].
        peak_current: Winding current at the effort limit [A].
        winding_resistance: At 20 degC [ohm].
        supply_voltage: [V].
        current_loop: First-order lag of the current loop [s].
        encoder_counts: Encoder steps per turn; a motor's encoder is before its gears [-].
        velocity_noise: Standard deviation of the velocity [rad/s], times the radius for a slide.
        effort_noise: Standard deviation of the measured effort, as a share of the effort limit [-].
        feedback_delay: From measurement to the host [s].
        command_delay: From the host to the drive, in addition to the plant file's transport delay [s].
        ambient: Ambient temperature [degC].
        thermal_resistance: From winding to ambient [K/W].
        thermal_time: Thermal time constant of the winding [s].
    """

    gear_ratio: float = 6.0
    pinion_radius: float = 0.02
    peak_current: float = 20.0
    winding_resistance: float = 0.2
    supply_voltage: float = 24.0
    current_loop: float = 1e-3
    encoder_counts: int = 16384
    velocity_noise: float = 2e-3
    effort_noise: float = 2e-3
    feedback_delay: float = 0.4e-3
    command_delay: float = 0.4e-3
    ambient: float = 25.0
    thermal_resistance: float = 1.0
    thermal_time: float = 60.0

    def scale(self, joint: Joint) -> float:
        """Return the joint's travel per radian at the gears' output [rad/rad or m/rad]."""
        return 1.0 if joint.turns or joint.unit == "rad" else self.pinion_radius

    def step(self, joint: Joint, *, driven: bool) -> float:
        """Return the resolution of a joint's encoder [rad or m]."""
        return 2.0 * math.pi / self.encoder_counts * self.scale(joint) / (self.gear_ratio if driven else 1.0)

    def constants(self, joint: Joint, effort_limit: float, motor: Motor | None = None) -> SeriesElasticParameters:
        """Return motor and gears of a joint with an effort limit [N m or N], for the bridge's checks; no spring.

        A ``motor`` has its own, and a supply that reaches its largest voltage.
        """
        gear_ratio = self.gear_ratio / self.scale(joint)
        per_ampere = effort_limit / self.peak_current / gear_ratio
        constants = SeriesElasticParameters(
            gear_ratio=gear_ratio,
            torque_constant=per_ampere,
            back_emf_constant=per_ampere,
            winding_resistance=self.winding_resistance,
            winding_temperature=self.ambient,
            supply_voltage=self.supply_voltage,
            efficiency=1.0,
        )
        if motor is None:
            return constants
        own = motor.torque_constant if motor.back_emf_constant is None else motor.back_emf_constant
        return replace(
            constants,
            gear_ratio=motor.gear_ratio,
            torque_constant=motor.torque_constant,
            back_emf_constant=own,
            winding_resistance=motor.resistance,
            # The plant's equation has one resistance, warm or cold.
            resistance_temperature_coefficient=0.0,
            supply_voltage=max(self.supply_voltage, motor.voltage_limit),
        )
