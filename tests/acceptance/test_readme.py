"""Every command in a README runs, and in no colours where nobody wants them.

Those of the pages are collected here, so that none is forgotten.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from pendulum_bags.experiments.host_pool import HostPool, share_pool
from pendulum_hw_bridge.checks.check_cli import EXIT_BUSY
from pendulum_msgs_py.programs.executables import run_package
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup

PAGES = sorted(
    path
    for path in PROJECT.rglob("*.md")
    if not {".venv", "build", "install", "node_modules", "runs"} & set(path.relative_to(PROJECT).parts)
)
NODES = {"simulator", "gymnasium", "adopt", "bridge", "controller", "disturbance", "effort_adapter"}
_COLOUR = re.compile(r"\x1b\[(?:\d*;)*(?:[34]\d|9[0-7]|10[0-7])[;m]")
"""Bold and the like are no colours; 30 to 49 and 90 to 107 are."""
_BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)


def _commands() -> list[tuple[str, str]]:
    found: dict[str, str] = {}
    # What several pages say runs once.
    for page in PAGES:
        for block in _BLOCK.findall(page.read_text(encoding="utf-8")):
            # Those of the first page run in order, below.
            lines = [] if page == PROJECT / "README.md" else block.replace("\\\n", " ").splitlines()
            for line in lines:
                command = line.split(" #")[0].strip()
                if command:
                    found.setdefault(command, str(page.relative_to(PROJECT)))
    return [(page, command) for command, page in found.items()]


COMMANDS = _commands()
RunLine = Callable[..., str]
OF_ONE_PROCESS = {"pendulum_sim", "pendulum_lqr", "pendulum_bags", "pendulum_course"}
"""Packages whose commands run in the process of the tests; those of the bridge measure or change their own."""
FROM_STAIRS = next(command for _, command in COMMANDS if " experiment gravity " in command)
"""From an unknown pendulum to a controller designed for it."""
TESTED_ELSEWHERE = {
    FROM_STAIRS: "tests/integration/test_experiments.py",
}


@pytest.fixture
def run_line(hosts: HostPool, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[RunLine]:
    """Return what runs a command of a page, in a folder, and returns what it printed; it must succeed.

    Our programs run in this process, which has imported them already, and share its hosts; a shell runs the rest.
    """

    def run(line: str, folder: Path, *codes: int) -> str:
        words = shlex.split(line)
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            patch.setenv("PATH", f"{PROJECT / '.venv' / 'bin'}:{os.environ['PATH']}")
            capfd.readouterr()
            if words[:2] == ["python", "-m"] and not {"&&", ">"} & set(words) and words[2] in OF_ONE_PROCESS:
                code = run_package(words[2], words[3:])
            else:
                code = subprocess.run(line, shell=True, timeout=500, check=False).returncode
            output = "".join(capfd.readouterr())
        assert code in {0, *codes}, f"{line}\n{output}"
        return output

    with share_pool(hosts):
        yield run


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a folder that looks like the project's: what a command writes must not land there."""
    (tmp_path / "shared").symlink_to(PROJECT.parent / "shared")
    folder = tmp_path / "root"
    folder.mkdir()
    for entry in PROJECT.iterdir():
        if entry.name != "build":
            (folder / entry.name).symlink_to(entry)
    return folder


@pytest.mark.timeout(600)
def test_the_first_page_runs_in_a_fresh_shell_as_it_is_printed(root: Path) -> None:
    blocks = _BLOCK.findall((PROJECT / "README.md").read_text(encoding="utf-8"))
    assert blocks[0].strip() == "make experiment"
    script = "set -e\n" + "".join(blocks[1:])
    assert "pendulum design" in script
    fresh = {"HOME": str(root), "PATH": "/usr/bin:/bin", "LANG": "C.UTF-8"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=root, env=fresh, capture_output=True, text=True, timeout=500, check=False
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert "33.345265" in done.stdout


@pytest.mark.timeout(600)
@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{page}: {command}" for page, command in COMMANDS])
def test_command_of_a_page_runs(
    processes: ProcessGroup,
    run_line: RunLine,
    domain_id: int,
    tmp_path: Path,
    root: Path,
    monkeypatch: pytest.MonkeyPatch,
    page: str,
    command: str,
) -> None:
    if command in TESTED_ELSEWHERE:
        pytest.skip(f"run by {TESTED_ELSEWHERE[command]}")
    if "../shared/" in command and not (PROJECT.parent / "shared").is_dir():
        pytest.skip("the recordings of real pendulums are not at hand")
    words = shlex.split(command)
    if words[0] == "python" and words[1] == "-m" and words[3] in NODES:
        monkeypatch.chdir(tmp_path)
        program = processes.start(words[2], words[3], *words[4:])
        program.wait_for_output(r"\[INFO\]|recording to", 200)
        program.interrupt()
        assert program.wait(60) == 0, program.output
        return
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setenv("FORCE_COLOR", "1")
    # Other tests run beside this one, and the checklist is right to say so.
    output = run_line(command, root, *([EXIT_BUSY] if words[3:4] == ["check"] else []))
    assert not _COLOUR.search(output), f"{page}: {command}\n{output!r}"
