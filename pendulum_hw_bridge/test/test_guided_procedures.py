"""The guided procedures, on the emulator and with a scripted person."""

import math
from pathlib import Path
from typing import Any

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.checks.nudge import EmulatedHand, Person, watch_nudge
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.lab import guided, lab_cli, proofs
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.plants.lab_file import LabFile, load_lab, write_lab


class Rig:
    """An emulated machine mounted somehow, and a person who does what they are told."""

    def __init__(self, plant: str = "thesis", *, position: float = 0.0) -> None:
        self.parameters = load_emulator(plant)
        self.actuator = EmulatedX5(self.parameters, seed=3, position=position)
        self.port = EmulatorBackend(self.actuator, SteppedClock())
        self.port.connect()
        self.said: list[str] = []
        self.driven_before_agreed = False
        self.agreed = False
        self.actuator.trace = self._watch

    def _watch(self, link: Any) -> None:
        self.driven_before_agreed |= not self.agreed and link.pwm != 0.0

    def say(self, text: str) -> None:
        self.said.append(text)

    def go_on(self, text: str) -> None:
        # Some time passes until Enter is pressed.
        self.port.clock.wait_until(self.port.now_ns() + 500_000_000)
        self.port.read(0.0)
        self.said.append(text)
        self.agreed = True

    def hands(self, sign: int = 1) -> tuple[EmulatedHand, EmulatedHand]:
        return EmulatedHand(self.port.push, sign), EmulatedHand(self.port.push, -sign)


# --- zero and sign ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", ["thesis", "x5_9"])
@pytest.mark.parametrize("sign", [1, -1])
def test_zero_is_the_middle_between_the_rests_and_sign_the_way_of_the_turn(plant: str, sign: int) -> None:
    rig = Rig(plant)
    # With the sign -1 the actuator is mounted the other way round: what the person turns counter-clockwise, it counts
    # down.
    found = guided.find_zero_and_sign(rig.port, rig, *rig.hands(sign))
    assert found.sign == sign
    # Alone, friction holds the link of x5_9 0.2 rad off.
    assert found.offset == pytest.approx(0.0, abs=0.03)
    assert not rig.driven_before_agreed
    assert rig.actuator.strategy is Strategy.OFF
    assert "no torque" in rig.said[0]


@pytest.mark.parametrize("encoder", [1.2, -9.0])
def test_a_zero_that_was_found_makes_the_hanging_joint_read_zero(
    monkeypatch: pytest.MonkeyPatch, encoder: float
) -> None:
    rig = Rig()
    read = rig.port.read

    def turned(timeout: float) -> Any:
        record = read(timeout)
        return record and record._replace(position=record.position + encoder)

    monkeypatch.setattr(rig.port, "read", turned)
    found = guided.find_zero_and_sign(rig.port, rig, *rig.hands(-1))
    assert found.sign * encoder + found.offset == pytest.approx(0.0, abs=0.03)


def test_two_turns_the_same_way_or_none_are_reported() -> None:
    rig = Rig()
    hand, _ = rig.hands()
    with pytest.raises(ActuatorError, match="both turns went the same way"):
        guided.find_zero_and_sign(rig.port, rig, hand, hand)
    with pytest.raises(ActuatorError, match="nothing turned"):
        guided.find_zero_and_sign(rig.port, rig, EmulatedHand(lambda torque: None), hand)


# --- tare -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", ["thesis", "x5_9"])
def test_a_healthy_sensor_has_next_to_no_tare(plant: str) -> None:
    rig = Rig(plant)
    found = guided.measure_tare(rig.port, BridgeSettings(), rig.parameters.plant, rig)
    assert found == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("sign", "offset"), [(1, 0.4), (-1, 0.4), (1, -0.7)])
def test_the_tare_is_what_the_sensor_shows_beyond_what_hangs_there(
    monkeypatch: pytest.MonkeyPatch, sign: int, offset: float
) -> None:
    rig = Rig()
    read = rig.port.read

    def biased(timeout: float) -> Any:
        record = read(timeout)
        return record and record._replace(effort=record.effort + offset)

    monkeypatch.setattr(rig.port, "read", biased)
    settings = BridgeSettings(joint_sign=sign)
    assert guided.measure_tare(rig.port, settings, rig.parameters.plant, rig) == pytest.approx(sign * offset, abs=0.02)


def test_a_torque_that_something_pulls_with_is_no_tare() -> None:
    rig = Rig()
    rig.actuator.inject(ActuatorFault.EFFORT_OFFSET)
    with pytest.raises(ActuatorError, match="something pulls, or zero is wrong"):
        guided.measure_tare(rig.port, BridgeSettings(), rig.parameters.plant, rig)


# --- proofs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lifetime", [0.03, 0.05, 0.25])
def test_the_torque_ends_by_itself_when_nobody_commands(lifetime: float) -> None:
    rig = Rig()
    took = proofs.prove_lifetime(rig.port, BridgeSettings(command_lifetime=lifetime), rig)
    assert lifetime - 0.01 <= took <= lifetime + 0.02
    assert rig.actuator.lifetime_expiries == 1
    assert not rig.driven_before_agreed
    assert rig.actuator.strategy is Strategy.OFF
    assert "THE MOTOR WILL TURN GENTLY" in rig.said[0]
    assert abs(rig.actuator.link.position) < math.radians(15.0)


def test_a_lifetime_that_does_not_end_the_torque_is_reported_and_the_motor_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = Rig()
    # A module that keeps another lifetime than it says.
    monkeypatch.setattr(rig.port, "set_command_lifetime", lambda lifetime: lifetime)
    rig.actuator.configure(command_lifetime=5.0)
    with pytest.raises(ActuatorError, match=r"kept its duty for .* Do not arm this machine"):
        proofs.prove_lifetime(rig.port, BridgeSettings(), rig)
    assert rig.actuator.strategy is Strategy.OFF


def test_the_motion_stop_is_proved_by_pressing_it() -> None:
    rig = Rig()
    write, cycles = rig.port.write, iter(range(1000))

    def press_in_the_30th_cycle(command: Command) -> Any:
        if next(cycles) == 30:
            rig.actuator.inject(ActuatorFault.M_STOP)
        return write(command)

    rig.port.write = press_in_the_30th_cycle  # type: ignore[method-assign]
    assert proofs.prove_m_stop(rig.port, BridgeSettings(), rig) <= 0.06
    assert not rig.driven_before_agreed
    assert rig.actuator.strategy is Strategy.OFF


def test_a_motion_stop_that_nobody_presses_or_that_is_pressed_already_proves_nothing() -> None:
    rig = Rig()
    with pytest.raises(ActuatorError, match="was not pressed within 20 s"):
        proofs.prove_m_stop(rig.port, BridgeSettings(), rig)
    assert rig.actuator.strategy is Strategy.OFF
    rig.actuator.inject(ActuatorFault.M_STOP)
    with pytest.raises(ActuatorError, match="is the motion stop pressed already"):
        proofs.prove_m_stop(rig.port, BridgeSettings(), rig)


@pytest.mark.parametrize("proof", [proofs.prove_lifetime, proofs.prove_m_stop])
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (ActuatorFault.OUTSIDE_WINDOW, r"position is 20\.00 rad; expected -4 to 4 rad"),
        (ActuatorFault.OVERSPEED, r"velocity is 1\.55 rad/s; expected at most 1\.5 rad/s"),
        (ActuatorFault.WINDING_HOT, "winding is at 150 degC"),
        (ActuatorFault.VOLTAGE_LOW, r"supply is 18\.0 V"),
    ],
)
def test_a_proof_that_leaves_its_limits_gets_no_more_duty(proof: Any, fault: ActuatorFault, message: str) -> None:
    rig = Rig()
    rig.actuator.inject(fault)
    settings = BridgeSettings(limits=HardwareLimits(position_min=-4.0, position_max=4.0))
    driven: list[float] = []
    write = rig.port.write

    def noted(command: Command) -> Any:
        driven.append(command.pwm)
        return write(command)

    rig.port.write = noted  # type: ignore[method-assign]
    with pytest.raises(ActuatorError, match=message):
        proof(rig.port, settings, rig)
    assert driven == []
    assert rig.actuator.limits == settings.limits
    assert rig.actuator.strategy is Strategy.OFF


def test_a_link_that_turns_on_under_the_gentle_duty_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    read, speed = rig.port.read, 1.0

    def turning(timeout: float) -> Any:
        record = read(timeout)
        return record and record._replace(position=speed * record.hardware_ns / 1e9, velocity=speed)

    monkeypatch.setattr(rig.port, "read", turning)
    begin_ns = rig.port.now_ns()
    with pytest.raises(ActuatorError, match=r"turned by 1\.0. rad under the duty 0\.01; expected at most 1 rad"):
        proofs.prove_m_stop(rig.port, BridgeSettings(), rig)
    assert rig.port.now_ns() - begin_ns < 2.5e9
    assert rig.actuator.strategy is Strategy.OFF


def test_a_lifetime_of_four_times_what_was_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    monkeypatch.setattr(rig.port, "set_command_lifetime", lambda lifetime: lifetime)
    rig.actuator.configure(command_lifetime=0.2)
    with pytest.raises(ActuatorError, match=r"kept its duty for [78]\d ms .* expected at most 70 ms"):
        proofs.prove_lifetime(rig.port, BridgeSettings(), rig)


def test_a_motion_stop_that_shows_but_does_not_end_the_duty_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    read, begin_ns = rig.port.read, rig.port.now_ns()

    def pressed_after_a_second(timeout: float) -> Any:
        record = read(timeout)
        return record and record._replace(m_stop=record.stamp_ns - begin_ns > 1_000_000_000)

    monkeypatch.setattr(rig.port, "read", pressed_after_a_second)
    with pytest.raises(ActuatorError, match=r"after the motion stop; expected at most 60 ms. Do not arm"):
        proofs.prove_m_stop(rig.port, BridgeSettings(command_lifetime=0.25), rig)
    assert rig.actuator.strategy is Strategy.OFF


def test_the_tare_of_a_link_that_hangs_aside_leaves_its_weight_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    read, weight = rig.port.read, rig.parameters.plant.gravity * math.sin(0.3)

    def aside(timeout: float) -> Any:
        record = read(timeout)
        return record and record._replace(position=record.position + 0.3, effort=record.effort + weight)

    monkeypatch.setattr(rig.port, "read", aside)
    assert guided.measure_tare(rig.port, BridgeSettings(), rig.parameters.plant, rig) == pytest.approx(0.0, abs=0.05)


def test_lost_feedback_ends_a_proof_with_the_motor_off() -> None:
    rig = Rig()
    rig.actuator.inject(ActuatorFault.FEEDBACK_LOST)
    with pytest.raises(ActuatorError, match="no feedback for 100 ms; expected it every 10 ms"):
        proofs.prove_lifetime(rig.port, BridgeSettings(), rig)
    assert rig.actuator.strategy is Strategy.OFF


@pytest.mark.parametrize("begun", [0.0, 3.0])
def test_a_module_that_goes_while_somebody_waits_for_it_is_missed_within_two_seconds(begun: float) -> None:
    def lost(procedure: Any) -> float:
        rig = Rig()
        read, start_ns = rig.port.read, rig.port.now_ns()

        def going(timeout: float) -> Any:
            if rig.port.now_ns() - start_ns > begun * 1e9:
                rig.actuator.inject(ActuatorFault.FEEDBACK_LOST)
            return read(timeout)

        rig.port.read = going  # type: ignore[method-assign]
        with pytest.raises(ActuatorError, match=r"no feedback for 1 s; expected it to flow"):
            procedure(rig)
        return (rig.port.now_ns() - start_ns) / 1e9 - begun

    still = EmulatedHand(lambda torque: None)
    for procedure in (
        lambda rig: guided.find_zero_and_sign(rig.port, rig, still, still),
        lambda rig: guided.measure_tare(rig.port, BridgeSettings(), rig.parameters.plant, rig),
        lambda rig: watch_nudge(rig.port, still),
    ):
        # Half a second goes by until the person agrees.
        assert lost(procedure) < 2.0


@pytest.mark.parametrize(
    ("fault", "what"), [(ActuatorFault.POSITION_NAN, "position"), (ActuatorFault.EFFORT_NAN, "effort")]
)
def test_what_is_no_number_is_reported_at_once_and_reaches_no_lab_file(fault: ActuatorFault, what: str) -> None:
    rig = Rig()
    rig.actuator.inject(fault)
    begin_ns = rig.port.now_ns()
    with pytest.raises(ActuatorError, match=f"{what} is nan"):
        guided.measure_tare(rig.port, BridgeSettings(), rig.parameters.plant, rig)
    with pytest.raises(ActuatorError, match=f"{what} is nan"):
        guided.find_zero_and_sign(rig.port, rig, *rig.hands())
    with pytest.raises(ActuatorError, match=f"{what} is nan"):
        proofs.prove_lifetime(rig.port, BridgeSettings(), rig)
    assert rig.port.now_ns() - begin_ns < 10e9
    assert rig.actuator.strategy is Strategy.OFF


def test_a_person_is_reported_that_a_turn_was_seen_only_where_it_was() -> None:
    rig = Rig()
    said: list[str] = []
    assert watch_nudge(rig.port, Person(said.append), patience=1.0) == 0.0
    assert not any("Seen" in sentence for sentence in said)
    rig.port.push(6.0)
    assert watch_nudge(rig.port, Person(said.append)) > 0.0
    assert "Seen" in said[-1]


# --- command line -----------------------------------------------------------------------------------------------


def test_a_lab_file_is_written_step_by_step_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = str(tmp_path / "lab.yaml")
    arguments = ["--backend", "emulator_process", "--emulator-address", "127.0.0.1:9"]
    assert lab_cli.main(["new", lab, *arguments, "--effort", "4", "--supply", "36"]) == 0
    assert lab_cli.main(["new", lab, *arguments]) == 2
    assert "is there already" in capsys.readouterr().err
    assert load_lab(lab).values["voltage_window"] == [30.6, 41.4]

    rig = Rig("thesis")
    monkeypatch.setattr("pendulum_hw_bridge.bridge.bridge_parameters.make_port", lambda *_, **__: rig.port)
    assert lab_cli.main(["backup", lab, "--out", str(tmp_path / "before")]) == 0
    assert "not what it was before us" not in capsys.readouterr().err
    for step in ("zero", "tare", "prove_lifetime"):
        assert lab_cli.main([step, lab, "--yes"]) == 0, capsys.readouterr().err
    values, proofs = load_lab(lab).values, load_lab(lab).proofs
    assert values["joint_sign"] == 1
    assert values["joint_offset"] == pytest.approx(0.0, abs=0.03)
    assert abs(values["effort_tare"]) < 0.1
    assert set(proofs) == {"zero", "effort_tare", "command_lifetime"}
    assert lab_cli.main(["backup", lab, "--out", str(tmp_path / "proved")]) == 0
    assert "this backup holds what the module is set to now, not what it was before us" in capsys.readouterr().err
    assert lab_cli.main(["restore", lab, str(tmp_path / "before"), "--yes"]) == 0
    # Given back, it is again what it was before us.
    assert lab_cli.main(["backup", lab, "--out", str(tmp_path / "after")]) == 0
    assert "not what it was before us" not in capsys.readouterr().err
    assert lab_cli.main(["show", lab]) == 0
    assert "torque ended" in capsys.readouterr().out


def test_a_step_that_fails_or_is_left_keeps_the_lab_file_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\nmodule: {backend: emulator}\n")
    before = lab.read_text()
    rig = Rig()
    rig.actuator.inject(ActuatorFault.EFFORT_OFFSET)
    monkeypatch.setattr("pendulum_hw_bridge.bridge.bridge_parameters.make_port", lambda *_, **__: rig.port)
    assert lab_cli.main(["tare", str(lab), "--yes"]) == 2
    assert "something pulls" in capsys.readouterr().err

    def leave(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr("builtins.input", leave)
    assert lab_cli.main(["prove_lifetime", str(lab)]) == 130

    def nobody(*_: object) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", nobody)
    assert lab_cli.main(["prove_lifetime", str(lab)]) == 2
    assert "a person is needed" in capsys.readouterr().err
    assert lab.read_text() == before
    assert not rig.driven_before_agreed


def test_a_machine_that_does_not_stand_a_proof_loses_an_older_one_and_a_person_that_leaves_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    write_lab(
        lab, LabFile({"backend": "emulator"}).proved("command_lifetime", "today", "ok").proved("m_stop", "1", "2")
    )
    rig = Rig()
    monkeypatch.setattr("pendulum_hw_bridge.bridge.bridge_parameters.make_port", lambda *_, **__: rig.port)

    def left(*_: object, **__: object) -> float:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(proofs, "prove_lifetime", left)
        assert lab_cli.main(["prove_lifetime", str(lab), "--yes"]) == 130
        assert set(load_lab(lab).proofs) == {"command_lifetime", "m_stop"}
    monkeypatch.setattr(rig.port, "set_command_lifetime", lambda lifetime: lifetime)
    rig.actuator.configure(command_lifetime=5.0)

    def fail() -> None:
        raise ActuatorError("stop_unacknowledged", "nobody has acknowledged it")

    monkeypatch.setattr(rig.port, "close", fail)
    assert lab_cli.main(["prove_lifetime", str(lab), "--yes"]) == 2
    assert set(load_lab(lab).proofs) == {"m_stop"}
    told = capsys.readouterr().err
    assert "command_lifetime: no longer proved" in told
    assert "Do not arm this machine; and then: nobody has acknowledged it" in told


@pytest.mark.parametrize("way", ["done", "failed", "left", "not connected"])
def test_the_module_is_released_on_every_way_out_of_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\nmodule: {backend: emulator}\n")
    rig, closed = Rig(), list[Strategy]()
    close = rig.port.close

    def noted() -> None:
        close()
        closed.append(rig.actuator.strategy)

    def break_off(*_: object, **__: object) -> Any:
        raise KeyboardInterrupt if way == "left" else ActuatorError("module_lost", "no answer")

    monkeypatch.setattr(rig.port, "close", noted)
    monkeypatch.setattr("pendulum_hw_bridge.bridge.bridge_parameters.make_port", lambda *_, **__: rig.port)
    if way == "not connected":
        monkeypatch.setattr(rig.port, "connect", break_off)
    elif way != "done":
        # In the middle of it: the motor has a strategy then, and nothing but the way out switches it off.
        monkeypatch.setattr(proofs, "_GentleDrive", break_off)
        monkeypatch.setattr(rig.port, "stop", lambda: None)
        rig.port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.0))
        monkeypatch.setattr(rig.port, "close", lambda: (EmulatorBackend.stop(rig.port), noted()))
    assert lab_cli.main(["prove_lifetime", str(lab), "--yes"]) == {"done": 0, "left": 130}.get(way, 2)
    assert closed == [Strategy.OFF]


@pytest.mark.parametrize("proof", [proofs.prove_lifetime, proofs.prove_m_stop])
@pytest.mark.parametrize(("effort", "supply"), [(0.1, 36.0), (0.45, 48.0)])
def test_no_proof_drives_with_more_than_the_effort_limit(proof: Any, effort: float, supply: float) -> None:
    rig = Rig()
    rig.actuator = EmulatedX5(rig.parameters.with_drivetrain(supply_voltage=supply), seed=3)
    rig.port = EmulatorBackend(rig.actuator, SteppedClock())
    rig.port.connect()
    duties: list[float] = []
    rig.actuator.trace = lambda link: duties.append(link.pwm)
    with pytest.raises(ActuatorError, match=rf"N m at {supply:.0f} V; expected at most the effort limit, {effort:g}"):
        proof(rig.port, BridgeSettings(limits=HardwareLimits(effort=effort)), rig)
    assert set(duties) == {0.0}
    assert rig.actuator.strategy is Strategy.OFF


@pytest.mark.parametrize("proof", [proofs.prove_lifetime, proofs.prove_m_stop])
@pytest.mark.parametrize(
    ("setter", "reads", "message"),
    [
        ("set_command_lifetime", 0.5, "command lifetime reads back as 0.5 s"),
        ("set_feedback_rate", 50.0, "feedback rate reads back as 50 Hz"),
        ("set_limits", HardwareLimits(velocity=9.0), "velocity limit reads back as 9 rad/s"),
    ],
)
def test_a_module_that_keeps_other_settings_gets_no_duty_for_a_proof(
    monkeypatch: pytest.MonkeyPatch, proof: Any, setter: str, reads: object, message: str
) -> None:
    rig = Rig()
    monkeypatch.setattr(rig.port, setter, lambda wanted: reads)
    duties: list[float] = []
    rig.actuator.trace = lambda link: duties.append(link.pwm)
    with pytest.raises(ActuatorError, match=message):
        proof(rig.port, BridgeSettings(), rig)
    assert not any(duties)
    assert rig.actuator.strategy is Strategy.OFF
