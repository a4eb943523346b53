"""The bridge's states, each against each input, and hand-over between them, on the emulated actuator."""

import itertools

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.motor_state import MotorState
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import ActuatorError, HardwareLimits, Strategy, no_torque
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Input, Mode, PlantLimits
from pendulum_msgs_py.contract.trajectory import Trajectory, TrajectoryPoint, thesis_ramp
from pendulum_msgs_py.contract.values import JointCommand

SECOND = 1_000_000_000


class Plant:
    """A bridge on the emulator in simulated time, and what a test does with it."""

    def __init__(self, position: float = 0.0, kind: EffortStrategy = EffortStrategy.DIRECT_PWM) -> None:
        parameters = load_emulator("thesis")
        clock = SteppedClock(SECOND)
        self.actuator = EmulatedX5(parameters, seed=1, position=position, start_ns=SECOND)
        self.port = EmulatorBackend(self.actuator, clock)
        limits = PlantLimits(
            effort=(13.0,), feedback_timeout=0.04, velocity=1.5, position_min=(-4.0,), position_max=(4.0,)
        )
        self.supervisor = SharedSupervisor(limits, self._prepare, self._withdraw)
        self.module = DrivenModule(
            self.port,
            EffortMapping(kind, parameters.drivetrain),
            SafetyMonitor(SafetyLimits(), 0.01, parameters.drivetrain),
            BridgeSettings(gains=DEFAULT_GAINS[3]),
        )
        self.bridge = Bridge([self.module], self.supervisor)
        self.bridge.connect()
        self.regulating = False
        self.duties: list[float] = []
        self.cycles(2)

    def _prepare(self) -> str:
        return self.bridge.prepare()

    def _withdraw(self) -> None:
        self.bridge.release()

    def cycles(self, count: int) -> None:
        for _ in range(count):
            while self.bridge.observe(0.02) is None:
                if not self.supervisor.mode.armed:
                    break
            sample = self.bridge.sample
            assert sample is not None
            if self.regulating:
                effort = -33.345 * from_upright(sample.position[0]) - 0.159 * sample.velocity[0]
                self.supervisor.offer(
                    Input.EFFORT_COMMAND, JointCommand.of_one(sample.stamp_ns, effort, "c"), self.port.now_ns()
                )
            outcome = self.bridge.act()
            self.supervisor.report_applied(outcome.effort)
            self.duties.append(self.actuator.link.pwm)

    def arm(self) -> str:
        return self.supervisor.arm(self.port.now_ns(), self.bridge.sample)

    def follow(self, goal: float) -> str:
        sample = self.bridge.sample
        assert sample is not None
        return self.supervisor.accept_trajectory(thesis_ramp(sample.position[0], goal), self.port.now_ns(), sample)

    @property
    def mode(self) -> Mode:
        return self.supervisor.mode


def in_mode(mode: Mode) -> Plant:
    plant = Plant()
    now = plant.port.now_ns()
    if mode in {Mode.POSITION, Mode.EFFORT, Mode.FAULT}:
        assert plant.arm() == ""
    if mode is Mode.POSITION:
        assert plant.follow(1.0) == ""
        plant.cycles(2)
    if mode is Mode.FAULT:
        plant.actuator.inject(ActuatorFault.M_STOP)
        plant.cycles(2)
        plant.actuator.clear_faults()
    if mode is Mode.E_STOP:
        plant.supervisor.e_stop(now)
    plant.cycles(2)
    assert plant.mode is mode
    return plant


@pytest.mark.parametrize("moving", [False, True])
def test_arming_again_before_a_cycle_ends_the_old_drive_before_settings_are_written(moving: bool) -> None:
    plant = Plant()
    assert plant.arm() == ""
    if moving:
        assert plant.follow(1.0) == ""
        plant.cycles(20)
    else:
        sample = plant.bridge.sample
        assert sample is not None
        # Little enough for arming not to be refused because of it.
        command = JointCommand.of_one(sample.stamp_ns, 0.4, "c")
        assert plant.supervisor.offer(Input.EFFORT_COMMAND, command, plant.port.now_ns()) is None
        plant.cycles(2)
    assert plant.actuator.link.pwm != 0.0
    seen: list[Strategy] = []
    set_limits = plant.port.set_limits

    def watch(limits: HardwareLimits) -> HardwareLimits:
        seen.append(plant.actuator.strategy)
        return set_limits(limits)

    plant.port.set_limits = watch  # type: ignore[method-assign]
    plant.supervisor.disarm(plant.port.now_ns())
    assert plant.arm() == ""
    assert seen == [Strategy.OFF]


EXPECTED = {
    # state: (arm, disarm, fault, e_stop, e_stop_reset, trajectory)
    Mode.DISARMED: (Mode.EFFORT, Mode.DISARMED, Mode.DISARMED, Mode.E_STOP, Mode.DISARMED, Mode.DISARMED),
    Mode.EFFORT: (Mode.EFFORT, Mode.DISARMED, Mode.FAULT, Mode.E_STOP, Mode.EFFORT, Mode.POSITION),
    Mode.POSITION: (Mode.POSITION, Mode.DISARMED, Mode.FAULT, Mode.E_STOP, Mode.POSITION, Mode.POSITION),
    Mode.FAULT: (Mode.FAULT, Mode.DISARMED, Mode.FAULT, Mode.E_STOP, Mode.FAULT, Mode.FAULT),
    Mode.E_STOP: (Mode.E_STOP, Mode.E_STOP, Mode.E_STOP, Mode.E_STOP, Mode.DISARMED, Mode.E_STOP),
}
INPUTS = ("arm", "disarm", "fault", "e_stop", "e_stop_reset", "trajectory")


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("what", INPUTS)
def test_every_state_answers_every_input_as_the_diagram_says(mode: Mode, what: str) -> None:
    plant = in_mode(mode)
    now = plant.port.now_ns()
    if what == "arm":
        plant.arm()
    elif what == "disarm":
        plant.supervisor.disarm(now)
    elif what == "fault":
        plant.actuator.inject(ActuatorFault.M_STOP)
    elif what == "e_stop":
        plant.supervisor.e_stop(now)
    elif what == "e_stop_reset":
        plant.supervisor.e_stop_reset(now)
    else:
        sample = plant.bridge.sample
        assert sample is not None
        point = TrajectoryPoint(1.0, sample.position[0], 0.0)
        plant.supervisor.accept_trajectory(Trajectory((point,)), now, sample)
    plant.cycles(3)
    assert plant.mode is EXPECTED[mode][INPUTS.index(what)]
    driving = plant.actuator.strategy is not Strategy.OFF
    assert driving is plant.mode.armed


def test_arming_sets_and_confirms_the_strategy_first() -> None:
    plant = Plant()
    assert plant.actuator.strategy is Strategy.OFF
    assert plant.arm() == ""
    assert plant.actuator.strategy is Strategy.DIRECT_PWM


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (ActuatorFault.COMMANDS_LOST, "did not acknowledge"),
        (ActuatorFault.LOCKED_BY_OTHER, "another sender holds the module"),
        (ActuatorFault.FEEDBACK_LOST, "no new feedback"),
    ],
)
def test_arming_is_refused_while_something_is_wrong(fault: ActuatorFault, reason: str) -> None:
    plant = Plant()
    plant.actuator.inject(fault)
    for _ in range(10):
        plant.bridge.observe(0.02)
    assert reason in plant.arm()
    assert plant.mode is Mode.DISARMED
    assert plant.actuator.strategy is Strategy.OFF


def test_arming_is_refused_while_a_large_command_waits() -> None:
    plant = Plant()
    now = plant.port.now_ns()
    plant.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(now, 5.0, "c"), now)
    assert "already commands 5.000 N m" in plant.arm()
    assert plant.actuator.strategy is Strategy.OFF


def test_preparing_without_arming_ends_by_itself() -> None:
    plant = Plant()
    assert plant.bridge.prepare() == ""
    plant.cycles(50)
    assert plant.actuator.strategy is Strategy.DIRECT_PWM
    plant.cycles(60)
    assert plant.actuator.strategy is Strategy.OFF


@pytest.mark.parametrize("kind", list(EffortStrategy))
def test_control_passes_from_position_to_effort_and_back_without_a_jump(kind: EffortStrategy) -> None:
    plant = Plant(position=UPRIGHT - 0.15, kind=kind)
    assert plant.arm() == ""
    assert plant.follow(UPRIGHT) == ""
    plant.cycles(250)
    assert plant.supervisor.trajectory_finished
    plant.duties.clear()
    plant.regulating = True
    plant.cycles(100)
    assert plant.mode is Mode.EFFORT
    assert plant.follow(UPRIGHT) == ""
    plant.regulating = False
    plant.cycles(50)
    assert plant.mode is Mode.POSITION
    steps = [abs(after - before) for before, after in itertools.pairwise(plant.duties)]
    # 13 N m is a duty of 0.33; one newton metre of jump would be 0.025.
    assert max(steps) < 0.03
    assert abs(plant.actuator.link.position - UPRIGHT) < 0.06


def test_a_settings_that_does_not_read_back_stops_the_connection() -> None:
    plant = Plant()
    plant.port.set_command_lifetime = lambda lifetime: 0.25  # type: ignore[method-assign]
    with pytest.raises(ActuatorError, match=r"command lifetime reads back as 0.25 s; expected 0.05 s"):
        plant.bridge.connect()


def test_joint_offset_and_sign_turn_everything_that_the_joint_sees() -> None:
    plant = Plant(position=0.3)
    plant.module.settings = BridgeSettings(gains=DEFAULT_GAINS[3], joint_sign=-1, joint_offset=1.0)
    plant.cycles(2)
    sample, feedback = plant.bridge.sample, plant.module.feedback
    assert sample is not None
    assert feedback is not None
    assert sample.position[0] == pytest.approx(1.0 - feedback.position)
    assert sample.velocity[0] == -feedback.velocity
    assert plant.arm() == ""
    plant.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(sample.stamp_ns, 1.0, "c"), plant.port.now_ns())
    outcome = plant.bridge.act()
    assert outcome.effort == pytest.approx((1.0,))
    assert outcome.applied[0].command.pwm < 0.0


@pytest.mark.parametrize("kind", list(EffortStrategy))
@pytest.mark.parametrize("voltage", [24.0, 36.0, 48.0])
def test_torque_to_setpoint_and_back(kind: EffortStrategy, voltage: float) -> None:
    mapping = Plant(kind=kind).module.mapping
    moving = MotorState(voltage, 0.3)
    for effort in (-5.0, 0.0, 0.3, 9.0):
        assert mapping.effort_of(mapping.command(effort, moving), moving, 0.7) == pytest.approx(effort, abs=1e-12)
    assert mapping.effort_of(no_torque(mapping.strategy), moving, 0.7) == 0.0


def test_release_never_raises_and_close_may_follow_any_failure() -> None:
    plant = in_mode(Mode.EFFORT)

    def fail() -> None:
        raise OSError("cable cut")

    plant.port.stop = fail  # type: ignore[method-assign]
    plant.bridge.release()
    plant.bridge.close()
    assert plant.bridge.faults == {"exception": 3}
