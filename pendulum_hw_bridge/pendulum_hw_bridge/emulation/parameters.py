"""Constants of the emulated actuator: drivetrain and link from a plant file, sensors, timing and temperatures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

import numpy as np

from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.emulation import EMULATOR_PRESET_NAMES, EMULATOR_PRESETS
from pendulum_hw_bridge.emulation.firmware import Array
from pendulum_hw_bridge.emulation.kernel import CONSTANTS
from pendulum_hw_bridge.emulation.thermal import ThermalParameters, torque_constant_at
from pendulum_hw_bridge.port.actuator import HardwareLimits
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.dynamics.series_elastic import shorted_winding_damping, winding_resistance_at
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.friction_terms import TERM_PARAMETERS, terms_of
from pendulum_msgs_py.plants.joint_parameters import SeriesElasticParameters
from pendulum_msgs_py.plants.plant_parameters import PRESETS, PlantParameters, load_plant

__all__ = [
    "FIRMWARE_EFFICIENCY",
    "SPEED_CONSTANT_RPM",
    "EmulatorParameters",
    "SensorParameters",
    "TimingParameters",
    "load_emulator",
]

FIRMWARE_EFFICIENCY = 0.65
"""Efficiency assumed by the firmware's torque feed-forward [-]."""
SPEED_CONSTANT_RPM = 1530.0
"""Motor speed constant K_v assumed by the firmware's velocity feed-forward [rpm/V]."""


@dataclass(frozen=True)
class SensorParameters:
    """Noise and resolution of the feedback.

    Source: resolution and deflection noise (at most 0.2 mrad) measured on a public log of an X5; position and velocity
    noise inferred.

    Attributes:
        position_step: Resolution of the output encoder [rad].
        velocity_noise: Standard deviation of the velocity [rad/s].
        effort_noise: Half width of uniform noise on the effort, 0.15 mrad of deflection at 100 N m/rad [N m].
        motor_position_step: Resolution of the rotor angle, before the gears [rad].
        pwm_step: [-].
        motor_current_step: Resolution of the supply current [A].
        voltage_step: [V].
        idle_current: Supply current of the electronics [A].
    """

    position_step: float = 1e-5
    velocity_noise: float = 5e-4
    effort_noise: float = 0.015
    motor_position_step: float = math.pi / 3.0
    pwm_step: float = 2.4e-4
    motor_current_step: float = 3.66e-3
    voltage_step: float = 15.3e-3
    idle_current: float = 0.1


@dataclass(frozen=True)
class TimingParameters:
    """Timing of feedback and commands.

    Source: public log of an X5 (feedback period 10.00 ms with a standard deviation of 0.68 ms, round trip 0.73 ms).

    Attributes:
        feedback_rate: [Hz].
        feedback_jitter: Standard deviation of a feedback's instant, at most a tenth of the period [s].
        feedback_delay: From measurement to the host [s].
        command_delay: From the host to the actuator [s].
        delay_jitter: Standard deviation of each delay [s].
    """

    feedback_rate: float = 100.0
    feedback_jitter: float = 0.48e-3
    feedback_delay: float = 0.365e-3
    command_delay: float = 0.365e-3
    delay_jitter: float = 0.1e-3


@dataclass(frozen=True)
class EmulatorParameters:
    """Constants of one emulated actuator; ``flat`` means without gravity."""

    plant: PlantParameters
    thermal: ThermalParameters = field(default_factory=ThermalParameters)
    sensors: SensorParameters = field(default_factory=SensorParameters)
    timing: TimingParameters = field(default_factory=TimingParameters)
    flat: bool = False

    def __post_init__(self) -> None:
        if self.plant.drivetrain is None:
            raise ParameterError(
                f"plant {self.plant.name!r} has no drivetrain; expected one with motor, gears and spring, such as "
                f"the presets {EMULATOR_PRESET_NAMES}"
            )

    @property
    def drivetrain(self) -> SeriesElasticParameters:
        """Motor, gears and spring."""
        assert self.plant.drivetrain is not None
        return self.plant.drivetrain

    def with_drivetrain(self, **changes: float) -> EmulatorParameters:
        """Return a copy with some drivetrain constants changed."""
        return replace(self, plant=self.plant.with_values(drivetrain=replace(self.drivetrain, **changes)))

    def shorted_winding_damping(self, temperature: float) -> float:
        """Return the back-EMF damping with winding and magnets at a temperature [degC], in [N m s/rad]."""
        drive, beta = self.drivetrain, self.thermal.magnet_coefficient
        return shorted_winding_damping(
            torque_constant_at(temperature, drive.torque_constant, beta),
            torque_constant_at(temperature, drive.back_emf_constant, beta),
            drive.gear_ratio,
            winding_resistance_at(temperature, drive.winding_resistance, drive.resistance_temperature_coefficient),
        )

    def constants(self, limits: HardwareLimits, supply_voltage: float, enabled: bool) -> Array:
        """Return the kernel's constant vector at a supply voltage [V]; ``enabled`` if the motor may be driven."""
        drive, thermal = self.drivetrain, self.thermal
        # The firmware normalises with nominal constants: it does not know its winding's temperature.
        effort_normaliser = drive.winding_resistance / (
            drive.gear_ratio * drive.supply_voltage * drive.torque_constant * FIRMWARE_EFFICIENCY
        )
        speed_constant = SPEED_CONSTANT_RPM * 2.0 * math.pi / 60.0
        inertness = 1e12 if thermal.isothermal else 1.0
        values = {
            "gear_ratio": drive.gear_ratio,
            "torque_constant": drive.torque_constant,
            "back_emf_constant": drive.back_emf_constant,
            "winding_resistance": drive.winding_resistance,
            "resistance_coefficient": drive.resistance_temperature_coefficient,
            "magnet_coefficient": thermal.magnet_coefficient,
            "supply_voltage": supply_voltage,
            "reflected_inertia": drive.reflected_inertia,
            "motor_damping": drive.motor_damping,
            "motor_coulomb": drive.motor_coulomb_friction,
            "motor_static": drive.motor_static_friction,
            "motor_stribeck": drive.motor_stribeck_velocity,
            "stiffness": drive.stiffness,
            "hardening": drive.stiffness_hardening,
            "hysteresis_torque": drive.hysteresis_torque,
            "hysteresis_deflection": drive.hysteresis_deflection,
            "link_inertia": self.plant.inertia,
            "link_damping": self.plant.damping,
            "gravity": 0.0 if self.flat else self.plant.gravity,
            "link_coulomb": self.plant.coulomb_friction,
            "link_static": self.plant.static_friction,
            "link_stribeck": self.plant.stribeck_velocity,
            "winding_housing": thermal.winding_housing,
            "housing_body": thermal.housing_body,
            "body_ambient": thermal.body_ambient,
            "winding_capacity": thermal.winding_capacity * inertness,
            "housing_capacity": thermal.housing_capacity * inertness,
            "body_capacity": thermal.body_capacity * inertness,
            "ambient": thermal.ambient,
            "max_winding": thermal.max_winding,
            "critical_winding": thermal.critical_winding,
            "effort_normaliser": effort_normaliser,
            "velocity_normaliser": drive.gear_ratio / (speed_constant * drive.supply_voltage),
            "velocity_clamp": MOTOR_SPEED_LIMIT / drive.gear_ratio,
            "effort_clamp": min(limits.effort, self.plant.effort_limit),
            "position_min": max(limits.position_min, -1e9),
            "position_max": min(limits.position_max, 1e9),
            "pwm_limit": limits.pwm,
            "pwm_step": self.sensors.pwm_step,
            "enabled": 1.0 if enabled else 0.0,
            **dict(zip(TERM_PARAMETERS, terms_of(self.plant), strict=True)),
            **dict(zip(JOINT_TORQUES, self.plant.joints[0].torques, strict=True)),
        }
        return np.array([values[name] for name in CONSTANTS])


def load_emulator(plant: str | Path = "thesis", *, heating: bool = False) -> EmulatorParameters:
    """Return the emulator of a preset (one of ``EMULATOR_PRESETS``) or of a plant file with a drivetrain.

    ``thesis`` is the machine on which the thesis's experiments give its M_c, b_c and G_c; the rigid preset of that name
    is their result.

    Raises:
        ParameterError: No such preset or file, or a plant without drivetrain.
    """
    if str(plant) == "thesis":
        path = Path(str(resources.files("pendulum_hw_bridge") / "presets" / "thesis_machine.yaml"))
        parameters = load_plant(path)
    else:
        if str(plant) in PRESETS and str(plant) not in EMULATOR_PRESETS:
            raise ParameterError(
                f"emulated plant is {str(plant)!r}, a rigid one; expected one of {EMULATOR_PRESET_NAMES} "
                "or the path of a plant file with a drivetrain"
            )
        parameters = load_plant(plant)
    drivetrain = parameters.drivetrain
    thermal = ThermalParameters()
    if drivetrain is not None:
        # The thesis's b_c is that of a cold motor; a hand at 1 rad/s heats the winding by 50 K.
        thermal = ThermalParameters(
            ambient=drivetrain.winding_temperature, isothermal=str(plant) == "thesis" and not heating
        )
    return EmulatorParameters(parameters, thermal)
