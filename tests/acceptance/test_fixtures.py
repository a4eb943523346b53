"""The fixtures that other tests lean on: a domain of one's own, and no process left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import psutil
import pytest

from pendulum_bags.experiments.domain import is_unused
from pendulum_testing.fixtures import PROJECT, wait_for
from pendulum_testing.processes import ProcessGroup


def python(code: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(code)]


def test_a_domain_is_reserved_for_as_long_as_the_test_runs(domain_id: int, tmp_path: Path) -> None:
    assert 1 <= domain_id <= 100
    assert os.environ["ROS_DOMAIN_ID"] == str(domain_id)
    assert Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]).name == "loopback.xml"
    inner = tmp_path / "test_inner.py"
    inner.write_text("def test_prints_its_domain(domain_id):\n    print(f'domain={domain_id}')\n")
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-s",
        "-p",
        "pendulum_testing.fixtures",
        "-c",
        str(PROJECT / "pyproject.toml"),
    ]
    done = subprocess.run([*command, str(inner)], cwd=PROJECT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert f"domain={domain_id}\n" not in done.stdout


def test_a_domain_in_which_someone_listens_is_not_handed_out(domain_id: int) -> None:
    assert is_unused(domain_id)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * domain_id + 10))
        assert not is_unused(domain_id)


def test_waiting_returns_the_answer_or_says_what_it_waited_for() -> None:
    answers = iter([None, 0, "yes"])
    assert wait_for(lambda: next(answers), 1.0, "a yes", period=0.0) == "yes"
    with pytest.raises(AssertionError, match=r"waited 0.01 s for the moon; last answer was None"):
        wait_for(lambda: None, 0.01, "the moon", period=0.001)


def test_a_program_is_watched_through_its_output(processes: ProcessGroup) -> None:
    program = processes.start_command(python("print('ready 7'); import time; time.sleep(60)"), name="sleeper")
    assert program.wait_for_output(r"^ready (\d)$", 10.0)[1] == "7"
    program.send_signal(signal.SIGTERM)
    assert program.wait(10.0) == -signal.SIGTERM
    with pytest.raises(AssertionError, match=r"sleeper ended with code -15 without printing 'never'"):
        program.wait_for_output("never", 1.0)


def test_programs_follow_each_other_in_one_process_unless_they_are_to_be_alone(processes: ProcessGroup) -> None:
    def started(executable: str, **how: Any) -> tuple[int, str]:
        program = processes.start("pendulum_bags", executable, "--help", **how)
        assert program.wait(60.0) == 0, program.output
        return program.pid, program.output

    (one, told), (again, told_again) = started("info"), started("info")
    assert one == again
    assert told == told_again != ""
    others = [started("info", alone=True), started("info", env={"SEEN": "1"}), started("info", cwd=processes.folder)]
    assert len({one, *(pid for pid, _ in others)}) == 4
    assert {output for _, output in others} == {told}
    refused = processes.start("pendulum_bags", "info", "nothing/there")
    assert (refused.pid, refused.wait(60.0)) == (one, 2)


def test_a_program_that_ignores_the_interrupt_is_killed_and_reported(tmp_path: Path) -> None:
    group = ProcessGroup(tmp_path, cwd=PROJECT)
    code = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('deaf'); time.sleep(60)"
    program = group.start_command(python(code), name="deaf")
    program.wait_for_output("deaf", 10.0)
    assert group.close(patience=0.2) == [f"deaf (pid {program.pid}) ran 0.2 s after SIGINT"]
    assert not psutil.pid_exists(program.pid)


def test_a_process_that_outlives_its_starter_is_killed_and_reported(tmp_path: Path) -> None:
    group = ProcessGroup(tmp_path, cwd=PROJECT)
    code = """
        import subprocess, sys
        sleeper = [sys.executable, "-c", "import time; time.sleep(60)"]
        print("child", subprocess.Popen(sleeper, start_new_session=True).pid)
    """
    program = group.start_command(python(code), name="careless parent")
    child = int(program.wait_for_output(r"child (\d+)", 10.0)[1])
    program.wait(10.0)
    (complaint,) = group.close()
    assert complaint.startswith(f"pid {child} outlived its starter")
    wait_for(lambda: not psutil.pid_exists(child) or psutil.Process(child).status() == "zombie", 5.0, "its end")
