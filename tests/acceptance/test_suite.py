"""``make test`` itself: parts side by side, what failed by name, the slowest, an exit code, and an end by Ctrl-C."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from tests.fixtures import PROJECT, wait_for
from tests.processes import ProcessGroup
from tests.suite import exit_code, rooms

_RUN = """
import sys
from tests.suite import Part, run_parts
parts = [Part(name, ["-p", "tests.fixtures", name], workers=1, nice=nice) for name, nice in zip(sys.argv[2:], (0, 5))]
raise SystemExit(run_parts(parts) if sys.argv[1] == "in turn" else run_parts(*([part] for part in parts)))
"""


def _parts(tmp_path: Path, *bodies: str, how: str = "at once") -> list[str]:
    names = []
    for number, body in enumerate(bodies):
        file = tmp_path / f"part_{number}" / f"test_part_{number}.py"
        file.parent.mkdir()
        file.write_text(body, encoding="utf-8")
        names.append(str(file))
    return [sys.executable, "-c", _RUN, how, *names]


def test_a_failure_is_named_at_once_explained_at_the_end_and_the_exit_code(
    processes: ProcessGroup, tmp_path: Path
) -> None:
    right = "def test_right() -> None:\n    pass\n"
    program = processes.start_command(_parts(tmp_path, right, f"def test_wrong():\n    assert 40 + 1 == 42\n\n{right}"))
    assert program.wait(60) == 1
    named, explained = (program.output.index(words) for words in ("FAILED ", "assert (40 + 1) == 42"))
    assert named < explained
    assert "test_part_1.py::test_wrong (" in program.output[named:explained]
    slowest, last = program.output.split("ten slowest:\n")[1].rsplit("\n", 2)[:2]
    assert slowest.count("::test_right") == 2
    assert "1 of 1; " in last
    assert "2 of 2, 1 FAILED" in last


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
        f"    open({str(tmp_path)!r} + '/began_' + __name__[-1], 'w').close()\n"
        "    time.sleep(600)\n"
    )
    program = processes.start_command(_parts(tmp_path, body, body))
    wait_for(lambda: len(list(tmp_path.glob("began_*"))) == 2, 60, "both tests to begin")
    program.send_signal(signal.SIGINT)
    assert program.wait(60) == pytest.ExitCode.INTERRUPTED
    assert "interrupted" in program.output
    assert processes.leftovers() == []


def test_parts_of_a_lane_run_in_turn(processes: ProcessGroup, tmp_path: Path) -> None:
    mark = tmp_path / "ended"
    # Started together, the second would look before the first is done.
    first = f"import time\n\ndef test_first():\n    time.sleep(1.0)\n    open({str(mark)!r}, 'w').close()\n"
    second = f"import os\n\ndef test_second():\n    assert os.path.exists({str(mark)!r})\n"
    program = processes.start_command(_parts(tmp_path, first, second, how="in turn"))
    assert program.wait(60) == 0, program.output
    assert program.output.splitlines()[-1].count("1 of 1") == 2


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="this Linux shares its cores without sessions")
def test_what_tests_that_compute_start_has_no_more_than_their_share_of_the_cores(
    processes: ProcessGroup, tmp_path: Path
) -> None:
    body = (
        "import subprocess, sys\n"
        "from pathlib import Path\n"
        "from tests.fixtures import wait_for\n\n"
        "def test_share() -> None:\n"
        "    program = subprocess.Popen(['sleep', '60'], start_new_session=True)\n"
        "    share = Path(f'/proc/{program.pid}/autogroup')\n"
        "    try:\n"
        "        wait_for(lambda: share.read_text().endswith(' nice %d\\n'), 30, 'its share')\n"
        "    finally:\n"
        "        program.kill()\n"
        "        program.wait()\n"
    )
    program = processes.start_command(_parts(tmp_path, body % 0, body % 5))
    assert program.wait(60) == 0, program.output


def test_each_file_of_tests_is_in_one_part() -> None:
    parts = rooms()
    folders = [PROJECT / "tests", *(path for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*"))]
    every = {str(path.relative_to(PROJECT)) for folder in folders for path in folder.rglob("test_*.py")}
    assert sorted(name for part in parts for name in part) == sorted(every)
