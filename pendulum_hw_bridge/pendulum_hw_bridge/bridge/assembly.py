"""Modules and limits of a plant, made from the bridge's parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.backends.emulated_machine import TORQUE_LOOP, DrivePort, machine_ports
from pendulum_hw_bridge.bridge import bridge_parameters
from pendulum_hw_bridge.bridge.bridge_consistency import check_consistency
from pendulum_hw_bridge.bridge.drive_assembly import DriveAssembly
from pendulum_hw_bridge.bridge.group_assembly import OF_GROUPS, GroupAssembly, refuse_slides
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.current_drive import CurrentCheck, CurrentMapping, VoltageMapping
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.output_check import OutputCheck
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import HardwareLimits, MStopAction
from pendulum_hw_bridge.port.clocks import Clock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates, Joint
from pendulum_msgs_py.contract.plant_specs import in_units_of
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.joint_parameters import Actuator
from pendulum_msgs_py.plants.plant_parameters import (
    MECHANISM_PRESETS,
    PRESETS,
    PlantParameters,
    common_delay,
    is_mechanism,
    load_mechanism,
)

__all__ = ["CURRENT_LOOP", "Assembly", "assemble", "for_plant"]

CURRENT_LOOP = "current_loop"
"""Reported in place of a value of ``effort_strategy`` for drives with a current loop."""
AMPLIFIER = "amplifier"
"""The same for motors in volts."""
_MEASURED_SHARE = 1.2
"""Limit of the measured effort, as a multiple of the effort limit [-]."""
_DISAGREEMENT = 0.05
"""Largest disagreement of position and velocity of a joint ten times as fast as an X5-9 [rad or m]."""
_FASTEST = 30.0
"""Default velocity limit of the armed machine [rad/s or m/s]."""
_RATE = 500.0
"""Default feedback rate: several links fall faster than one [Hz]."""
_OF_ONE_MODULE = (
    "lab_file", "effort_strategy", "effort_efficiency", "gains_file", "joint_offset", "effort_tare", "joint_sign",
    "initial_position", "flat", "family", "name", "mac_address", "serial", "interface", "hebi_log",
    "back_emf_compensation", "emulator_address", "replay_file", "drivetrain", *OF_GROUPS,
)  # fmt: skip
"""Parameters that an emulated machine of several joints does not have; most are for a single module."""
_OF_EVERY_GROUP = (
    "effort_strategy", "effort_efficiency", "gains_file", "interface", "hebi_log", "back_emf_compensation",
    "drivetrain", *OF_GROUPS,
)  # fmt: skip
"""Those of them that a group of HEBI modules has."""
_SLOWEST_DRIVE = 0.1
"""Longest delay and time constant of a drive that the output check supports [s]."""
_LEAD_NS = 500_000
"""In lockstep, time from measurement of the feedback to the state that shows it [ns]."""


@dataclass(frozen=True)
class Assembly:
    """Modules of one plant.

    Attributes:
        coordinates: Joints, and which of them are driven.
        limits: Limits of the supervisor.
        described: Known parameters of the plant; empty if unknown.
        hardware: Short description.
        effort_strategy: Mapping of torque to setpoints.
        mapping: That of the first drive.
        modules: Makes the modules on a host clock, not connected yet.
    """

    coordinates: Coordinates
    limits: PlantLimits
    described: list[PlantParameters]
    hardware: str
    effort_strategy: str
    mapping: EffortMapping
    modules: Callable[[Clock], list[Module]]


def for_plant(specs: tuple[ParameterSpec, ...], plant: str, backend: str = "emulator") -> tuple[ParameterSpec, ...]:
    """Return the bridge's parameters with defaults for several joints; ParameterError if there is no such plant."""
    if backend in BACKENDS:
        own = BACKENDS[backend].defaults
        specs = tuple(replace(spec, default=own.get(spec.name, spec.default)) for spec in specs)
    if not is_mechanism(plant):
        return specs
    mechanism = load_mechanism(plant)
    of_one = next(spec.default for spec in specs if spec.name == "position_window")
    assert isinstance(of_one, list)
    # A real joint always has a window, and several X5-9s are as slow as one.
    real = backend in BACKENDS and BACKENDS[backend].is_machine
    free = of_one if real else [0.0, 0.0]
    ends = [end for low, high in mechanism.stops for end in ((low, high) if math.isfinite(low + high) else free)]
    specs = in_units_of(specs, mechanism.coordinates)
    defaults: dict[str, Any] = {"position_window": ends}
    if not real:
        defaults |= {"velocity_limit": _FASTEST, "feedback_rate": _RATE}
    return tuple(replace(spec, default=defaults.get(spec.name, spec.default)) for spec in specs)


def assemble(values: Mapping[str, Any], specs: tuple[ParameterSpec, ...], *, lockstep: bool = False) -> Assembly:
    """Return what the parameters describe; ``lockstep`` means simulated time.

    Raises:
        ParameterError: The parameters contradict each other or the plant.
    """
    if BACKENDS[values["backend"]].torque_drive:
        return _drives(values, specs, lockstep=lockstep)
    if is_mechanism(values["plant"]):
        return _several(values, specs, lockstep=lockstep)
    if values["initial_positions"] != [0.0]:
        raise ParameterError("initial_positions is for several joints; expected initial_position for one")
    _refuse_names(values, specs, several=False)
    return _one(values, lockstep=lockstep)


def _refuse_names(values: Mapping[str, Any], specs: tuple[ParameterSpec, ...], *, several: bool) -> None:
    """Refuse names for one module's parameters where there are several joints, and the other way round."""
    defaults = {spec.name: spec.default for spec in specs}
    few, many = ("one joint", "several") if several else ("several joints", "one")
    if several and values["lab_file"]:
        raise ParameterError(f"lab_file is for {few}; expected its values as parameters for {many}")
    for of_several, of_one in OF_GROUPS.items():
        name, other = (of_one, of_several) if several else (of_several, of_one)
        if values[name] != defaults[name]:
            raise ParameterError(f"{name} is for {few}; expected {other} for {many}")


def _one(values: Mapping[str, Any], *, lockstep: bool) -> Assembly:
    plant = bridge_parameters.plant_of(values)
    gains = bridge_parameters.trajectory_gains(values)
    limits = bridge_parameters.supervisor_limits(values, (plant.effort_limit,), lockstep=lockstep)
    check_consistency(values, limits)
    mapping = bridge_parameters.effort_mapping(values, plant, gains, limits)
    settings = bridge_parameters.bridge_settings(
        values,
        effort=limits.effort[0],
        velocity=mapping.velocity_limit,
        gains=gains,
        window=(limits.position_min[0], limits.position_max[0]),
    )
    safety = bridge_parameters.safety_limits(values, limits.effort[0])
    period = round(NANOSECONDS / values["feedback_rate"]) / NANOSECONDS

    def modules(clock: Clock) -> list[Module]:
        port = bridge_parameters.make_port(values, clock, lockstep=lockstep)
        return [DrivenModule(port, mapping, SafetyMonitor(safety, period, plant.drivetrain), settings)]

    described = list(bridge_parameters.described_plants(values))
    return Assembly(
        ONE_JOINT, limits, [*described], f"X5-9, {values['backend']}", values["effort_strategy"], mapping, modules
    )


def _several(values: Mapping[str, Any], specs: tuple[ParameterSpec, ...], *, lockstep: bool) -> Assembly:
    plant = load_mechanism(values["plant"])
    coordinates = plant.coordinates
    names = ", ".join(coordinates.names)
    real = values["backend"] == "hebi"
    if not real and values["backend"] != "emulator":
        raise ParameterError(
            f"backend {values['backend']!r} has one module, and plant {plant.name!r} has the joints {names}; expected "
            "backend 'emulator' or 'hebi'"
        )
    if real and coordinates.volts:
        raise ParameterError(
            f"plant {plant.name!r} is driven in volts; expected one driven by an effort: so are the modules of backend "
            f"{values['backend']!r}"
        )
    if real:
        refuse_slides(coordinates)
    if not coordinates.driven:
        raise ParameterError(f"plant {plant.name!r} has no driven joint; expected an actuator at one of {names}")
    defaults = {spec.name: spec.default for spec in specs}
    for name in _OF_ONE_MODULE:
        if values[name] != defaults[name] and not (real and name in _OF_EVERY_GROUP):
            kind = "backend 'hebi'" if name in {"drivetrain", *OF_GROUPS} else "one module"
            raise ParameterError(
                f"{name} is {values[name]!r}, which is for {kind}, and plant {plant.name!r} has the joints "
                f"{names}; expected it left out"
            )
    limits = bridge_parameters.supervisor_limits(
        values, plant.command_limits, push=plant.effort_limits, coordinates=coordinates, lockstep=lockstep
    )
    check_consistency(values, limits)
    if real:
        return _group(values, plant, limits, lockstep=lockstep)
    hardware, gains = QuasiDirectDrive(), DEFAULT_GAINS[TORQUE_LOOP]
    period_ns = round(NANOSECONDS / values["feedback_rate"])
    start = plant.coordinates.for_each("initial_positions", values["initial_positions"])
    delay = common_delay(plant)
    slowest = max(actuator.time_constant for actuator in plant.actuators)
    for name, value in (("transport_delay", delay), ("time_constant", slowest)):
        if value > _SLOWEST_DRIVE:
            raise ParameterError(
                f"{name} of plant {plant.name!r} is {value:g} s; expected at most {_SLOWEST_DRIVE:g} s: for so long a "
                "torque that is no longer commanded may still be measured"
            )
    mappings = [
        _mapping(hardware, coordinates.joints[index], actuator, limit, delay, values["feedback_rate"])
        for index, actuator, limit in zip(coordinates.driven, plant.actuators, limits.effort, strict=True)
    ]
    # A duty that is late, or partly without effect, contradicts the current.
    tells = not (delay or any(own.motor is not None and own.motor.dead_band > 0.0 for own in plant.actuators))

    def modules(clock: Clock) -> list[Module]:
        start_ns = clock.now_ns()
        if lockstep:
            start_ns -= period_ns + min(_LEAD_NS, period_ns // 2)
        machine = EmulatedMachine(
            plant, hardware, seed=values["seed"], position=start, start_ns=start_ns, rate=values["feedback_rate"]
        )
        made: list[Module] = []
        for index, port in enumerate(machine_ports(machine, clock)):
            joint = coordinates.joints[index].name
            driven = coordinates.driven.index(index) if isinstance(port, DrivePort) else None
            effort = mappings[driven].effort_limit if driven is not None else max(m.effort_limit for m in mappings)
            safety = _safety(values, effort)
            if driven is not None and (motor := plant.actuators[driven].motor) is not None:
                # A motor that is reversed at speed gets the back EMF on top.
                braking = motor.damping * (limits.velocity if math.isfinite(limits.velocity) else _FASTEST)
                most = values["measured_effort_limit"] or _MEASURED_SHARE * (effort + braking)
                safety = replace(safety, measured_effort=most)
            monitor = SafetyMonitor(
                safety,
                period_ns / NANOSECONDS,
                mappings[driven].drivetrain if driven is not None and (tells or not coordinates.volts) else None,
                coordinates.joints[index],
            )
            settings = BridgeSettings(
                feedback_rate=values["feedback_rate"],
                command_lifetime=values["command_lifetime"],
                limits=HardwareLimits(
                    effort=effort,
                    position_min=limits.position_min[index],
                    position_max=limits.position_max[index],
                    m_stop=MStopAction(values["m_stop_action"]),
                    joint=coordinates.joints[index],
                ),
                gains=gains,
            )
            if driven is None:
                made.append(Module(port, monitor, settings, joint=joint))
                continue
            assert isinstance(port, DrivePort)
            check = OutputCheck if coordinates.volts else CurrentCheck
            made.append(DrivenModule(port, mappings[driven], monitor, settings, joint=joint, check=check))
        return made

    strategy = AMPLIFIER if coordinates.volts else CURRENT_LOOP
    return Assembly(coordinates, limits, [plant], f"emulated machine {plant.name}", strategy, mappings[0], modules)


def _drives(values: Mapping[str, Any], specs: tuple[ParameterSpec, ...], *, lockstep: bool) -> Assembly:
    plant = load_mechanism(values["plant"])
    _refuse_names(values, specs, several=len(plant.joints) > 1)
    bridge_parameters.require_real_time(values, lockstep=lockstep)
    limits = bridge_parameters.supervisor_limits(
        values, plant.command_limits, push=plant.effort_limits, coordinates=plant.coordinates, lockstep=lockstep
    )
    check_consistency(values, limits)
    made = DriveAssembly(values, plant, limits)
    known = values["plant"] in PRESETS or values["plant"] in MECHANISM_PRESETS
    name = f"{values['drive_model']}, {values['backend']}"
    # A preset is not a measurement of this machine.
    described = [] if known else [plant]
    return Assembly(plant.coordinates, limits, described, name, CURRENT_LOOP, made.mappings[0], made.modules)


def _mapping(
    hardware: QuasiDirectDrive, joint: Joint, actuator: Actuator, limit: float, delay: float, rate: float
) -> EffortMapping:
    """Return the mapping of a drive's commands within a limit [N m or N, or V], for a delay [s] and a rate [Hz]."""
    constants, motor = hardware.constants(joint, actuator.effort_limit, actuator.motor), actuator.motor
    if motor is not None:
        return VoltageMapping(
            EffortStrategy.DIRECT_PWM,
            constants,
            gains=DEFAULT_GAINS[TORQUE_LOOP],
            effort_limit=limit * motor.gain,
            joint=joint,
        )
    return CurrentMapping(
        EffortStrategy.EFFORT_LOOP,
        constants,
        gains=DEFAULT_GAINS[TORQUE_LOOP],
        effort_limit=limit,
        joint=joint,
        # After the delay, the rest of an older torque decays to a twentieth within three time constants.
        late=math.ceil((delay + 3.0 * actuator.time_constant) * rate),
    )


def _group(values: Mapping[str, Any], plant: PlantParameters, limits: PlantLimits, *, lockstep: bool) -> Assembly:
    bridge_parameters.require_real_time(values, lockstep=lockstep)
    if values["initial_positions"] != [0.0]:
        raise ParameterError("initial_positions is for the emulator; expected it left out with backend 'hebi'")
    group = GroupAssembly(values, plant.coordinates, limits)
    # A preset is not a measurement of this machine.
    described: list[PlantParameters] = [] if values["plant"] in MECHANISM_PRESETS else [plant]
    return Assembly(
        plant.coordinates,
        limits,
        described,
        f"group of X5-9, {values['backend']}",
        values["effort_strategy"],
        group.mappings[0],
        group.modules,
    )


def _safety(values: Mapping[str, Any], effort: float) -> SafetyLimits:
    of_one = bridge_parameters.safety_limits(values, effort)
    return replace(
        of_one,
        measured_effort=values["measured_effort_limit"] or _MEASURED_SHARE * effort,
        position_disagreement=_DISAGREEMENT,
    )
