"""Several joints on the graph: whose numbers are whose is said by names in every message, and never guessed."""

from __future__ import annotations

import math

import pytest

from pendulum_msgs_py.contract import cdr
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joints
from pendulum_msgs_py.contract.commands import CommandGate, Refusal
from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.contract.supervisor import DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.trajectories import from_points

serialization = pytest.importorskip("rclpy.serialization")
JointState = pytest.importorskip("sensor_msgs.msg").JointState
convert = pytest.importorskip("pendulum_msgs_py.ros.convert")

_NOW = 1_000 * NANOSECONDS
_MS = 1_000_000
_TWO = (Joint("shoulder", goal=math.pi), Joint("elbow"))
_ARM = Coordinates(_TWO, (0, 1))
_ACROBOT = Coordinates(_TWO, (1,))
_NAMES = ("shoulder", "elbow")
_SO = "; expected ['shoulder', 'elbow']"


def _command(effort: tuple[float, ...], joints: tuple[str, ...], stamp_ns: int = _NOW) -> JointCommand:
    return JointCommand(stamp_ns, effort, "lqr", joints)


# --- bytes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [_NAMES, ("a", "bc", "def"), ("",) * 4])
@pytest.mark.parametrize("given", [(1, 1, 1), (0, 0, 1), (1, 1, 0), (0, 0, 0)])
@pytest.mark.parametrize("frame", ["", "/sim/controller"])
def test_the_middleware_reads_what_we_write_of_several_joints_and_we_read_what_it_writes(
    names: tuple[str, ...], given: tuple[int, int, int], frame: str
) -> None:
    cdr._known_layouts.clear()
    values = tuple(tuple(10.0 * k + i for i in range(len(names))) * present for k, present in enumerate(given))
    message = JointState(name=list(names))
    message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec = frame, 5, 7
    message.position, message.velocity, message.effort = (list(each) for each in values)
    data = encode_joints(5 * NANOSECONDS + 7, frame, names, *values)
    assert serialization.deserialize_message(data, JointState) == message
    expected = (5 * NANOSECONDS + 7, frame, names, *values)
    # The second time by the layout that the first has left.
    for each in (data, serialization.serialize_message(message)):
        assert decode_joint_state(each) == expected
        assert decode_joint_state(each) == expected


def test_a_message_of_as_many_bytes_with_the_names_the_other_way_round_is_read_by_its_own_names() -> None:
    cdr._known_layouts.clear()
    for names in (("left_", "right"), ("right", "left_"), ("right", "right")):
        fields = decode_joint_state(encode_joints(1, "lqr", names, (), (), (1.0, 2.0)))
        assert fields is not None
        assert (fields.joints, fields.effort) == (names, (1.0, 2.0))


@pytest.mark.parametrize(
    ("names", "position", "velocity", "effort", "problem"),
    [
        (["shoulder", "elbow"], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0], ""),
        (["shoulder", "elbow"], [1.0, 2.0], [3.0, 4.0], [], ""),
        (["elbow", "shoulder"], [1.0, 2.0], [3.0, 4.0], [], "name is ['elbow', 'shoulder']" + _SO),
        (["shoulder"], [1.0], [3.0], [], "name is ['shoulder']" + _SO),
        (["shoulder", "knee"], [1.0, 2.0], [3.0, 4.0], [], "name is ['shoulder', 'knee']" + _SO),
        (["elbow", "elbow"], [1.0, 2.0], [3.0, 4.0], [], "name is ['elbow', 'elbow']" + _SO),
        ([], [1.0, 2.0], [3.0, 4.0], [], "name is []" + _SO),
        (["shoulder", "elbow"], [1.0], [3.0, 4.0], [], "position has 1 values; expected 2"),
        (["shoulder", "elbow"], [1.0, 2.0], [3.0, 4.0, 5.0], [], "velocity has 3 values; expected 2"),
        (["shoulder", "elbow"], [1.0, 2.0], [3.0, 4.0], [5.0], "effort has 1 values; expected 2"),
    ],
)
def test_a_state_of_several_joints_is_believed_in_full_and_in_order_or_not_at_all(
    names: list[str], position: list[float], velocity: list[float], effort: list[float], problem: str
) -> None:
    data = serialization.serialize_message(JointState(name=names, position=position, velocity=velocity, effort=effort))
    sample = convert.sample_from_bytes(data, _NAMES)
    assert convert.problem_of_state(data, _NAMES) == problem
    assert (sample is None) == bool(problem)
    if sample is not None:
        assert sample[1:] == ((1.0, 2.0), (3.0, 4.0), tuple(effort) or (0.0, 0.0))


def test_a_state_of_several_joints_is_none_of_the_pendulum() -> None:
    data = encode_joints(1, "", _NAMES, (1.0, 2.0), (3.0, 4.0))
    assert convert.sample_from_bytes(data) is None
    shown = convert.fields_from_bytes(encode_joints(1, "", _NAMES, (), (), (1.0, 2.0)))
    assert shown is not None
    assert (shown.joints, shown.effort) == (_NAMES, (1.0, 2.0))
    assert convert.fields_from_bytes(b"no message") is None


# --- the gate --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("effort", "joints", "refusal", "problem"),
    [
        ((1.0, 2.0), ("shoulder", "elbow"), None, ""),
        ((1.0, 2.0), ("elbow", "shoulder"), Refusal.OTHER_JOINT, "name is ['elbow', 'shoulder']" + _SO),
        ((1.0, 2.0), ("shoulder", "knee"), Refusal.OTHER_JOINT, "name is ['shoulder', 'knee']" + _SO),
        ((1.0, 2.0), ("elbow", "elbow"), Refusal.OTHER_JOINT, "name is ['elbow', 'elbow']" + _SO),
        ((1.0,), ("shoulder",), Refusal.NOT_ONE_JOINT, "name is ['shoulder']" + _SO),
        ((1.0,), (), Refusal.NOT_ONE_JOINT, "name is []" + _SO),
        ((1.0, 2.0), (), Refusal.NOT_ONE_JOINT, "name is []" + _SO),
        ((1.0, 2.0, 3.0), (*_NAMES, "knee"), Refusal.NOT_ONE_JOINT, "name is ['shoulder', 'elbow', 'knee']" + _SO),
        ((1.0,), ("shoulder", "elbow"), Refusal.NOT_ONE_JOINT, "effort has 1 values; expected 2"),
        ((1.0, 2.0, 3.0), ("shoulder", "elbow"), Refusal.NOT_ONE_JOINT, "effort has 3 values; expected 2"),
        ((1.0, math.nan), ("shoulder", "elbow"), Refusal.NOT_FINITE, "effort is [1.0, nan]; expected finite numbers"),
        ((math.inf, 0.0), ("shoulder", "elbow"), Refusal.NOT_FINITE, "effort is [inf, 0.0]; expected finite numbers"),
    ],
)
def test_a_command_is_for_all_driven_joints_by_name_and_in_order_or_for_none(
    effort: tuple[float, ...], joints: tuple[str, ...], refusal: Refusal | None, problem: str
) -> None:
    gate = CommandGate(0.05, joints=_NAMES)
    assert gate.offer(_command(effort, joints), _NOW) is refusal
    assert dict(gate.refused) == ({} if refusal is None else {refusal: 1})
    assert gate.problems == ({} if refusal is None else {refusal: problem})
    assert (gate.fresh(_NOW) is None) == (refusal is not None)


@pytest.mark.parametrize(
    ("effort", "joints", "filled"),
    [
        ((1.0, 2.0), ("shoulder", "elbow"), (1.0, 2.0)),
        ((1.0,), ("shoulder",), (1.0, 0.0)),
        ((2.0,), ("elbow",), (0.0, 2.0)),
        ((2.0, 1.0), ("elbow", "shoulder"), None),
        ((1.0, 1.0), ("elbow", "elbow"), None),
        ((1.0,), ("knee",), None),
        ((1.0,), (), None),
        ((1.0, 2.0), ("elbow",), None),
        ((math.nan,), ("elbow",), None),
    ],
)
def test_a_disturbance_may_be_for_some_joints_and_the_others_get_nothing(
    effort: tuple[float, ...], joints: tuple[str, ...], filled: tuple[float, ...] | None
) -> None:
    gate = CommandGate(0.05, joints=_NAMES, partial=True)
    assert (gate.offer(_command(effort, joints), _NOW) is None) == (filled is not None)
    fresh = gate.fresh(_NOW)
    assert (None if fresh is None else (fresh.effort, fresh.joints)) == (None if filled is None else (filled, _NAMES))


@pytest.mark.parametrize(("effort", "joints"), [((), ()), ((1.0,), ()), ((1.0,), ("elbow",))])
def test_a_plant_without_a_motor_takes_no_command(effort: tuple[float, ...], joints: tuple[str, ...]) -> None:
    assert CommandGate(0.05, joints=()).offer(_command(effort, joints), _NOW) is Refusal.NOT_ONE_JOINT


# --- the rules -------------------------------------------------------------------------------------------------


class Plant:
    """A plant of two joints that stays where it is."""

    def __init__(self, coordinates: Coordinates = _ARM, **limits: object) -> None:
        self.now = _NOW
        self.position, self.velocity = [0.0, 0.0], [0.0, 0.0]
        usual = {"effort": (5.0, 2.0)[: len(coordinates.driven)], "feedback_timeout": 0.03}
        self.supervisor = PlantSupervisor(PlantLimits(**{**usual, **limits}), coordinates=coordinates)
        assert self.supervisor.arm(self.now, self.sample()) == ""

    def sample(self) -> JointSample:
        return JointSample(self.now, tuple(self.position), tuple(self.velocity), (0.0, 0.0))

    def run(self, *offers: tuple[Input, tuple[float, ...], tuple[str, ...]]):
        self.now += _MS
        for kind, effort, joints in offers:
            self.supervisor.offer(kind, _command(effort, joints, self.now), self.now)
        drive = self.supervisor.decide(self.now, self.sample())
        self.supervisor.report_applied(drive.effort)
        return drive


def test_each_joint_has_its_own_limit_and_the_disturbance_of_one_leaves_the_other_alone() -> None:
    plant = Plant()
    drive = plant.run(
        (Input.EFFORT_COMMAND, (1.0, 1.5), _NAMES),
        (Input.DISTURBANCE, (1.0,), ("elbow",)),
        (Input.PUSH, (0.25,), ("shoulder",)),
    )
    assert (drive.kind, drive.effort, drive.saturated) == (DriveKind.EFFORT, (1.0, 2.0), True)
    assert (drive.controller, drive.disturbance, drive.push) == ((1.0, 1.5), (0.0, 1.0), (0.25, 0.0))
    assert plant.run((Input.EFFORT_COMMAND, (-9.0, -9.0), _NAMES)).effort == (-5.0, -2.0)


def test_the_joints_rise_each_at_the_slew_limit() -> None:
    assert Plant(slew=10.0).run((Input.EFFORT_COMMAND, (5.0, -0.005), _NAMES)).effort == pytest.approx((0.01, -0.005))


def test_a_joint_that_rises_slowly_keeps_no_other_from_falling_at_once() -> None:
    plant = Plant(slew=10.0)
    for _ in range(5):
        plant.run((Input.EFFORT_COMMAND, (0.05, -0.05), _NAMES))
    drive = plant.run((Input.EFFORT_COMMAND, (5.0, 0.0), _NAMES))
    assert drive.effort == pytest.approx((0.06, 0.0))
    assert plant.run((Input.EFFORT_COMMAND, (-5.0, 5.0), _NAMES)).effort == pytest.approx((-0.01, 0.01))


def test_without_a_command_and_after_a_stop_every_joint_is_without_torque() -> None:
    plant = Plant()
    plant.run((Input.EFFORT_COMMAND, (1.0, 1.0), _NAMES))
    plant.now += 100 * _MS
    assert plant.run().effort == (0.0, 0.0)
    plant.supervisor.e_stop(plant.now)
    drive = plant.run((Input.EFFORT_COMMAND, (1.0, 1.0), _NAMES))
    assert (drive.kind, drive.effort) == (DriveKind.OFF, (0.0, 0.0))


@pytest.mark.parametrize(
    ("joint", "what", "value", "reason"),
    [
        (0, "position", 1.5, "position of shoulder is 1.500 rad; expected inside -1.0 to 1.0 rad"),
        (1, "position", -2.5, "position of elbow is -2.500 rad; expected inside -2.0 to 2.0 rad"),
        (1, "velocity", -9.0, "velocity of elbow is -9.000 rad/s; expected at most 8.0 rad/s"),
        (0, "position", math.nan, "measurement is not finite: [nan, 0.0] rad"),
        (1, "velocity", math.inf, "measurement is not finite: [0.0, 0.0] rad, [0.0, inf] rad/s"),
    ],
)
def test_any_joint_that_leaves_its_limits_ends_the_torque_of_all(
    joint: int, what: str, value: float, reason: str
) -> None:
    plant = Plant(position_min=(-1.0, -2.0), position_max=(1.0, 2.0), velocity=8.0)
    assert plant.run((Input.EFFORT_COMMAND, (1.0, 1.0), _NAMES)).effort == (1.0, 1.0)
    getattr(plant, what)[joint] = value
    drive = plant.run((Input.EFFORT_COMMAND, (1.0, 1.0), _NAMES))
    assert (plant.supervisor.mode, drive.effort) == (Mode.FAULT, (0.0, 0.0))
    assert plant.supervisor.reason.startswith(reason)


def test_a_measurement_of_fewer_joints_ends_torque() -> None:
    plant = Plant()
    plant.supervisor.decide(plant.now, JointSample.of_one(plant.now, 0.0, 0.0))
    assert plant.supervisor.mode is Mode.FAULT
    assert plant.supervisor.reason == "measurement has 1 joints; expected 2"


def test_of_an_acrobot_the_elbow_is_commanded_and_either_joint_pushed() -> None:
    plant = Plant(_ACROBOT)
    drive = plant.run((Input.EFFORT_COMMAND, (1.0,), ("elbow",)), (Input.PUSH, (0.5,), ("shoulder",)))
    assert (drive.effort, drive.push) == ((1.0,), (0.5, 0.0))
    assert plant.run((Input.EFFORT_COMMAND, (2.0,), ("shoulder",))).effort == (1.0,)
    assert plant.supervisor.gates[Input.EFFORT_COMMAND].refused == {Refusal.OTHER_JOINT: 1}


def test_a_plant_of_several_joints_follows_no_trajectory_and_says_so() -> None:
    plant = Plant()
    refusal = plant.supervisor.accept_trajectory(
        from_points([0.0, 1.0], [0.0, 0.1], [0.0, 0.0]), plant.now, plant.sample()
    )
    assert refusal == (
        "plant has shoulder, elbow and follows no trajectory; one that does has one joint alone; "
        "expected effort_command"
    )
    assert plant.supervisor.mode is Mode.EFFORT


@pytest.mark.parametrize("limits", [{"effort": (5.0,)}, {"position_min": (-1.0,), "position_max": (1.0,)}])
def test_limits_for_another_number_of_joints_are_refused(limits: dict[str, tuple[float, ...]]) -> None:
    with pytest.raises(ParameterError, match="expected 2"):
        Plant(**limits)


@pytest.mark.parametrize(("low", "high"), [(-1.0, math.inf), (-math.inf, 1.0), (-1.0, 1.0)])
def test_one_window_is_none_for_two_joints_whichever_end_it_has(low: float, high: float) -> None:
    limits = PlantLimits((5.0,), position_min=(low,), position_max=(high,))
    with pytest.raises(ParameterError, match="there are 1 position windows; expected 2"):
        limits.for_joints(2, 1)


def test_a_window_with_one_end_too_few_is_refused() -> None:
    with pytest.raises(ValueError, match="shorter"):
        PlantLimits((5.0,), position_min=(-1.0, -2.0), position_max=(1.0,))


_THREE = (*_TWO, Joint("wrist"))


@pytest.mark.parametrize(("driven", "effort", "largest"), [((0, 1), (5.0, 2.0), 50.0), ((), (), 10.0)])
def test_a_passive_joint_takes_a_push_of_what_the_strongest_motor_could_give_or_of_one_newton_metre(
    driven: tuple[int, ...], effort: tuple[float, ...], largest: float
) -> None:
    supervisor = PlantSupervisor(PlantLimits(effort), coordinates=Coordinates(_THREE, driven))
    supervisor.offer(Input.PUSH, _command((1e9,), ("wrist",)), _NOW)
    still = JointSample(_NOW, *(3 * [(0.0, 0.0, 0.0)]))
    assert supervisor.decide(_NOW, still).push == (0.0, 0.0, largest)


@pytest.mark.parametrize("end", [-1.0, 1.0])
def test_the_joint_that_has_left_its_limits_is_named_and_not_one_that_is_just_there(end: float) -> None:
    plant = Plant(position_min=(-1.0, -1.0), position_max=(1.0, 1.0))
    plant.position = [end, 2.0]
    plant.run()
    assert plant.supervisor.reason.startswith("position of elbow is 2.000 rad")
    plant = Plant(velocity=8.0)
    plant.velocity = [8.0 * end, 9.0]
    plant.run()
    assert plant.supervisor.reason.startswith("velocity of elbow is 9.000 rad/s")


def test_of_a_plant_of_one_joint_nobody_asks_which() -> None:
    supervisor = PlantSupervisor(PlantLimits((5.0,), position_max=(1.0,)))
    assert supervisor.no_trajectories == ""
    assert supervisor.arm(_NOW, JointSample.of_one(_NOW, 0.0, 0.0)) == ""
    supervisor.decide(_NOW, JointSample.of_one(_NOW, 2.0, 0.0))
    assert supervisor.reason.startswith("position is 2.000 rad")


def test_a_disturbance_of_two_joints_for_one_is_not_one_joint() -> None:
    gate = CommandGate(0.05, joints=("elbow",), partial=True)
    assert gate.offer(_command((1.0, 1.0), _NAMES), _NOW) is Refusal.NOT_ONE_JOINT


def test_a_plant_without_a_motor_says_that_it_has_none() -> None:
    gate = CommandGate(0.05, joints=())
    gate.offer(_command((1.0,), ("elbow",)), _NOW)
    assert gate.problems[Refusal.NOT_ONE_JOINT].endswith("expected no command: no joint has a motor")


def test_what_slides_is_asked_for_newtons_and_not_for_a_torque() -> None:
    cart = Coordinates((Joint("cart", unit="m", turns=False), Joint("pole")), (0,))
    plant = Plant(cart, start_effort=1.0, start_sum=1.5)
    plant.run((Input.EFFORT_COMMAND, (2.0,), ("cart",)))
    assert "asks for 2.00 N; expected at most 1.0 N to begin" in plant.supervisor.reason
    plant.run((Input.EFFORT_COMMAND, (1.0,), ("cart",)), (Input.DISTURBANCE, (0.9,), ("cart",)))
    assert "asks for 1.00 N and the disturbance for 0.90 N; expected a sum of at most 1.5 N" in plant.supervisor.reason
    plant.velocity = [math.nan, 0.0]
    plant.run()
    assert plant.supervisor.reason == (
        "measurement is not finite: [0.0, 0.0] m or rad, [nan, 0.0] m/s or rad/s, [0.0, 0.0] N or N m"
    )
    assert Coordinates((Joint("cart", unit="m", turns=False), Joint("pole")), (0, 1)).drive_unit == "N or N m"


def test_a_push_that_is_no_number_is_reported_with_the_units_of_all_joints() -> None:
    plant = Plant(Coordinates((Joint("cart", unit="m", turns=False), Joint("pole")), (0,)))
    units = {kind: gate.unit for kind, gate in plant.supervisor.gates.items()}
    assert units == {Input.EFFORT_COMMAND: "N", Input.DISTURBANCE: "N", Input.PUSH: "N or N m"}
