"""The checklist before arming: what it passes, what it refuses, and whom it blames."""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.checks import check_cli
from pendulum_hw_bridge.checks.check_item import HOST_ITEM, Checklist
from pendulum_hw_bridge.checks.checklist import run_checklist
from pendulum_hw_bridge.checks.nudge import hand_of
from pendulum_hw_bridge.drive.safety import SafetyLimits
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.nodes import bridge_node
from pendulum_hw_bridge.port.actuator import Feedback, MStopAction, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock, WallClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_hw_bridge.port.settings import BridgeSettings

SETTINGS = BridgeSettings(gains=DEFAULT_GAINS[3])


class Pulse:
    """A computer that wakes as late as it is told, stretch by stretch; the last stays."""

    def __init__(self, *late: float) -> None:
        self.late = list(late) or [0.0]

    def start(self) -> None:
        """Begin."""

    def poll(self) -> None:
        """Nothing keeps a reader of simulated time from looking."""

    def stop(self) -> Sequence[float]:
        """Return one lateness for all wakings."""
        return [self.late.pop(0) if len(self.late) > 1 else self.late[0]] * 100


class LateReader(EmulatorBackend):
    """An emulator whose records are taken in bursts for its first stretches, as on a computer that is held up."""

    busy_until_ns = 0

    def read(self, timeout: float) -> Feedback | None:
        if self.clock.now_ns() < self.busy_until_ns:
            self.clock.wait_until(self.clock.now_ns() + 70_000_000)
            self.actuator.feedback(self.clock.now_ns())
        return super().read(timeout)


class LossyNetwork(EmulatorBackend):
    """An emulator some of whose records never come, by their number."""

    lost = frozenset[int]()
    records = 0

    def read(self, timeout: float) -> Feedback | None:
        record = super().read(timeout)
        self.records += record is not None
        return None if self.records in self.lost else record


class HeldUpReader(EmulatorBackend):
    """An emulator on the wall clock whose reader alone is held up now and then, in its first stretch."""

    records = 0

    def read(self, timeout: float) -> Feedback | None:
        record = super().read(timeout)
        self.records += record is not None
        if record is not None and self.records in {20, 30, 40}:
            time.sleep(0.035)
        return record


def checklist(
    fault: ActuatorFault | None = None,
    settings: BridgeSettings = SETTINGS,
    *,
    plant: str = "thesis",
    position: float = 0.0,
    busy_for: float = 0.0,
    host: Pulse | None = None,
    nudge: bool = True,
) -> Checklist:
    parameters = load_emulator(plant)
    actuator = EmulatedX5(parameters, seed=1, position=position)
    port = LateReader(actuator, SteppedClock())
    port.busy_until_ns = round(1e9 * busy_for)
    if fault is not None:
        actuator.inject(fault)
    found = run_checklist(
        port,
        settings,
        SafetyLimits(),
        parameters.plant,
        window=(-4.0, 4.0),
        hand=hand_of(port, print) if nudge else None,
        host=host or Pulse(),
    )
    assert actuator.strategy is Strategy.OFF
    return found


def lossy_checklist(lost: Sequence[int]) -> tuple[Checklist, list[str]]:
    """Return the checklist of a module some of whose records never come, and what was told on the way."""
    parameters = load_emulator("thesis")
    port = LossyNetwork(EmulatedX5(parameters, seed=1), SteppedClock())
    port.lost = frozenset(lost)
    told: list[str] = []
    found = run_checklist(port, SETTINGS, SafetyLimits(), parameters.plant, host=Pulse(), progress=told.append)
    return found, told


def passed(found: Checklist) -> dict[str, bool | None]:
    return {item.name: item.passed for item in found.items}


def test_the_check_states_what_the_motor_makes_where_it_brakes_beside_the_effort_limit() -> None:
    limits = replace(SETTINGS.limits, effort=3.0, velocity=1.5)
    (item,) = [
        item for item in checklist(settings=replace(SETTINGS, limits=limits)).items if "effort limit" in item.name
    ]
    assert item.passed
    assert item.seen == "3 N m, up to 20.8 N m where the motor brakes at 1.5 rad/s"


def test_a_motion_stop_that_is_disabled_as_it_was_set_fails_the_check() -> None:
    limits = replace(SETTINGS.limits, m_stop=MStopAction.DISABLED)
    found = checklist(settings=replace(SETTINGS, limits=limits))
    (item,) = [item for item in found.items if item.name == "motion stop does what it should"]
    assert (item.passed, item.seen) == (False, "disabled")
    assert not found.ready


@pytest.mark.parametrize("plant", ["thesis", "x5_9"])
def test_a_healthy_actuator_passes_every_line(plant: str) -> None:
    found = checklist(plant=plant)
    assert len(found.items) >= 25
    assert found.ready, [item for item in found.items if not item.passed]
    assert not found.untried
    assert found.figures["rate_hz"] == pytest.approx(100.0, rel=0.01)
    assert found.figures["lost"] == 0.0


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        (ActuatorFault.M_STOP, "motion stop is released"),
        (ActuatorFault.M_STOP, "the bridge finds no fault"),
        (ActuatorFault.VOLTAGE_LOW, "supply voltage"),
        (ActuatorFault.WINDING_HOT, "winding temperature"),
        (ActuatorFault.FEEDBACK_LOST, "feedback flows"),
        (ActuatorFault.POSITION_NAN, "position, velocity, effort are numbers"),
        (ActuatorFault.VELOCITY_SPIKE, "pendulum is at rest"),
        (ActuatorFault.EFFORT_OFFSET, "torque at rest is what hangs there"),
        (ActuatorFault.OUTSIDE_WINDOW, "angle is inside its window"),
        (ActuatorFault.LOCKED_BY_OTHER, "no_acknowledgement"),
        (ActuatorFault.OVER_TEMPERATURE_MOTOR, "firmware's temperature state"),
    ],
)
def test_each_defect_fails_its_own_line(fault: ActuatorFault, line: str) -> None:
    found = checklist(fault)
    assert passed(found)[line] is False
    assert found.refused


@pytest.mark.parametrize("offset", [3.1, -0.3, 0.3, math.tau, -math.tau])
def test_a_zero_that_is_not_where_it_hangs_is_refused(offset: float) -> None:
    found = checklist(settings=replace(SETTINGS, joint_offset=offset))
    assert passed(found)["hanging is zero"] is False


def test_an_upright_pendulum_at_rest_does_not_pass_for_a_hanging_one() -> None:
    assert passed(checklist(position=math.pi, nudge=False))["hanging is zero"] is False


def test_friction_may_hold_a_link_as_far_off_zero_as_it_can() -> None:
    # 0.39 N m of gear friction hold 1.678 N m sin(0.2 rad).
    assert passed(checklist(plant="x5_9", position=0.2))["hanging is zero"] is True
    assert passed(checklist(plant="x5_9", position=0.2))["torque at rest is what hangs there"] is True


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wrong_sign_is_found_by_a_nudge(sign: int) -> None:
    found = checklist(settings=replace(SETTINGS, joint_sign=sign))
    assert passed(found)["counter-clockwise is positive"] is (sign == 1)
    # Nothing else can tell: mirrored angle and mirrored torque fit each other.
    assert [item.name for item in found.items if item.passed is False] == [
        "counter-clockwise is positive" for _ in range(sign == -1)
    ]


def test_a_sign_that_was_not_tried_is_not_called_ok() -> None:
    found = checklist(nudge=False)
    assert found.ready
    assert found.untried == ["counter-clockwise is positive"]


def test_a_busy_computer_is_blamed_and_not_the_actuator() -> None:
    found = checklist(busy_for=60.0, host=Pulse(0.06))
    lines = passed(found)
    assert lines[HOST_ITEM] is False
    for line in ("feedback flows", "feedback is regular", "no feedback gets lost", "feedback comes in time"):
        assert lines[line] is None
    assert found.host_busy
    assert not found.ready
    assert not found.refused


def test_a_busy_moment_passes() -> None:
    found = checklist(busy_for=1.5, host=Pulse(0.06, 0.06, 0.0))
    assert found.ready, [item for item in found.items if not item.passed]


def test_an_actuator_that_loses_records_is_blamed_by_a_punctual_computer() -> None:
    found = checklist(busy_for=60.0, host=Pulse(0.0))
    assert passed(found)["no feedback gets lost"] is False
    assert not found.host_busy


@pytest.mark.parametrize(
    ("lost", "share"),
    [
        ((), None),
        ((20, 55), None),
        # As many in one second, but too many of all.
        (range(20, 80, 8), 8 / 6.0),
        (range(20, 2000, 50), 2.0),
    ],
)
def test_lost_records_are_judged_by_their_share_of_many(lost: Sequence[int], share: float | None) -> None:
    found, told = lossy_checklist(lost)
    line = next(item for item in found.items if item.name == "no feedback gets lost")
    assert line.passed is (share is None)
    assert found.ready is (share is None)
    assert ("listening for 5 s more: records got lost" in told) is bool(lost)
    if share is not None:
        assert found.figures["lost"] == pytest.approx(share / 100.0, rel=0.1)


def test_a_gap_is_refused_at_once_however_regular_feedback_is_later() -> None:
    found, told = lossy_checklist(range(20, 24))
    assert passed(found)["feedback is regular"] is False
    assert not any("more" in line for line in told)


def test_a_reader_that_is_held_up_alone_is_no_gap_of_the_module() -> None:
    parameters, clock = load_emulator("thesis"), WallClock()
    EmulatedX5(parameters).advance_to(1_000_000)  # compiles
    port = HeldUpReader(EmulatedX5(parameters, seed=1, start_ns=clock.now_ns()), clock)
    found = run_checklist(port, SETTINGS, SafetyLimits(), parameters.plant)
    assert port.records > 40
    # Where this computer is busy all along it is told, and the module is not judged.
    told = [item.name for item in found.items if item.passed is False and item.name != HOST_ITEM]
    assert not {"feedback is regular", "no feedback gets lost", "feedback flows"} & set(told), told


def test_regular_feedback_needs_no_punctual_computer() -> None:
    assert checklist(host=Pulse(0.02)).ready


# --- command lines ----------------------------------------------------------------------------------------------


def test_check_prints_json_and_says_by_its_exit_code_whether_to_arm(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = check_cli.main(["--backend", "emulator", "--json"])
    printed = json.loads(capsys.readouterr().out)
    # On the wall clock of a busy machine the emulator's feedback is as irregular as the machine, which is then told.
    assert [item for item in printed["items"] if item["passed"] is False and item["name"] != HOST_ITEM] == []
    assert code == (3 if printed["host_busy"] else 0)
    assert {"rate_hz", "lost", "way_p99_s", "acknowledgement_median_s"} <= printed["figures"].keys()


def test_check_is_judged_by_the_options_of_the_bridge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        "format: pendulum_lab/1\nmodule: {backend: emulator}\n"
        "limits:\n  effort: {value: 2.0, unit: N m}\n  position_window: {value: [-2.0, 2.0], unit: rad}\n"
    )
    arguments = ["--check", "--json", "--ros-args", "-r", "__ns:=/hw", "-p", f"lab_file:={lab}"]
    assert bridge_node.main([*arguments, "-p", "joint_offset:=2.5", "-p", "voltage_window:=[40.0, 50.0]"]) == 1
    printed = json.loads(capsys.readouterr().out)
    lines = {item["name"]: item for item in printed["items"]}
    assert lines["effort limit reads back"]["seen"].startswith("2 N m, up to ")
    assert lines["angle is inside its window"]["expected"] == "-2 to 2 rad"
    wrong = {name for name, item in lines.items() if item["passed"] is False} - {HOST_ITEM}
    assert {"angle is inside its window", "hanging is zero", "supply voltage"} <= wrong


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--backend", "emulater"], "backend is 'emulater'; expected one of"),
        (["--lab", "none.yaml"], "lab file none.yaml does not exist"),
        (["--ros-args", "-p", "joint_ofset:=1.0"], "did you mean 'joint_offset'"),
        (["--ros-args", "-p", "effort_limit:=1"], "write 1.0"),
        (["--ros-args", "-p", "nonsense"], "ROS arguments are not understood"),
        (["--backend", "emulator", "--joint-sign", "0"], "joint_sign is 0; expected 1 or -1"),
    ],
)
def test_a_wrong_command_line_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert check_cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err


def test_a_lab_file_with_a_value_that_the_bridge_refuses_is_reported_with_its_entry(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\nlimits:\n  pwm: 1.5\n")
    assert check_cli.main(["--lab", str(lab)]) == 2
    assert f"{lab}: limits.pwm: pwm_limit is 1.5" in capsys.readouterr().err
