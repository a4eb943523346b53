"""``adopt``: add arming, limits and an e-stop to a plant that is on the ROS graph already."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from rclpy.clock import Clock, ClockType
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind
from pendulum_msgs_py.contract.timing import SteadyWallClock, Throttle
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PRESET_NAMES, load_plant
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_msgs_py.ros.runner import run_node
from pendulum_sim.stepping.servo import PositionServo

__all__ = ["SPECS", "AdoptNode", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("states", "/joint_states", "", "Topic of its sensor_msgs/JointState.", read_only=True),
    ParameterSpec(
        "commands", "/effort_controller/commands", "", "Topic of its std_msgs/Float64MultiArray.", read_only=True
    ),
    ParameterSpec("joint", JOINT, "", "Name of its joint in the states.", read_only=True),
    ParameterSpec("command_index", 0, "-", "Entry of the commands that is the joint's.", minimum=0, read_only=True),
    ParameterSpec(
        "command_size", 1, "-", "Number of entries of the commands; others are 0.", minimum=1, read_only=True
    ),
    ParameterSpec("sign", 1, "-", "Sign of its angle in ours, 1 or -1.", minimum=-1, maximum=1, read_only=True),
    ParameterSpec("zero", 0.0, "rad", "Its angle when the link hangs.", read_only=True),
    ParameterSpec(
        "plant", "thesis", "",
        f"Preset ({PRESET_NAMES}) or plant file that describes it: limit of torque, and position control.",
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


class AdoptNode(PollingNode):
    """Applies the contract's rules to a plant on the graph.

    Each state is republished with its arrival time, and answered with the torque that the rules allow: zero until
    armed, after a fault or an e-stop, or without commands.
    """

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("simulator", enable_logger_service=True)
        self._settings = NodeParameters(self, SPECS, _check)
        values = self._settings.values
        plant = load_plant(values["plant"])
        self._joint: str = values["joint"]
        self._sign, self._zero = float(values["sign"]), values["zero"]
        self._efforts = [0.0] * values["command_size"]
        self._index: int = values["command_index"]
        late = plant.transport_delay + _LATENESS * values["period"]
        self._servo = PositionServo(plant.with_values(transport_delay=late), values["period"])
        self._clock_ns = SteadyWallClock()
        limits = limits_from_parameters(
            values,
            (plant.effort_limit,),
            lockstep=False,
            feedback_timeout=values["state_timeout"],
            least_command_timeout=_LATENESS * values["period"],
        )
        self._supervisor = SharedSupervisor(limits, self._preflight)
        self._odd: Counter[str] = Counter()
        self._lines = Throttle(1.0)
        self._interface = PlantInterface(
            self, self._supervisor, self._clock_ns, push=False, more_diagnostics=self._diagnostics
        )
        self._interface.hardware_id = f"adopted {values['states']}"
        self._commands = self.create_publisher(Float64MultiArray, values["commands"], 10)
        # As bytes: an unreadable message must not end the node with the e-stop.
        self.create_subscription(JointState, values["states"], self._on_state, _HEARD, raw=True)
        # When states stop, nothing else would remove the torque.
        self.create_timer(
            0.25 * values["state_timeout"], self._on_silence, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.get_logger().info(f"adopts joint {self._joint!r} of {values['states']}, efforts to {values['commands']}")

    def close(self) -> None:
        """Disarm, and send zero efforts: the plant may hold the last one forever."""
        self._interface.safe_stop("adopt ends")
        for _ in range(_LAST_ZEROS):
            self._send(0.0)
            time.sleep(0.01)
        if self._interface.sample is not None:
            self._interface.publish_applied(self._interface.sample.stamp_ns, (0.0,))
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
        (effort,) = drive.effort
        if drive.kind is DriveKind.POSITION and sample is not None:
            (limit,) = self._supervisor.limits.effort
            where, wanted = (sample.position[0], sample.velocity[0]), (drive.position[0], drive.velocity[0])
            effort = self._servo.effort(*where, *wanted, limit=limit)
        others = self.count_publishers(self._settings.values["commands"]) - 1
        if others > 0 and self._supervisor.mode.armed:
            self._supervisor.fault(self._not_alone(others), self._clock_ns())
            effort = 0.0
        self._send(effort)
        if sample is not None:
            self._interface.publish_applied(sample.stamp_ns, (effort,))

    def _send(self, effort: float) -> None:
        self._efforts[self._index] = self._sign * effort
        self._commands.publish(Float64MultiArray(data=self._efforts))

    def _sample(self, message: JointState, now_ns: int) -> JointSample | None:
        if self._joint not in message.name:
            self._refuse(f"a state of {', '.join(message.name) or 'no joint'}; expected {self._joint!r}")
            return None
        i = message.name.index(self._joint)
        if len(message.position) <= i or len(message.velocity) <= i:
            self._refuse(f"a state of {self._joint!r} without position or velocity; expected both")
            return None
        effort = message.effort[i] if len(message.effort) > i else math.nan
        theta = self._sign * (message.position[i] - self._zero)
        if self._interface.sample is not None and math.isfinite(theta):
            # Adopted angles may wrap; the contract's do not.
            before = self._interface.sample.position[0]
            theta = before + wrap(theta - before)
        if math.isnan(effort) and self._interface.sample is None:
            self.get_logger().warning(f"states of {self._joint!r} have no effort: measured torque is NaN from here on")
        sample = JointSample.of_one(now_ns, theta, self._sign * message.velocity[i], self._sign * effort)
        if not sample.is_finite():
            self._refuse("a state is not finite")
            if self._supervisor.mode.armed:
                position, velocity = message.position[i], message.velocity[i]
                self._supervisor.fault(f"its state is not finite: {position} rad, {velocity} rad/s", now_ns)
                self._send(0.0)
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
