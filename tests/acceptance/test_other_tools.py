"""What other tools call: the notebook and the MATLAB function of the examples, and both without ROS."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pendulum_testing.fixtures import PROJECT
from tests.layers import environment_of

EXAMPLES = PROJECT / "bags" / "examples"


@pytest.fixture
def examples(tmp_path: Path) -> Path:
    return Path(shutil.copytree(EXAMPLES, tmp_path / "examples"))


def test_cells_of_the_notebook_run_in_their_order_without_ros_and_end_with_the_picture(
    examples: Path, tmp_path: Path
) -> None:
    notebook = json.loads((examples / "compare_recordings.ipynb").read_text(encoding="utf-8"))
    cells = [ast.parse("".join(cell["source"])) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    # A kernel shows the value of a cell's last line.
    cells[-1].body[-1:] = ast.parse("print(type(shown := " + ast.unparse(cells[-1].body[-1]) + "), shown.size)").body
    code = "\n".join(ast.unparse(cell) for cell in cells)
    without_ros = environment_of(tmp_path / "hide", "run", ros=False)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=examples, env=without_ros, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    sentence, shown = done.stdout.splitlines()
    assert sentence.startswith("Simulation and emulated hardware are not equivalent within the stated margins")
    assert "PngImageFile" in shown


def test_a_program_that_needs_ros_says_so_where_it_is_missing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_bags", "experiment", "thesis"],
        env=environment_of(tmp_path / "hide", "run", ros=False),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "rclpy is not installed, which this needs; install ROS 2 Jazzy, or its wheels for Linux" in done.stderr
    assert "Traceback" not in done.stderr


def octave(folder: Path, code: str) -> subprocess.CompletedProcess[str]:
    program = shutil.which("octave-cli") or pytest.skip("octave-cli is not installed; it runs MATLAB's language")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        [program, "--quiet", "--norc", "--eval", code],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_function_for_matlab_returns_the_result_and_raises_what_the_program_reports(examples: Path) -> None:
    done = octave(
        examples,
        "r = compare_recordings('regulation_sim', 'regulation_hw', '--margin', 'delay=20ms');"
        "disp(r.verdict.outcome); disp(r.plants.hw.rate_hz);"
        "try; compare_recordings('regulation_sim', 'no such'); catch e; disp(e.message); end",
    )
    assert done.returncode == 0, done.stderr
    outcome, rate, reason = done.stdout.strip().splitlines()
    assert outcome == "not equivalent"
    assert float(rate) == pytest.approx(100.0)
    assert reason.startswith("error: ")
    assert "no such" in reason


def test_octave_reads_an_exported_recording_with_the_values_of_the_bag(examples: Path) -> None:
    from pendulum_rosbag.reader import read_bag
    from pendulum_rosbag.reader.tables import export_bag

    bag = read_bag(examples / "regulation_hw")
    export_bag(bag, examples / "out", "mat")
    states: Any = bag["/hw/joint_states"]
    done = octave(
        examples / "out",
        "s = load('hw__joint_states.mat'); printf('%.17g\\n', s.time(2), s.position(end)); disp(class(s.stamp_ns));"
        "e = load('hw__events.mat'); disp(jsondecode(e.data{1}).name);",
    )
    assert done.returncode == 0, done.stderr
    time, last, kind, name = done.stdout.split()
    assert float(time) == pytest.approx((states["stamp_ns"][1] - bag.start_ns) * 1e-9, abs=1e-15)
    assert float(last) == states["position"][-1]
    assert (kind, name) == ("int64", bag.events()[0]["name"])
