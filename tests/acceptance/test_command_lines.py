"""Every command line of the project: an example in its help, JSON for its tables, completion, colours only if wanted.

The command lines are found, not listed: all programs of all packages with all their subcommands, and the tools of the
tests.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs import completion
from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import PROGRAMS as INSTALLED
from tests.acceptance.test_packaging import executables
from tests.completing import completed

# ``pendulum`` has no command line of its own: it starts the others (test_pendulum_command.py).
PROGRAMS = [(package, program) for package, program in INSTALLED if program != "pendulum"]

TOOLS = sorted(
    ".".join(path.relative_to(PROJECT).with_suffix("").parts)
    for path in (PROJECT / "tests").rglob("*.py")
    if re.search(r"^app = typer\.Typer\(", path.read_text(encoding="utf-8"), re.MULTILINE)
)


@dataclass(frozen=True)
class CommandLine:
    """One command: how it is typed, and what typer knows of it."""

    typed: str
    command: Any


@cache
def application(package: str, program: str) -> Any | None:
    """Return the command that a program runs, or None for a node: asked as the shell does that wants to complete it."""
    asked: list[Any] = []

    def note(command: Any, _: Any) -> list[str]:
        asked.append(command)
        return []

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(completion.VARIABLE, "1")
        patch.setattr(completion, "of_command", note)
        patch.setattr(completion, "of_node", lambda _, words: note(None, words))
        assert run(package, program, [""]) == 0
    assert len(asked) == 1, f"{package} {program} does not let itself be completed"
    return asked[0]


def run(package: str, program: str, arguments: list[str]) -> int:
    """Run a program in this process and return its exit code."""
    module, function = executables(package)[program].split(":")
    return int(getattr(importlib.import_module(module), function)(arguments))


def _below(typed: str, command: Any) -> Iterator[CommandLine]:
    commands = getattr(command, "commands", {})
    if not commands:
        yield CommandLine(typed, command)
    for name, found in commands.items():
        yield from _below(f"{typed} {name}", found)


@cache
def command_lines() -> tuple[CommandLine, ...]:
    """Find all of them."""
    found: list[CommandLine] = []
    for package, program in PROGRAMS:
        command = application(package, program)
        if command is not None:
            found += _below(f"python -m {package} {program}", command)
    for tool in TOOLS:
        found += _below(f"python -m {tool}", typer.main.get_command(importlib.import_module(tool).app))
    return tuple(found)


def nodes() -> list[tuple[str, str]]:
    """Find all programs that are nodes and nothing else."""
    return [(package, program) for package, program in PROGRAMS if application(package, program) is None]


def _functions(module: Any) -> dict[str, ast.AST]:
    tree = ast.parse(inspect.getsource(module))
    return {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}


def prints_a_table(callback: Any) -> bool:
    """Tell whether a command, or a function of its module that it calls, makes a table for the terminal."""
    function = inspect.unwrap(callback)
    known = _functions(sys.modules[function.__module__])
    seen: set[str] = set()
    todo = [function.__name__]
    while todo:
        name = todo.pop()
        if name in seen or name not in known:
            continue
        seen.add(name)
        for node in ast.walk(known[name]):
            if isinstance(node, ast.Call):
                called = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
                if called in {"WholeTable", "print_table"}:
                    return True
                todo.append(called)
    return False


def test_all_programs_are_found() -> None:
    found = {line.typed for line in command_lines()}
    assert len(found) > 25
    for expected in ("pendulum_bags info", "pendulum_bags experiment leaderboard", "tests.tools.faults.run"):
        assert f"python -m {expected}" in found
    assert ("pendulum_sim", "simulator") in nodes()
    assert len(nodes()) + len({typed.split()[2] + typed.split()[3] for typed in found if "tests." not in typed}) == len(
        PROGRAMS
    )


def test_the_help_of_every_command_shows_an_example_of_it() -> None:
    without = []
    for line in command_lines():
        text = " ".join(f"{line.command.help or ''} {line.command.epilog or ''}".split())
        # pendulum_bags offers the commands of pendulum_rosbag, too: one example serves both.
        typed = re.escape(line.typed).replace("pendulum_bags", "pendulum_(?:bags|rosbag)")
        if not re.search(rf"Example: {typed}(?![\w.])", text):
            without.append(line.typed)
    assert not without


def test_the_help_of_every_command_keeps_the_units_in_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    # Rich would take [rad] for a style of its own and leave it out.
    lost = []
    for line in command_lines():
        with pytest.raises(SystemExit):
            line.command.main(["--help"], prog_name=line.typed)
        text = " ".join(capsys.readouterr().out.split())
        helps = " ".join(getattr(option, "help", None) or "" for option in line.command.params)
        lost += [(line.typed, unit) for unit in re.findall(r"\[[^\]]+\]", helps) if " ".join(unit.split()) not in text]
    assert not lost


def test_the_help_of_every_node_shows_an_example_and_its_parameters(capsys: pytest.CaptureFixture[str]) -> None:
    for package, program in nodes():
        assert run(package, program, ["--help"]) == 0
        text = capsys.readouterr().out
        assert f"example: python -m {package} {program}" in text
        assert "parameters (name, default, meaning):" in text


def test_what_prints_a_table_prints_json_too() -> None:
    tables = [line for line in command_lines() if prints_a_table(line.command.callback)]
    assert len(tables) > 12

    def has_json(line: CommandLine) -> bool:
        written = [option.default for option in line.command.params if "--out" in option.opts]
        asked = any("--json" in option.opts for option in line.command.params)
        return asked or any(Path(str(path)).suffix == ".json" for path in written)

    assert not [line.typed for line in tables if not has_json(line)]


def test_an_option_has_one_name_and_one_meaning_in_every_command() -> None:
    found: dict[str, set[str]] = {}
    for line in command_lines():
        if "tests." in line.typed:
            continue
        for option in line.command.params:
            if option.param_type_name != "option":
                continue
            for name in option.opts:
                found.setdefault(name, set()).add("/".join(sorted(option.opts)))
            if "--json" in option.opts:
                found.setdefault("help of --json", set()).add(str(option.help))
    assert found["--out"] == {"--out/-o"}
    assert found["-o"] == {"--out/-o"}
    # The other name of it, as ROS 2's own tools call it, is accepted everywhere and shown nowhere.
    assert "--output" not in found
    assert found["help of --json"] == {"Print JSON instead of text."}


def test_every_command_completes_its_options(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through the same way as the shell: a run of the program that must do nothing but answer."""
    monkeypatch.setenv(completion.VARIABLE, "1")
    for line in command_lines():
        if "tests." in line.typed:
            continue
        package, program, *below = line.typed.split()[2:]
        assert run(package, program, [*below, "--"]) == 0
        told = set(capsys.readouterr().out.split())
        expected = {
            name for option in line.command.params if option.param_type_name == "option" for name in option.opts
        }
        assert {name for name in expected if name.startswith("--")} <= told, line.typed
    for package, program in nodes():
        assert run(package, program, ["--ros-args", "-p", ""]) == 0
        assert ":=" in capsys.readouterr().out, program


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_the_shell_completes_what_is_typed(shell: str) -> None:
    typed = (
        "pendul",
        "pendulum_bags rep",
        "pendulum_bags experiment the",
        "pendulum_bags compare --js",
        "pendulum_lqr controller --ros-args -p set_po",
        "http.ser",
    )
    packages, *others = completed(shell, completion.script(shell), *(f"{sys.executable} -m {line}" for line in typed))
    assert {"pendulum_bags", "pendulum_sim"} <= set(packages)
    assert others == [["repair", "replay", "report"], ["thesis"], ["--json"], ["set_point:="], []]


def test_another_shell_is_refused_with_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    from pendulum_msgs_py.programs.executables import run_package

    with pytest.raises(ParameterError):
        completion.script("tcsh")
    assert run_package("pendulum_bags", ["--completion", "tcsh"]) == 2
    assert "expected one of bash, zsh" in capsys.readouterr().err
    assert run_package("pendulum_bags", ["--completion"]) == 0
    assert "_pendulum_complete" in capsys.readouterr().out


def _in_a_terminal(arguments: list[str]) -> str:
    """Run a program in a terminal of its own and return what it wrote there."""
    ours, theirs = pty.openpty()
    unset = {"NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE"}
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=theirs,
        stderr=theirs,
        cwd=PROJECT,
        env={**inherited, "TERM": "xterm-256color", "COLUMNS": "100"},
    )
    os.close(theirs)
    told = b""
    try:
        while data := os.read(ours, 65536):
            told += data
    except OSError:
        pass  # the terminal's other end is closed
    finally:
        os.close(ours)
    assert process.wait(30) == 0
    return told.decode()


def test_a_terminal_has_colours_and_only_the_library_that_leaves_them_out_if_asked_writes_them(tmp_path: Path) -> None:
    """That it does leave them out, test_readme.py sees by every command of the pages."""
    colour = re.compile(r"\x1b\[[0-9;]*(?:3[0-7]|4[0-7]|9[0-7]|38;|48;)[0-9;]*m")
    arguments = ["pendulum_sim", "phase_plot", "--out", str(tmp_path / "phase.svg")]
    assert colour.search(_in_a_terminal(arguments))
    # Nobody writes colours past the library that knows when not to.
    sources = [path for top in ("", "bags/") for path in PROJECT.glob(f"{top}pendulum_*/pendulum_*/**/*.py")]
    assert len(sources) > 100
    raw = re.compile(r"\\033\[|\\x1b\[|\\u001b\[|force_terminal|color_system")
    assert [str(path) for path in sources if raw.search(path.read_text(encoding="utf-8"))] == []


def test_json_of_a_table_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    from pendulum_hw_bridge.lab.emulator_cli import fault_main

    assert fault_main(["--json"]) == 0
    assert "m_stop" in json.loads(capsys.readouterr().out)["faults"]


@pytest.mark.parametrize("program", ["pendulum_bags experiment", "pendulum_course course"])
def test_a_help_of_80_columns_has_the_whole_summary_of_each_command(program: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *program.split(), "--help"],
        env={**os.environ, "COLUMNS": "80"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "..." not in done.stdout.partition("Commands:")[2]
    assert max(map(len, done.stdout.splitlines())) <= 80
