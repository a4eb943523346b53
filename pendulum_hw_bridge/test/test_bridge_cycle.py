"""Each rule of the bridge's cycle, on a port that keeps what it is told and answers what a test wants."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, Feedback, HardwareLimits, Strategy
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.drive import Drive, DriveKind
from pendulum_msgs_py.contract.supervisor import Mode, PlantLimits, PlantSupervisor
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.scripted_port import DRIVETRAIN, MILLISECOND, PERIOD, SECOND, STEP, TIMEOUT, Port


class Rig:
    """A bridge on such a port."""

    def __init__(self, kind: EffortStrategy = EffortStrategy.DIRECT_PWM, **settings: Any) -> None:
        self.port = Port()
        self.supervisor = PlantSupervisor(PlantLimits(effort=(8.0,), feedback_timeout=1.0, starvation=100.0))
        self.monitor = SafetyMonitor(
            SafetyLimits(winding_current=0.0, pwm_tolerance=9.0, command_tolerance=9.0), PERIOD, DRIVETRAIN
        )
        self.module = DrivenModule(
            self.port,  # type: ignore[arg-type]
            EffortMapping(kind, DRIVETRAIN, effort_limit=2.0),
            self.monitor,
            BridgeSettings(**settings),
        )
        self.bridge = Bridge([self.module], self.supervisor)
        self.count = 0

    def record(self, **given: Any) -> Feedback:
        """Return one more record of now, a little different from the one before."""
        self.count += 1
        return feedback_record(self.port.time_ns, self.count, **{"voltage": 32.0, "deflection": self.count, **given})

    def see(self, after_ns: int = STEP, **given: Any) -> Feedback | None:
        """Let a record come and the bridge observe it."""
        self.port.time_ns += after_ns
        self.port.records.append(self.record(**given))
        return None if self.bridge.observe(0.01) is None else self.module.feedback

    def connected(self) -> Rig:
        """Connect and see a record."""
        self.bridge.connect()
        assert self.see() is not None
        return self

    def armed(self) -> Rig:
        """Connect, see a record, prepare and arm."""
        self.connected().prepare_and_arm()
        self.port.calls.clear()
        return self

    def released_and_armed_again(self) -> None:
        self.bridge.release()
        self.supervisor.disarm(self.port.time_ns)
        self.see()
        self.prepare_and_arm()

    def prepare_and_arm(self) -> None:
        assert self.bridge.prepare() == ""
        assert self.supervisor.arm(self.port.time_ns, self.bridge.sample) == ""

    def drive(self, effort: float = 1.0, **given: Any) -> Any:
        return self.bridge.carry_out(Drive(DriveKind.EFFORT, effort=(effort,), **given), was_armed=True)


OFF = Drive(DriveKind.OFF)


# --- connecting and preparing ----------------------------------------------------------------------------------


def test_it_connects_switches_off_sets_everything_and_asks_again_who_it_is() -> None:
    rig = Rig()
    assert rig.bridge.connect() == (rig.module.info,) == ("connected 2",)
    assert rig.port.calls == ["connect", "strategy 0", "limits", "gains", "connect"]
    # The loops are limited as for the highest supply there may be, as long as none was measured.
    assert rig.port.gains == rig.module.mapping.limited_gains(50.0)
    assert rig.module._output.gains == rig.port.gains


def test_a_module_that_does_not_switch_off_is_not_connected() -> None:
    rig = Rig()
    rig.port.reads_strategy = Strategy.DIRECT_PWM
    with pytest.raises(ActuatorError, match=r"strategy reads back as DIRECT_PWM \(1\); expected OFF \(0\)"):
        rig.bridge.connect()


def test_a_drive_is_prepared_with_settings_of_the_measured_supply_and_zero_torque() -> None:
    rig = Rig()
    rig.bridge.connect()
    assert rig.bridge.prepare() == "no feedback yet"
    rig.see()
    rig.port.calls.clear()
    assert rig.bridge.prepare() == ""
    assert rig.port.calls == ["limits", "gains", "strategy 1"]
    assert rig.port.commands[-1].pwm == 0.0
    assert rig.port.gains == rig.module.mapping.limited_gains(32.0)


@pytest.mark.parametrize("fault", ["host_stalled", ""])
def test_a_drive_that_is_prepared_during_a_stop_of_category_1_waits_while_it_went_on_to_fade(fault: str) -> None:
    rig = Rig().armed()
    rig.supervisor.limits = replace(rig.supervisor.limits, stop_time=1.0)
    rig.supervisor.report_applied((1.0,))
    rig.supervisor.disarm(rig.port.time_ns)
    rig.see()
    assert rig.bridge.act().effort[0] > 0.9
    if fault:
        rig.bridge.fail(fault, "did not run")
    rig.see()
    assert rig.bridge.prepare() == ""
    rig.see()
    assert rig.bridge.act().drive.kind is DriveKind.OFF
    assert rig.port.commands[-1].pwm == 0.0
    assert rig.supervisor.arm(rig.port.time_ns, rig.bridge.sample) == ""
    assert rig.bridge.act().fault == ""


def test_setpoints_that_a_port_keeps_count_as_in_force_from_when_they_left(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig().armed()
    rig.see()
    sent_ns = rig.port.time_ns

    def flush() -> None:
        rig.port.time_ns += 7 * MILLISECOND

    monkeypatch.setattr(rig.port, "flush", flush, raising=False)
    rig.drive()
    # A record of before may still show what was in force until then.
    assert [times[:2] for times in rig.monitor._sent][-1] == (sent_ns, sent_ns + 7 * MILLISECOND)


def test_a_drive_is_not_prepared_with_a_present_fault() -> None:
    rig = Rig()
    rig.bridge.connect()
    rig.see(m_stop=True)
    rig.port.calls.clear()
    assert "m_stop" in rig.bridge.prepare()
    rig.see()
    rig.port.time_ns += TIMEOUT + 1
    assert "feedback_lost" in rig.bridge.prepare()
    # Nor is anything set, not even for a moment.
    assert rig.port.calls == ["read 0.01"]
    rig.see()
    assert rig.bridge.prepare() == ""


@pytest.mark.parametrize("call", ["limits", "gains", "strategy 1"])
def test_a_setting_that_is_refused_leaves_the_drive_off(call: str) -> None:
    rig = Rig().connected()
    rig.port.fails[call] = ActuatorError("no_acknowledgement", "did not acknowledge")
    rig.port.calls.clear()
    assert rig.bridge.prepare() == "did not acknowledge"
    assert rig.port.strategy is Strategy.OFF
    # What was not begun needs no stop; a strategy may have arrived though it was not confirmed.
    assert ("stop" in rig.port.calls) == (call == "strategy 1")
    assert not rig.bridge._driving


def test_settings_that_took_longer_than_a_period_are_followed_by_a_look_at_the_feedback() -> None:
    for slow_ns, looks in ((STEP, 0), (STEP + 1, 1)):
        rig = Rig().connected()
        rig.port.takes["strategy 1"] = slow_ns
        rig.port.time_ns += MILLISECOND
        rig.port.records = [rig.record(m_stop=True)]
        rig.port.time_ns -= MILLISECOND
        rig.port.calls.clear()
        refusal = rig.bridge.prepare()
        assert [call for call in rig.port.calls if call.startswith("read")] == [f"read {3 * PERIOD}"] * looks
        assert ("m_stop" in refusal) == bool(looks)
        assert (rig.port.strategy is Strategy.OFF) == bool(looks)


def test_feedback_that_stays_away_while_settings_are_written_refuses() -> None:
    rig = Rig().connected()
    rig.port.takes["strategy 1"] = TIMEOUT + 1
    assert "feedback_lost" in rig.bridge.prepare()
    assert rig.port.strategy is Strategy.OFF


def test_whenever_feedback_gets_too_old_while_preparing_a_refused_drive_is_off() -> None:
    refused = set()
    for early_ns in range(20):
        rig = Rig().connected()
        rig.port.tick_ns = 1
        rig.port.takes.update({"strategy 1": 2 * STEP, "read": STEP - early_ns})
        refusal = rig.bridge.prepare()
        assert (rig.port.strategy is Strategy.DIRECT_PWM) == (refusal == "")
        refused.add(refusal[:13])
    assert refused == {"", "feedback_lost"}


def test_a_read_that_fails_while_preparing_releases_and_says_why() -> None:
    rig = Rig().connected()
    rig.port.takes["strategy 1"] = STEP + 1
    rig.port.fails["read"] = ActuatorError("module_lost", "gone")
    assert rig.bridge.prepare() == "released again: module_lost"
    assert rig.port.strategy is Strategy.OFF


def test_a_preparation_lasts_a_second_and_ends_behind_an_e_stop_or_an_armed_drive() -> None:
    for after_ns, driving in ((SECOND, True), (SECOND + 1, False)):
        rig = Rig().connected()
        assert rig.bridge.prepare() == ""
        rig.bridge._turn_ns = rig.port.time_ns = rig.port.time_ns + after_ns
        assert rig.bridge.carry_out(OFF).effort == (0.0,)
        assert (rig.port.strategy is Strategy.DIRECT_PWM) == driving
    rig = Rig().connected()
    assert rig.bridge.prepare() == ""
    rig.supervisor.e_stop(rig.port.time_ns)
    rig.bridge.carry_out(OFF)
    assert rig.port.strategy is Strategy.OFF
    rig = Rig().armed()
    rig.supervisor.disarm(rig.port.time_ns)
    rig.bridge.carry_out(OFF, was_armed=True)
    assert rig.port.strategy is Strategy.OFF


def test_a_preparation_that_was_used_is_none_any_more() -> None:
    rig = Rig().armed()
    rig.drive()
    rig.supervisor.disarm(rig.port.time_ns)
    rig.bridge.carry_out(OFF)
    assert rig.port.strategy is Strategy.OFF


def test_connecting_again_ends_a_drive() -> None:
    rig = Rig().armed()
    rig.bridge.connect()
    assert rig.port.strategy is Strategy.OFF
    assert not rig.bridge._driving


# --- release ---------------------------------------------------------------------------------------------------


def test_a_stop_that_fails_is_counted_put_into_the_fault_state_and_asked_again_after_a_tenth_of_a_second() -> None:
    rig = Rig().armed()
    rig.port.fails["stop"] = ActuatorError("stop_unacknowledged", "not confirmed")
    assert not rig.bridge.stop_pending
    rig.bridge.release()
    assert rig.bridge.stop_pending
    assert rig.bridge.last_fault == "stop_unacknowledged"
    assert rig.bridge.faults == {"stop_unacknowledged": 1}
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.supervisor.reason == "stop_unacknowledged: not confirmed"
    asked = rig.port.calls.count("stop")
    rig.port.time_ns += SECOND // 10 - 1
    rig.bridge.carry_out(OFF)
    assert rig.port.calls.count("stop") == asked
    rig.port.time_ns += 1
    rig.port.fails["stop"] = OSError("cable cut")
    rig.bridge.carry_out(OFF)
    assert rig.port.calls.count("stop") == asked + 1
    assert rig.bridge.faults == {"stop_unacknowledged": 1, "exception": 1}
    # The first is what it is about.
    assert rig.bridge.last_fault == "stop_unacknowledged"
    rig.port.fails.clear()
    rig.bridge.release()
    assert not rig.bridge.stop_pending


def test_before_preparing_a_pending_stop_is_asked_for_once_more() -> None:
    rig = Rig().armed()
    rig.port.fails["stop"] = ActuatorError("stop_unacknowledged", "not confirmed")
    rig.bridge.release()
    assert rig.bridge.prepare() == "the module has not confirmed that it is off"
    rig.port.fails.clear()
    rig.supervisor.disarm(rig.port.time_ns)
    assert rig.bridge.prepare() == ""


def test_closing_disarms_and_releases_whatever_fails() -> None:
    rig = Rig().armed()
    rig.port.fails["close"] = ActuatorError("module_lost", "gone")
    rig.bridge.close()
    assert rig.supervisor.mode is Mode.DISARMED
    assert rig.port.calls == ["stop", "close"]
    assert rig.bridge.faults == {"module_lost": 1}
    rig.port.fails["close"] = OSError("cable cut")
    rig.bridge.close()
    assert rig.bridge.faults == {"module_lost": 1, "exception": 1}


def test_a_fault_while_nothing_drives_and_nobody_is_armed_counts_for_nothing() -> None:
    rig = Rig()
    rig.bridge.connect()
    rig.port.calls.clear()
    rig.bridge.fail("m_stop", "pressed")
    assert rig.bridge.faults == {}
    assert rig.port.calls == []
    assert rig.supervisor.mode is Mode.DISARMED


def test_a_fault_of_a_prepared_drive_releases_it_without_the_fault_state_and_of_an_armed_one_with() -> None:
    rig = Rig().connected()
    assert rig.bridge.prepare() == ""
    rig.bridge.fail("m_stop", "pressed")
    assert rig.supervisor.mode is Mode.DISARMED
    assert rig.port.strategy is Strategy.OFF
    rig = Rig().armed()
    for _ in range(2):
        rig.bridge.fail("m_stop", "pressed")
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.supervisor.reason == "m_stop: pressed"
    assert (rig.bridge.last_fault, rig.bridge.faults) == ("m_stop", {"m_stop": 1})
    assert rig.port.calls == ["stop"]


def test_a_stop_that_fails_on_top_of_a_fault_does_not_hide_it() -> None:
    rig = Rig().armed()
    rig.port.fails["stop"] = OSError("cable cut")
    rig.bridge.fail("m_stop", "pressed")
    assert rig.supervisor.reason == "m_stop: pressed"
    assert rig.bridge.last_fault == "m_stop"
    assert rig.bridge.faults == {"m_stop": 1, "exception": 1}


def test_a_bridge_that_closes_says_that_a_module_did_not_confirm_its_stop() -> None:
    rig = Rig().armed()
    rig.port.fails["stop"] = ActuatorError("stop_unacknowledged", "press the motion stop")
    rig.bridge.close()
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.supervisor.reason == "stop_unacknowledged: press the motion stop"
    assert rig.bridge.faults == {"stop_unacknowledged": 1}


@pytest.mark.parametrize(("tell", "told"), [("fault", "fail"), ("disarm", "close")])
def test_the_drive_is_off_before_the_supervisor_is_reported_which_may_have_to_be_waited_for(
    tell: str, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig().armed()
    seen: list[Strategy] = []

    def held(*_: object) -> None:
        seen.append(rig.port.strategy)
        raise RuntimeError("held by another")

    monkeypatch.setattr(type(rig.supervisor), tell, held)
    with pytest.raises(RuntimeError, match="held by another"):
        getattr(rig.bridge, told)(*(("m_stop", "pressed") if told == "fail" else ()))
    assert seen == [Strategy.OFF]


def test_a_fault_wins_over_a_disarm_that_comes_while_the_drive_stops_and_is_stamped_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig().armed()
    stamps: list[int] = []
    fault, stop = rig.supervisor.fault, rig.port.stop

    def slow_stop() -> None:
        stop()
        rig.port.time_ns += 45_000_000
        rig.supervisor.disarm(rig.port.time_ns, "asked")

    monkeypatch.setattr(rig.port, "stop", slow_stop)
    monkeypatch.setattr(rig.supervisor, "fault", lambda reason, now_ns: (stamps.append(now_ns), fault(reason, now_ns)))
    rig.bridge.fail("m_stop", "pressed")
    assert (rig.supervisor.mode, rig.supervisor.reason) == (Mode.FAULT, "m_stop: pressed")
    assert stamps == [rig.port.time_ns]


# --- observing -------------------------------------------------------------------------------------------------


def test_a_good_record_becomes_the_sample_and_a_repeated_one_does_not() -> None:
    rig = Rig(joint_sign=-1, joint_offset=0.5, effort_tare=0.25)
    rig.bridge.connect()
    record = rig.see(position=0.25, velocity=0.125, effort=2.0)
    assert rig.module.feedback is record is not None
    sample = rig.bridge.sample
    assert sample is not None
    assert sample == (record.stamp_ns, (0.25,), (-0.125,), (-2.25,))
    rig.port.records = [record._replace(position=9.0), None]
    assert rig.bridge.observe(0.01) is None
    assert rig.bridge.observe(0.02) is None
    assert rig.bridge.sample is sample
    assert rig.port.calls[-2:] == ["read 0.01", "read 0.02"]
    rig = Rig(joint_sign=1, joint_offset=0.5, effort_tare=0.25)
    rig.see(position=0.25, velocity=0.125, effort=2.0)
    assert rig.bridge.sample is not None
    assert rig.bridge.sample[1:] == ((0.75,), (0.125,), (1.75,))


def test_the_motor_watch_sees_each_record() -> None:
    rig = Rig()
    rig.see(voltage=40.0)
    assert rig.module._motor.state.voltage == 40.0
    assert rig.monitor.output is rig.module._output
    assert (
        DrivenModule(
            rig.port,  # type: ignore[arg-type]
            rig.module.mapping,
            rig.monitor,
            BridgeSettings(limits=HardwareLimits(pwm=0.25)),
        )._output._pwm_limit
        == 0.25
    )


def test_a_fault_of_a_record_ends_driving_and_arming_but_is_none_while_at_rest() -> None:
    rig = Rig()
    rig.bridge.connect()
    assert rig.see(m_stop=True) is not None
    assert rig.bridge.faults == {}
    rig = Rig().armed()
    rig.see(m_stop=True)
    assert rig.bridge.faults == {"m_stop": 1}
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.port.strategy is Strategy.OFF
    # Armed, but released meanwhile by somebody else.
    rig = Rig().armed()
    rig.bridge.release()
    rig.see(m_stop=True)
    assert rig.supervisor.mode is Mode.FAULT


def test_a_restart_is_counted_even_at_rest() -> None:
    rig = Rig()
    rig.see()
    rig.see(hardware_ns=1)
    assert rig.bridge.faults == {"module_restarted": 1}
    rig.see(m_stop=True, hardware_ns=2)
    assert rig.bridge.faults == {"module_restarted": 1}


def test_feedback_that_stays_away_ends_an_armed_drive_and_is_none_at_rest() -> None:
    rig = Rig()
    rig.see()
    rig.port.time_ns += 2 * TIMEOUT
    assert rig.bridge.observe(0.01) is None
    assert rig.bridge.faults == {}
    rig = Rig().armed()
    for _ in range(3):
        rig.port.time_ns += STEP
        assert rig.bridge.observe(0.01) is None
    assert rig.supervisor.mode is Mode.EFFORT
    rig.port.time_ns += 1
    assert rig.bridge.observe(0.01) is None
    assert rig.bridge.last_fault == "feedback_lost"
    assert rig.supervisor.mode is Mode.FAULT


def test_feedback_that_seemed_lost_and_comes_late_is_reported_so_once_in_the_fault_state_only() -> None:
    def late(rig: Rig) -> None:
        rig.port.time_ns += TIMEOUT + 2 * STEP
        rig.port.records.append(rig.record(hardware_ns=rig.port.time_ns - TIMEOUT - MILLISECOND))
        rig.bridge.observe(0.01)

    rig = Rig().armed()
    rig.port.takes["read"] = TIMEOUT // 2
    for _ in range(3):
        rig.bridge.observe(0.01)
    rig.port.takes.clear()
    assert rig.bridge.last_fault == "feedback_lost"
    assert rig.supervisor.reason.startswith("feedback_lost: ")
    # What came in time is no news.
    assert rig.see() is not None
    assert rig.bridge.last_fault == "feedback_lost"
    for _ in range(2):
        late(rig)
        assert rig.bridge.last_fault == "feedback_late"
        assert rig.supervisor.reason.startswith("feedback_late: feedback is 48 ms late")
        assert rig.bridge.faults == {"feedback_lost": 1, "feedback_late": 1}
    # Acknowledged, the plant is disarmed for the reason that it was.
    rig = Rig().armed()
    rig.bridge.fail("feedback_lost", "gone")
    rig.supervisor.disarm(rig.port.time_ns, "acknowledged")
    late(rig)
    assert (rig.bridge.last_fault, rig.supervisor.reason) == ("feedback_late", "acknowledged")
    # Nor does it hide a stop that nobody confirmed since.
    rig = Rig().armed()
    rig.bridge.fail("feedback_lost", "gone")
    rig.supervisor.disarm(rig.port.time_ns, "acknowledged")
    rig.port.fails["stop"] = ActuatorError("stop_unacknowledged", "press the motion stop")
    rig.bridge.release()
    late(rig)
    assert rig.supervisor.reason == "stop_unacknowledged: press the motion stop"
    # A late record after another fault explains nothing.
    rig = Rig().armed()
    rig.bridge.fail("m_stop", "pressed")
    late(rig)
    assert (rig.bridge.last_fault, rig.supervisor.reason) == ("m_stop", "m_stop: pressed")
    assert rig.bridge.faults == {"m_stop": 1}


def test_a_port_that_fails_to_read_is_a_fault_by_its_name() -> None:
    rig = Rig().armed()
    rig.port.fails["read"] = ActuatorError("module_lost", "gone")
    assert rig.bridge.observe(0.01) is None
    assert rig.bridge.last_fault == "module_lost"
    assert rig.supervisor.mode is Mode.FAULT


@pytest.mark.parametrize(("pause_ns", "fault"), [(TIMEOUT, ""), (TIMEOUT + 1, "host_stalled")])
def test_a_pause_before_or_in_a_read_or_before_driving_is_a_stall_beyond_the_timeout(pause_ns: int, fault: str) -> None:
    before = Rig().armed()
    before.see(pause_ns)
    within = Rig().armed()
    within.port.takes["read"] = pause_ns
    within.port.records = [within.record(stamp_ns=within.port.time_ns + pause_ns)]
    within.bridge.observe(0.01)
    ahead = Rig().armed()
    ahead.port.time_ns += pause_ns
    outcome = ahead.drive(push=(0.5,))
    for rig in (before, within, ahead):
        assert rig.bridge.last_fault == fault
        assert rig.bridge._driving == (not fault)
    assert outcome.fault == fault
    assert (outcome.drive.kind is DriveKind.OFF) == bool(fault)
    assert outcome.drive.push == (0.5,)
    assert (not outcome.applied) == bool(fault)
    assert outcome.effort == (0.0 if fault else 1.0,)
    assert ahead.port.commands[-1].pwm == (0.0 if fault else 0.25)


def test_a_pause_and_a_wait_within_the_timeout_each_are_no_stall() -> None:
    rig = Rig().armed()
    rig.port.takes["read"] = 2 * STEP
    rig.port.time_ns += 2 * STEP
    rig.port.records = [rig.record(stamp_ns=rig.port.time_ns + 2 * STEP)]
    assert rig.bridge.observe(0.01) is not None
    assert rig.bridge.faults == {}


def test_at_rest_a_pause_is_no_stall_and_the_first_turn_has_none_before_it() -> None:
    rig = Rig()
    rig.bridge.connect()
    for _ in range(3):
        rig.see(10 * TIMEOUT)
        rig.bridge.carry_out(OFF)
    assert rig.bridge.faults == {}
    assert rig.bridge._turn()


# --- driving ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
def test_a_torque_is_sent_in_the_motors_sign_and_reported_in_the_joints(sign: int) -> None:
    rig = Rig(joint_sign=sign).armed()
    outcome = rig.drive(1.0, push=(0.5,))
    assert rig.port.pushes == [0.5]
    assert rig.port.commands[-1].pwm == sign * 0.25
    assert outcome.effort == (1.0,)
    assert outcome.fault == ""
    assert len(outcome.applied) == 1
    # No more than the limit of 2 N m leaves, half of what the supply could make.
    assert rig.drive(9.0).effort == (2.0,)
    assert rig.port.calls == ["write", "write"]
    assert rig.drive(1.0, starved=True).effort == (0.0,)
    assert rig.port.commands[-1].pwm == 0.0


def test_a_port_without_a_hand_is_not_pushed() -> None:
    rig = Rig().armed()
    rig.port.push = None  # type: ignore[assignment,method-assign]
    assert rig.drive().effort == (1.0,)


def test_what_is_sent_is_what_the_monitor_compares() -> None:
    rig = Rig().armed()
    rig.drive(1.0)
    sent_ns, _, command = rig.monitor._sent[-1]
    assert (sent_ns, command.pwm) == (rig.port.time_ns, 0.25)
    assert rig.monitor._strategy is Strategy.DIRECT_PWM
    rig.bridge.release()
    assert rig.monitor._strategy is Strategy.OFF


def test_an_armed_plant_without_a_prepared_drive_is_a_fault_that_names_what_released_it() -> None:
    rig = Rig().connected()
    assert rig.supervisor.arm(rig.port.time_ns, rig.bridge.sample) == ""
    outcome = rig.drive(1.0, push=(0.5,))
    told = (outcome.drive.kind, outcome.drive.push, outcome.effort, outcome.fault)
    assert told == (DriveKind.OFF, (0.5,), (0.0,), "not_prepared")
    assert rig.supervisor.reason == ("not_prepared: drive was released before it was armed; disarm, then arm again")
    assert rig.port.strategy is Strategy.OFF
    rig.supervisor.disarm(rig.port.time_ns)
    rig.bridge.last_fault = "m_stop"
    assert rig.supervisor.arm(rig.port.time_ns, rig.bridge.sample) == ""
    rig.drive(1.0)
    assert "before it was armed: m_stop; disarm" in rig.supervisor.reason


def test_without_feedback_nothing_is_driven() -> None:
    rig = Rig().armed()
    rig.module.feedback = None
    rig.port.calls.clear()
    assert not rig.drive().applied
    assert "write" not in rig.port.calls


def test_a_command_that_cannot_be_sent_is_a_fault_by_its_name() -> None:
    rig = Rig().armed()
    rig.port.fails["write"] = ActuatorError("send_failed", "network down")
    outcome = rig.drive(1.0, push=(0.5,))
    told = (outcome.drive.kind, outcome.drive.push, outcome.effort, outcome.fault)
    assert told == (DriveKind.OFF, (0.5,), (0.0,), "send_failed")
    assert rig.supervisor.reason == "send_failed: network down"
    assert rig.port.strategy is Strategy.OFF


def test_acting_asks_the_supervisor_and_counts_a_fault_of_its_own() -> None:
    rig = Rig().armed()
    outcome = rig.bridge.act()
    assert outcome.drive.starved
    assert outcome.effort == (0.0,)
    # The pendulum is outside its window from now on.
    rig.supervisor.limits = replace(rig.supervisor.limits, position_min=(0.5,))
    outcome = rig.bridge.act()
    assert rig.supervisor.mode is Mode.FAULT
    assert outcome.fault == rig.bridge.last_fault == "supervisor"
    assert rig.bridge.faults == {"supervisor": 1}
    assert rig.port.strategy is Strategy.OFF
    # In the fault state it is told no more.
    rig.port.calls.clear()
    assert rig.bridge.act().fault == ""
    assert rig.port.calls == []


def test_disarming_is_no_fault() -> None:
    rig = Rig().armed()
    rig.supervisor.disarm(rig.port.time_ns)
    assert rig.bridge.carry_out(OFF, was_armed=True).fault == ""
    assert rig.bridge.faults == {}


# --- position control ------------------------------------------------------------------------------------------


def position(rig: Rig, **given: float) -> Command:
    """Carry out one decision of position control and return what was sent."""
    setpoints = {name: (given.pop(name, 0.0),) for name in ("position", "velocity")}
    rig.bridge.carry_out(Drive(DriveKind.POSITION, **setpoints, **given), was_armed=True)
    return rig.port.commands[-1]


@pytest.mark.parametrize("sign", [1, -1])
def test_a_setpoint_goes_out_in_the_motors_angle_with_a_dither_that_turns_each_time(sign: int) -> None:
    rig = Rig(joint_sign=sign, joint_offset=0.5).armed()
    dither = rig.module.mapping.dither
    assert dither > 0.0
    for turn in (-1.0, 1.0, -1.0):
        command = position(rig, position=1.5, velocity=0.125)
        assert command.position == sign * 1.0 + turn * dither
        assert command.velocity == sign * 0.125
    assert rig.port.strategy is Strategy.PARALLEL_PWM
    assert rig.port.calls == ["strategy 3", "write", "write"]


@pytest.mark.parametrize("sign", [1, -1])
def test_the_torque_in_force_passes_into_position_control_and_fades(sign: int) -> None:
    rig = Rig(joint_sign=sign).armed()
    rig.drive(1.0)
    rig.see(velocity=sign * 0.125, pwm_command=sign * 0.375)
    mapping, state = rig.module.mapping, rig.module._motor.state
    offset, speed = mapping.handover(sign * 1.0, sign * 0.375, sign * 0.125, state)
    assert sign * offset > 0.0
    dither = mapping.dither
    command = position(rig, handover=1.0)
    assert command.position == pytest.approx(offset - dither)
    assert command.velocity == pytest.approx(speed)
    # It fades from where it began, whatever the duty is by then.
    for turn in (1.0, -1.0):
        rig.see(velocity=0.0, pwm_command=0.0)
        command = position(rig, handover=0.5, velocity=0.0625)
        assert command.position == pytest.approx(0.5 * offset + turn * dither)
        assert command.velocity == pytest.approx(0.5 * speed + 0.5 * sign * 0.0625)
    assert position(rig, handover=0.0).position == pytest.approx(dither)
    # The next one, which begins anew, has its own.
    rig.see(velocity=0.0, pwm_command=sign * 0.25)
    effort = rig.module._effort
    offset, _ = mapping.handover(effort, sign * 0.25, 0.0, rig.module._motor.state)
    assert position(rig, handover=1.0).position == pytest.approx(offset - dither)


def test_a_drive_that_begins_with_a_trajectory_hands_over_no_torque_but_the_speed() -> None:
    rig = Rig().armed()
    rig.see(velocity=0.125, pwm_command=0.25)
    drive = Drive(DriveKind.POSITION, position=(0.0,), velocity=(0.0,), handover=1.0)
    outcome = rig.bridge.carry_out(drive, was_armed=True)
    assert len(outcome.applied) == 1
    assert not outcome.applied[0].limited
    offset, speed = rig.module.mapping.handover(0.0, 0.25, 0.125, rig.module._motor.state)
    command = rig.port.commands[-1]
    assert command.position == pytest.approx(offset - rig.module.mapping.dither)
    assert 0.0 < command.velocity <= speed


def test_effort_control_between_two_trajectories_makes_the_second_hand_over_its_own() -> None:
    rig = Rig().armed()
    rig.see(pwm_command=0.0)
    position(rig, handover=1.0)
    rig.drive(2.0)
    rig.see(pwm_command=0.5)
    offset, _ = rig.module.mapping.handover(2.0, 0.5, 0.0, rig.module._motor.state)
    assert offset > 0.1
    assert position(rig, handover=0.5).position == pytest.approx(0.5 * offset, abs=0.01)


def test_after_a_release_no_torque_of_before_is_handed_over() -> None:
    rig = Rig().armed()
    rig.drive(2.0)
    position(rig, handover=1.0)
    rig.drive(2.0)
    rig.released_and_armed_again()
    assert abs(position(rig, handover=1.0).position) == rig.module.mapping.dither


def test_a_release_in_a_hand_over_leaves_nothing_of_it() -> None:
    rig = Rig().armed()
    rig.drive(2.0)
    assert position(rig, handover=1.0).position > 0.1
    rig.released_and_armed_again()
    assert abs(position(rig, handover=0.5).position) == rig.module.mapping.dither


def test_a_strategy_that_does_not_read_back_ends_driving() -> None:
    rig = Rig().armed()
    rig.port.reads_strategy = Strategy.MIXED
    position(rig)
    assert rig.bridge.last_fault == "strategy"
    assert rig.port.strategy is Strategy.OFF
    assert rig.supervisor.mode is Mode.FAULT
