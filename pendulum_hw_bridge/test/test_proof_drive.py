"""How the proofs of a lab drive its motor: gently, watched as by the bridge, and off whatever ends them."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import pytest

from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.lab import proofs
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    Command,
    Feedback,
    HardwareLimits,
    Strategy,
    afterwards,
)
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.lab_rig import PARAMETERS, Person, emulator
from pendulum_testing.proof_bench import BOTH, Bench


def test_the_duty_for_proofs_makes_less_than_half_a_newton_metre() -> None:
    drivetrain = PARAMETERS.plant.drivetrain
    assert drivetrain is not None
    mapping = EffortMapping(EffortStrategy.DIRECT_PWM, drivetrain, effort_limit=13.0)
    assert 0.2 < mapping.motor_effort(proofs.PROOF_DUTY, 0.0, 36.0) < 0.5


@pytest.mark.parametrize("lifetime", [0.04, 0.1])
@BOTH
def test_a_proof_sends_its_gentle_duty_and_sets_what_the_bridge_sets(
    monkeypatch: pytest.MonkeyPatch, proof: Any, lifetime: float
) -> None:
    bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
    settings = BridgeSettings(feedback_rate=200.0, command_lifetime=lifetime, limits=HardwareLimits(effort=3.0))
    write, duties = bench.port.write, set[float]()

    def noted(command: Command) -> Any:
        duties.add(command.pwm)
        return write(command)

    monkeypatch.setattr(bench.port, "write", noted)
    took = proof(bench.port, settings, bench.person)
    assert duties == {proofs.PROOF_DUTY}
    # The lifetime is proved by silence, the motion stop under a duty that is commanded on.
    end = 0.3 if proof is proofs.prove_lifetime else 0.36
    assert end - 0.01 <= bench.sent[-1] <= end + 0.01
    assert max(later - sent for sent, later in itertools.pairwise(bench.sent)) < 0.008
    assert took == pytest.approx(lifetime, abs=0.012) if proof is proofs.prove_lifetime else 0.0 < took <= 0.015
    status = bench.port.connect()
    # While a motion stop is proved, commands live for longer, or those that get lost could end the duty.
    expected = lifetime if proof is proofs.prove_lifetime else 0.25
    assert (status.feedback_rate, status.command_lifetime) == (200.0, expected)
    assert status.limits == settings.limits
    assert bench.port.strategy is Strategy.OFF


def test_a_strategy_that_reads_back_as_another_gets_no_duty(monkeypatch: pytest.MonkeyPatch) -> None:
    port, sent = emulator(), list[Command]()
    monkeypatch.setattr(port, "set_strategy", lambda strategy, command=None: Strategy.PARALLEL_PWM)
    monkeypatch.setattr(port, "write", sent.append)
    with pytest.raises(ActuatorError, match="strategy reads back as PARALLEL_PWM; expected DIRECT_PWM"):
        proofs.prove_lifetime(port, BridgeSettings(), Person())
    assert sent == []


def test_ten_periods_of_silence_end_a_drive_and_not_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    port, looks = emulator(), list[float]()
    drive = proofs._GentleDrive(port, BridgeSettings(), None, None)
    record = feedback_record(stamp_ns=drive.begin_ns + 1)

    def read(timeout: float) -> Feedback | None:
        looks.append(timeout)
        return record if len(looks) == 11 else None

    monkeypatch.setattr(port, "read", read)
    assert drive.read() is record
    with pytest.raises(ActuatorError, match="no feedback for 100 ms; expected it every 10 ms"):
        drive.read()
    assert looks == [0.01] * 22


def test_a_record_that_is_older_than_the_one_before_it_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    port = emulator()
    drive = proofs._GentleDrive(port, BridgeSettings(), None, None)
    stamps = [drive.begin_ns + offset for offset in (-1, 0, 5, 4, 5, 6)]
    records = [
        feedback_record(stamp_ns=stamp, hardware_ns=n, sequence=n, effort=0.01 * n)
        for n, stamp in enumerate(stamps, start=1)
    ]
    monkeypatch.setattr(port, "read", lambda _: records.pop(0))
    assert [drive.read().stamp_ns - drive.begin_ns for _ in range(4)] == [0, 5, 5, 6]


@pytest.mark.parametrize(("duty", "driven"), [(0.0051, True), (-0.0051, True), (0.005, False), (-0.005, False)])
def test_a_motor_with_more_than_half_of_the_duty_is_driven(duty: float, driven: bool) -> None:
    assert proofs._has_duty(feedback_record(pwm_command=duty)) is driven


@pytest.mark.parametrize("limits", [None, SafetyLimits(winding_temperature=90.0)])
def test_a_proof_is_watched_by_the_checks_that_the_bridge_has_at_its_own_rate(
    monkeypatch: pytest.MonkeyPatch, limits: SafetyLimits | None
) -> None:
    made: list[tuple[SafetyLimits, float]] = []

    class Watched(SafetyMonitor):
        def __init__(self, limits: SafetyLimits, period: float) -> None:
            made.append((limits, period))
            super().__init__(limits, period)

    monkeypatch.setattr(proofs, "SafetyMonitor", Watched)
    proofs.prove_lifetime(emulator(), BridgeSettings(feedback_rate=200.0), Person(), limits)
    assert made == [(limits or SafetyLimits(), 1.0 / 200.0)]


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
        proofs._expect_inside(feedback_record(**{"position": 2.0, **given}), settings, begin)
    for inside in ({"position": 4.0}, {"position": -4.0}, {"velocity": 1.5}, {"velocity": -1.5}):
        begin = inside.get("position", 3.0) * 0.75
        proofs._expect_inside(feedback_record(**{"position": 3.0, **inside}), settings, begin)
    proofs._expect_inside(feedback_record(position=3.0), settings, 2.0)


@BOTH
def test_the_torque_of_the_duty_is_that_of_the_drivetrain_that_is_there(proof: Any) -> None:
    drivetrain = PARAMETERS.plant.drivetrain
    assert drivetrain is not None
    strong = replace(drivetrain, gear_ratio=10.0 * drivetrain.gear_ratio)
    settings = BridgeSettings(limits=HardwareLimits(effort=1.0))
    with pytest.raises(ActuatorError, match="expected at most the effort limit, 1 N m"):
        proof(emulator(), settings, Person(), None, strong)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ZeroDivisionError("first"), ActuatorError("m_stop", "first")])
def test_a_motor_is_stopped_whatever_ends_what_it_does(error: BaseException) -> None:
    done: list[str] = []
    with pytest.raises(type(error)) as told, afterwards(lambda: done.append("stopped")):
        raise error
    assert told.value is error
    assert done == ["stopped"]
    with afterwards(lambda: done.append("again")):
        assert done == ["stopped"]
    assert done == ["stopped", "again"]

    def fail() -> None:
        raise RuntimeError("no stop")

    if isinstance(error, ActuatorError):
        with pytest.raises(ActuatorError, match=r"^first; and then: no stop$"), afterwards(fail):
            raise error
    with pytest.raises(RuntimeError, match="no stop"), afterwards(fail):
        pass


@pytest.mark.parametrize("at", [0.1, 0.33])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": 20.0}, "position is 20"),
        ({"winding_temperature": 200.0}, "winding is at 200 degC"),
        ({"effort": math.nan}, "effort is nan N m"),
        ({"pwm_command": math.nan}, "duty is nan; expected a finite number"),
        ({"pwm_command": math.inf}, "duty is inf"),
    ],
)
@BOTH
def test_what_goes_wrong_is_reported_at_once_also_while_the_duty_should_end(
    monkeypatch: pytest.MonkeyPatch, proof: Any, change: dict[str, float], message: str, at: float
) -> None:
    bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
    bench.change = lambda record, now: record._replace(**change) if now >= at else record  # type: ignore[method-assign]
    settings = BridgeSettings(command_lifetime=0.25, limits=HardwareLimits(position_min=-4.0, position_max=4.0))
    bench.refused(proof, settings, message)
    assert bench.now() < at + 0.03


@pytest.mark.parametrize("moment", ["begin", "drive", "end"])
@BOTH
def test_ctrl_c_leaves_the_motor_off(monkeypatch: pytest.MonkeyPatch, proof: Any, moment: str) -> None:
    bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
    at = {"begin": 0.0, "drive": 0.2, "end": 0.33}[moment]

    def press(record: Feedback, now: float) -> Feedback:
        if now >= at:
            raise KeyboardInterrupt
        return record

    bench.change = press  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        proof(bench.port, BridgeSettings(), bench.person)
    assert bench.port.strategy is Strategy.OFF


class GivenDrive:
    """A drive whose records are given, by time [ns] since it began; it notes how many commands were sent."""

    begin_ns = 5_000_000_000

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *since_begin: int) -> None:
        stamps = [self.begin_ns + stamp for stamp in since_begin]
        self._records = iter(feedback_record(stamp_ns=stamp, pwm_command=0.01) for stamp in stamps)
        self.sent_ns = self.begin_ns
        self.commands = 0
        monkeypatch.setattr(proofs, "_GentleDrive", lambda *_: self)

    def read(self, *, may_be_pressed: bool = False) -> Feedback:
        return next(self._records)

    def command(self, record: Feedback) -> None:
        self.commands += 1

    def expects_nothing(self) -> None:
        pass


def test_the_motor_is_driven_for_the_announced_times_and_no_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(proofs, "_end_of_duty", lambda *_: 0.05)
    drive = GivenDrive(monkeypatch, 0, 299_999_999, 300_000_000)
    proofs.prove_lifetime(emulator(), BridgeSettings(), Person())
    assert drive.commands == 2
    drive = GivenDrive(monkeypatch, 0, 19_999_999_999, 20_000_000_000)
    with pytest.raises(ActuatorError, match="was not pressed within 20 s"):
        proofs.prove_m_stop(emulator(), BridgeSettings(), Person())
    assert drive.commands == 2


@pytest.mark.parametrize(("silence", "proved"), [(29_999_999, True), (30_000_000, False)])
def test_a_command_that_is_as_old_as_its_lifetime_may_have_ended(
    monkeypatch: pytest.MonkeyPatch, silence: int, proved: bool
) -> None:
    drive: Any = GivenDrive(monkeypatch)
    record = feedback_record(stamp_ns=drive.begin_ns + silence, m_stop=True)
    watched = proofs._while_pressed(drive, record, BridgeSettings(command_lifetime=0.03))
    if proved:
        assert next(watched) is record
    else:
        with pytest.raises(ActuatorError, match="no feedback for 30 ms while the motion stop"):
            next(watched)


def test_a_duty_that_makes_the_effort_limit_is_allowed_and_no_more() -> None:
    settings = BridgeSettings(limits=HardwareLimits(effort=0.5))
    proofs._expect_allowed(0.5, 36.0, settings)
    for effort in (0.5000001, math.nan):
        with pytest.raises(ActuatorError, match=r"N m at 36 V; expected at most the effort limit, 0\.5 N m"):
            proofs._expect_allowed(effort, 36.0, settings)


@BOTH
def test_a_stop_that_fails_does_not_hide_what_was_wrong(monkeypatch: pytest.MonkeyPatch, proof: Any) -> None:
    def fail() -> None:
        raise ActuatorError("stop_unacknowledged", "nobody has acknowledged it")

    bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
    bench.change = lambda record, now: record._replace(pwm_command=0.01)  # type: ignore[method-assign]
    monkeypatch.setattr(bench.port, "stop", fail)
    with pytest.raises(ActuatorError, match=r"Do not arm this machine; and then: nobody has") as told:
        proof(bench.port, BridgeSettings(), bench.person)
    assert told.value.fault != "stop_unacknowledged"
    # A proof that held is none if the motor could not be stopped behind it.
    bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
    monkeypatch.setattr(bench.port, "stop", fail)
    with pytest.raises(ActuatorError, match=r"^nobody has acknowledged it"):
        proof(bench.port, BridgeSettings(), bench.person)
    assert not any("Proved" in sentence for sentence in bench.person.said)
