"""Fault table of the drives with a current loop: each through its vendor's library, in simulated time.

A fault begins while the pendulum is held upright. The torque that counts is the emulated motor's.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from pendulum_hw_bridge.drive.fault_table import FAULTS
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_testing.drive_rigs import DriveRig, SteppedServo

MILLISECOND = 1_000_000
LONGEST = 0.06
"""Time within which a fault ends all torque [s]."""
NO_TORQUE = 1e-3


def servo() -> SteppedServo:
    pytest.importorskip("dynamixel_sdk", reason="dynamixel-sdk is not installed")
    return SteppedServo(position=UPRIGHT + 0.02)


DRIVES: dict[str, Callable[[], SteppedServo]] = {"dynamixel": servo}


def inject(*faults: ActuatorFault) -> Callable[[DriveRig], None]:
    return lambda rig: rig.drive.faults.update(faults)


def kill(rig: DriveRig) -> None:
    rig.alive = False


def stall(rig: DriveRig) -> None:
    rig.clock.wait_until(rig.clock.now_ns() + 100 * MILLISECOND)


def lose_controller(rig: DriveRig) -> None:
    rig.controlling = False


def not_a_number(rig: DriveRig) -> None:
    rig.spoil = lambda effort: math.nan


F = ActuatorFault
STUCK = {"output_disagreement", "command_not_in_force", "effort_measured"}
TABLE: dict[str, tuple[Callable[[DriveRig], None], set[str]]] = {
    "replies lost": (inject(F.FEEDBACK_LOST), {"feedback_lost"}),
    "replies frozen": (inject(F.FEEDBACK_FROZEN), {"feedback_frozen"}),
    "every tenth reply": (inject(F.FEEDBACK_SLOW), {"feedback_lost"}),
    "replies late by 80 ms": (inject(F.FEEDBACK_LATE), {"feedback_lost", "feedback_late"}),
    "encoder slips": (inject(F.POSITION_JUMP), {"position_jump"}),
    "position outside its window": (inject(F.OUTSIDE_WINDOW), {"position_jump"}),
    "velocity spike": (inject(F.VELOCITY_SPIKE), {"motion_disagreement", "position_jump", "supervisor"}),
    "current sensor slips": (inject(F.EFFORT_OFFSET), STUCK),
    "output stuck": (inject(F.PWM_STUCK), STUCK),
    "output runs away": (inject(F.PWM_RUNAWAY), {*STUCK, "supervisor"}),
    "motor phase broken": (inject(F.WINDING_OPEN), {*STUCK, "supervisor"}),
    "commands lost": (inject(F.COMMANDS_LOST), {"command_not_in_force"}),
    "bus fails": (inject(F.SEND_FAILED), {"send_failed", "feedback_lost"}),
    "drive restarts": (lambda rig: rig.drive.restart(), {"module_restarted", "command_not_in_force"}),
    "drive switches itself off, too hot": (lambda rig: rig.drive.fail(), {"drive_error"}),
    "another program switches it off": (lambda rig: rig.drive.switch_off(), {*STUCK, "supervisor"}),
    "supply sags": (inject(F.VOLTAGE_LOW), {"voltage"}),
    "supply rises": (inject(F.VOLTAGE_HIGH), {"voltage"}),
    "motor hot": (inject(F.WINDING_HOT), {"over_temperature"}),
    "computer stands still": (stall, {"host_stalled"}),
    "bridge killed": (kill, {"lifetime"}),
    "bridge ends": (lambda rig: rig.bridge.close(), {"closed"}),
    "e-stop": (lambda rig: rig.supervisor.e_stop(rig.clock.now_ns()), {"e_stop"}),
    "disarmed": (lambda rig: rig.supervisor.disarm(rig.clock.now_ns()), {"disarmed"}),
    "controller lost": (lose_controller, {"starved", "supervisor"}),
    "command not a number": (not_a_number, {"starved", "supervisor"}),
}
LATER = {"every tenth reply": 0.03, "commands lost": 0.02, "output stuck": 0.02, "output runs away": 0.02}
"""Time on top: a reply that still comes, records until it shows, the silence in which a watchdog acts [s]."""
OWN_TORQUE = {"output stuck", "output runs away"}
"""Torque that the drive makes by itself ends when it is switched off."""


@pytest.mark.parametrize("name", list(TABLE))
@pytest.mark.parametrize("drive", list(DRIVES))
def test_fault_is_named_and_ends_torque_in_time(drive: str, name: str) -> None:
    rig = DriveRig(DRIVES[drive]())
    begin, expected = TABLE[name]
    rig.torques.clear()
    begin_ns, expiries = rig.clock.now_ns(), rig.drive.expiries
    begin(rig)
    if name == "bridge ends":
        rig.alive = False
    rig.run(0.5)
    reaction = reaction_of(rig, name, expiries)
    assert reaction in expected, rig.supervisor.reason
    if reaction == "goes on":
        return
    driven = [time for time, torque in rig.torques if abs(torque) > NO_TORQUE]
    after = (driven[-1] - begin_ns) / 1e9 if driven else 0.0
    assert after <= LONGEST + LATER.get(name, 0.0)
    if name not in OWN_TORQUE:
        assert max(abs(torque) for _, torque in rig.torques) <= rig.limits.effort[0] + NO_TORQUE
    # It does not come back by itself.
    rig.drive.faults.clear()
    rig.torques.clear()
    rig.controlling = name not in {"controller lost", "command not a number"}
    rig.run(0.3)
    assert max(abs(torque) for _, torque in rig.torques) < NO_TORQUE


def reaction_of(rig: DriveRig, name: str, expiries: int) -> str:
    if not rig.alive:
        if name == "bridge ends":
            return "closed" if not rig.drive.is_on else "none"
        return "lifetime" if rig.drive.expiries > expiries else "none"
    if rig.supervisor.mode is Mode.FAULT:
        assert rig.bridge.last_fault in FAULTS
        assert rig.supervisor.reason.startswith(f"{rig.bridge.last_fault}: ") or rig.bridge.last_fault == "supervisor"
        return rig.bridge.last_fault
    if rig.supervisor.mode is Mode.EFFORT:
        starved = rig.supervisor.decide(rig.clock.now_ns(), rig.bridge.sample).starved
        return "starved" if starved else "goes on"
    assert not rig.drive.is_on
    return rig.supervisor.mode.value


@pytest.mark.parametrize("drive", list(DRIVES))
def test_without_a_fault_it_is_held_upright_and_no_check_raises_a_false_alarm(drive: str) -> None:
    rig = DriveRig(DRIVES[drive]())
    rig.run(5.0)
    assert rig.supervisor.mode is Mode.EFFORT
    assert rig.bridge.faults == {}
    assert abs(rig.drive.machine.state[0][0] - UPRIGHT) < 0.05
