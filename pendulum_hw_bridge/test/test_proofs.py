"""What the proofs of a lab accept, condemn and leave open: a wrong word here arms a machine that cannot be stopped."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge import proofs
from pendulum_hw_bridge.actuator import (
    ActuatorError,
    Command,
    Feedback,
    HardwareLimits,
    MStopAction,
    Strategy,
    afterwards,
)
from pendulum_hw_bridge.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.settings import BridgeSettings
from tests.feedback_records import feedback_record
from tests.lab_rig import PARAMETERS, Person, emulator

BOTH = pytest.mark.parametrize("proof", [proofs.prove_lifetime, proofs.prove_m_stop])


class Bench:
    """An emulated module whose motion stop is pressed, and whose feedback is changed, at times of the drive [s]."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, press_at: float = math.inf) -> None:
        self.port, self.person = emulator(), Person()
        self.press_at = press_at
        self.begin_ns: int | None = None
        self.sent: list[float] = []
        read, write, begin = self.port.read, self.port.write, self.port.set_strategy

        def noted_begin(strategy: Strategy, command: Command | None = None) -> Strategy:
            reads = begin(strategy, command)
            if strategy is Strategy.DIRECT_PWM:
                self.begin_ns = self.port.now_ns()
            return reads

        def noted_write(command: Command) -> Any:
            self.sent.append(self.now())
            return write(command)

        def pressed_read(timeout: float) -> Feedback | None:
            if self.now() >= self.press_at:
                self.port.actuator.inject(ActuatorFault.M_STOP)
            record = read(timeout)
            return record and self.change(record, self.time_of(record.stamp_ns))

        monkeypatch.setattr(self.port, "set_strategy", noted_begin)
        monkeypatch.setattr(self.port, "write", noted_write)
        monkeypatch.setattr(self.port, "read", pressed_read)

    def now(self) -> float:
        return self.time_of(self.port.now_ns())

    def time_of(self, stamp_ns: int) -> float:
        return -math.inf if self.begin_ns is None else (stamp_ns - self.begin_ns) / 1e9

    def change(self, record: Feedback, now: float) -> Feedback | None:
        return record

    def refused(self, proof: Any, settings: BridgeSettings, match: str) -> str:
        """Expect a proof to say why it proves nothing, and to leave the motor off; return the fault's name."""
        with pytest.raises(ActuatorError, match=match) as told:
            proof(self.port, settings, self.person)
        assert self.port.strategy is Strategy.OFF
        assert not any("Proved" in sentence for sentence in self.person.said)
        return told.value.fault


def keeps_its_lifetime(monkeypatch: pytest.MonkeyPatch, bench: Bench, lifetime: float) -> None:
    """Let a module keep another command lifetime than it says."""
    monkeypatch.setattr(bench.port, "set_command_lifetime", lambda wanted: wanted)
    bench.port.actuator.configure(command_lifetime=lifetime)


# --- the drive --------------------------------------------------------------------------------------------------


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
def test_what_goes_wrong_is_told_at_once_also_while_the_duty_should_end(
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


def test_the_motor_is_driven_for_the_times_that_a_person_is_told_and_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
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


# --- the end of the duty ----------------------------------------------------------------------------------------


def records_of(*given: tuple[float, float]) -> Iterator[Feedback]:
    """Yield records with a time [ms] and a duty; whoever wants another one has looked too far."""
    for milliseconds, duty in given:
        yield feedback_record(stamp_ns=round(milliseconds * 1e6), pwm_command=duty)
    raise AssertionError("one record more was looked at")


def ended(*given: tuple[float, float]) -> float:
    return proofs._end_of_duty(records_of(*given), 100_000_000, 0.07)


def test_a_duty_has_ended_when_no_record_up_to_the_limit_has_it_any_more() -> None:
    # A record from before says nothing of it, and half of the duty is duty.
    assert ended((90.0, 0.0), (110.0, 0.01), (120.0, 0.005), (140.0, 0.0), (171.0, 0.0)) == pytest.approx(0.04)
    assert ended((110.0, 1e-8), (120.0, -1e-10), (171.0, 1e-10)) == pytest.approx(0.02)
    assert ended((110.0, -0.01), (120.0, 1e-9), (130.0, 0.0), (171.0, 0.0)) == pytest.approx(0.03)
    assert ended((100.0, 0.0), (171.0, 0.0)) == 0.0
    assert ended((90.0, 0.0), (110.0, 0.0), (171.0, 0.0)) == pytest.approx(0.01)
    # It may come back.
    assert ended((110.0, 0.0), (120.0, 0.01), (130.0, 0.0), (171.0, 0.0)) == pytest.approx(0.03)
    assert ended((110.0, 0.0), (170.0, 0.01), (171.0, 0.0)) == pytest.approx(0.071)
    assert ended((110.0, 0.0), (170.0, 0.0), (171.0, 0.01)) == pytest.approx(0.071)


def test_a_machine_is_condemned_with_the_first_record_behind_the_limit() -> None:
    assert ended((110.0, 0.01), (170.0, 0.01), (170.1, 0.01)) == pytest.approx(0.0701)
    assert ended((110.0, 0.01), (145.0, 0.01), (170.1, 0.0)) == pytest.approx(0.0701)
    assert ended((300.0, -0.01)) == pytest.approx(0.2)


def test_a_duty_that_ended_while_no_feedback_came_is_judged_only_where_that_can_be() -> None:
    # In time for certain: the first record without it came in time.
    assert ended((110.0, 0.01), (170.0, 0.0), (300.0, 0.0)) == pytest.approx(0.07)
    # Up to half of the limit between two records is feedback as it should be, and the machine is late.
    assert ended((136.0, 0.01), (171.0, 0.0)) == pytest.approx(0.071)
    for given in (((136.0, 0.01), (171.1, 0.0)), ((90.0, 0.01), (171.0, 0.0)), ((136.0, 0.01), (300.0, 0.0))):
        with pytest.raises(
            ActuatorError, match=r"no feedback for \d+ ms while .* within 70 ms. Nothing is prov"
        ) as told:
            ended(*given)
        assert told.value.fault == "feedback_lost"


def test_a_module_that_goes_while_the_duty_should_end_has_neither_kept_nor_lost_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for proof in (proofs.prove_lifetime, proofs.prove_m_stop):
        bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
        bench.change = lambda record, now: record if now < 0.32 else None  # type: ignore[method-assign]
        assert bench.refused(proof, BridgeSettings(), "no feedback for 100 ms; expected it every 10") == "feedback_lost"


# --- the command lifetime ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_lifetime_is_proved_up_to_two_records_later(monkeypatch: pytest.MonkeyPatch, rate: float) -> None:
    bench = Bench(monkeypatch)
    lifetime = max(0.05, 2.2 / rate)
    limit = lifetime + max(2.0 / rate, 0.02)
    asked: list[tuple[int, float]] = []

    def end(records: Any, since_ns: int, within: float) -> float:
        asked.append((since_ns, within))
        next(records)
        return limit

    monkeypatch.setattr(proofs, "_end_of_duty", end)
    settings = BridgeSettings(feedback_rate=rate, command_lifetime=lifetime)
    assert proofs.prove_lifetime(bench.port, settings, bench.person) == limit
    assert [(bench.time_of(since_ns), within) for since_ns, within in asked] == [(bench.sent[-1], limit)]
    expected = f"Proved: the torque ended {1e3 * limit:.0f} ms after the last command (at most {1e3 * limit:.0f} ms"
    assert bench.person.said[-1].startswith(expected)
    bench = Bench(monkeypatch)
    monkeypatch.setattr(proofs, "_end_of_duty", lambda *_: limit + 1e-6)
    expected = rf"after the last command; expected at most {1e3 * limit:.0f} ms\. Do not arm"
    assert bench.refused(proofs.prove_lifetime, settings, expected) == "exception"


@pytest.mark.parametrize("rate", [20.0, 100.0, 1000.0])
def test_a_module_that_keeps_its_duty_for_longer_is_condemned_as_soon_as_it_shows(
    monkeypatch: pytest.MonkeyPatch, rate: float
) -> None:
    bench = Bench(monkeypatch)
    keeps_its_lifetime(monkeypatch, bench, 5.0)
    settings = BridgeSettings(feedback_rate=rate, command_lifetime=max(0.05, 2.2 / rate))
    bench.refused(proofs.prove_lifetime, settings, "kept its duty for .* Do not arm")
    assert bench.now() < bench.sent[-1] + settings.command_lifetime + max(2.0 / rate, 0.02) + 2.0 / rate


@pytest.mark.parametrize("pressed", [0.25, 0.28, 0.29, 0.3, 0.31, 0.33, 0.35, 0.36])
def test_a_motion_stop_that_is_pressed_proves_no_lifetime(monkeypatch: pytest.MonkeyPatch, pressed: float) -> None:
    bench = Bench(monkeypatch, press_at=pressed)
    keeps_its_lifetime(monkeypatch, bench, 5.0)
    fault = bench.refused(proofs.prove_lifetime, BridgeSettings(), "motion stop is pressed|kept its duty")
    assert pressed > 0.34 or fault == "m_stop"


@pytest.mark.parametrize(
    ("gone", "words"), [(0.2, "acts on PWM 0"), (0.3, r"did not have the duty 0\.01 when it was to")]
)
def test_a_duty_that_was_gone_before_the_silence_proves_no_lifetime(
    monkeypatch: pytest.MonkeyPatch, gone: float, words: str
) -> None:
    bench = Bench(monkeypatch)
    keeps_its_lifetime(monkeypatch, bench, 5.0)
    bench.change = lambda record, now: record._replace(pwm_command=0.01 * (now < gone))  # type: ignore[method-assign]
    assert bench.refused(proofs.prove_lifetime, BridgeSettings(), words) == "command_not_in_force"


# --- the motion stop --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lifetime", [0.03, 0.04, 0.05, 0.055, 0.06, 0.07, 0.1, 0.25])
@pytest.mark.parametrize("broken", ["shows only", "action is not kept"])
def test_a_motion_stop_that_does_not_end_the_duty_is_never_proved_by_the_command_lifetime(
    monkeypatch: pytest.MonkeyPatch, lifetime: float, broken: str
) -> None:
    bench = Bench(monkeypatch)
    if broken == "shows only":
        bench.change = lambda record, now: record._replace(m_stop=now > 0.5)  # type: ignore[method-assign]
    else:
        bench.press_at, actuator = 0.5, bench.port.actuator
        configure = bench.port.set_limits

        def disabled(limits: HardwareLimits) -> HardwareLimits:
            configure(HardwareLimits(**{**vars(limits), "m_stop": MStopAction.DISABLED}))
            return limits

        monkeypatch.setattr(bench.port, "set_limits", disabled)
        assert actuator.limits is not None
    settings = BridgeSettings(command_lifetime=lifetime)
    fault = bench.refused(proofs.prove_m_stop, settings, r"after the motion stop; expected at most 60 ms\. Do not arm")
    assert fault == "m_stop"
    assert bench.now() < 0.6


@pytest.mark.parametrize("lifetime", [0.03, 0.05, 0.25])
@pytest.mark.parametrize("rate", [50.0, 100.0, 500.0, 1000.0])
def test_a_motion_stop_that_ends_it_is_proved(monkeypatch: pytest.MonkeyPatch, rate: float, lifetime: float) -> None:
    bench = Bench(monkeypatch, press_at=0.5)
    settings = BridgeSettings(feedback_rate=rate, command_lifetime=max(lifetime, 2.0 / rate))
    took = proofs.prove_m_stop(bench.port, settings, bench.person)
    assert 0.0 < took <= 2.0 / rate + 0.002
    assert bench.person.said[-1] == f"Proved: the torque ended within {1e3 * took:.0f} ms. Release the motion stop."
    assert "Press the motion stop NOW." in bench.person.said


def test_a_motion_stop_is_proved_within_60_ms_and_waited_for_no_longer_than_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[int, float]] = []
    answers = iter([0.06, 0.060001])

    def end(records: Any, since_ns: int, within: float) -> float:
        asked.append((since_ns, within))
        return next(answers)

    with monkeypatch.context() as patch:
        patch.setattr(proofs, "_end_of_duty", end)
        bench = Bench(patch, press_at=0.5)
        assert proofs.prove_m_stop(bench.port, BridgeSettings(), bench.person) == 0.06
        # Since the last record that shows the duty, whenever it was pressed.
        assert 0.48 < bench.time_of(asked[0][0]) <= 0.51
        assert asked[0][1] == 0.06
        bench = Bench(patch, press_at=0.5)
        bench.refused(proofs.prove_m_stop, BridgeSettings(), r"expected at most 60 ms\. Do not arm")
    bench = Bench(monkeypatch)
    assert bench.refused(proofs.prove_m_stop, BridgeSettings(), "was not pressed within 20 s") == "m_stop"
    assert 20.0 <= bench.now() < 20.05


@pytest.mark.parametrize("kept", [0.0, 0.05, 0.1, 0.14, 0.3])
@pytest.mark.parametrize("pause", [0.02, 0.04, 0.05, 0.07, 0.09])
@pytest.mark.parametrize("lifetime", [0.05, 0.25])
def test_a_pause_of_feedback_around_the_press_proves_nothing_that_was_not_seen(
    monkeypatch: pytest.MonkeyPatch, kept: float, pause: float, lifetime: float
) -> None:
    bench = Bench(monkeypatch)

    def paused(record: Feedback, now: float) -> Feedback | None:
        if now >= 0.5 + kept:
            bench.port.actuator.inject(ActuatorFault.M_STOP)
        return None if 0.5 <= now < 0.5 + pause else record._replace(m_stop=now >= 0.5)

    bench.change = paused  # type: ignore[method-assign]
    took, fault = math.inf, ""
    try:
        took = proofs.prove_m_stop(bench.port, BridgeSettings(command_lifetime=lifetime), bench.person)
    except ActuatorError as error:
        fault = error.fault
    if kept >= 0.06:
        assert fault in {"feedback_lost", "m_stop"}
    elif fault:
        # A machine that was fast enough is not condemned.
        assert fault == "feedback_lost" or kept >= 0.05
        assert pause >= 0.04 or kept >= 0.05
    else:
        assert kept < took <= 0.06


@pytest.mark.parametrize("gone", [0.005, 0.3, 0.42])
def test_a_duty_that_was_gone_before_the_press_proves_no_motion_stop(
    monkeypatch: pytest.MonkeyPatch, gone: float
) -> None:
    bench = Bench(monkeypatch)
    bench.change = lambda record, now: record._replace(  # type: ignore[method-assign]
        pwm_command=0.01 * (0.005 < now < gone), m_stop=now > 0.5
    )
    fault = bench.refused(
        proofs.prove_m_stop, BridgeSettings(), r"when the motion stop was pressed; is the|acts on PWM 0"
    )
    assert fault == "command_not_in_force"


def test_a_motion_stop_that_shows_one_record_late_is_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, press_at=0.5)
    bench.change = lambda record, now: record._replace(m_stop=now > 0.525)  # type: ignore[method-assign]
    assert proofs.prove_m_stop(bench.port, BridgeSettings(), bench.person) <= 0.025


@pytest.mark.parametrize(
    ("pressed", "driven", "heard", "fault"),
    [
        (160, 100, 100, None),
        (161, 100, 101, "command_not_in_force"),
        (161, 100, 100, "feedback_lost"),
        (100, None, 90, "command_not_in_force"),
        (200, None, 100, "command_not_in_force"),
    ],
)
def test_the_motor_was_driven_up_to_60_ms_before_the_motion_stop_showed(
    pressed: int, driven: int | None, heard: int, fault: str | None
) -> None:
    def expect() -> None:
        million = 1_000_000
        proofs._expect_driven_until(pressed * million, None if driven is None else driven * million, heard * million)

    if fault is None:
        expect()
    else:
        with pytest.raises(ActuatorError) as told:
            expect()
        assert told.value.fault == fault


def test_a_motion_stop_that_is_released_too_early_proves_nothing_and_gives_no_torque_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, press_at=0.5)
    bench.change = lambda record, now: record._replace(m_stop=record.m_stop and now < 0.53)  # type: ignore[method-assign]
    fault = bench.refused(proofs.prove_m_stop, BridgeSettings(), "released during its proof; expected it to be held")
    assert fault == "m_stop"
    assert bench.sent[-1] < 0.53


@pytest.mark.parametrize("stall", [0.02, 0.05, 0.1, 0.24, 0.26, 0.4])
@pytest.mark.parametrize("at", [0.48, 0.5, 0.52])
def test_a_computer_that_stalls_proves_no_motion_stop_that_does_nothing(
    monkeypatch: pytest.MonkeyPatch, stall: float, at: float
) -> None:
    bench = Bench(monkeypatch)
    bench.change = lambda record, now: record._replace(m_stop=now > 0.5)  # type: ignore[method-assign]
    write, stalled = bench.port.write, list[float]()

    def late_write(command: Command) -> Any:
        if bench.now() >= at and not stalled:
            stalled.append(bench.now())
            bench.port.clock.wait_until(bench.port.now_ns() + round(stall * 1e9))
        return write(command)

    monkeypatch.setattr(bench.port, "write", late_write)
    bench.refused(
        proofs.prove_m_stop, BridgeSettings(), "Do not arm|passed between two commands|no feedback|late|acts on"
    )
    assert stalled


def test_a_pause_between_two_commands_as_long_as_their_lifetime_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    port = emulator()
    drive = proofs._GentleDrive(port, BridgeSettings(command_lifetime=0.05), None, None)
    sent = iter([drive.begin_ns + 49_999_999, drive.begin_ns + 99_999_999])
    monkeypatch.setattr(port, "write", lambda _: SimpleNamespace(sent_ns=next(sent)))
    record = feedback_record(voltage=36.0)
    drive.command(record)
    assert drive.sent_ns == drive.begin_ns + 49_999_999
    with pytest.raises(
        ActuatorError, match="50 ms passed between two commands; expected less than the command"
    ) as told:
        drive.command(record)
    assert told.value.fault == "host_stalled"


@pytest.mark.parametrize("lost", [0.05, 0.1, 0.15])
@pytest.mark.parametrize("begin", [0.4, 0.45, 0.48, 0.5])
def test_commands_that_get_lost_prove_no_motion_stop_that_does_nothing(
    monkeypatch: pytest.MonkeyPatch, lost: float, begin: float
) -> None:
    bench = Bench(monkeypatch)
    bench.change = lambda record, now: record._replace(m_stop=now > 0.5)  # type: ignore[method-assign]
    write = bench.port.write

    def lossy_write(command: Command) -> Any:
        if begin <= bench.now() < begin + lost:
            return SimpleNamespace(sent_ns=bench.port.now_ns())
        return write(command)

    monkeypatch.setattr(bench.port, "write", lossy_write)
    bench.refused(proofs.prove_m_stop, BridgeSettings(), "after the motion stop; expected at most 60 ms. Do not arm")


@pytest.mark.parametrize("factor", [-1.0, 0.6, 3.0])
@BOTH
def test_a_motor_that_has_another_duty_than_it_was_sent_is_driven_no_further(
    monkeypatch: pytest.MonkeyPatch, proof: Any, factor: float
) -> None:
    bench = Bench(monkeypatch, press_at=0.5)
    bench.change = lambda record, now: record._replace(  # type: ignore[method-assign]
        pwm_command=factor * record.pwm_command
    )
    assert bench.refused(proof, BridgeSettings(), "acts on PWM .* sent was 0.0100") == "command_not_in_force"
    assert bench.now() < 0.2


def test_a_record_that_comes_again_is_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    for proof in (proofs.prove_lifetime, proofs.prove_m_stop):
        bench = Bench(monkeypatch, press_at=0.3 if proof is proofs.prove_m_stop else math.inf)
        kept: list[Feedback] = []

        def again(record: Feedback, now: float, kept: list[Feedback] = kept) -> Feedback:
            if now >= 0.32:
                kept.append(record)
            return kept[0]._replace(stamp_ns=record.stamp_ns) if kept else record

        bench.change = again  # type: ignore[method-assign]
        assert bench.refused(proof, BridgeSettings(), "no feedback for 100 ms") == "feedback_lost"


@pytest.mark.parametrize("action", [MStopAction.DISABLED, MStopAction.HOLD_POSITION])
def test_a_motion_stop_that_is_not_to_end_the_torque_is_refused_before_the_motor_turns(
    monkeypatch: pytest.MonkeyPatch, action: MStopAction
) -> None:
    bench = Bench(monkeypatch)
    settings = BridgeSettings(limits=HardwareLimits(m_stop=action))
    bench.refused(proofs.prove_m_stop, settings, f"action is {action.value}; expected motor_off")
    assert not bench.sent
    assert not bench.person.said


@pytest.mark.parametrize(("rate", "enough"), [(10.0, False), (49.9, False), (50.0, True)])
def test_a_feedback_rate_that_cannot_show_the_end_in_time_is_refused_before_the_motor_turns(
    monkeypatch: pytest.MonkeyPatch, rate: float, enough: bool
) -> None:
    bench = Bench(monkeypatch, press_at=0.5)
    settings = BridgeSettings(feedback_rate=rate, command_lifetime=0.25)
    if enough:
        proofs.prove_m_stop(bench.port, settings, bench.person)
    else:
        bench.refused(proofs.prove_m_stop, settings, f"rate is {rate:g} Hz; expected at least 50 Hz, to see")
        assert not bench.sent
