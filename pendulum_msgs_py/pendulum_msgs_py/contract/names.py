"""Names on the ROS graph: one definition of each topic, service, joint and node."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

__all__ = [
    "APPLIED_EFFORT",
    "APPLIED_VOLTAGE",
    "ARM",
    "CLOCK",
    "DIAGNOSTICS",
    "DISTURBANCE",
    "EFFORT_COMMAND",
    "EFFORT_TOPICS",
    "ENABLE_INPUT",
    "EVENTS",
    "E_STOP",
    "E_STOP_INPUT",
    "E_STOP_RESET",
    "JOINT",
    "JOINT_STATES",
    "JOINT_TRAJECTORY",
    "LINK",
    "PUSH",
    "RECORDER",
    "SIGNALS",
    "VOLTAGE_COMMAND",
    "VOLTAGE_DISTURBANCE",
    "VOLTAGE_TOPICS",
    "DriveTopics",
    "Event",
    "drive_topics",
    "full_name",
]

JOINT = "pendulum_joint"
LINK = "pendulum_link"

RECORDER = "recorder"
"""Name of the node that records a plant, in the plant's namespace."""

# Relative names: a namespace or a remap swaps the plant.
JOINT_STATES = "joint_states"
EFFORT_COMMAND = "effort_command"
DISTURBANCE = "disturbance"
JOINT_TRAJECTORY = "joint_trajectory"
PUSH = "push"
APPLIED_EFFORT = "applied_effort"
VOLTAGE_COMMAND = "voltage_command"
VOLTAGE_DISTURBANCE = "voltage_disturbance"
APPLIED_VOLTAGE = "applied_voltage"
SIGNALS = (JOINT_STATES, EFFORT_COMMAND, DISTURBANCE, APPLIED_EFFORT)
"""The signals of the control loop, in order; a recording needs all of them."""


class DriveTopics(NamedTuple):
    """Topics that carry a plant's commands in its own unit, so that no volt is read as a newton metre."""

    command: str
    disturbance: str
    applied: str


EFFORT_TOPICS = DriveTopics(EFFORT_COMMAND, DISTURBANCE, APPLIED_EFFORT)
VOLTAGE_TOPICS = DriveTopics(VOLTAGE_COMMAND, VOLTAGE_DISTURBANCE, APPLIED_VOLTAGE)
EVENTS = "events"
E_STOP_INPUT = "e_stop_input"
"""``std_msgs/Bool``, published continuously: true is pressed."""
ENABLE_INPUT = "enable_input"
"""``std_msgs/Bool``, published continuously: true is held."""

# Absolute names, by ROS convention.
DIAGNOSTICS = "/diagnostics"
CLOCK = "/clock"

# Private services of a plant.
ARM = "~/arm"
E_STOP = "~/e_stop"
E_STOP_RESET = "~/e_stop_reset"


def drive_topics(recorded: Collection[str], space: str) -> DriveTopics:
    """Return the topics of commands of a plant in a namespace, by those that were recorded."""
    efforts, volts = ([f"{space}/{name}" in recorded for name in topics] for topics in (EFFORT_TOPICS, VOLTAGE_TOPICS))
    # A command alone may be one that its plant did not receive.
    return VOLTAGE_TOPICS if volts[2] or (volts[0] and not efforts[0] and not efforts[2]) else EFFORT_TOPICS


def full_name(namespace: str, node: str) -> str:
    """Return the full name of a node, such as ``/sim/controller``."""
    return f"{namespace.rstrip('/')}/{node}"


class Event:
    """Names of the events on ``events``, explained in the README."""

    PLANT_MODE = "plant_mode"
    TRAJECTORY_REFUSED = "trajectory_refused"
    TRAJECTORY_FINISHED = "trajectory_finished"
    LOCKSTEP_FINISHED = "lockstep_finished"
    NOISE_START = "noise_start"
    NOISE_END = "noise_end"
    TRIAL_START = "trial_start"
    TRIAL_END = "trial_end"
    TRIAL_FAILED = "trial_failed"
