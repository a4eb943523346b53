"""What an experiment says of a program that ended under it."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pendulum_bags.experiments import processes as processes_module
from pendulum_bags.experiments import progress
from pendulum_bags.experiments.bound_process import start_bound_process
from pendulum_bags.experiments.processes import ProcessSet
from pendulum_msgs_py.errors import FaultError
from pendulum_testing.fixtures import wait_for

_LOGS_AND_ENDS = """
import sys
print("[ERROR] [1795326665.885562565] [hw.bridge]: actuator thread did not answer within 30 s")
print("error: actuator thread did not answer within 30 s")
sys.exit(2)
"""


def _message(folder: Path, program: str = _LOGS_AND_ENDS) -> str:
    with ProcessSet(folder, {}) as processes:
        child = processes.start("hw_bridge", [sys.executable, "-c", program])
        child.process.wait(20)
        with pytest.raises(FaultError) as caught:
            processes.check()
    return str(caught.value)


def test_what_a_node_logs_and_then_ends_with_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (0.1, 0.1, 0.1))
    assert _message(tmp_path) == (
        "hw_bridge ended with code 2; its last output: error: actuator thread did not answer within 30 s"
    )


def test_a_busy_computer_is_named_where_a_program_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (23.4, 1.0, 1.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert "This computer is busy (load 23 on 2 cores)" in _message(tmp_path / "late")
    # A full disk is no matter of time.
    assert "busy" not in _message(tmp_path / "full", "import sys; sys.exit('error: no space left on device')")


def test_a_program_that_gives_its_priority_away_is_behind_among_sessions_too(tmp_path: Path) -> None:
    if not Path("/proc/self/autogroup").is_file():
        pytest.skip("this kernel shares the cores among processes alone")
    own = os.getpriority(os.PRIO_PROCESS, 0)
    show = "print(open('/proc/self/autogroup').read())"
    with ProcessSet(tmp_path, {}) as processes:
        child = processes.start("behind", [sys.executable, "-c", show], ends_by_itself=True, niceness=3)
        processes.wait(child, 20.0)
    assert child.log.read_text().split()[1:] == ["nice", str(own + 3)]


def test_a_program_that_does_not_end_in_time_is_named_with_its_output(tmp_path: Path) -> None:
    program = "import time; print('simulating', flush=True); time.sleep(60)"
    with ProcessSet(tmp_path, {}) as processes:
        child = processes.start("repeat_1", [sys.executable, "-c", program], ends_by_itself=True)
        wait_for(lambda: child.log.read_text() != "", 20.0, "the program to print")
        with pytest.raises(FaultError) as caught:
            processes.wait(child, 0.3)
    assert str(caught.value) == "repeat_1 still runs after 0.3 s; its last output: simulating"


def test_a_stopped_program_continues_to_end_by_itself(tmp_path: Path) -> None:
    program = "import signal, sys; print('up', flush=True); signal.sigwait([signal.SIGINT]); sys.exit(3)"
    guarded = f"import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]); {program}"
    with ProcessSet(tmp_path, {}) as processes:
        child = processes.start("frozen", [sys.executable, "-c", guarded])
        wait_for(lambda: child.log.read_text() != "", 20.0, "the program to print")
        child.process.send_signal(signal.SIGSTOP)
        assert processes.finish(child, 20.0) == 3


def test_programs_end_but_those_that_are_to_go_on(tmp_path: Path) -> None:
    program = "import time; print('up', flush=True); time.sleep(60)"
    with ProcessSet(tmp_path, {}) as processes:
        first, kept, recorder = (
            processes.start(name, [sys.executable, "-c", program], ends_last=name == "recorder")
            for name in ("plant", "repeat_1", "recorder")
        )
        wait_for(lambda: kept.log.read_text() != "", 20.0, "the program to print")
        processes.stop(keep=[kept])
        assert [child.process.poll() is None for child in (first, kept, recorder)] == [False, True, False]
        # Those that were ended have not died.
        processes.check()
    assert kept.process.poll() is not None


def test_a_long_phase_is_reported_repeatedly_where_the_output_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_SILENCE", 0.0)
    output = io.StringIO()
    with progress.PhaseProgress(10.0, Console(file=output)) as shown:
        shown.phase("noise", 5.0)
        wait_for(lambda: output.getvalue().count("  noise: ") >= 2, 20.0, "two lines of one phase")


def test_a_program_is_waited_for_though_its_start_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        os.kill(os.getpid(), signal.SIGINT)
        return start_bound_process(*arguments, **options)

    monkeypatch.setattr(processes_module, "start_bound_process", interrupted)
    with ProcessSet(tmp_path, {}) as processes:
        with pytest.raises(KeyboardInterrupt):
            processes.start("sleeper", ["sleep", "60"])
        (child,) = processes.children
    assert child.process.poll() is not None
