"""When a duty has ended, by the records of a module."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from pendulum_hw_bridge.lab import proofs
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    Feedback,
)
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.proof_bench import Bench


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
