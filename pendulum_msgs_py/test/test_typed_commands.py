"""Commands that programs print run as they are printed, in a shell with an activated environment and without."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pendulum_msgs_py.programs.typed_commands import as_typed
from pendulum_testing.fixtures import PROJECT, in_repository

TEXT = "Next: python -m pendulum_lqr design --preset thesis"
FRESH = "/usr/bin:/bin"
BIN = Path(sys.executable).parent


def test_a_shell_that_finds_the_interpreter_gets_the_short_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{BIN}:{FRESH}")
    assert as_typed(TEXT) == TEXT


def test_a_fresh_shell_gets_the_interpreters_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", FRESH)
    monkeypatch.chdir(tmp_path)
    assert as_typed(TEXT) == f"Next: {BIN}/python -m pendulum_lqr design --preset thesis"
    monkeypatch.chdir(BIN.parents[1])
    typed = as_typed(TEXT)
    assert typed == f"Next: {BIN.relative_to(BIN.parents[1])}/python -m pendulum_lqr design --preset thesis"
    assert as_typed(typed) == typed
    assert as_typed("python -m pip install 'x'") == "python -m pip install 'x'"


def test_another_python_first_on_the_path_is_not_taken_for_ours(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("python", "python3"):
        (tmp_path / name).symlink_to("/bin/true")
    monkeypatch.setenv("PATH", f"{tmp_path}:{BIN}")
    monkeypatch.chdir(tmp_path)
    assert as_typed(TEXT) == f"Next: {BIN}/python -m pendulum_lqr design --preset thesis"


@in_repository
@pytest.mark.parametrize(
    "arguments",
    [
        ["pendulum_lqr", "design", "--help"],
        ["pendulum_sim", "viewer", "--help"],
        ["pendulum_lqr"],
        ["pendulum_sim", "viewer", "x"],
    ],
    ids=" ".join,
)
def test_examples_that_a_program_prints_in_a_fresh_shell_name_an_interpreter_that_exists(arguments: list[str]) -> None:
    environment = {**os.environ, "PATH": FRESH, "COLUMNS": "400"}
    done = subprocess.run(
        [sys.executable, "-m", *arguments], capture_output=True, text=True, check=False, env=environment
    )
    interpreters = set(re.findall(r"(\S+) -m pendulum_", done.stdout + done.stderr))
    assert interpreters
    assert [name for name in interpreters if not Path(name.lstrip("<(`")).is_file()] == []


@in_repository
@pytest.mark.parametrize("package", ["pendulum_msgs_py", "pendulum_sim", "pendulum_lqr", "pendulum_hw_bridge"])
def test_the_systems_python_in_the_projects_folder_says_where_the_programs_are(package: str) -> None:
    start = f"import runpy, sys; sys.path.insert(0, '.'); runpy.run_module('{package}', run_name='__main__')"
    done = subprocess.run(
        [sys.executable, "-S", "-I", "-c", start],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(
        f"error: {package} is not installed for this Python; run .venv/bin/python -m {package}"
    )
