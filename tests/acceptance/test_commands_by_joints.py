"""The table of commands in the page on mechanisms: what is refused is refused in a sentence, all else has its test."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from pendulum_bags.commands import experiment_cli
from pendulum_lqr.design_command import design_cli
from pendulum_lqr.swing_up import swing_up_cli
from pendulum_msgs_py.plants.plant_parameters import MECHANISM_PRESETS
from pendulum_sim.pictures import phase_plot
from pendulum_testing.fixtures import PROJECT

PAGE = PROJECT / "pendulum_msgs_py" / "docs" / "mechanisms.md"
_ROW = re.compile(r"^\| (`[^|]*) \| (yes|no)[^|]* \| ([^|]*) \|$", re.MULTILINE)
SEVERAL = ("--plant", "cart_pole")


def _experiment(name: str, *options: str) -> Callable[[Path], int]:
    return lambda folder: experiment_cli.main([name, *options, "--out", str(folder / "run")])


def _of(main: Callable[[list[str]], int], *options: str) -> Callable[[Path], int]:
    return lambda folder: main([*options, "--out", str(folder / "file")])


REFUSED: dict[str, Callable[[Path], int]] = {
    "gymnasium": _experiment("joints", *SEVERAL, "--simulation", "gymnasium:Pendulum-v1"),
    "phase_plot": _of(phase_plot.main, *SEVERAL),
    "design --tracking": lambda _: design_cli.main(["--preset", "cart_pole", "--tracking", "amplitude=0.3"]),
    "swing_up": _of(swing_up_cli.main, "--preset", "thesis"),
    "experiment benchmark": _experiment("benchmark", "--plant", "thesis"),
    "experiment pid_vs_lqr": _experiment("pid_vs_lqr", *SEVERAL),
    "experiment random_start": _experiment("random_start", *SEVERAL),
    "experiment ranking": _experiment("ranking", *SEVERAL),
    "experiment frequency_response": _experiment("frequency_response", *SEVERAL),
    "experiment leaderboard": _experiment("leaderboard", "--plants", "cart_pole"),
}
"""Commands of the table with a no, and how it comes about."""
WITHOUT_A_PLANT = {
    *("trajectory_action", "move", "effort_adapter", "lab", "procedure", "course"),
    *("experiment inertia_damping", "experiment gravity", "experiment strategies", "foxglove"),
}
"""Commands with a no that take no plant of several joints: their options name none, or it is on the graph."""
TESTED = {
    "simulator": "tests/integration/test_several_joints.py",
    "export_model": "pendulum_sim/test/test_mechanism_model_files.py",
    "viewer": "pendulum_sim/test/test_shown_mechanisms.py",
    "markers": "pendulum_sim/test/test_shown_mechanisms.py",
    "console": "bags/pendulum_console/test/test_console_joints.py",
    "mujoco": "pendulum_sim/test/test_equation_check.py",
    "adopt": "tests/integration/test_plants_on_the_graph.py",
    "controller": "tests/integration/test_several_joints.py",
    "disturbance": "tests/integration/test_several_joints.py",
    "design --uncertainty --machine": "pendulum_lqr/test/test_mechanism_model.py",
    "design --figures": "pendulum_lqr/test/test_mechanism_model.py",
    "bridge": "tests/integration/test_emulated_machine_and_simulator.py",
    "check": "pendulum_hw_bridge/test/test_machine_checklist.py",
    "emulator": "pendulum_hw_bridge/test/test_emulated_machine.py",
    "experiment thesis": "bags/pendulum_bags/test/test_foreign_simulation.py",
    "experiment joints": "tests/integration/test_experiments.py",
    "experiment lockstep": "tests/integration/test_several_joints.py",
    "experiment monte_carlo": "bags/pendulum_bags/test/test_joint_monte_carlo.py",
    "experiment region_of_attraction": "bags/pendulum_bags/test/test_joint_region.py",
    "experiment study": "bags/pendulum_bags/test/test_study_files.py",
    "excite": "bags/pendulum_bags/test/test_joint_excitation.py",
    "identify": "bags/pendulum_bags/test/test_mechanism_identification.py",
    "replay": "bags/pendulum_bags/test/test_mechanism_identification.py",
    "analyse": "bags/pendulum_bags/test/test_commands_on_files.py",
    "compare": "bags/pendulum_bags/test/test_joint_comparison.py",
    "report": "tests/integration/test_experiments.py",
    "frequency_response": "bags/pendulum_bags/test/test_joint_frequency_response.py",
    "train": "bags/pendulum_learning/test/test_learning_joints.py",
}
"""Commands with a yes, and a test that gives them a plant of several joints."""


def _rows() -> dict[str, tuple[str, str]]:
    rows = _ROW.findall(PAGE.read_text(encoding="utf-8").partition("## Which command takes which plant")[2])
    return {name: (one, several) for names, one, several in rows for name in re.findall(r"`([^`]*)`", names)}


def test_every_command_of_the_table_is_refused_or_tested_and_no_other() -> None:
    rows = {name.removeprefix("--"): cells for name, cells in _rows().items() if not name.startswith("--")}
    refused = {name for name, cells in rows.items() if any(cell.startswith("no") for cell in cells)}
    assert refused == set(REFUSED) | WITHOUT_A_PLANT
    assert set(rows) - refused == set(TESTED)


@pytest.mark.parametrize("name", REFUSED)
def test_what_the_table_refuses_is_refused_in_a_sentence_before_anything_is_written(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert REFUSED[name](tmp_path) == 2
    error = capsys.readouterr().err
    assert "error: " in error
    assert "Traceback" not in error
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("name", TESTED)
def test_what_the_table_allows_has_a_test_with_a_plant_of_several_joints(name: str) -> None:
    text = (PROJECT / TESTED[name]).read_text(encoding="utf-8")
    assert any(plant in text for plant in (*MECHANISM_PRESETS, "shoulder"))
