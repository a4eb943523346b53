"""What proves a motion stop: a wrong word here arms a machine that cannot be stopped."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.lab import proofs
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    Command,
    Feedback,
    HardwareLimits,
    MStopAction,
)
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.lab_rig import emulator
from pendulum_testing.proof_bench import BOTH, Bench


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


def test_a_motion_stop_is_proved_within_60_ms_and_waited_for_no_longer_than_configured(
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


def test_a_pause_between_two_commands_as_long_as_their_lifetime_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
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
