"""The course where it needs running plants: a sealed one is played on and identified."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

from pendulum_testing.fixtures import PROJECT

PAGE = PROJECT / "bags" / "pendulum_bags" / "docs" / "tutorial.md"


def _run(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    words = shlex.split(line)
    assert words[0] == "python"
    return subprocess.run(
        [sys.executable, *words[1:]], cwd=folder, capture_output=True, text=True, timeout=120, check=False
    )


def test_the_answers_page_identifies_the_hidden_plant(domain_id: int, tmp_path: Path) -> None:
    made = _run("python -m pendulum_bags course make --seed 1 --out course", tmp_path)
    assert made.returncode == 0, made.stderr
    blocks = re.findall(r"^```console\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    for line in blocks[-1].splitlines():
        if line.startswith("$ "):
            done = _run(line[2:], tmp_path)
            assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    assert done.stdout.startswith("right: every parameter")
