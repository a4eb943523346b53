"""Every setting is compared with what the module says it keeps, and the drive is not prepared where it may not be."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from pendulum_hw_bridge.port.actuator import ActuatorError, HardwareLimits, MStopAction
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet
from pendulum_hw_bridge.port.settings import BridgeSettings, write_settings
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import PlantLimits
from pendulum_msgs_py.contract.values import JointSample

_LIMITS = HardwareLimits(position_min=-3.0, position_max=0.0)
_GAINS = DEFAULT_GAINS[3]


class Forgetful:
    """A port that keeps everything but one setting."""

    def __init__(self, lifetime: float = 0.05, rate: float = 100.0, gains: GainSet = _GAINS, **limits: object) -> None:
        self.lifetime, self.rate, self.gains = lifetime, rate, gains
        self.limits = replace(_LIMITS, **limits)  # type: ignore[arg-type]

    def set_command_lifetime(self, _: float) -> float:
        return self.lifetime

    def set_feedback_rate(self, _: float) -> float:
        return self.rate

    def set_limits(self, _: HardwareLimits) -> HardwareLimits:
        return self.limits

    def set_gains(self, _: GainSet) -> GainSet:
        return self.gains


def _write(port: Forgetful) -> None:
    write_settings(port, BridgeSettings(limits=_LIMITS), _GAINS)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "port",
    [
        Forgetful(),
        Forgetful(lifetime=0.0505),
        Forgetful(effort=13.0 * (1.0 + 5e-6), velocity=1.5 * (1.0 - 5e-6)),
        Forgetful(position_max=5e-7),
    ],
)
def test_what_rounding_changes_is_kept(port: Forgetful) -> None:
    _write(port)


@pytest.mark.parametrize(
    ("port", "message"),
    [
        (Forgetful(lifetime=0.051), "command lifetime reads back as 0.051 s"),
        (Forgetful(rate=99.0), "feedback rate reads back as 99 Hz"),
        (Forgetful(effort=13.0 * (1.0 + 1.5e-5)), "effort limit reads back as 13.0002 N m"),
        (Forgetful(velocity=2.0), "velocity limit reads back as 2 rad/s"),
        (Forgetful(pwm=0.9), "pwm limit reads back as 0.9"),
        (Forgetful(position_min=-math.inf), "position_min reads back as -inf rad"),
        (Forgetful(position_max=1.5e-6), "position_max reads back as 1.5e-06 rad"),
        (Forgetful(m_stop=MStopAction.HOLD_POSITION), "motion stop action reads back as"),
        (
            Forgetful(gains=replace(_GAINS, position=replace(_GAINS.position, kp=2.0 * _GAINS.position.kp))),
            "position gain kp reads back as",
        ),
    ],
)
def test_a_setting_that_the_module_keeps_otherwise_is_an_error_by_name(port: Forgetful, message: str) -> None:
    with pytest.raises(ActuatorError, match=message):
        _write(port)


def test_a_drive_is_prepared_for_arming_only_where_it_may_be_armed() -> None:
    prepared = []

    def prepare() -> str:
        prepared.append("once")
        return ""

    supervisor = SharedSupervisor(PlantLimits(effort=(5.0,)), prepare)
    sample = JointSample.of_one(0, 0.0, 0.0)
    supervisor.e_stop(0)
    assert "e-stop" in supervisor.arm(0, sample)
    supervisor.e_stop_reset(0)
    supervisor.fault("smoke", 0)
    assert "smoke" in supervisor.arm(0, sample)
    supervisor.disarm(0)
    assert prepared == []
    assert supervisor.arm(0, sample) == ""
    assert supervisor.arm(0, sample) == ""
    assert prepared == ["once"]


def test_what_was_measured_before_the_drive_was_prepared_decides_nothing() -> None:
    now, newest = 0, JointSample.of_one(0, 0.0, 0.0)

    def prepare() -> str:
        nonlocal now
        now += 100_000_000
        return ""

    limits = PlantLimits(effort=(5.0,), feedback_timeout=0.04, position_min=(-1.0,), position_max=(1.0,))
    supervisor = SharedSupervisor(limits, prepare, measure=lambda: (now, newest))
    assert "old" in supervisor.arm(now, JointSample.of_one(0, 0.0, 0.0))
    newest = JointSample.of_one(195_000_000, 2.0, 0.0)
    assert "position" in supervisor.arm(now, JointSample.of_one(now, 0.0, 0.0))
    newest = JointSample.of_one(295_000_000, 0.0, 0.0)
    assert supervisor.arm(now, JointSample.of_one(0, 0.0, 0.0)) == ""
    assert supervisor.mode.armed
    # Judged by what was measured while it was prepared, it is no fault at once.
    supervisor.decide(now, newest)
    assert supervisor.mode.armed
