"""``adopt``: add arming, limits and an e-stop to a plant that is on the ROS graph already."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import Coordinates
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind
from pendulum_msgs_py.contract.timing import SteadyWallClock, Throttle
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample, Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import MECHANISM_PRESETS, PRESET_NAMES, load_mechanism
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_sim.stepping.servo import PositionServo

__all__ = ["SPECS", "AdoptNode", "entries_of", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("states", "/joint_states", "", "Topic of its sensor_msgs/JointState.", read_only=True),
    ParameterSpec(
        "commands", "/effort_controller/commands", "", "Topic of its std_msgs/Float64MultiArray.", read_only=True
    ),
    ParameterSpec(
        "joints", [""], "", "Names of its joints in the states, in the order of a plant of several; -NAME for one that "
        "counts the other way.", read_only=True,
    ),
    ParameterSpec("zeros", [0.0], "rad or m", "Its positions when hanging; one stands for all.", read_only=True),
    ParameterSpec(
        "command_joints", [""], "", "Names of the joints that the entries of the commands stand for; empty for the "
        "driven ones.", read_only=True,
    ),
    ParameterSpec("joint", JOINT, "", "Name of its one joint in the states.", read_only=True),
    ParameterSpec("command_index", 0, "-", "Entry of the commands that is the joint's.", minimum=0, read_only=True),
    ParameterSpec(
        "command_size", 1, "-", "Number of entries of the commands; others are 0.", minimum=1, read_only=True
    ),
    ParameterSpec("sign", 1, "-", "Sign of its angle in ours, 1 or -1.", minimum=-1, maximum=1, read_only=True),
    ParameterSpec("zero", 0.0, "rad", "Its angle when the link hangs.", read_only=True),
    ParameterSpec(
        "plant", "thesis", "",
        f"Preset ({PRESET_NAMES}; of several joints: {', '.join(MECHANISM_PRESETS)}) or plant file that describes it: "
        "joints, limits of effort, and position control of one joint.",
        read_only=True,
    ),
    ParameterSpec(
        "state_timeout", 0.1, "s", "Time without a state after which the armed plant faults.", minimum=0.0,
        exclusive_minimum=True, read_only=True,
    ),
    ParameterSpec(
        "period", 0.01, "s", "Time between two of its states.", minimum=0.0, exclusive_minimum=True, read_only=True
    ),
    *LIMIT_SPECS,
)  # fmt: skip
_LATENESS = 2.0
"""Most periods between a state and the first effect of its command, on a graph."""
_HEARD = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers of either reliability."""
_LAST_ZEROS = 5
"""Zero efforts at the end."""


class _Entries(NamedTuple):
    """Where the adopted plant has what: its n joints by name, with signs and zeros, and the places of m commands."""

    names: tuple[str, ...]
    signs: tuple[float, ...]
    zeros: tuple[float, ...]
    places: tuple[int, ...]
    size: int


def entries_of(values: Mapping[str, Any], coordinates: Coordinates) -> _Entries:
    """Return the entries of parameters; a ParameterError if they do not fit the plant's joints."""
    given, n = [name for name in values["joints"] if name], len(coordinates.joints)
    commanded = [name for name in values["command_joints"] if name]
    if n == 1 and not given and not commanded:
        return _Entries(
            (values["joint"],), (float(values["sign"]),), (values["zero"],), (values["command_index"],),
            values["command_size"],
        )  # fmt: skip
    names = tuple(name.removeprefix("-") for name in given) or coordinates.names
    if len(names) != n or len(set(names)) != n:
        raise ParameterError(f"joints are {', '.join(given)}; expected {n} names, of {coordinates.with_units}")
    driven = [names[index] for index in coordinates.driven]
    commanded = commanded or driven
    if missing := [name for name in driven if name not in commanded]:
        raise ParameterError(
            f"command_joints are {', '.join(commanded)}; expected {missing[0]}, which is driven, in it"
        )
    signs = tuple(-1.0 if name.startswith("-") else 1.0 for name in given) or (1.0,) * n
    places = tuple(commanded.index(name) for name in driven)
    return _Entries(names, signs, coordinates.for_each("zeros", values["zeros"]), places, len(commanded))


class AdoptNode(PollingNode):
    """Applies the contract's rules to a plant on the graph.

    Each state is republished with its arrival time, and answered with the torque that the rules allow: zero until
    armed, after a fault or an e-stop, or without commands.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("simulator", enable_logger_service=True)
        self._settings = NodeParameters(self, SPECS, _check)
        values = self._settings.values
        plant = load_mechanism(values["plant"])
        self._coordinates, self._entries = plant.coordinates, entries_of(values, plant.coordinates)
        self._efforts = [0.0] * self._entries.size
        self._no_effort = (0.0,) * len(plant.coordinates.driven)
        self._servo = None
        if plant.is_pendulum:
            late = plant.transport_delay + _LATENESS * values["period"]
            self._servo = PositionServo(plant.with_values(transport_delay=late), values["period"])
        self._clock_ns = SteadyWallClock()
        limits = limits_from_parameters(
            values,
            plant.command_limits,
            push=plant.effort_limits,
            coordinates=plant.coordinates,
            lockstep=False,
            feedback_timeout=values["state_timeout"],
            least_command_timeout=_LATENESS * values["period"],
        )
        self._supervisor = SharedSupervisor(
            limits, self._preflight, coordinates=plant.coordinates, follows=self._servo is not None
        )
        self._odd: Counter[str] = Counter()
        self._lines = Throttle(1.0)
        self._interface = PlantInterface(
            self, self._supervisor, self._clock_ns, push=False, more_diagnostics=self._diagnostics,
            motor_efforts=plant.voltage_efforts if plant.coordinates.volts else None,
        )  # fmt: skip
        self._interface.hardware_id = f"adopted {values['states']}"
        self._commands = self.create_publisher(Float64MultiArray, values["commands"], 10)
        # As bytes: an unreadable message must not end the node with the e-stop.
        self.create_subscription(JointState, values["states"], self._on_state, _HEARD, raw=True)
        # When states stop, nothing else would remove the torque.
        self.create_timer(
            0.25 * values["state_timeout"], self._on_silence, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._joint = ", ".join(map(repr, self._entries.names))
        self.get_logger().info(
            f"adopts {self._joint} of {values['states']}, {self._coordinates.drive_unit} to {values['commands']}"
        )

    def close(self) -> None:
        """Disarm, and send zero efforts: the plant may hold the last one forever."""
        self._interface.safe_stop("adopt ends")
        for _ in range(_LAST_ZEROS):
            self._send(self._no_effort)
            time.sleep(0.01)
        if self._interface.sample is not None:
            self._interface.publish_applied(self._interface.sample.stamp_ns, self._no_effort)
        self._interface.close()

    def _on_state(self, data: bytes) -> None:
        now_ns = self._clock_ns()
        try:
            message = deserialize_message(data, JointState)
        except Exception as error:  # noqa: BLE001  # what the middleware raises has no common base
            self._refuse(f"a state cannot be read: {error}")
            return
        sample = self._sample(message, now_ns)
        if sample is None:
            return
        self._interface.publish_state(sample)
        self._answer(self._interface.decide(now_ns), sample)

    def _on_silence(self) -> None:
        now_ns = self._clock_ns()
        sample = self._interface.sample
        quiet = 0.5 * self._settings.values["state_timeout"] * NANOSECONDS
        if sample is None or now_ns - sample.stamp_ns > quiet:
            drive = self._interface.decide(now_ns)
            # Without a state only a commanded torque may continue, and only until the state is too old.
            self._answer(drive if drive.kind is DriveKind.EFFORT else Drive(DriveKind.OFF), sample)

    def _answer(self, drive: Drive, sample: JointSample | None) -> None:
        effort = drive.effort
        if drive.kind is DriveKind.POSITION and sample is not None:
            assert self._servo is not None
            (limit,) = self._supervisor.limits.effort
            where, wanted = (sample.position[0], sample.velocity[0]), (drive.position[0], drive.velocity[0])
            effort = (self._servo.effort(*where, *wanted, limit=limit),)
        others = self.count_publishers(self._settings.values["commands"]) - 1
        if others > 0 and self._supervisor.mode.armed:
            self._supervisor.fault(self._not_alone(others), self._clock_ns())
            effort = self._no_effort
        self._send(effort)
        if sample is not None:
            self._interface.publish_applied(sample.stamp_ns, effort)

    def _send(self, effort: Vector) -> None:
        for joint, place, value in zip(self._coordinates.driven, self._entries.places, effort, strict=True):
            self._efforts[place] = self._entries.signs[joint] * value
        self._commands.publish(Float64MultiArray(data=self._efforts))

    def _sample(self, message: JointState, now_ns: int) -> JointSample | None:
        entries, before = self._entries, self._interface.sample
        if missing := [name for name in entries.names if name not in message.name]:
            self._refuse(f"a state of {', '.join(message.name) or 'no joint'}; expected {missing[0]!r}")
            return None
        at = [message.name.index(name) for name in entries.names]
        if len(message.position) <= max(at) or len(message.velocity) <= max(at):
            self._refuse(f"a state of {self._joint} without position or velocity; expected both")
            return None
        measured = len(message.effort) > max(at)
        position, velocity, effort = [], [], []
        for i, (index, joint, sign) in enumerate(zip(at, self._coordinates.joints, entries.signs, strict=True)):
            q = sign * (message.position[index] - entries.zeros[i])
            if before is not None and math.isfinite(q) and joint.unit == "rad":
                # Adopted angles may wrap; the contract's do not.
                q = before.position[i] + wrap(q - before.position[i])
            position.append(q)
            velocity.append(sign * message.velocity[index])
            of_driven = sign * message.effort[index] if measured else math.nan
            effort.append(of_driven if i in self._coordinates.driven else 0.0)
        if not measured and before is None:
            self.get_logger().warning(f"states of {self._joint} have no effort: measured torque is NaN from here on")
        sample = JointSample(now_ns, tuple(position), tuple(velocity), tuple(effort))
        if not sample.is_finite():
            self._refuse("a state is not finite")
            if self._supervisor.mode.armed:
                states = ", ".join(
                    f"{message.position[index]} {joint.unit}, {message.velocity[index]} {joint.velocity_unit}"
                    for index, joint in zip(at, self._coordinates.joints, strict=True)
                )
                self._supervisor.fault(f"its state is not finite: {states}", now_ns)
                self._send(self._no_effort)
                self._interface.decide(now_ns)
            return None
        return sample

    def _refuse(self, problem: str) -> None:
        self._odd[problem] += 1
        if self._lines.ask(time.monotonic()) is not None:
            self.get_logger().warning(f"state refused: {problem}")

    def _not_alone(self, others: int) -> str:
        topic = self._settings.values["commands"]
        return f"{others} other publishers on {topic}; expected none, so that torque comes through the rules alone"

    def _preflight(self) -> str:
        topic = self._settings.values["commands"]
        others = self.count_publishers(topic) - 1
        if others > 0:
            return self._not_alone(others)
        return "" if self.count_subscribers(topic) else f"nobody takes efforts on {topic}"

    def _diagnostics(self) -> Mapping[str, object]:
        values = self._settings.values
        refused = {f"refused_state.{i}": f"{problem} ({count})" for i, (problem, count) in enumerate(self._odd.items())}
        return {"states": values["states"], "commands": values["commands"], "joint": self._joint, **refused}


def _check(values: Mapping[str, object]) -> None:
    if values["sign"] == 0:
        raise ParameterError("sign is 0; expected 1 or -1")
    index, size = values["command_index"], values["command_size"]
    assert isinstance(index, int)
    assert isinstance(size, int)
    if index >= size:
        raise ParameterError(f"command_index is {index}; expected less than command_size, {size}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the supervising node."""
    return run_node(
        AdoptNode,
        argv,
        program="pendulum_sim adopt",
        description="Puts a plant of others, states out and efforts in, behind the contract and its rules.",
        specs=SPECS,
        example="python -m pendulum_sim adopt --ros-args -r __ns:=/sim -p states:=/joint_states -p joint:=hinge",
    )
