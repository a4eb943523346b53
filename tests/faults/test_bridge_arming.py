"""Arming: not with a fault, not with lost settings; and every broken output found in every strategy and phase."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.port.actuator import Feedback, HardwareLimits, MStopAction
from pendulum_hw_bridge.port.gains import GainSet
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.contract.values import JointCommand
from tests.tools.faults.bridge_rig import MILLISECOND, Rig
from tests.tools.faults.node_rig import NodeRig, ros_of_its_own

KINDS = pytest.mark.parametrize("kind", list(EffortStrategy), ids=lambda kind: kind.value)


def disarmed(kind: EffortStrategy = EffortStrategy.DIRECT_PWM) -> Rig:
    """Return a rig at rest that was armed once and is not any more."""
    rig = Rig(kind=kind, start=0.0)
    rig.controlling = rig.disturbing = False
    rig.run(0.05)
    rig.supervisor.disarm(rig.port.now_ns())
    rig.run(0.1)
    return rig


@KINDS
@pytest.mark.parametrize(
    ("fault", "name"),
    [
        (ActuatorFault.M_STOP, "m_stop"),
        (ActuatorFault.VOLTAGE_LOW, "voltage"),
        (ActuatorFault.VOLTAGE_HIGH, "voltage"),
        (ActuatorFault.WINDING_HOT, "over_temperature"),
        (ActuatorFault.OVER_TEMPERATURE_BOARD, "over_temperature"),
        (ActuatorFault.EFFORT_OFFSET, "effort_measured"),
        (ActuatorFault.EFFORT_LIMIT, "firmware_limit"),
        (ActuatorFault.LOCKED_BY_OTHER, "locked_by_other"),
        (ActuatorFault.VELOCITY_NAN, "feedback_not_finite"),
        (ActuatorFault.FEEDBACK_LOST, "feedback_lost"),
        (ActuatorFault.FEEDBACK_FROZEN, "feedback_frozen"),
    ],
)
def test_arming_is_refused_with_a_fault_that_is_there(kind: EffortStrategy, fault: ActuatorFault, name: str) -> None:
    rig = disarmed(kind)
    rig.actuator.inject(fault)
    rig.run(0.1)
    assert name in rig.bridge.prepare()
    assert int(rig.actuator.strategy) == 0
    rig.actuator.clear_faults()
    rig.run(1.5)
    assert rig.bridge.prepare() == ""


def test_a_fault_that_comes_while_settings_are_written_keeps_from_arming() -> None:
    rig = disarmed()
    set_gains = rig.port.set_gains

    def slow(gains: GainSet) -> GainSet:
        rig.clock.wait_until(rig.clock.now_ns() + 30 * MILLISECOND)
        rig.actuator.inject(ActuatorFault.M_STOP)
        return set_gains(gains)

    rig.port.set_gains = slow  # type: ignore[method-assign]
    assert "m_stop" in rig.bridge.prepare()
    assert int(rig.actuator.strategy) == 0


@KINDS
def test_a_module_that_was_without_power_gets_all_settings_again_when_it_is_armed(
    kind: EffortStrategy,
) -> None:
    rig = disarmed(kind)
    before = rig.actuator.limits, rig.actuator.gains
    rig.actuator.inject(ActuatorFault.MODULE_REBOOT)
    assert rig.actuator.limits != before[0]
    assert rig.actuator.gains != before[1]
    rig.actuator.clear_faults()
    rig.run(0.1)
    assert rig.bridge.faults["module_restarted"] == 1
    assert rig.bridge.prepare() == ""
    assert (rig.actuator.limits, rig.actuator.gains) == before


SPOILT: dict[str, Callable[[Rig], None]] = {
    "command lifetime": lambda rig: setattr(rig.port, "set_command_lifetime", lambda lifetime: 0.25),
    "feedback rate": lambda rig: setattr(rig.port, "set_feedback_rate", lambda rate: rate / 2),
    "effort limit": lambda rig: spoil_limits(rig, effort=12.0),
    "velocity limit": lambda rig: spoil_limits(rig, velocity=1.4),
    "pwm limit": lambda rig: spoil_limits(rig, pwm=0.61),
    "position_min": lambda rig: spoil_limits(rig, position_min=-3.0),
    "position_max": lambda rig: spoil_limits(rig, position_max=5.0),
    "motion stop action": lambda rig: spoil_limits(rig, m_stop=MStopAction.DISABLED),
    "position gain kp": lambda rig: spoil_gain(rig, "position", "kp", 1.501),
    "velocity gain max_output": lambda rig: spoil_gain(rig, "velocity", "max_output", 1.0),
    "effort gain kd": lambda rig: spoil_gain(rig, "effort", "kd", 0.0011),
    "effort gain min_output": lambda rig: spoil_gain(rig, "effort", "min_output", -1.0),
}


def spoil_limits(rig: Rig, **changes: object) -> None:
    set_limits = rig.port.set_limits

    def spoilt(limits: HardwareLimits) -> HardwareLimits:
        return replace(set_limits(limits), **changes)  # type: ignore[arg-type]

    rig.port.set_limits = spoilt  # type: ignore[method-assign]


def spoil_gain(rig: Rig, loop: str, name: str, value: float) -> None:
    set_gains = rig.port.set_gains

    def spoilt(gains: GainSet) -> GainSet:
        reads = set_gains(gains)
        return replace(reads, **{loop: replace(reads.loop(loop), **{name: value})})  # type: ignore[arg-type]

    rig.port.set_gains = spoilt  # type: ignore[method-assign]


@pytest.mark.parametrize("setting", list(SPOILT))
def test_arming_is_refused_where_a_setting_reads_back_as_another(setting: str) -> None:
    rig = disarmed()
    rig.module.settings = replace(
        rig.module.settings, limits=replace(rig.module.settings.limits, position_min=-4.0, position_max=4.0)
    )
    SPOILT[setting](rig)
    assert f"{setting} reads back as" in rig.bridge.prepare()
    assert int(rig.actuator.strategy) == 0


def in_phase(phase: str, kind: EffortStrategy, seed: int) -> Rig:
    """Return a rig in regulation, on a ramp or holding its end."""
    if phase == "regulation":
        rig = Rig(seed, kind=kind, start=math.pi)
        rig.run(0.5)
    elif phase == "ramp":
        rig = Rig(seed, kind=kind, moving=True)
        rig.run(1.0)
    else:
        rig = Rig(seed, kind=kind, moving=True, start=0.5, goal=0.7)
        rig.run(1.2)
        assert rig.supervisor.trajectory_finished
    rig.run(float(rig.random.uniform(0.0, 0.02)))
    assert rig.supervisor.mode.armed
    return rig


@KINDS
@pytest.mark.parametrize("phase", ["regulation", "ramp", "hold"])
@pytest.mark.parametrize(
    "fault",
    [
        ActuatorFault.PWM_STUCK,
        ActuatorFault.PWM_RUNAWAY,
        ActuatorFault.STRATEGY_CHANGED,
        ActuatorFault.MODULE_REBOOT,
        ActuatorFault.FEEDBACK_LOST,
        ActuatorFault.FEEDBACK_FROZEN,
        ActuatorFault.COMMANDS_LOST,
    ],
    ids=lambda fault: fault.value,
)
def test_a_broken_output_or_link_ends_torque_in_every_strategy_and_phase(
    kind: EffortStrategy, phase: str, fault: ActuatorFault
) -> None:
    expected = {
        ActuatorFault.PWM_STUCK: {"command_not_in_force", "output_disagreement", "motor_effort"},
        ActuatorFault.PWM_RUNAWAY: {
            "command_not_in_force",
            "output_disagreement",
            "motor_effort",
            "supervisor",
        },
        ActuatorFault.STRATEGY_CHANGED: {"command_not_in_force", "output_disagreement", "motor_effort"},
        ActuatorFault.MODULE_REBOOT: {"module_restarted"},
        ActuatorFault.FEEDBACK_LOST: {"feedback_lost"},
        ActuatorFault.FEEDBACK_FROZEN: {"feedback_frozen"},
        # In hold, the setpoint's own small swing is what does not arrive.
        ActuatorFault.COMMANDS_LOST: {"command_not_in_force", "output_disagreement"},
    }[fault]
    rig = in_phase(phase, kind, seed=21)
    rig.actuator.advance_to(rig.clock.now_ns())
    begin_ns = rig.actuator.now_ns
    rig.actuator.inject(fault)
    rig.run(0.3)
    rig.actuator.advance_to(rig.clock.now_ns())
    driven = [time for time, duty, _ in rig.duties if time > begin_ns and duty != 0.0]
    assert not driven or driven[-1] - begin_ns <= 60 * MILLISECOND
    assert rig.supervisor.mode is Mode.FAULT
    assert next(iter(rig.bridge.faults)) in expected


@KINDS
def test_holding_raises_no_false_alarm_though_nothing_moves(kind: EffortStrategy) -> None:
    rig = in_phase("hold", kind, seed=3)
    rig.run(30.0)
    assert rig.supervisor.mode is Mode.POSITION
    assert not rig.bridge.faults


@pytest.mark.parametrize("seed", range(6))
def test_a_ramp_raises_no_false_alarm(seed: int) -> None:
    rig = Rig(seed, moving=True)
    rig.run(8.0)
    assert not rig.bridge.faults
    assert rig.supervisor.trajectory_finished


def test_records_that_count_on_but_measure_nothing_new_are_frozen() -> None:
    rig = Rig(seed=2)
    rig.run(0.5)
    read = rig.port.read
    first: list[Feedback] = []

    def repeated(timeout: float) -> Feedback | None:
        record = read(timeout)
        if record is None:
            return None
        first.append(record)
        kept = first[0]
        return kept._replace(stamp_ns=record.stamp_ns, hardware_ns=record.hardware_ns, sequence=record.sequence)

    rig.port.read = repeated  # type: ignore[method-assign]
    rig.run(0.06)
    # Whatever else no longer fits: the record itself is told, or what contradicts it first.
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.bridge.last_fault in {"feedback_frozen", "command_not_in_force"}


@pytest.mark.parametrize("state", ["temperature_state", "lock", "position_limit", "velocity_limit", "effort_limit"])
def test_a_state_of_a_newer_firmware_never_ends_in_an_exception(state: str) -> None:
    rig = Rig()
    rig.run(0.3)
    read = rig.port.read

    def unknown(timeout: float) -> Feedback | None:
        record = read(timeout)
        return None if record is None else record._replace(**{state: 77})  # type: ignore[arg-type]

    rig.port.read = unknown  # type: ignore[method-assign]
    rig.run(0.1)
    assert "exception" not in rig.bridge.faults
    # A temperature that is not normal ends driving, whatever its name.
    assert rig.bridge.last_fault == ("over_temperature" if state == "temperature_state" else "")


def test_an_e_stop_while_a_plant_is_prepared_but_not_armed_switches_off_at_once() -> None:
    rig = disarmed()
    assert rig.bridge.prepare() == ""
    assert int(rig.actuator.strategy) != 0
    rig.supervisor.e_stop(rig.port.now_ns())
    rig.run(0.02)
    assert int(rig.actuator.strategy) == 0


@KINDS
def test_nothing_of_the_torque_before_an_e_stop_is_in_the_trajectory_after_it(kind: EffortStrategy) -> None:
    rig = Rig(kind=kind, start=0.0)
    place = rig.actuator.link.position
    rig.actuator.hand = lambda time, position, velocity: -2000.0 * (position - place) - 8.0 * velocity
    rig.disturbing = False
    rig.send = lambda answer: rig._send(JointCommand.of_one(answer.stamp_ns, 8.0, "controller"))
    rig.run(0.3)
    assert rig.outcomes[-1].effort[0] > 5.0
    rig.controlling = False
    rig.supervisor.e_stop(rig.port.now_ns())
    rig.run(0.2)
    rig.actuator.hand = lambda time, position, velocity: 0.0
    rig.run(1.0)
    assert not rig.supervisor.e_stop_reset(rig.port.now_ns())
    assert not rig.bridge.prepare()
    assert not rig.supervisor.arm(rig.port.now_ns(), rig.bridge.sample)
    begin_ns = rig.clock.now_ns()
    # At once, before a cycle of effort control has told the bridge that no torque is in force.
    sample = rig.bridge.sample
    assert sample is not None
    assert not rig.follow(sample.position[0])
    rig.run(0.2)
    duties = [abs(duty) for time, duty, _ in rig.duties if time > begin_ns]
    assert max(duties, default=0.0) / rig.module.mapping.pwm_per_torque() < 0.5


@KINDS
@pytest.mark.parametrize("fault", [ActuatorFault.MODULE_REBOOT, ActuatorFault.M_STOP], ids=lambda fault: fault.value)
def test_a_fault_between_preparing_and_arming_keeps_from_driving(kind: EffortStrategy, fault: ActuatorFault) -> None:
    rig = disarmed(kind)
    before = rig.actuator.limits, rig.actuator.gains
    assert not rig.bridge.prepare()
    rig.actuator.inject(fault)
    # One record, and sooner than the watchdog of the bridge's own pauses.
    rig.run(0.012)
    rig.actuator.clear_faults()
    assert not rig.supervisor.arm(rig.port.now_ns(), rig.bridge.sample)
    rig.run(0.02)
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.bridge.last_fault == "not_prepared"
    assert int(rig.actuator.strategy) == 0
    rig.supervisor.disarm(rig.port.now_ns())
    assert not rig.bridge.prepare()
    assert (rig.actuator.limits, rig.actuator.gains) == before


def test_a_preparation_that_has_lapsed_is_none() -> None:
    rig = disarmed()
    assert not rig.bridge.prepare()
    rig.run(1.1)
    assert not rig.supervisor.arm(rig.port.now_ns(), rig.bridge.sample)
    rig.run(0.05)
    assert rig.supervisor.mode is Mode.FAULT
    assert "not_prepared" in rig.supervisor.reason
    assert int(rig.actuator.strategy) == 0


@KINDS
@pytest.mark.parametrize("delay", [30, 50, 100], ids=lambda delay: f"{delay} ms")
def test_a_module_that_is_slow_to_set_is_armed_and_stays_so(domain_id: int, kind: EffortStrategy, delay: int) -> None:
    with ros_of_its_own(domain_id), NodeRig(kind=kind, start=0.0) as rig:
        rig.controlling = rig.disturbing = False
        rig.run(0.1)
        rig.disarm()
        rig.run(0.1)
        set_limits = rig.port.set_limits

        def slow(limits: HardwareLimits) -> HardwareLimits:
            rig.clock.wait_until(rig.clock.now_ns() + delay * MILLISECOND)
            return set_limits(limits)

        rig.port.set_limits = slow  # type: ignore[method-assign]
        assert rig.arm() == ""
        rig.run(0.1)
        assert rig.supervisor.mode.armed, rig.supervisor.reason


def test_a_drive_that_was_prepared_and_then_not_armed_is_off_at_once(domain_id: int) -> None:
    with ros_of_its_own(domain_id), NodeRig(start=0.0) as rig:
        rig.controlling = rig.disturbing = False
        rig.run(0.1)
        rig.disarm()
        rig.run(0.1)
        sample = rig.bridge.sample
        assert sample is not None
        rig._send(JointCommand.of_one(sample.stamp_ns, 6.0, "/controller"))
        assert "already commands 6.000 N m" in rig.arm()
        assert int(rig.actuator.strategy) == 0
