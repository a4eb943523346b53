"""Rules of the Dynamixel backend on an emulated servo: what is sent, what is believed, what is refused."""

from __future__ import annotations

import math
import os
import struct
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pendulum_hw_bridge.backends import dynamixel as module
from pendulum_hw_bridge.backends.dynamixel import MODELS, DynamixelBackend, serial_port
from pendulum_hw_bridge.backends.torque_drive import TORQUE_LOOP
from pendulum_hw_bridge.emulation.dynamixel_servo import EmulatedServo, ServoLine, checksum, serve
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.machine import EmulatedMachine
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, CommandLock, Feedback, HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import WallClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.timing import SteadyWallClock
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_testing.drive_rigs import SteppedServo, loop_port

pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
MILLISECOND = 1_000_000


def ready(**options: float) -> SteppedServo:
    """Return a servo that is connected and set, not on."""
    drive = SteppedServo(**options)  # type: ignore[arg-type]
    drive.port.connect()
    drive.port.set_strategy(Strategy.OFF)
    drive.port.set_command_lifetime(0.04)
    drive.port.set_limits(HardwareLimits(effort=0.4))
    return drive


def driven(**options: float) -> SteppedServo:
    drive = ready(**options)
    drive.port.set_strategy(TORQUE_LOOP, Command(effort=0.1))
    return drive


def goal(drive: SteppedServo) -> int:
    return int(struct.unpack_from("<h", drive.servo.table, 102)[0])


def record(drive: SteppedServo) -> Feedback:
    found = drive.port.read(0.02)
    assert found is not None
    return found


# --- numbers on the wire --------------------------------------------------------------------------------------


def test_checksum_is_that_of_the_manuals_example() -> None:
    # e-Manual, protocol 2.0, instruction Ping of ID 1.
    assert checksum(bytes.fromhex("FFFFFD0001030001")) == int.from_bytes(bytes.fromhex("194E"), "little")


@pytest.mark.parametrize("name", list(MODELS))
def test_every_code_of_torque_goes_both_ways_and_in_between_the_nearest_is_sent(name: str) -> None:
    drive = SteppedServo(model=name)
    port, model = drive.port, MODELS[name]
    port._largest = most = round(model.largest_current / model.current_step)
    for code in range(-most, most + 1):
        assert port._code(code * model.step) == code
        assert port._code((code + 0.49) * model.step) == code
        assert port._code((code - 0.49) * model.step) == code
    assert port._code(1e9) == most
    assert port._code(-1e9) == -most


def test_a_torque_arrives_in_its_sign_and_unit_and_comes_back_as_it_acts() -> None:
    drive = driven()
    for effort in (0.1, -0.1):
        applied = drive.port.write(Command(effort=effort)).command.effort
        assert applied == pytest.approx(effort, abs=2e-4)
        assert goal(drive) == round(effort / MODELS["XL330-M288"].step)
        drive.clock.wait_until(drive.clock.now_ns() + 30 * MILLISECOND)
        found = record(drive)
        assert found.effort_command == applied
        assert found.effort == pytest.approx(applied, abs=2e-3)
        assert found.winding_current == pytest.approx(applied * 1.47 / 0.52, abs=5e-3)


@pytest.mark.parametrize("angle", [-3.0, -0.5, 0.0, 0.7, 3.1])
def test_angle_and_velocity_come_in_radians_with_their_sign(angle: float) -> None:
    drive = ready(position=angle)
    drive.clock.wait_until(drive.clock.now_ns() + 20 * MILLISECOND)
    found = record(drive)
    (position,), (velocity,), _ = drive.machine.state
    assert found.position == pytest.approx(position, abs=1.6e-3)
    assert found.velocity == pytest.approx(velocity, abs=0.013)
    assert found.position == pytest.approx(angle, abs=0.1)
    assert found.voltage == pytest.approx(drive.servo.voltage)


def test_a_torque_limit_is_rounded_down_and_none_beyond_it_is_sent() -> None:
    drive = driven()
    limit = struct.unpack_from("<H", drive.servo.table, 38)[0]
    assert limit * MODELS["XL330-M288"].step <= 0.4 < (limit + 1) * MODELS["XL330-M288"].step
    assert drive.port.write(Command(effort=5.0)).limited
    assert goal(drive) == limit


@pytest.mark.parametrize(("effort", "sentence"), [(0.7, "at most 0.619 N m: XL330-M288"), (1e-5, "at least a step")])
def test_limits_that_the_servo_does_not_have_are_refused(effort: float, sentence: str) -> None:
    drive = ready()
    with pytest.raises(ParameterError, match=sentence):
        drive.port.set_limits(HardwareLimits(effort=effort))


@pytest.mark.parametrize("lifetime", [0.05, 0.019, 0.01, 2.56])
def test_lifetimes_between_steps_of_the_watchdog_are_refused(lifetime: float) -> None:
    with pytest.raises(ParameterError, match=r"expected a multiple of 0.02 s up to 2.54 s"):
        ready().port.set_command_lifetime(lifetime)


def test_the_servos_clock_passes_its_overflow_and_reveals_a_restart() -> None:
    drive = ready()
    before = record(drive)
    drive.clock.wait_until(drive.clock.now_ns() + 40_000 * MILLISECOND)
    after = record(drive)
    assert after.hardware_ns - before.hardware_ns == pytest.approx(after.stamp_ns - before.stamp_ns, abs=2e6)
    drive.restart()
    assert record(drive).hardware_ns < after.hardware_ns


# --- the port that all drives have ----------------------------------------------------------------------------

CALLS: dict[str, Callable[[DynamixelBackend], object]] = {
    "read": lambda port: port.read(0.01),
    "write": lambda port: port.write(Command()),
    "set_strategy": lambda port: port.set_strategy(Strategy.OFF),
    "set_gains": lambda port: port.set_gains(DEFAULT_GAINS[3]),
    "set_limits": lambda port: port.set_limits(HardwareLimits(effort=0.4)),
    "set_command_lifetime": lambda port: port.set_command_lifetime(0.04),
    "set_feedback_rate": lambda port: port.set_feedback_rate(50.0),
}


@pytest.mark.parametrize("name", list(CALLS))
def test_each_call_is_refused_before_connecting_and_after_closing(name: str) -> None:
    port = SteppedServo().port
    for _ in range(2):
        with pytest.raises(ActuatorError, match=r"dynamixel drive is not connected; call connect\(\) first"):
            CALLS[name](port)
        port.connect()
        port.close()


def test_it_reports_who_it_is_and_what_was_set() -> None:
    drive = SteppedServo()
    assert drive.port.connect().command_lifetime == 0.1
    drive.port.set_command_lifetime(0.04)
    drive.port.set_feedback_rate(50.0)
    drive.port.set_gains(DEFAULT_GAINS[3])
    info = drive.port.connect()
    assert (info.name, info.family, info.serial, info.firmware) == ("XL330-M288", "Dynamixel", "1", "53")
    assert (info.command_lifetime, info.feedback_rate, info.gains) == (0.04, 50.0, DEFAULT_GAINS[3])
    assert info.drivetrain["gear_ratio"] == 288.35
    assert "name" not in info.drivetrain
    named = DynamixelBackend(1, lambda: loop_port(drive.line, drive.clock), drive.clock, joint="elbow")
    assert named.connect().name == "elbow"


@pytest.mark.parametrize("rate", [0.0, -1.0, 500.1, math.nan, math.inf])
def test_rates_that_the_servos_clock_cannot_tell_apart_are_refused(rate: float) -> None:
    with pytest.raises(ParameterError, match=r"feedback_rate is .* expected > 0 and <= 500 Hz for dynamixel"):
        ready().port.set_feedback_rate(rate)


@pytest.mark.parametrize("rate", [0.5, 100.0, 500.0])
def test_records_come_at_the_rate_and_a_late_reader_gets_no_burst(rate: float) -> None:
    drive = ready()
    port, period = drive.port, 1.0 / rate
    assert port.set_feedback_rate(rate) == rate
    assert port.read(0.02) is not None
    stamps = [found.stamp_ns for _ in range(20) if (found := port.read(1.1 * period)) is not None]
    assert np.diff(stamps) == pytest.approx(period * 1e9, abs=4e5)
    drive.clock.wait_until(drive.clock.now_ns() + round(5.3 * period * 1e9))
    first, second = record(drive), port.read(1.1 * period)
    assert second is not None
    assert 0.45 * period < (second.stamp_ns - first.stamp_ns) / 1e9 < 1.1 * period
    assert second.sequence == first.sequence + 1
    before = drive.clock.now_ns()
    assert port.read(0.1 * period) is None
    assert (drive.clock.now_ns() - before) / 1e9 == pytest.approx(0.1 * period, abs=1e-6)


@pytest.mark.parametrize(("rate", "patience"), [(10.0, 0.02), (100.0, 0.008), (500.0, 0.0016)])
def test_a_reply_is_awaited_for_most_of_a_period_and_never_long(rate: float, patience: float) -> None:
    drive = ready()
    drive.port.set_feedback_rate(rate)
    drive.faults.add(ActuatorFault.FEEDBACK_LOST)
    before = drive.clock.now_ns()
    assert drive.port.read(0.2) is None
    assert (drive.clock.now_ns() - before) / 1e9 == pytest.approx(patience, abs=1e-5)


def test_a_record_that_is_due_at_the_very_end_of_the_wait_is_asked_for() -> None:
    drive = ready()
    drive.port._next_ns = drive.clock.now_ns() + 20 * MILLISECOND
    assert drive.port.read(0.02) is not None


def test_no_torque_is_sent_while_the_strategy_is_off() -> None:
    drive = ready()
    applied = drive.port.write(Command(effort=0.2))
    assert (applied.command, applied.strategy) == (Command(), Strategy.OFF)
    assert goal(drive) == 0


def test_a_position_or_a_velocity_is_refused() -> None:
    drive = driven()
    for command in (Command(position=1.0), Command(velocity=1.0)):
        with pytest.raises(ActuatorError, match="drive got a position or a velocity; expected a torque alone"):
            drive.port.write(command)


# --- what is believed -----------------------------------------------------------------------------------------


def test_a_late_reply_is_never_taken_for_that_to_the_next_request() -> None:
    drive = ready(position=0.5)
    port, line = drive.port, drive.line
    ready_at = port.read(0.02)
    assert ready_at is not None
    held: list[bytes] = []

    def late(due_ns: int, packet: bytes) -> list[tuple[int, bytes]]:
        # The first reply comes with the next one, right before it.
        held.append(packet)
        return [] if len(held) == 1 else [(due_ns - 1000, held[0]), (due_ns, packet)]

    line.tamper = late
    assert port.read(0.02) is None
    before = drive.machine.state[0][0]
    drive.clock.wait_until(drive.clock.now_ns() + 50 * MILLISECOND)
    found = record(drive)
    assert abs(found.position - before) > 0.005
    assert found.position == pytest.approx(drive.machine.state[0][0], abs=2e-3)


@pytest.mark.parametrize("behind", [1, 2, 3])
def test_replies_that_stay_some_requests_behind_are_no_feedback(behind: int) -> None:
    drive = ready()
    line = drive.line
    queue: list[bytes] = []

    def behind_by(due_ns: int, packet: bytes) -> list[tuple[int, bytes]]:
        queue.append(packet)
        return [(due_ns, queue.pop(0))] if len(queue) > behind else []

    line.tamper = behind_by
    assert [drive.port.read(0.02) for _ in range(12)] == [None] * 12


def test_a_setting_that_is_read_back_late_is_never_taken_for_another() -> None:
    drive = ready()
    line = drive.line
    queue: list[bytes] = []

    def behind(due_ns: int, packet: bytes) -> list[tuple[int, bytes]]:
        queue.append(packet)
        return [(due_ns, queue.pop(0))] if len(queue) > 1 else []

    line.tamper = behind
    # The watchdog's 5 once came as a hardware error, and as any other register of one byte.
    with pytest.raises(ActuatorError, match="servo 1 does not answer"):
        drive.port._get(module.WATCHDOG)
    with pytest.raises(ActuatorError, match="servo 1 does not answer"):
        drive.port._refuse_alert()


@pytest.mark.parametrize(
    ("rate", "late"),
    [(100.0, 0.034), (100.0, 0.041), (250.0, 0.0165), (500.0, 0.0085), (500.0, 0.0165), (500.0, 0.0305)],
)
def test_replies_that_stay_late_are_no_feedback_at_any_rate(rate: float, late: float) -> None:
    drive = ready()
    drive.port.set_feedback_rate(rate)
    drive.line.tamper = lambda due_ns, packet: [(due_ns + round(late * 1e9), packet)]
    assert [drive.port.read(0.02) for _ in range(60)] == [None] * 60
    drive.line.tamper = lambda due_ns, packet: [(due_ns, packet)]
    drive.clock.wait_until(drive.clock.now_ns() + 100 * MILLISECOND)
    assert drive.port.read(0.02) is not None


def test_after_single_lost_replies_the_next_is_asked_for_in_time() -> None:
    drive = ready()
    sent: list[bytes] = []

    def every_second(due_ns: int, packet: bytes) -> list[tuple[int, bytes]]:
        sent.append(packet)
        return [(due_ns, packet)] if len(sent) % 2 else []

    drive.line.tamper = every_second
    stamps = [found.stamp_ns for _ in range(80) if (found := drive.port.read(0.02)) is not None]
    assert np.diff(stamps)[1:] == pytest.approx(20e6, abs=1e6)


def test_damaged_foreign_and_short_packets_are_no_feedback_and_the_next_good_one_is() -> None:
    drive = ready()
    spoiled: list[Callable[[bytes], bytes]] = [
        lambda packet: packet[:20] + bytes([packet[20] ^ 1]) + packet[21:],
        lambda packet: packet[:15],
        lambda packet: b"\xff\xff\xfd" + bytes(range(30)),
        lambda packet: (
            packet[:4] + b"\2" + packet[5:-2] + struct.pack("<H", checksum(packet[:4] + b"\2" + packet[5:-2]))
        ),
    ]
    for spoil in spoiled:
        drive.line.tamper = lambda due_ns, packet, spoil=spoil: [(due_ns, spoil(packet))]  # type: ignore[misc]
        assert drive.port.read(0.02) is None
    drive.line.tamper = lambda due_ns, packet: [(due_ns, packet)]
    assert drive.port.read(0.02) is not None


# --- safety ---------------------------------------------------------------------------------------------------


def test_as_delivered_and_with_dangerous_settings_it_is_set_before_it_gets_torque() -> None:
    drive = SteppedServo()
    table = drive.servo.table
    table[10], table[60] = 0b1001, 1
    assert table[9] == 250
    port = drive.port
    port.connect()
    assert table[11] == 3
    port.set_command_lifetime(0.04)
    port.set_limits(HardwareLimits(effort=0.4))
    assert (table[9], table[10], table[11], table[60], table[64], table[98]) == (0, 0, 0, 0, 0, 2)
    port.set_strategy(TORQUE_LOOP)
    assert (table[64], goal(drive)) == (1, 0)


@pytest.mark.parametrize(("address", "what"), [(11, "operating mode"), (10, "drive mode"), (60, "startup")])
def test_a_setting_that_does_not_hold_is_a_fault_and_no_torque_follows(address: int, what: str) -> None:
    drive = ready()
    drive.servo.stubborn.add(address)
    drive.servo.table[address] = 4
    for call in (
        lambda: drive.port.set_limits(HardwareLimits(effort=0.4)),
        lambda: drive.port.set_strategy(TORQUE_LOOP, Command(effort=0.1)),
    ):
        with pytest.raises(ActuatorError, match=f"{what} of servo 1 reads back as 4; expected 0") as caught:
            call()
        assert caught.value.fault == "settings"
        assert not drive.is_on


def test_a_goal_that_was_left_by_another_program_is_cleared_before_torque() -> None:
    drive = ready()
    struct.pack_into("<h", drive.servo.table, 102, 900)
    efforts = []
    drive.clock.watch = lambda: efforts.append(drive.servo.torque_on and goal(drive))
    original = drive.servo._apply

    def apply(now_ns: int) -> None:
        efforts.append(drive.servo.torque_on and goal(drive))
        original(now_ns)

    drive.servo._apply = apply  # type: ignore[method-assign]
    drive.port.set_strategy(TORQUE_LOOP)
    assert max(map(abs, efforts)) == 0


def test_before_limits_and_lifetime_are_set_no_torque_is_sent_and_the_watchdog_acts() -> None:
    drive = SteppedServo()
    drive.port.connect()
    drive.port.set_strategy(TORQUE_LOOP, Command(effort=0.1))
    assert drive.port.write(Command(effort=0.1)).command.effort == 0.0
    assert (goal(drive), drive.servo.table[98]) == (0, 5)


def test_a_rate_that_the_line_refuses_is_named() -> None:
    drive = SteppedServo()
    line = loop_port(drive.line, drive.clock)
    line.openPort = lambda: False
    with pytest.raises(ActuatorError, match="serial device loop refuses 1000000 baud"):
        DynamixelBackend(1, lambda: line, drive.clock).connect()


def test_connecting_finds_a_servo_that_is_driven_and_off_ends_its_torque() -> None:
    drive = SteppedServo()
    drive.servo.table[11] = 0
    drive.servo.write(64, b"\1", drive.clock.now_ns())
    drive.servo.write(102, struct.pack("<h", 300), drive.clock.now_ns())
    drive.port.connect()
    assert drive.is_on
    assert drive.port.set_strategy(Strategy.OFF) is Strategy.OFF
    assert (drive.is_on, goal(drive)) == (False, 0)


def test_closing_ends_the_torque_that_another_program_left_and_releases_the_line() -> None:
    drive = ready()
    drive.servo.write(64, b"\1", drive.clock.now_ns())
    line = loop_port(drive.line, drive.clock)
    port = DynamixelBackend(1, lambda: line, drive.clock)
    assert port.connect().feedback_rate == 100.0
    assert (drive.is_on, line.is_open) == (True, True)
    port.close()
    assert (drive.is_on, line.is_open) == (False, False)


def test_commands_expire_although_requests_go_on() -> None:
    drive = driven()
    port = drive.port
    port._written_ns = drive.clock.now_ns()
    port._next_ns = port._written_ns + 40 * MILLISECOND
    assert port.read(0.05) is not None
    assert goal(drive) > 0
    port._next_ns = drive.clock.now_ns() + MILLISECOND
    assert port.read(0.05) is not None
    assert goal(drive) == 0
    assert drive.expiries == 0


@pytest.mark.parametrize(
    "change",
    [
        lambda port: port.set_limits(HardwareLimits(effort=0.3)),
        lambda port: port.set_command_lifetime(0.06),
    ],
)
def test_settings_of_a_driven_servo_are_written_with_its_torque_off(
    change: Callable[[DynamixelBackend], object],
) -> None:
    drive = driven()
    assert record(drive).lock == CommandLock.LOCKED_BY_SENDER
    change(drive.port)
    assert not drive.is_on
    drive.port.stop()
    assert record(drive).lock == CommandLock.UNLOCKED


def test_a_servo_that_another_program_has_switched_on_is_off_before_it_is_set() -> None:
    drive = ready()
    drive.servo.table[11], drive.servo.table[64] = 3, 1
    drive.port.set_strategy(TORQUE_LOOP)
    assert (drive.servo.table[11], drive.is_on, goal(drive)) == (0, True, 0)


@pytest.mark.parametrize("lifetime", [0.02, 2.54])
def test_the_shortest_and_the_longest_lifetime_are_set(lifetime: float) -> None:
    drive = ready()
    drive.servo.table[98] = 0xFF
    assert drive.port.set_command_lifetime(lifetime) == pytest.approx(lifetime)
    assert drive.servo.table[98] == round(lifetime / 0.02)


def test_the_smallest_and_the_largest_limit_are_set() -> None:
    drive, model = ready(), MODELS["XL330-M288"]
    for effort, code in ((1.01 * model.step, 1), (model.peak, 1750)):
        assert drive.port.set_limits(HardwareLimits(effort=effort)).effort == effort
        assert abs(struct.unpack_from("<H", drive.servo.table, 38)[0] - code) <= 1


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [(ActuatorFault.COMMANDS_LOST, "reads torque enable 1"), (ActuatorFault.FEEDBACK_LOST, "is silent")],
)
def test_a_stop_that_is_not_confirmed_names_what_was_seen(fault: ActuatorFault, sentence: str) -> None:
    drive = driven()
    # Another servo of the line, not connected yet, changes nothing.
    drive.port.on_this_bus({"drive_id": 2, "drive_model": "XL330-M288"})
    drive.faults.add(fault)
    with pytest.raises(ActuatorError, match=f"servo 1 {sentence}; expected 0"):
        drive.port.stop()


def test_a_servo_that_does_not_switch_on_wholly_is_switched_off() -> None:
    drive = ready()
    drive.servo.stubborn.add(98)
    drive.servo.table[98] = 7
    with pytest.raises(ActuatorError, match="Bus Watchdog of servo 1 reads back as 7"):
        drive.port.set_strategy(TORQUE_LOOP, Command(effort=0.1))
    assert (drive.is_on, drive.port.strategy, drive.port._possibly_on) == (False, Strategy.OFF, False)


def test_the_watchdog_ends_torque_of_a_dead_computer_and_its_error_is_named_and_cleared_by_arming_again() -> None:
    drive = driven()
    begin = drive.clock.now_ns()
    drive.clock.wait_until(begin + 39 * MILLISECOND)
    drive.advance()
    assert goal(drive) > 0
    drive.clock.wait_until(begin + 42 * MILLISECOND)
    drive.advance()
    assert (goal(drive), drive.expiries, drive.servo.table[98]) == (0, 1, 0xFF)
    drive.port._turn = 0
    with pytest.raises(ActuatorError, match=r"stopped by its Bus Watchdog: no request for 0.04 s") as caught:
        drive.port.read(0.02)
    assert caught.value.fault == "command_not_in_force"
    drive.port.stop()
    drive.port.set_strategy(TORQUE_LOOP, Command(effort=0.1))
    assert (goal(drive) > 0, drive.servo.table[98]) == (True, 2)


def test_a_goal_that_a_watchdog_holds_back_gives_no_torque_when_it_is_cleared() -> None:
    drive = driven()
    # Not known of a real servo: the goal may outlast the watchdog's action, and not be writable until that is cleared.
    drive.servo.table[98] = 0xFF
    drive.port.stop()
    assert goal(drive) > 0
    given: list[int] = []
    original = drive.servo._apply

    def apply(now_ns: int) -> None:
        given.append(goal(drive) if drive.servo.torque_on else 0)
        original(now_ns)

    drive.servo._apply = apply  # type: ignore[method-assign]
    drive.port.set_strategy(TORQUE_LOOP)
    assert (drive.is_on, any(given)) == (True, False)


def test_a_restart_is_named_by_the_watchdog_that_it_lost() -> None:
    drive = driven()
    drive.restart()
    drive.port._turn = 0
    with pytest.raises(ActuatorError, match="Bus Watchdog of servo 1 reads 0; expected 2") as caught:
        drive.port.read(0.02)
    assert caught.value.fault == "module_restarted"
    assert not drive.is_on


def test_an_alert_is_an_error_with_its_cause_while_driving_and_refuses_to_arm_again() -> None:
    drive = driven()
    drive.fail()
    with pytest.raises(ActuatorError, match=r"hardware error status 0x04 \(overheating\); expected none") as caught:
        drive.port.read(0.02)
    assert caught.value.fault == "drive_error"
    drive.port.stop()
    assert drive.port.read(0.02) is not None
    for call in (
        lambda: drive.port.set_limits(HardwareLimits(effort=0.4)),
        lambda: drive.port.set_strategy(TORQUE_LOOP),
    ):
        with pytest.raises(ActuatorError, match="overheating"):
            call()


def test_an_alert_whose_cause_does_not_come_is_an_error_all_the_same() -> None:
    drive = driven()
    drive.fail()
    drive.line.tamper = lambda due_ns, packet: [(due_ns, packet)] if len(packet) > 20 else []
    with pytest.raises(ActuatorError, match=r"replies with error 0x80, then is silent; expected none") as caught:
        drive.port.read(0.02)
    assert caught.value.fault == "drive_error"


def test_a_silent_servo_is_named_with_its_line() -> None:
    drive = SteppedServo()
    drive.faults.add(ActuatorFault.FEEDBACK_LOST)
    before = drive.clock.now_ns()
    with pytest.raises(ActuatorError, match="servo 1 does not answer on loop at 1000000 baud") as caught:
        drive.port.connect()
    assert caught.value.fault == "module_lost"
    # Three times a reply, and three times the silence after it.
    assert (drive.clock.now_ns() - before) / 1e9 == pytest.approx(0.3, abs=1e-3)


def test_another_model_is_refused_by_name() -> None:
    drive = SteppedServo()
    port = DynamixelBackend(1, lambda: loop_port(drive.line, drive.clock), drive.clock, model="XM430-W350")
    with pytest.raises(ActuatorError, match="servo 1 is of model XL330-M288; expected XM430-W350"):
        port.connect()
    with pytest.raises(ParameterError, match="drive_model is 'AX-12'; expected one of XL330-M288"):
        DynamixelBackend.drive_of("AX-12")


def test_a_stop_that_is_not_confirmed_leaves_the_line_silent_until_the_watchdog_has_acted() -> None:
    drive = driven()
    drive.faults.add(ActuatorFault.COMMANDS_LOST)
    with pytest.raises(ActuatorError, match="drive did not confirm that it is off, asked 3 times") as caught:
        drive.port.stop()
    assert caught.value.fault == "stop_unacknowledged"
    assert goal(drive) > 0
    other = drive.port.on_this_bus({"drive_id": 1, "drive_model": "XL330-M288"})
    other._connected = True
    for _ in range(4):
        assert drive.port.read(0.005) is None
        assert other.read(0.005) is None
        drive.advance()
    drive.clock.wait_until(drive.clock.now_ns() + 2 * MILLISECOND)
    drive.advance()
    assert (goal(drive), drive.expiries) == (0, 1)
    assert drive.port.read(0.02) is not None


def test_a_line_that_fails_is_named_and_closing_still_releases_it() -> None:
    drive = driven()
    drive.faults.add(ActuatorFault.SEND_FAILED)
    with pytest.raises(ActuatorError, match=r"serial line failed: .*Input/output error") as caught:
        drive.port.write(Command(effort=0.2))
    assert caught.value.fault == "send_failed"
    with pytest.raises(ActuatorError, match="asked 3 times"):
        drive.port.close()
    drive.faults.clear()
    drive.clock.wait_until(drive.clock.now_ns() + 60 * MILLISECOND)
    drive.advance()
    assert goal(drive) == 0
    drive.port.connect()
    drive.port.close()
    assert not drive.is_on


def test_the_bridges_parameters_name_device_rate_and_servo_and_the_device_is_opened_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = SteppedServo("double_pendulum", position=(0.0, 0.0))
    drive.line.servos[2] = EmulatedServo(drive.machine, 1, number=2)
    opened: list[tuple[str, int]] = []

    def device(path: str, rate: int) -> object:
        opened.append((path, rate))
        return loop_port(drive.line, drive.clock)

    monkeypatch.setattr(module, "serial_port", device)
    values = {"interface": "/dev/ttyUSB7", "bus_rate": 57600, "drive_id": 2.0, "drive_model": "XL330-M288"}
    port = DynamixelBackend.from_parameters(values, drive.clock)
    assert (port.connect().serial, port.on_this_bus({**values, "drive_id": 1.0}).connect().serial) == ("2", "1")
    assert opened == [("/dev/ttyUSB7", 57600)]


def test_a_scan_names_models_that_are_known_and_others_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = SteppedServo("double_pendulum", position=(0.0, 0.0))
    drive.line.servos[7] = EmulatedServo(drive.machine, 1, number=7, model=350)
    line = loop_port(drive.line, drive.clock)
    monkeypatch.setattr(module, "serial_port", lambda path, rate: line)
    found = DynamixelBackend.scan({"interface": "loop", "bus_rate": 1_000_000})
    assert [(each.serial, each.model.name, each.firmware) for each in found] == [
        ("1", "XL330-M288", "53"),
        ("7", "number 350", "53"),
    ]
    assert not line.is_open

    def missing() -> bool:
        raise OSError("no such device")

    line.openPort = missing
    with pytest.raises(ActuatorError, match="serial line failed: no such device"):
        DynamixelBackend.scan({"interface": "loop", "bus_rate": 1_000_000})
    line.openPort = lambda: False
    with pytest.raises(ActuatorError, match="serial device loop refuses 1000000 baud"):
        DynamixelBackend.scan({"interface": "loop", "bus_rate": 1_000_000})
    with pytest.raises(ParameterError, match="interface is empty; expected the serial device"):
        DynamixelBackend.scan({"interface": "", "bus_rate": 1_000_000})


def test_a_header_inside_a_packet_is_stuffed_and_taken_out_again() -> None:
    drive = driven()
    drive.port.write(Command(effort=-MODELS["XL330-M288"].step))
    drive.servo.table[104] = 0xFD
    assert drive.servo.read(102, 3, drive.clock.now_ns()) == b"\xff\xff\xfd"
    assert record(drive).effort_command == -MODELS["XL330-M288"].step


def test_a_line_that_fails_or_is_busy_is_a_fault_of_each_call_and_no_other_error() -> None:
    drive = driven()
    drive.port._port.is_using = True
    with pytest.raises(ActuatorError, match="request to servo 1 could not be sent"):
        drive.port.read(0.02)
    drive.port._port.is_using = True
    with pytest.raises(ActuatorError, match="command to servo 1 could not be sent"):
        drive.port.write(Command(effort=0.1))
    drive.port._port.is_using = False
    drive.faults.add(ActuatorFault.SEND_FAILED)
    with pytest.raises(ActuatorError, match="serial line failed") as caught:
        drive.port.read(0.02)
    assert caught.value.fault == "feedback_lost"
    # The SDK calls a line busy after an error: it must not stay so.
    drive.faults.clear()
    assert drive.port.read(0.02) is not None


def test_flash_memory_is_written_only_when_a_setting_differs() -> None:
    drive = ready()
    written: list[int] = []
    drive.port._put = lambda register, value: written.append(register.address)  # type: ignore[method-assign]
    drive.port.set_limits(HardwareLimits(effort=0.4))
    assert written == []


# --- several servos, and a real line --------------------------------------------------------------------------


def two_driven() -> tuple[SteppedServo, EmulatedServo, DynamixelBackend, DynamixelBackend]:
    drive = SteppedServo("double_pendulum", position=(0.0, 0.0))
    second = drive.line.servos[2] = EmulatedServo(drive.machine, 1, number=2)
    shared = loop_port(drive.line, drive.clock)
    first = DynamixelBackend(1, lambda: shared, drive.clock)
    other = first.on_this_bus({"drive_id": 2, "drive_model": "XL330-M288"})
    for port in (first, other):
        port.connect()
        port.set_command_lifetime(0.04)
        port.set_limits(HardwareLimits(effort=0.4))
        port.set_strategy(TORQUE_LOOP, Command(effort=0.1))
    assert goal(drive) > 0
    return drive, second, first, other


def test_two_servos_share_a_line_and_a_stop_of_one_leaves_the_other() -> None:
    drive, second, first, other = two_driven()
    drive.servo.faults.add(ActuatorFault.FEEDBACK_LOST)
    assert first.read(0.02) is None
    # After one silent servo the SDK's group read gives 0 for all: each is asked alone.
    assert other.read(0.02) is not None
    other.stop()
    assert (drive.servo.torque_on, second.torque_on) == (True, False)


@pytest.mark.parametrize("silent", [0, 1])
def test_torque_of_a_servo_does_not_wait_for_the_stop_of_a_silent_one(silent: int) -> None:
    drive, second, *ports = two_driven()
    servos = (drive.servo, second)
    servos[silent].faults.add(ActuatorFault.FEEDBACK_LOST)
    goals: list[int] = []
    drive.clock.watch = lambda: goals.append(struct.unpack_from("<h", servos[1 - silent].table, 102)[0])
    with pytest.raises(ActuatorError, match="asked 3 times"):
        ports[silent].stop()
    # Of three times 15 ms, the first.
    assert sum(each != 0 for each in goals) <= 17
    assert goals[-1] == 0


def test_a_line_that_fails_for_all_servos_is_asked_as_often_as_for_one() -> None:
    drive, _, first, _ = two_driven()
    drive.faults.add(ActuatorFault.SEND_FAILED)
    with pytest.raises(ActuatorError, match="asked 3 times") as caught:
        first.stop()
    assert caught.value.fault == "stop_unacknowledged"


@pytest.fixture
def terminal() -> Iterator[tuple[str, EmulatedServo]]:
    clock = SteadyWallClock()
    servo = EmulatedServo(EmulatedMachine(load_mechanism("xl330"), start_ns=clock(), rate=1.0))
    running, found, path = threading.Event(), threading.Event(), [""]

    def noted(name: str) -> None:
        path[0] = name
        found.set()

    running.set()
    thread = threading.Thread(target=serve, args=(ServoLine([servo]), clock, running.is_set, noted))
    thread.start()
    assert found.wait(20.0)
    yield path[0], servo
    running.clear()
    thread.join()


def test_the_vendors_library_reads_and_drives_a_servo_on_a_real_terminal(
    terminal: tuple[str, EmulatedServo], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, servo = terminal
    # The emulator's thread may have to wait for a core.
    monkeypatch.setattr(module, "_STOP_PATIENCE", 5.0)
    monkeypatch.setattr(module, "_PATIENCE", 2.0)
    port = DynamixelBackend(1, lambda: serial_port(path, 1_000_000), WallClock())
    assert port.connect().name == "XL330-M288"
    port.set_strategy(Strategy.OFF)
    port.set_command_lifetime(2.54)
    port.set_feedback_rate(20.0)
    port.set_limits(HardwareLimits(effort=0.4))
    port.set_strategy(TORQUE_LOOP, Command(effort=0.2))
    for _ in range(200):
        found = port.read(0.1)
        port.write(Command(effort=0.2))
        if found is not None and abs(found.effort - 0.2) < 2e-3:
            break
    else:
        pytest.fail("the torque was not seen in 200 records")
    with pytest.raises(ActuatorError, match="serial line failed"):
        DynamixelBackend(1, lambda: serial_port(path, 1_000_000), WallClock()).connect()
    port.close()
    assert not servo.torque_on


def test_an_adapter_that_is_pulled_is_an_error_of_the_line() -> None:
    master, slave = os.openpty()
    port = serial_port(os.ttyname(slave), 1_000_000)
    assert port.openPort()
    os.close(slave)
    os.close(master)
    # Discarding what came before a request is the first call that fails, with an error that is no OSError of itself.
    with pytest.raises(OSError, match="Input/output error"):
        port.clearPort()
    port.closePort()


def test_a_serial_device_that_is_not_there_is_refused_in_a_sentence(tmp_path: Path) -> None:
    port = DynamixelBackend(1, lambda: serial_port(str(tmp_path / "none"), 1_000_000), WallClock())
    with pytest.raises(ActuatorError, match=r"serial line failed: .*No such file") as caught:
        port.connect()
    assert caught.value.fault == "module_lost"


def test_without_the_vendors_library_or_a_device_the_way_out_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ParameterError, match="interface is empty; expected the serial device"):
        DynamixelBackend.from_parameters({"interface": ""}, WallClock())
    monkeypatch.setitem(__import__("sys").modules, "dynamixel_sdk", None)
    with pytest.raises(ActuatorError, match=r"pip install 'pendulum_hw_bridge\[dynamixel\]'") as caught:
        serial_port("/dev/none", 1_000_000)
    assert caught.value.fault == "not_installed"
