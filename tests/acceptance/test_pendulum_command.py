"""``pendulum``: one name that lists, completes and starts every program, and imports none but the one it starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pendulum_bags.commands.pendulum_cli import SECTIONS, main
from pendulum_msgs_py.programs import completion
from pendulum_msgs_py.programs.executables import tables_of
from pendulum_testing.fixtures import PROJECT
from tests.acceptance.test_packaging import FOLDERS, executables
from tests.completing import completed

COMMANDS = {name: target for section in SECTIONS.values() for name, target in section.items()}
BAG = "bags/examples/regulation_sim"


def test_every_program_of_every_package_has_a_command_and_each_command_a_program() -> None:
    programs = {
        target
        for package in FOLDERS
        if executables(package)
        for program, target in tables_of(package).items()
        if program != "pendulum"
    }
    named = [tables_of(package)[program] for package, program in map(str.split, COMMANDS.values())]
    assert set(named) == programs
    assert len(named) == len(set(named)) == len(COMMANDS)


def test_help_says_what_each_command_is_for_and_how_to_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert capsys.readouterr().out.startswith("usage: pendulum COMMAND")
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    lines = {line.split()[0]: line for line in text.splitlines() if line.startswith("  ")}
    assert COMMANDS.keys() <= lines.keys()
    assert [name for name in COMMANDS if len(lines[name].split(maxsplit=1)[1]) < 10] == []
    assert max(map(len, text.splitlines())) <= 120
    assert "pendulum experiment thesis --seed 7" in text
    assert "source <(pendulum --completion bash)" in text


def test_help_imports_no_library_and_no_program() -> None:
    code = (
        "import sys; from pendulum_bags.commands.pendulum_cli import main; assert main(['--help']) == 0; "
        "print(*sorted({name.partition('.')[0] for name in sys.modules}), sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PROJECT)
    imported = set(done.stdout.splitlines())
    assert "pendulum_bags" in imported
    assert not {"numpy", "scipy", "typer", "rich", "rclpy", "yaml", "pendulum_sim.simulator.simulator_node"} & imported


def test_arguments_are_handed_on_untouched(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(PROJECT / BAG), "--json"]) == 0
    told = capfd.readouterr().out
    assert tables_of("pendulum_bags")["info"].startswith("pendulum_rosbag.")
    from pendulum_rosbag.reader import info_cli

    assert info_cli.main([str(PROJECT / BAG), "--json"]) == 0
    assert capfd.readouterr().out == told
    # What belongs to ROS as well: the node's own help answers, not ours.
    assert main(["simulator", "--ros-args", "-r", "__ns:=/sim", "--help"]) == 0
    assert "__ns:=/sim -p plant:=x5_9" in capfd.readouterr().out


def test_the_help_of_a_program_names_the_command_that_was_typed(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--help"]) == 0
    assert "Usage: pendulum compare [OPTIONS]" in capfd.readouterr().out
    assert main(["experiment", "thesis", "--help"]) == 0
    assert "Usage: pendulum experiment thesis [OPTIONS]" in capfd.readouterr().out


def test_a_command_that_is_none_is_refused_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["comapre"]) == 2
    said = capsys.readouterr().err
    assert said == (
        "error: there is no command 'comapre'; expected one that pendulum --help lists; did you mean 'compare'?\n"
    )


@pytest.mark.parametrize("shell", completion.SHELLS)
def test_the_shell_completes_commands_and_what_follows(shell: str) -> None:
    ours = Path(sys.executable).with_name("pendulum")
    script = subprocess.run([ours, "--completion", shell], capture_output=True, text=True, check=True).stdout
    typed = ("rep", "experiment the", "compare --js", "simulator --ros-args -p plan")
    assert completed(shell, script, *(f"{ours} {words}" for words in typed)) == [
        ["repair", "replay", "report"],
        ["thesis"],
        ["--json"],
        ["plant:="],
    ]
