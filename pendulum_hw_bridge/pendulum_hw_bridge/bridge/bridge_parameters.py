"""Parameters of the bridge (one table for ROS, README and command line), and the objects made from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.motor_state import MOTOR_SPEED_LIMIT
from pendulum_hw_bridge.drive.safety_limits import SafetyLimits
from pendulum_hw_bridge.emulation import EMULATOR_PRESET_NAMES
from pendulum_hw_bridge.port.actuator import MAX_COMMAND_LIFETIME, ActuatorPort, HardwareLimits, MStopAction
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet, load_gains
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.plant_specs import limits_from_parameters
from pendulum_msgs_py.contract.values import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PRESETS, PlantParameters, load_plant

__all__ = [
    "BRIDGE_SPECS",
    "POSITION_LOOP_STRATEGY",
    "bridge_settings",
    "described_plants",
    "effort_mapping",
    "make_port",
    "plant_of",
    "require_real_time",
    "safety_limits",
    "supervisor_limits",
    "trajectory_gains",
]

POSITION_LOOP_STRATEGY = 3
_MEASURED_EFFORT_MARGIN = 1.0
"""Margin of the measured torque above the effort limit: noise, friction, a light push [N m]."""


def _fixed(name: str, default: Any, unit: str, description: str, **domain: Any) -> ParameterSpec:
    return ParameterSpec(name, default, unit, description, read_only=True, **domain)


BRIDGE_SPECS: tuple[ParameterSpec, ...] = (
    _fixed("lab_file", "", "",
        "Lab file: actuator, mounting, limits, drive and supply; explicit parameters take precedence."),
    _fixed("backend", "emulator", "", "Backend of the actuator port.", choices=tuple(BACKENDS)),
    _fixed("autostart", True, "", "Configure and activate at once, without a lifecycle manager."),
    _fixed("plant", "thesis", "",
        f"Drivetrain and link: {EMULATOR_PRESET_NAMES}, or a plant file with a drivetrain; what the emulator is, and "
        "for `hebi` the constants of the effort mapping. Also a plant of several joints: with `backend:=emulator`, "
        "such as cart_pole, with quasi-direct drives; with `hebi`, whose joints all turn, with a module for each."),
    _fixed("family", "", "", "HEBI family of the actuator; empty for any, if there is only one."),
    _fixed("name", "", "", "HEBI name of the actuator; empty for any, if there is only one."),
    _fixed("mac_address", "", "", "MAC address of the HEBI actuator; empty for any. `scan` lists them."),
    _fixed("serial", "", "", "Serial number of the HEBI actuator; empty for any."),
    _fixed("module_type", "X5-9", "",
        "Type that the HEBI actuator must be of, since constants and limits are those of an X5-9; empty for any."),
    _fixed("interface", "", "",
        "Network address on which to search the HEBI actuator; empty for all; `emulator:HOST:PORT` in a rehearsal."),
    _fixed("drive_id", 1, "", "Number of the drive on its bus; with several joints `drive_ids`.", minimum=0,
        maximum=252),
    _fixed("drive_model", "", "", "Model of the drive on a bus; it must be the one that answers."),
    _fixed("bus_rate", 0, "1/s", "Bits per second of the drive's bus.", minimum=0),
    _fixed("feedback_rate", 100.0, "Hz", "Feedback records, and so control cycles, per second.", minimum=1.0,
        maximum=1000.0),
    _fixed("command_lifetime", 0.05, "s",
        "Time for which the actuator acts on a command after the bridge falls silent.", minimum=0.0,
        maximum=MAX_COMMAND_LIFETIME, exclusive_minimum=True),
    _fixed("effort_strategy", EffortStrategy.DIRECT_PWM.value, "",
        "How a torque becomes a setpoint; changes the damping that a controller sees.",
        choices=tuple(kind.value for kind in EffortStrategy)),
    _fixed("effort_efficiency", 0.0, "-",
        "Share of the motor's torque that reaches the joint, in the feed-forward; 0 takes that of the plant file.",
        minimum=0.0, maximum=1.0),
    _fixed("back_emf_compensation", 0.9, "-", "Share of the back-EMF that `direct_pwm_compensated` takes away.",
        minimum=0.0, maximum=1.0),
    _fixed("gains_file", "", "", "HEBI gains file (XML) for trajectories; empty for the X5-9's defaults."),
    _fixed("joint_offset", 0.0, "rad", "Joint angle at which the actuator reads zero."),
    _fixed("effort_tare", 0.0, "N m",
        "Torque that the sensor shows at the joint when nothing pulls; taken off the measured torque.", minimum=-2.0,
        maximum=2.0),
    _fixed("joint_sign", 1, "-", "1, or -1 where the actuator turns the other way.", minimum=-1, maximum=1),
    _fixed("pwm_limit", 0.6, "-", "Largest PWM duty; 0.6 still reaches 13 N m at standstill.", minimum=0.0,
        maximum=1.0, exclusive_minimum=True),
    _fixed("m_stop_action", MStopAction.MOTOR_OFF.value, "",
        "Action of the module when the motion stop is pressed; `disabled` on emulators only.",
        choices=tuple(action.value for action in MStopAction)),
    _fixed("winding_temperature_limit", 120.0, "degC", "Winding temperature at which the bridge faults.", minimum=0.0,
        maximum=155.0, exclusive_minimum=True),
    _fixed("derating_temperature", 105.0, "degC",
        "Winding temperature from which the torque limit of effort control falls, to none at the cut-off; 0 for never.",
        minimum=0.0, maximum=155.0),
    _fixed("feedback_watchdog", 3, "-", "Feedback periods without a record after which the bridge faults. "
        "Raise it only for an emulator on a busy machine.", minimum=2, maximum=50),
    _fixed("voltage_window", [22.0, 50.0], "V", "Supply voltages between which the bridge drives, [low, high]."),
    _fixed("measured_effort_limit", 0.0, "N m",
        "Torque of the spring at which the bridge faults; 0 for 1 N m above the effort limit.", minimum=0.0),
    _fixed("winding_current_tolerance", 0.15, "A",
        "Disagreement of winding current and PWM at which the bridge faults; 0 switches the check off.", minimum=0.0),
    _fixed("answer_window", 0.3, "-", "Share of a cycle in which to wait for commands for a state before acting.",
        minimum=0.0, maximum=0.8),
    _fixed("initial_position", 0.0, "rad", "Emulator: position of the pendulum at the start, at rest."),
    _fixed("initial_positions", [0.0], "rad or m",
        "Emulator of several joints: position of each at the start, at rest; one value for all."),
    _fixed("seed", 0, "-", "Emulator: seed of sensor noise and timing jitter.", minimum=0),
    _fixed("flat", False, "", "Emulator: the pendulum lies flat on a table, without gravity."),
    _fixed("e_stop_input_timeout", 0.0, "s",
        "With a hardware button or joystick as e-stop: silence of `e_stop_input` that latches it as a press does; 0 "
        "for no such input.", minimum=0.0, maximum=10.0),
    *(spec for backend in BACKENDS.values() for spec in backend.parameters),
)  # fmt: skip
"""Parameters of the bridge, without those that every plant has."""


def plant_of(values: Mapping[str, Any]) -> PlantParameters:
    """Return the plant file's content; ParameterError if missing, or without a drivetrain that the actuator needs."""
    if BACKENDS[values["backend"]].torque_drive:
        return load_plant(values["plant"])
    from pendulum_hw_bridge.emulation.parameters import load_emulator

    return load_emulator(values["plant"]).plant


def described_plants(values: Mapping[str, Any]) -> list[PlantParameters]:
    """Return the known parameters of the plant behind the bridge; empty if unknown.

    An emulator in this process is known; ``thesis`` also as the rigid plant that the thesis identified. For any other
    actuator a plant file counts, but not a preset, which is not a measurement of it.

    Raises:
        ParameterError: As :func:`plant_of`.
    """
    emulated = BACKENDS[values["backend"]].in_process
    if not emulated and values["plant"] in PRESETS:
        return []
    plants = [plant_of(values)]
    if values["plant"] == "thesis":
        plants.append(load_plant("thesis"))
    return [plant.with_values(gravity=0.0) for plant in plants] if emulated and values["flat"] else plants


def make_port(values: Mapping[str, Any], clock: Clock, *, lockstep: bool = False) -> ActuatorPort:
    """Return the backend that the parameters name, not connected yet.

    In ``lockstep``, time is simulated: feedback comes without jitter, just before each state.

    Raises:
        ParameterError: A parameter of the backend is refused.
    """
    require_real_time(values, lockstep=lockstep)
    return BACKENDS[values["backend"]].make(values, clock, lockstep=lockstep)


def require_real_time(values: Mapping[str, Any], *, lockstep: bool) -> None:
    """Raise ParameterError for simulated time with a backend that has its own clock."""
    if lockstep and not BACKENDS[values["backend"]].in_process:
        raise ParameterError(
            f"clock is 'lockstep' with backend {values['backend']!r}; expected backend 'emulator': others keep time"
        )


def trajectory_gains(values: Mapping[str, Any]) -> GainSet:
    """Return the gains for trajectories; ParameterError if the file is refused or for another strategy."""
    if not values["gains_file"]:
        return DEFAULT_GAINS[POSITION_LOOP_STRATEGY]
    gains = load_gains(values["gains_file"])
    if gains.strategy != POSITION_LOOP_STRATEGY:
        raise ParameterError(
            f"gains file {values['gains_file']} is for strategy {gains.strategy}; "
            f"expected {POSITION_LOOP_STRATEGY}, under which trajectories are followed"
        )
    return gains


def effort_mapping(
    values: Mapping[str, Any], plant: PlantParameters, gains: GainSet, limits: PlantLimits, *, joint: int = 0
) -> EffortMapping:
    """Return the mapping of torque to setpoints of one of the driven joints, with its limits."""
    drivetrain = plant.drivetrain
    if drivetrain is None:
        raise ParameterError(f"plant {plant.name!r} has no drivetrain; expected one for the effort mapping")
    return EffortMapping(
        EffortStrategy(values["effort_strategy"]),
        drivetrain,
        efficiency=values["effort_efficiency"] or drivetrain.efficiency,
        compensation=values["back_emf_compensation"],
        gains=gains,
        effort_limit=limits.effort[joint],
        velocity_limit=min(limits.velocity, MOTOR_SPEED_LIMIT / drivetrain.gear_ratio),
    )


def supervisor_limits(
    values: Mapping[str, Any],
    limits: Vector,
    *,
    push: Vector = (),
    coordinates: Coordinates = ONE_JOINT,
    lockstep: bool = False,
) -> PlantLimits:
    """Return the supervisor's limits; ``limits`` are the plant file's of the driven joints' commands.

    Raises:
        ParameterError: They contradict each other or the plant.
    """
    # One period more than the monitor's timeout: the monitor names the fault first, this one backs it up.
    patience = (values["feedback_watchdog"] + 1) / values["feedback_rate"]
    return limits_from_parameters(
        values, limits, push=push, coordinates=coordinates, lockstep=lockstep, feedback_timeout=patience
    )


def bridge_settings(
    values: Mapping[str, Any],
    *,
    effort: float,
    velocity: float,
    gains: GainSet,
    window: tuple[float, float] = (-math.inf, math.inf),
) -> BridgeSettings:
    """Return the actuator's settings for limits of effort [N m], velocity [rad/s] and joint angles [rad].

    Raises:
        ParameterError: ``joint_sign`` is zero, or a limit is refused.
    """
    if values["joint_sign"] == 0:
        raise ParameterError("joint_sign is 0; expected 1 or -1")
    ends = sorted(values["joint_sign"] * (angle - values["joint_offset"]) for angle in window)
    return BridgeSettings(
        feedback_rate=values["feedback_rate"],
        command_lifetime=values["command_lifetime"],
        limits=HardwareLimits(
            effort=effort,
            velocity=velocity,
            position_min=ends[0],
            position_max=ends[1],
            pwm=values["pwm_limit"],
            m_stop=MStopAction(values["m_stop_action"]),
        ),
        gains=gains,
        joint_offset=values["joint_offset"],
        joint_sign=values["joint_sign"],
        effort_tare=values["effort_tare"],
    )


def safety_limits(values: Mapping[str, Any], effort: float) -> SafetyLimits:
    """Return the limits of the feedback checks, for an effort limit [N m]; ParameterError for a malformed window."""
    window = values["voltage_window"]
    if len(window) != 2:
        raise ParameterError(f"voltage_window has {len(window)} values; expected [low, high] in V")
    return SafetyLimits(
        winding_temperature=values["winding_temperature_limit"],
        voltage_min=window[0],
        voltage_max=window[1],
        measured_effort=values["measured_effort_limit"] or effort + _MEASURED_EFFORT_MARGIN,
        winding_current=values["winding_current_tolerance"],
        feedback_cycles=values["feedback_watchdog"],
    )
