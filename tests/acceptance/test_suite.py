"""``make test`` itself: parts side by side, what failed by name, the slowest, an exit code, and an end by Ctrl-C."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from pendulum_testing.fixtures import PROJECT, wait_for
from pendulum_testing.processes import ProcessGroup
from tests.suite import exit_code, rooms

_RUN = """
import sys
from tests.suite import Part, run_parts
lanes = [[Part(name, ["-p", "pendulum_testing.fixtures", name], workers=1, nice=nice) for name in lane.split()]
         for lane, nice in zip(sys.argv[1:], (0, 7))]
raise SystemExit(run_parts(*lanes))
"""


def _run(tmp_path: Path, *lanes: list[str]) -> list[str]:
    """Return the command that runs lanes of parts, of one file each, the second with less priority."""
    names = []
    for number, lane in enumerate(lanes):
        files = [tmp_path / f"part_{number}{it}" / f"test_part_{number}{it}.py" for it in range(len(lane))]
        for file, body in zip(files, lane, strict=True):
            file.parent.mkdir()
            file.write_text(body, encoding="utf-8")
        names.append(" ".join(map(str, files)))
    return [sys.executable, "-c", _RUN, *names]


_SHARE = """
import os
import subprocess
import sys
from pathlib import Path
from pendulum_testing.fixtures import wait_for

def test_share() -> None:
    if not Path("/proc/self/autogroup").exists():
        return  # this Linux shares its cores without sessions
    began, held_back = Path({folder!r}, "began"), Path({folder!r}, "held_back")
    if {steps_back}:
        wait_for(began.exists, 60, "a program of the other part")
    # On a busy machine some time goes by until a session is begun.
    words = "import os, time; time.sleep(0.7); os.setsid(); time.sleep(100)"
    program = subprocess.Popen([sys.executable, "-c", words])
    share = Path(f"/proc/{{program.pid}}/autogroup")
    try:
        wait_for(lambda: os.getsid(program.pid) == program.pid, 30, "its session")
        if {steps_back}:
            wait_for(lambda: share.read_text().endswith(" nice 7\\n"), 30, "its share")
            held_back.touch()
        else:
            began.touch()
            wait_for(held_back.exists, 90, "the other part's program to be held back")
            assert not share.read_text().endswith(" nice 7\\n")
    finally:
        program.kill()
        program.wait()
"""
"""What a test starts in a session of its own has its part's share of the cores, and no other part's.

The share is one that ``make test`` gives to nobody: this test may run in a part that is held back itself."""


def test_a_lane_runs_its_parts_in_turn_and_a_failure_is_named_at_once_and_explained_at_the_end(
    processes: ProcessGroup, tmp_path: Path
) -> None:
    mark = tmp_path / "ended"
    # Started together, the second would look before the first is done.
    first = f"import time\n\ndef test_first():\n    time.sleep(1.0)\n    open({str(mark)!r}, 'w').close()\n"
    second = f"import os\n\ndef test_second():\n    assert os.path.exists({str(mark)!r})\n"
    wrong = "\ndef test_wrong():\n    assert 40 + 1 == 42\n"
    stays, steps_back = (_SHARE.format(folder=str(tmp_path), steps_back=it) for it in (False, True))
    program = processes.start_command(_run(tmp_path, [first + stays, second], [steps_back + wrong]))
    assert program.wait(120) == 1, program.output
    named, explained = (program.output.index(words) for words in ("FAILED ", "assert (40 + 1) == 42"))
    assert named < explained
    assert "test_part_10.py::test_wrong (" in program.output[named:explained]
    assert program.output.count("slowest 10 durations") == 3
    last = program.output.splitlines()[-1]
    assert last.count(" 100 %; ") == 2
    assert " 100 %, 1 FAILED; took " in last


@pytest.mark.parametrize(
    ("codes", "expected"), [((0, 0), 0), ((1, 0), 1), ((0, 1), 1), ((0, 5), 0), ((5, 2), 2), ((5, 5), 5), ((0, -9), -9)]
)
def test_a_part_that_fails_is_the_exit_code_and_one_with_nothing_to_do_is_not(
    codes: tuple[int, int], expected: int
) -> None:
    assert exit_code(codes) == expected


def test_ctrl_c_ends_the_parts_and_what_their_tests_started(processes: ProcessGroup, tmp_path: Path) -> None:
    body = (
        "import sys, time\n\n"
        "def test_long(processes) -> None:\n"
        "    processes.start_command([sys.executable, '-c', 'import time; print(1, flush=True); time.sleep(600)'])\n"
        f"    open({str(tmp_path)!r} + '/began_' + __name__, 'w').close()\n"
        "    time.sleep(600)\n"
    )
    program = processes.start_command(_run(tmp_path, [body], [body]))
    wait_for(lambda: len(list(tmp_path.glob("began_*"))) == 2, 60, "both tests to begin")
    program.send_signal(signal.SIGINT)
    assert program.wait(60) == pytest.ExitCode.INTERRUPTED
    assert "interrupted" in program.output
    wait_for(lambda: not processes.leftovers(), 10, "the end of what they started, which sleeps for ten minutes")


def test_each_file_of_tests_is_in_one_part() -> None:
    parts = rooms()
    folders = [PROJECT / "tests", *(path for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*"))]
    every = {str(path.relative_to(PROJECT)) for folder in folders for path in folder.rglob("test_*.py")}
    assert sorted(name for part in parts for name in part) == sorted(every)
