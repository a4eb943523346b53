"""Every command in a README runs, and in no colours where nobody wants them.

Those of the pages are collected here, so that none is forgotten.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from pendulum_hw_bridge.checks.check_cli import EXIT_BUSY
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
FROM_STAIRS = next(command for _, command in COMMANDS if " experiment gravity " in command)
"""From an unknown pendulum to a controller designed for it."""
TESTED_ELSEWHERE = {
    FROM_STAIRS: "tests/integration/test_experiments.py",
}


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
    processes: ProcessGroup, domain_id: int, tmp_path: Path, root: Path, page: str, command: str
) -> None:
    if command in TESTED_ELSEWHERE:
        pytest.skip(f"run by {TESTED_ELSEWHERE[command]}")
    if "../shared/" in command and not (PROJECT.parent / "shared").is_dir():
        pytest.skip("the recordings of real pendulums are not at hand")
    words = shlex.split(command)
    environment = {**os.environ, "PATH": f"{PROJECT / '.venv' / 'bin'}:{os.environ['PATH']}"}
    if words[0] == "python" and words[1] == "-m" and words[3] in NODES:
        program = processes.start(words[2], words[3], *words[4:], cwd=tmp_path)
        program.wait_for_output(r"\[INFO\]|recording to", 200)
        program.interrupt()
        assert program.wait(60) == 0, program.output
        return
    environment |= {"NO_COLOR": "1", "FORCE_COLOR": "1"}
    done = subprocess.run(
        command, shell=True, cwd=root, env=environment, capture_output=True, text=True, timeout=500, check=False
    )
    assert not _COLOUR.search(done.stdout + done.stderr), f"{page}: {command}\n{done.stdout!r}\n{done.stderr!r}"
    # Other tests run beside this one, and the checklist is right to say so.
    if words[3:4] == ["check"] and done.returncode == EXIT_BUSY:
        assert "This computer is too busy to tell" in done.stdout
        return
    assert done.returncode == 0, f"{page}: {command}\n{done.stdout}\n{done.stderr}"
