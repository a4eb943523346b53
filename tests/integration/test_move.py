"""``python -m pendulum_bags move``, as it is typed beside a running plant."""

from __future__ import annotations

import re

import pytest

from pendulum_bags.commands import move_cli
from pendulum_testing.processes import ProcessGroup, RunningProgram

PATIENCE = 60.0


def test_move_holds_an_angle_and_its_stop_latches_until_its_reset(processes: ProcessGroup, domain_id: int) -> None:
    def move(goal: str) -> RunningProgram:
        program = processes.start("pendulum_bags", "move", goal, "--namespace", "/sim")
        program.wait(PATIENCE)
        return program

    processes.start("pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim", "-p", "rate_hz:=100.0")
    # A negative angle is no option.
    held = move("-0.15")
    assert held.returncode == 0, held.output
    angle = re.search(r"/sim: at (-[0-9.]+) rad; held under position control", held.output)
    assert angle is not None, held.output
    assert abs(float(angle.group(1)) + 0.15) < 0.05
    stopped = move("stop")
    assert stopped.returncode == 0
    assert stopped.output.endswith("/sim: e-stop, latched; end it with: move reset\n")
    refused = move("0.1")
    assert refused.returncode == 2, refused.output
    assert "e-stop" in refused.output
    assert "moving" not in refused.output
    ended = move("reset")
    assert (ended.returncode, ended.output) == (0, "/sim: e-stop ended; the plant is disarmed\n")
    # The end of an e-stop is no order to move: what moves it is asked for anew.
    again = move("-0.05")
    assert again.returncode == 0, again.output
    assert "arming" in again.output


@pytest.mark.parametrize("goal", ["sideways", "nan", "inf", "0,3"])
def test_a_goal_that_is_no_place_is_refused_before_anything_is_started(
    goal: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert move_cli.main([goal]) == 2
    assert f"goal is {goal!r}; expected upright, down, stop, reset, or an angle" in capsys.readouterr().err
