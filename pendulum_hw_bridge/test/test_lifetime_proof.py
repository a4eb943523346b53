"""What proves a command lifetime: a wrong word here arms a machine that a silent computer would not stop."""

from __future__ import annotations

from typing import Any

import pytest

from pendulum_hw_bridge.lab import proofs
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_testing.proof_bench import Bench, keeps_its_lifetime


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
