"""What the guided procedures measure and allow, to the number, on records that are given and a biased emulator."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from pendulum_hw_bridge.checks.nudge import EmulatedHand
from pendulum_hw_bridge.lab import guided, lab_cli
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, Strategy
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.plants.lab_file import load_lab
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.lab_rig import PARAMETERS, Person, changed, emulator

HAND = EmulatedHand(lambda torque: None)

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


def test_the_noise_of_the_sensor_is_reported_with_the_tare(monkeypatch: pytest.MonkeyPatch) -> None:
    port, person, signs = emulator(), Person(), iter([1.0, -1.0] * 1000)
    changed(monkeypatch, port, lambda record: record._replace(position=0.0, effort=0.5 + 0.1 * next(signs)))
    guided.measure_tare(port, BridgeSettings(), PARAMETERS.plant, person)
    assert person.said[-1] == "Tare: +0.500 N m (noise 0.100 N m)."


def test_the_tare_reaches_the_lab_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\nmodule: {backend: emulator}\n", encoding="utf-8")
    port = emulator()
    changed(monkeypatch, port, lambda record: record._replace(position=0.0, effort=0.4))
    monkeypatch.setattr("pendulum_hw_bridge.bridge.bridge_parameters.make_port", lambda *_, **__: port)
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


@pytest.mark.parametrize("what", ["position", "velocity", "effort"])
def test_what_is_no_number_is_named_with_its_unit(what: str) -> None:
    units = {"position": "rad", "velocity": "rad/s", "effort": "N m"}
    with pytest.raises(ActuatorError, match=f"{what} is inf {units[what]}; expected a finite number"):
        guided.expect_numbers(feedback_record(**{what: float("inf")}))


def test_two_records_are_feedback_and_one_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def heard(count: int) -> int:
        monkeypatch.setattr(guided, "feedback_for", lambda *_: iter([feedback_record()] * count))
        return len(guided._listen(emulator(), 2.0))

    assert heard(2) == 2
    with pytest.raises(ActuatorError, match="1 records in 2 s; expected feedback to flow"):
        heard(1)
