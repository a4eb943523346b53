"""Fault table of the drives with a current loop: each through its vendor's library, in simulated time.

A fault begins while the pendulum is held upright. The torque that counts is the emulated motor's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest

from pendulum_hw_bridge.backends import dynamixel
from pendulum_hw_bridge.bridge.assembly import assemble, for_plant
from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.drive.fault_table import FAULTS
from pendulum_hw_bridge.emulation.dynamixel_servo import EmulatedServo
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.supervisor import Input, Mode, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.drive_rigs import DriveRig, SteppedServo, loop_port

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


def assembled(monkeypatch: pytest.MonkeyPatch, drive: SteppedServo, plant: str, **given: Any) -> tuple[Bridge, Any]:
    """Return the bridge that parameters describe, on an emulated line, connected; and its supervisor."""
    monkeypatch.setattr(dynamixel, "serial_port", lambda path, rate: loop_port(drive.line, drive.clock))
    specs = for_plant(SPECS, plant, "dynamixel")
    values = {spec.name: spec.default for spec in specs}
    values |= {"plant": plant, "backend": "dynamixel", "interface": "loop", **given}
    assembly = assemble(values, specs)
    supervisor = PlantSupervisor(assembly.limits, coordinates=assembly.coordinates)
    bridge = Bridge(assembly.modules(drive.clock), supervisor)
    bridge.connect()
    for _ in range(4):
        bridge.observe(0.02)
    return bridge, supervisor


def commanded(bridge: Bridge, supervisor: PlantSupervisor, drive: SteppedServo, *efforts: float) -> None:
    """Arm, and let a controller ask for constant torques for a while."""
    assert (bridge.prepare() or supervisor.arm(drive.clock.now_ns(), bridge.sample)) == ""
    names = supervisor.coordinates.driven_names
    for _ in range(20):
        sample = bridge.observe(0.02)
        if sample is not None:
            supervisor.offer(
                Input.EFFORT_COMMAND, JointCommand(sample.stamp_ns, efforts, "c", names), drive.clock.now_ns()
            )
        bridge.act()
    assert supervisor.mode is Mode.EFFORT, supervisor.reason


@pytest.mark.parametrize("sign", [1, -1])
def test_number_zero_and_sign_of_one_drive_are_those_of_its_parameters(
    monkeypatch: pytest.MonkeyPatch, sign: int
) -> None:
    drive = SteppedServo(position=0.7)
    drive.servo.number = 3
    drive.line.servos = {3: drive.servo}
    bridge, supervisor = assembled(monkeypatch, drive, "xl330", drive_id=3, joint_offset=0.5, joint_sign=sign)
    assert bridge.sample is not None
    raw = drive.machine.state[0][0]
    assert bridge.sample.position[0] == pytest.approx(sign * raw + 0.5, abs=0.05)
    commanded(bridge, supervisor, drive, 0.05)
    assert drive.machine.state[2][0] == pytest.approx(sign * 0.05, abs=1e-3)


def test_several_drives_on_one_line_have_their_own_sign_and_a_fault_of_one_releases_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = SteppedServo("double_pendulum", position=(0.0, 0.0))
    other = drive.line.servos[2] = EmulatedServo(drive.machine, 1, number=2)
    given = {"drive_ids": [1.0, 2.0], "joint_signs": [1.0, -1.0], "effort_limit": 0.4}
    bridge, supervisor = assembled(monkeypatch, drive, "double_pendulum", **given)
    commanded(bridge, supervisor, drive, 0.1, 0.05)
    assert drive.machine.state[2] == pytest.approx((0.1, -0.05), abs=1e-3)
    other.fail(0x04, drive.clock.now_ns())
    for _ in range(3):
        bridge.observe(0.02)
    assert supervisor.reason.startswith("drive_error: elbow: servo 2 replies with error 0x80")
    assert (drive.servo.torque_on, other.torque_on) == (False, False)


@pytest.mark.parametrize(
    ("plant", "given", "sentence"),
    [
        ("xl330", {"drive_ids": [2.0]}, "drive_ids is for several joints; expected drive_id for one"),
        ("xl330", {"joint_signs": [-1.0]}, "joint_signs is for several joints; expected joint_sign for one"),
        ("double_pendulum", {"joint_sign": -1}, "joint_sign is for one joint; expected joint_signs for several"),
        ("double_pendulum", {"lab_file": "lab.yaml"}, "lab_file is for one joint"),
        ("cart_pole", {"effort_limit": 0.4}, "joint 'cart' slides, and a module of backend 'dynamixel' turns"),
        ("acrobot", {"effort_limit": 0.4}, "plant 'acrobot' has no motor at shoulder; expected one at each joint"),
        ("xl330", {"clock": "lockstep"}, "clock is 'lockstep' with backend 'dynamixel'"),
    ],
)
def test_parameters_that_do_not_fit_the_joints_are_refused(plant: str, given: dict[str, Any], sentence: str) -> None:
    specs = for_plant(SPECS, plant, "dynamixel")
    values = {spec.name: spec.default for spec in specs}
    values |= {"plant": plant, "backend": "dynamixel", "interface": "loop", **given}
    with pytest.raises(ParameterError, match=re.escape(sentence)):
        assemble(values, specs, lockstep=values["clock"] == "lockstep")
