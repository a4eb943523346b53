"""Parameters of every plant: the limits that it enforces, and how its loop runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from pendulum_msgs_py.contract.drive import Input, PlantLimits
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.values import NANOSECONDS, Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec

__all__ = [
    "COMPILED",
    "LIMIT_SPECS",
    "LOCKSTEP_EPOCH_NS",
    "LOOP_SPECS",
    "REALTIME_PRIORITY",
    "in_units_of",
    "limits_from_parameters",
]

LOCKSTEP_EPOCH_NS = NANOSECONDS
"""Stamp of the first state in lockstep [ns]; a stamp of zero means "no time" to ROS tools."""

REALTIME_PRIORITY = ParameterSpec(
    "realtime_priority", 0, "-",
    "Real-time priority (SCHED_FIFO), 1 to 99; 0 for an ordinary process; -1 for 50 if permitted and in wall time.",
    minimum=-1, maximum=99, read_only=True,
)  # fmt: skip
"""Of all programs that run at a plant's rate."""

COMPILED = ParameterSpec(
    "compiled", True, "", "Use the compiled loop if available; diagnostics report which one runs.", read_only=True
)

LOOP_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        "clock", "realtime", "",
        "Absolute deadlines of wall time, or step only when all expected answers to a state have come.",
        choices=("realtime", "lockstep"), read_only=True,
    ),
    ParameterSpec(
        "lockstep_inputs", ["effort_command"], "", "Inputs that must answer a state before the next step, in lockstep.",
        choices=tuple(kind.value for kind in Input), read_only=True,
    ),
    ParameterSpec(
        "lockstep_subscribers", 1, "-",
        "Subscriptions to joint_states that must be there before the first state, in lockstep.", minimum=0,
        read_only=True,
    ),
    ParameterSpec(
        "lockstep_duration", 0.0, "s",
        "Simulated time after which the plant stops stepping and publishes `lockstep_finished`; 0 for never.",
        minimum=0.0, read_only=True,
    ),
    REALTIME_PRIORITY,
)  # fmt: skip

LIMIT_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        "effort_limit",
        0.0,
        "N m",
        "Largest torque after the sum of controller and disturbance, with which a motor drives; 0 takes that of the "
        "plant file. A motor that turns brakes on top of it: an X5-9 with 11.9 N m at 1 rad/s.",
        minimum=0.0,
        read_only=True,
    ),
    ParameterSpec(
        "command_timeout", 0.05, "s", "Age at which a command expires and the torque goes to zero.", minimum=0.0,
        exclusive_minimum=True, read_only=True,
    ),
    ParameterSpec(
        "velocity_limit", 0.0, "rad/s",
        "Speed at which the armed plant faults, and the largest of a trajectory; 0 for none.", minimum=0.0,
        read_only=True,
    ),
    ParameterSpec(
        "position_window", [0.0, 0.0], "rad",
        "Angles between which the armed plant must stay, [low, high] of each joint; equal for no window.",
        read_only=True,
    ),
    ParameterSpec(
        "effort_slew_limit", 0.0, "N m/s",
        "Largest rate at which the torque rises, away from zero; it falls at once. 0 for none.", minimum=0.0,
        read_only=True,
    ),
    ParameterSpec(
        "handover_time", 0.1, "s", "Time over which torque passes between position and effort control.", minimum=0.0,
        read_only=True,
    ),
    ParameterSpec(
        "handover_effort_limit", 2.0, "N m",
        "A command takes over from position control only if it is this close to the torque that holds.", minimum=0.0,
        exclusive_minimum=True, read_only=True,
    ),
    ParameterSpec(
        "start_effort_limit", 2.0, "N m",
        "Largest torque of each joint with which a commander begins; 0 for none, which the plant logs and reports.",
        minimum=0.0, read_only=True,
    ),
    ParameterSpec(
        "starvation_limit", 0.0, "s",
        "Time without a command after which a plant that is armed for effort disarms; 0 for never.", minimum=0.0,
        read_only=True,
    ),
    ParameterSpec(
        "stop_time",
        0.0,
        "s",
        "Time over which the torque fades to zero at an e-stop and at disarming (stop category 1 of IEC 60204-1); 0 "
        "cuts it at once (category 0), as a fault always does.",
        minimum=0.0,
        maximum=1.0,
        read_only=True,
    ),
    ParameterSpec(
        "enable_timeout", 0.0, "s",
        "With a hold-to-run switch: silence of `enable_input` that disarms, as its release does; 0 for no such switch.",
        minimum=0.0, maximum=1.0, read_only=True,
    ),
    ParameterSpec(
        "tracking_error_limit", 0.3, "rad", "Distance from a trajectory at which the plant faults.", minimum=0.0,
        exclusive_minimum=True, read_only=True,
    ),
)  # fmt: skip


def in_units_of(specs: Iterable[ParameterSpec], coordinates: Coordinates) -> tuple[ParameterSpec, ...]:
    """Return specs with those of ``LIMIT_SPECS`` in the units of a plant's joints."""
    limits = {spec.name for spec in LIMIT_SPECS}
    of_position, of_velocity, _ = coordinates.units
    units = {"rad": of_position, "rad/s": of_velocity, "N m": coordinates.drive_unit, "N m/s": coordinates.slew_unit}
    return tuple(replace(spec, unit=units.get(spec.unit, spec.unit)) if spec.name in limits else spec for spec in specs)


def limits_from_parameters(
    values: Mapping[str, object],
    plant_limits: Vector,
    *,
    push: Vector = (),
    coordinates: Coordinates = ONE_JOINT,
    lockstep: bool,
    feedback_timeout: float = float("inf"),
    least_command_timeout: float = 0.0,
) -> PlantLimits:
    """Return the limits that the parameters of ``LIMIT_SPECS`` describe.

    Args:
        values: Parameter values by name.
        plant_limits: Of the driven joints' commands, in the plant file [N m or N, or V]; parameters only lower them.
        push: As in the limits.
        coordinates: Joints of the plant.
        lockstep: Simulated time, in which noise starts with the controller: their sum is not limited.
        feedback_timeout: Age of a measurement that faults an armed plant [s].
        least_command_timeout: A shorter command timeout is raised to this [s].

    Raises:
        ParameterError: The values contradict each other or the plant.
    """

    def number(name: str) -> float:
        value = values[name]
        assert isinstance(value, float)
        return value

    joints, unit = len(coordinates.joints), coordinates.drive_unit
    window = values["position_window"]
    assert isinstance(window, list)
    if len(window) != 2 * joints and window != [0.0, 0.0]:
        expected = "[low, high] in rad" if joints == 1 else f"{2 * joints}, low and high of each joint"
        raise ParameterError(f"position_window has {len(window)} values; expected {expected}")
    largest = max(plant_limits, default=0.0)
    wanted = number("effort_limit")
    if wanted > largest:
        raise ParameterError(
            f"effort_limit is {wanted} {unit}; expected at most {largest} {unit}, the limit of the plant file"
        )
    unlimited = float("inf")
    ends = [
        (low, high) if low != high else (-unlimited, unlimited)
        for low, high in zip(window[::2], window[1::2], strict=True)
    ]
    if lockstep and number("enable_timeout"):
        raise ParameterError(
            f"enable_timeout is {number('enable_timeout')} s in lockstep; expected 0: a switch is held in real time"
        )
    start, handover = number("start_effort_limit") or unlimited, number("handover_effort_limit")
    return PlantLimits(
        effort=tuple(min(wanted, limit) if wanted else limit for limit in plant_limits),
        command_timeout=max(number("command_timeout"), least_command_timeout),
        feedback_timeout=feedback_timeout,
        velocity=number("velocity_limit") or unlimited,
        position_min=tuple(low for low, _ in ends),
        position_max=tuple(high for _, high in ends),
        slew=number("effort_slew_limit") or unlimited,
        handover_time=number("handover_time"),
        tracking_error=number("tracking_error_limit"),
        handover_effort=handover,
        handover_sum=unlimited if lockstep else handover,
        start_effort=start,
        start_sum=unlimited if lockstep else start,
        starvation=number("starvation_limit") or unlimited,
        stop_time=number("stop_time"),
        enable_timeout=number("enable_timeout") or unlimited,
        push=push,
        coordinates=coordinates,
    )
