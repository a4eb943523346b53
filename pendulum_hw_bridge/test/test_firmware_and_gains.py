"""Firmware loops against closed forms, and HEBI's gains file there and back."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_hw_bridge.emulation.firmware import (
    EFFORT,
    POSITION,
    VELOCITY,
    control_pwm,
    gain_rows,
    new_loop_memory,
    pid_step,
)
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GainSet, PidGains, load_gains, write_gains
from pendulum_msgs_py.errors import ParameterError

OFF = math.nan


def pwm(strategy: int, setpoints: tuple[float, float, float], measured: tuple[float, float, float]) -> float:
    return float(
        control_pwm(
            strategy,
            gain_rows(DEFAULT_GAINS[max(1, strategy)]),
            new_loop_memory(),
            np.array(setpoints),
            *measured,
            0.05,
            0.3,
            1e-3,
        )
    )


def test_defaults_are_the_x5_9s() -> None:
    assert (DEFAULT_GAINS[3].position.kp, DEFAULT_GAINS[3].velocity.kp) == (1.5, 0.05)
    assert (
        DEFAULT_GAINS[2].position.kp,
        DEFAULT_GAINS[2].velocity.kp,
        DEFAULT_GAINS[2].velocity.feed_forward,
    ) == (15.0, 0.5, 0.0)
    assert (
        DEFAULT_GAINS[4].position.kp,
        DEFAULT_GAINS[4].velocity.kp,
        DEFAULT_GAINS[4].velocity.feed_forward,
    ) == (15.0, 0.05, 1.0)
    for strategy in (2, 3, 4):
        effort = DEFAULT_GAINS[strategy].effort
        assert (effort.kp, effort.ki, effort.kd, effort.feed_forward) == (0.25, 0.0, 0.001, 1.0)
        assert (effort.max_target, effort.output_lowpass) == (20.0, 0.9)
        assert DEFAULT_GAINS[strategy].velocity.output_lowpass == 0.75


def test_each_strategy_combines_its_loops_as_documented() -> None:
    setpoints, measured = (0.6, 0.2, 1.0), (0.5, 0.1, 0.8)
    position, velocity = 0.1, 0.1

    def effort_of(target: float) -> float:
        return 0.25 * (target - 0.8) + target * 0.05

    forward = 0.05 * velocity + 0.2 * 0.3
    assert pwm(0, setpoints, measured) == 0.0
    assert pwm(1, (OFF, OFF, 0.4), measured) == 0.4
    assert pwm(2, setpoints, measured) == pytest.approx(effort_of(1.0 + 15.0 * position + 0.5 * velocity))
    assert pwm(3, setpoints, measured) == pytest.approx(1.5 * position + forward + effort_of(1.0))
    assert pwm(4, setpoints, measured) == pytest.approx(effort_of(1.0 + 15.0 * position) + forward)


@pytest.mark.parametrize("strategy", [0, 1, 2, 3, 4])
def test_without_setpoints_every_strategy_gives_nothing(strategy: int) -> None:
    assert pwm(strategy, (OFF, OFF, OFF), (1.0, 2.0, 3.0)) == 0.0


@given(
    st.integers(0, 4),
    st.tuples(*[st.one_of(st.floats(-1e3, 1e3), st.just(OFF))] * 3),
    st.tuples(*[st.floats(-1e3, 1e3)] * 3),
)
def test_the_duty_never_leaves_its_range(
    strategy: int, setpoints: tuple[float, float, float], measured: tuple[float, float, float]
) -> None:
    assert -1.0 <= pwm(strategy, setpoints, measured) <= 1.0


def loop(**gains: float) -> np.ndarray:
    return gain_rows(GainSet(3, PidGains(**gains), PidGains(), PidGains()))


def test_integral_is_clamped_and_derivative_waits_for_a_second_cycle() -> None:
    rows, memory = loop(ki=10.0, i_clamp=0.2), new_loop_memory()
    for _ in range(100):
        output = pid_step(rows, memory, POSITION, 1.0, 0.0, 0.0, 0.01)
    assert output == pytest.approx(0.2)
    rows, memory = loop(kd=0.01), new_loop_memory()
    assert pid_step(rows, memory, POSITION, 1.0, 0.0, 0.0, 0.01) == 0.0
    assert pid_step(rows, memory, POSITION, 1.0, 0.5, 0.0, 0.01) == pytest.approx(-0.5)


def test_dead_zone_punch_and_low_pass() -> None:
    rows, memory = loop(kp=1.0, dead_zone=0.1, punch=0.3), new_loop_memory()
    assert pid_step(rows, memory, POSITION, 0.05, 0.0, 0.0, 0.01) == 0.0
    assert pid_step(rows, memory, POSITION, 0.2, 0.0, 0.0, 0.01) == pytest.approx(0.5)
    rows, memory = loop(kp=1.0, output_lowpass=0.25), new_loop_memory()
    assert pid_step(rows, memory, POSITION, 0.4, 0.0, 0.0, 0.01) == pytest.approx(0.4)
    assert pid_step(rows, memory, POSITION, 0.8, 0.0, 0.0, 0.01) == pytest.approx(0.25 * 0.8 + 0.75 * 0.4)


def test_a_loop_switched_off_forgets() -> None:
    rows, memory = loop(ki=1.0, i_clamp=1.0), new_loop_memory()
    pid_step(rows, memory, POSITION, 1.0, 0.0, 0.0, 0.1)
    assert pid_step(rows, memory, POSITION, OFF, 0.0, 0.0, 0.1) == 0.0
    assert not memory[POSITION].any()
    assert (POSITION, VELOCITY, EFFORT) == (0, 1, 2)


def test_gains_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    for strategy, gains in DEFAULT_GAINS.items():
        assert load_gains(write_gains(tmp_path / f"{strategy}.xml", gains)) == gains


def test_hebi_py_reads_the_gains_that_we_write(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    for strategy, gains in DEFAULT_GAINS.items():
        command = hebi.GroupCommand(1)
        command.read_gains(str(write_gains(tmp_path / f"{strategy}.xml", gains)))
        assert command.control_strategy[0] == strategy
        assert command.position_kp[0] == pytest.approx(gains.position.kp)
        assert bool(command.velocity_d_on_error[0]) is bool(gains.velocity.d_on_error)


def test_a_file_of_hebi_py_itself_is_read(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    command = hebi.GroupCommand(1)
    command.control_strategy = 3
    command.position_kp = 2.5
    command.velocity_feed_forward = 0.5
    path = tmp_path / "gains.xml"
    command.write_gains(str(path))
    gains = load_gains(path)
    assert (gains.position.kp, gains.velocity.feed_forward, gains.effort.kp) == (2.5, 0.5, 0.25)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "<group_gains><control_strategy>7</control_strategy></group_gains>",
            "control_strategy is 7; expected 1 to 4",
        ),
        ("<group_gains><position><kp>x</kp></position></group_gains>", "kp is 'x'; expected one number"),
        ("<group_gains><position><kp>-1</kp></position></group_gains>", "gain kp is -1.0; expected >= 0"),
        ("<group_gains><position><kq>1</kq></position></group_gains>", "unknown parameter .kq."),
        ("<other/>", "root element is <other>"),
        ("<group_gains>", "is not XML"),
        ("<!DOCTYPE x><group_gains/>", "declares a document type"),
    ],
)
def test_a_wrong_gains_file_is_refused_with_its_reason(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gains.xml"
    path.write_text(text)
    with pytest.raises(ParameterError, match=message):
        load_gains(path)


def test_gains_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(ParameterError, match="gain kp is nan"):
        PidGains(kp=math.nan)
    with pytest.raises(ParameterError, match=r"output_lowpass is 0.0"):
        PidGains(output_lowpass=0.0)
