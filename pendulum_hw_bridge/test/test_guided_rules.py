"""What the guided procedures measure and allow, to the number, on records that are given and a biased emulator."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path
from typing import Any

import pytest

from pendulum_hw_bridge import guided, lab_cli
from pendulum_hw_bridge.actuator import ActuatorError, Command, Feedback, HardwareLimits, Strategy
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.clocks import SteppedClock
from pendulum_hw_bridge.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.nudge import EmulatedHand
from pendulum_hw_bridge.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.settings import BridgeSettings
from pendulum_msgs_py.plants.lab_file import load_lab
from tests.feedback_records import feedback_record

PARAMETERS = load_emulator("thesis")
HAND = EmulatedHand(lambda torque: None)


class Person:
    """Agrees to everything, and remembers what was said."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    go_on = say


def emulator() -> EmulatorBackend:
    port = EmulatorBackend(EmulatedX5(PARAMETERS, seed=3), SteppedClock())
    port.connect()
    return port


def changed(monkeypatch: pytest.MonkeyPatch, port: EmulatorBackend, change: Any) -> None:
    """Change each record on its way."""
    read = port.read

    def altered(timeout: float) -> Feedback | None:
        record = read(timeout)
        return record and change(record)

    monkeypatch.setattr(port, "read", altered)


class Given:
    """An actuator whose records are given, with the time in milliseconds and the duty; then none comes any more."""

    def __init__(self, *records: tuple[float, float]) -> None:
        self._records = list(records)
        self.time_ns = 0

    def now_ns(self) -> int:
        return self.time_ns

    def read(self, timeout: float) -> Feedback | None:
        assert timeout == 0.01
        if not self._records:
            self.time_ns += round(timeout * 1e9)
            return None
        milliseconds, duty = self._records.pop(0)
        self.time_ns = max(self.time_ns, round(milliseconds * 1e6))
        return feedback_record(stamp_ns=round(milliseconds * 1e6), pwm_command=duty)


# --- zero and tare ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
def test_zero_lies_between_the_two_rests(monkeypatch: pytest.MonkeyPatch, sign: int) -> None:
    port, person = emulator(), Person()
    places = {"now": 0.0}
    ways = iter([(0.25 * sign, 0.3 * sign), (-0.15 * sign, -0.3 * sign)])
    port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.0))

    def turned(*_: object) -> float:
        places["now"], way = next(ways)
        return way

    changed(monkeypatch, port, lambda record: record._replace(position=places["now"]))
    monkeypatch.setattr(guided, "_turned", turned)
    found = guided.find_zero_and_sign(port, person, HAND, HAND)
    assert found.sign == sign
    assert found.offset == pytest.approx(-0.05)
    assert port.actuator.strategy is Strategy.OFF
    assert found.play == pytest.approx(0.4)
    assert f"joint angle is -0.0500 rad where the actuator reads zero, sign {sign:+d}" in person.said[-1]
    assert "22.9 degrees of play" in person.said[-1]
    assert "CLOCKWISE" in "".join(person.said[1:-1])


def test_a_tare_of_up_to_a_newton_metre_is_one_and_more_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def tare(offset: float) -> float:
        port = emulator()
        with monkeypatch.context() as patch:
            changed(patch, port, lambda record: record._replace(position=0.0, effort=offset))
            return guided.measure_tare(port, BridgeSettings(), PARAMETERS.plant, Person())

    assert tare(1.0) == 1.0
    assert tare(-1.0) == -1.0
    for offset in (1.01, -1.01):
        with pytest.raises(ActuatorError, match="expected within 1 N m of what hangs there: something pulls"):
            tare(offset)


def test_the_tare_is_in_joint_coordinates_and_leaves_out_what_hangs_at_the_joint_s_own_angle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = emulator()
    port.set_strategy(Strategy.DIRECT_PWM, Command(pwm=0.0))
    torque = PARAMETERS.plant.gravity * math.sin(0.5) + 0.25
    changed(monkeypatch, port, lambda record: record._replace(position=-0.2, effort=-torque))
    settings = BridgeSettings(joint_sign=-1, joint_offset=0.3)
    assert guided.measure_tare(port, settings, PARAMETERS.plant, Person()) == pytest.approx(0.25)
    assert port.actuator.strategy is Strategy.OFF


def test_the_noise_of_the_sensor_is_told_with_the_tare(monkeypatch: pytest.MonkeyPatch) -> None:
    port, person, signs = emulator(), Person(), iter([1.0, -1.0] * 1000)
    changed(monkeypatch, port, lambda record: record._replace(position=0.0, effort=0.5 + 0.1 * next(signs)))
    guided.measure_tare(port, BridgeSettings(), PARAMETERS.plant, person)
    assert person.said[-1] == "Tare: +0.500 N m (noise 0.100 N m)."


def test_the_tare_reaches_the_lab_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\nmodule: {backend: emulator}\n", encoding="utf-8")
    port = emulator()
    changed(monkeypatch, port, lambda record: record._replace(position=0.0, effort=0.4))
    monkeypatch.setattr("pendulum_hw_bridge.bridge_parameters.make_port", lambda *_, **__: port)
    assert lab_cli.main(["tare", str(lab), "--yes"]) == 0
    assert load_lab(lab).values["effort_tare"] == pytest.approx(0.4)
    assert "+0.400 N m" in load_lab(lab).proofs["effort_tare"]["result"]


def test_a_pendulum_that_never_rests_is_waited_for_two_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    def rest(speed: float) -> float:
        port = emulator()
        with monkeypatch.context() as patch:
            changed(patch, port, lambda record: record._replace(position=speed * record.hardware_ns / 1e9))
            return guided._rest(port, Person())

    # Between the means of a first and a last quarter of two seconds lie one and a half.
    rest(0.0003)
    begin = emulator()
    changed(monkeypatch, begin, lambda record: record._replace(position=-0.0004 * record.hardware_ns / 1e9))
    begin_ns = begin.now_ns()
    with pytest.raises(ActuatorError, match="did not come to rest within 120 s; expected it to hang still"):
        guided._rest(begin, Person())
    assert 120.0 <= (begin.now_ns() - begin_ns) / 1e9 < 121.0


def test_three_records_are_enough_to_rest_and_half_a_milliradian_is_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    person, windows = Person(), iter([[0.0, 0.0, 0.0, 5e-4], [0.0, 0.0, 0.0, -5e-4], [0.1, 0.1, 0.1]])
    monkeypatch.setattr(guided, "_listen", lambda *_: [feedback_record(position=angle) for angle in next(windows)])
    assert guided._rest(emulator(), person) == pytest.approx(0.1)
    assert person.said == ["Waiting for it to come to rest ..."]


# --- proofs -----------------------------------------------------------------------------------------------------


def test_the_duty_for_proofs_makes_less_than_half_a_newton_metre() -> None:
    drivetrain = PARAMETERS.plant.drivetrain
    assert drivetrain is not None
    mapping = EffortMapping(EffortStrategy.DIRECT_PWM, drivetrain, effort_limit=13.0)
    assert 0.2 < mapping.motor_effort(guided.PROOF_DUTY, 0.0, 36.0) < 0.5


@pytest.mark.parametrize("proof", [guided.prove_lifetime, guided.prove_m_stop])
def test_a_proof_sends_its_gentle_duty_for_its_time_and_sets_what_the_bridge_sets(
    monkeypatch: pytest.MonkeyPatch, proof: Any
) -> None:
    port, sent = emulator(), list[float]()
    settings = BridgeSettings(feedback_rate=200.0, command_lifetime=0.04, limits=HardwareLimits(effort=3.0))
    write = port.write

    def noted(command: Command) -> Any:
        sent.append(command.pwm)
        if proof is guided.prove_m_stop and len(sent) == 60:
            port.actuator.inject(ActuatorFault.M_STOP)
        return write(command)

    monkeypatch.setattr(port, "write", noted)
    took = proof(port, settings, Person())
    assert set(sent) == {guided.PROOF_DUTY}
    # 0.3 s at 200 Hz; the motion stop shows in the record after next.
    assert 55 <= len(sent) <= 64
    assert 0.0 <= took <= 0.06
    status = port.connect()
    assert (status.feedback_rate, status.command_lifetime) == (200.0, 0.04)
    assert status.limits == settings.limits
    assert port.strategy is Strategy.OFF


def test_a_strategy_that_reads_back_as_another_gets_no_duty(monkeypatch: pytest.MonkeyPatch) -> None:
    port, sent = emulator(), list[Command]()
    monkeypatch.setattr(port, "set_strategy", lambda strategy, command=None: Strategy.PARALLEL_PWM)
    monkeypatch.setattr(port, "write", sent.append)
    with pytest.raises(ActuatorError, match="strategy reads back as PARALLEL_PWM; expected DIRECT_PWM"):
        guided.prove_lifetime(port, BridgeSettings(), Person())
    assert sent == []


def test_ten_periods_of_silence_end_a_drive_and_not_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    def silence_of(looks: int, first: int) -> int:
        port, count = emulator(), {"reads": 0, "silent": 0}
        read = port.read

        def silent(timeout: float) -> Feedback | None:
            record = read(timeout)
            assert timeout == 0.01
            count["reads"] += 1
            if first < count["reads"] <= first + looks:
                count["silent"] += 1
                return None
            return record

        with monkeypatch.context() as patch:
            patch.setattr(port, "read", silent)
            with contextlib.suppress(ActuatorError):
                guided._drive(port, BridgeSettings(), None, lambda record, now: now < 0.3)
                return 0
        return count["silent"]

    for first in (0, 4):
        assert silence_of(10, first) == 0
        assert silence_of(1000, first) == 11


@pytest.mark.parametrize(("duty", "driven"), [(0.0051, True), (-0.0051, True), (0.005, False), (-0.005, False)])
def test_a_motor_with_more_than_half_of_the_duty_was_driven(
    monkeypatch: pytest.MonkeyPatch, duty: float, driven: bool
) -> None:
    port = emulator()
    changed(monkeypatch, port, lambda record: record._replace(pwm_command=duty))
    monkeypatch.setattr(SafetyMonitor, "check", lambda *_: None)
    with contextlib.nullcontext() if driven else pytest.raises(ActuatorError, match=r"never had the duty 0\.01"):
        guided._drive(port, BridgeSettings(), None, lambda record, now: now < 0.1)


class Proof:
    """A proof whose drive and end of duty are given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, ended: float, *, pressed: bool = True) -> None:
        self.person, self.limits, self.port = Person(), list[float](), emulator()
        self.goes_on: Any = None
        self._pressed = pressed
        self._ended = ended
        monkeypatch.setattr(guided, "_drive", self._drive)
        monkeypatch.setattr(guided, "_duty_ends", self._duty_ends)

    def _drive(self, port: object, settings: object, checks: object, goes_on: Any, drivetrain: object) -> int:
        self.goes_on = goes_on
        if self._pressed:
            goes_on(feedback_record(stamp_ns=1_000_000_000, m_stop=True), 1.0)
        return 1_000_000_000

    def _duty_ends(self, port: object, since_ns: int, limit: float) -> float:
        assert since_ns == 1_000_000_000
        self.limits.append(limit)
        return self._ended


def test_a_lifetime_is_proved_up_to_two_records_later_and_driven_for_no_longer_than_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = BridgeSettings(feedback_rate=100.0, command_lifetime=0.05)
    limit = 0.05 + 2 / 100.0
    proof = Proof(monkeypatch, limit)
    assert guided.prove_lifetime(proof.port, settings, proof.person) == limit
    assert proof.person.said[-1].startswith("Proved: the torque ended 70 ms after the last command (at most 70 ms")
    assert [proof.goes_on(feedback_record(), now) for now in (0.0, 0.2999, 0.3)] == [True, True, False]
    assert proof.limits == [limit]
    proof = Proof(monkeypatch, limit + 1e-6)
    with pytest.raises(ActuatorError, match=r"expected at most 70 ms\. Do not arm"):
        guided.prove_lifetime(proof.port, settings, proof.person)


def test_a_motion_stop_is_proved_within_60_ms_and_waited_for_no_longer_than_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    proof = Proof(monkeypatch, 0.06)
    assert guided.prove_m_stop(proof.port, BridgeSettings(), proof.person) == 0.06
    assert "Press the motion stop NOW." in proof.person.said
    assert proof.person.said[-1] == "Proved: the torque ended within 60 ms. Release the motion stop."
    assert [proof.goes_on(feedback_record(), now) for now in (0.0, 19.99, 20.0)] == [True, True, False]
    assert not proof.goes_on(feedback_record(m_stop=True), 0.0)
    assert proof.limits == [0.06]
    proof = Proof(monkeypatch, 0.060001)
    with pytest.raises(ActuatorError, match=r"expected at most 60 ms\. Do not arm"):
        guided.prove_m_stop(proof.port, BridgeSettings(), proof.person)
    proof = Proof(monkeypatch, 0.0, pressed=False)
    with pytest.raises(ActuatorError, match="was not pressed within 20 s"):
        guided.prove_m_stop(proof.port, BridgeSettings(), proof.person)


@pytest.mark.parametrize("limits", [None, SafetyLimits(winding_temperature=90.0)])
def test_a_proof_is_watched_by_the_checks_that_the_bridge_has_at_its_own_rate(
    monkeypatch: pytest.MonkeyPatch, limits: SafetyLimits | None
) -> None:
    made: list[tuple[SafetyLimits, float]] = []

    class Watched(SafetyMonitor):
        def __init__(self, limits: SafetyLimits, period: float) -> None:
            made.append((limits, period))
            super().__init__(limits, period)

    monkeypatch.setattr(guided, "SafetyMonitor", Watched)
    guided.prove_lifetime(emulator(), BridgeSettings(feedback_rate=200.0), Person(), limits)
    assert made == [(limits or SafetyLimits(), 1.0 / 200.0)]


def test_the_duty_has_ended_with_the_first_record_after_the_last_command_that_has_none() -> None:
    def ended(*records: tuple[float, float]) -> float:
        return guided._duty_ends(Given(*records), 100_000_000, 0.07)  # type: ignore[arg-type]

    # A record from before the last command says nothing of it, and half of the duty is duty.
    assert ended((90.0, 0.0), (110.0, 0.01), (120.0, 0.005), (130.0, 1e-8), (140.0, 0.0)) == pytest.approx(0.04)
    assert ended((100.0, 0.0)) == 0.0
    assert ended((110.0, 0.01), (120.0, -1e-10)) == pytest.approx(0.02)
    kept = [(110.0 + 10.0 * number, -0.01) for number in range(80)]
    assert ended(*kept) == pytest.approx(0.7)
    with pytest.raises(ActuatorError, match=r"no feedback for 0\.7 s; expected to see the duty end"):
        ended((110.0, 0.01))
    # Half of the patience without a record is little, more is none.
    assert ended(*kept[:35]) == pytest.approx(0.7)
    with pytest.raises(ActuatorError, match=r"no feedback for 0\.4 s"):
        ended(*kept[:34])
    assert ended((110.0, 1e-9), (120.0, 0.0)) == pytest.approx(0.02)


def test_a_duty_that_ended_while_no_feedback_came_is_judged_only_where_that_can_be() -> None:
    def ended(*records: tuple[float, float]) -> float:
        return guided._duty_ends(Given(*records), 100_000_000, 0.07)  # type: ignore[arg-type]

    # In time for certain, and late for certain.
    assert ended((110.0, 0.01), (170.0, 0.0)) == pytest.approx(0.07)
    assert ended((110.0, 0.01), (171.0, -0.01), (250.0, 0.0)) == pytest.approx(0.15)
    # Records that come as they should are what a machine is judged by, up to half of the limit between two.
    assert ended((135.0, 0.01), (170.0, 0.0)) == pytest.approx(0.07)
    assert ended((136.0, 0.01), (171.0, 0.0)) == pytest.approx(0.071)
    for record in ((136.0, 0.01), (170.0, 0.01)):
        with pytest.raises(
            ActuatorError, match=r"no feedback for \d+ ms while the duty ended; .* within 70 ms"
        ) as told:
            ended((110.0, 0.01), record, (206.0, 0.0))
        assert told.value.fault == "feedback_lost"
    with pytest.raises(ActuatorError, match=r"no feedback for 71 ms while"):
        ended((90.0, 0.01), (171.0, 0.0))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"position": 4.0001}, r"position is 4\.00 rad; expected -4 to 4 rad"),
        ({"position": -4.0001}, r"position is -4\.00 rad"),
        ({"velocity": 1.5001}, r"velocity is 1\.50 rad/s; expected at most 1\.5 rad/s"),
        ({"velocity": -1.5001}, r"velocity is -1\.50 rad/s"),
        ({"position": 3.0001}, r"turned by 1\.00 rad under the duty 0\.01; expected at most 1 rad"),
        ({"position": 0.9999}, r"turned by 1\.00 rad"),
    ],
)
def test_a_proof_stays_within_window_velocity_and_one_radian(given: dict[str, float], message: str) -> None:
    settings = BridgeSettings(limits=HardwareLimits(position_min=-4.0, position_max=4.0, velocity=1.5))
    begin = {4.0001: 3.5, -4.0001: -3.5}.get(given.get("position", 0.0), 2.0)
    with pytest.raises(ActuatorError, match=message):
        guided._expect_inside(feedback_record(**{"position": 2.0, **given}), settings, begin)
    for inside in ({"position": 4.0}, {"position": -4.0}, {"velocity": 1.5}, {"velocity": -1.5}):
        begin = inside.get("position", 3.0) * 0.75
        guided._expect_inside(feedback_record(**{"position": 3.0, **inside}), settings, begin)
    guided._expect_inside(feedback_record(position=3.0), settings, 2.0)


@pytest.mark.parametrize("what", ["position", "velocity", "effort"])
def test_what_is_no_number_is_named_with_its_unit(what: str) -> None:
    units = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
    with pytest.raises(ActuatorError, match=f"{what} is inf {units[what]}; expected a finite number"):
        guided._expect_numbers(feedback_record(**{what: float("inf")}))


def test_two_records_are_feedback_and_one_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def heard(count: int) -> int:
        monkeypatch.setattr(guided, "feedback_for", lambda *_: iter([feedback_record()] * count))
        return len(guided._listen(emulator(), 2.0))

    assert heard(2) == 2
    with pytest.raises(ActuatorError, match="1 records in 2 s; expected feedback to flow"):
        heard(1)
