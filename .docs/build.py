"""Build the site into ``build/site`` from the Markdown files where they stand, with their pictures."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
GATHERED = PROJECT / "build" / "docs"


def main() -> int:
    """Gather the pages that git knows, or would add, and run mkdocs on them."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md", "*.png", "*.svg", "*.gif"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    if "README.md" not in listed:
        print(
            "error: README.md is missing; expected the first page of the site there",
            file=sys.stderr,
        )
        return 2
    shutil.rmtree(GATHERED, ignore_errors=True)
    for name in listed:
        target = GATHERED / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PROJECT / name, target)
    configuration = str(PROJECT / ".docs" / "mkdocs.yml")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--config-file", configuration]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    code = subprocess.run(command, cwd=PROJECT, env=environment, check=False).returncode
    if code == 0:
        print("the site is build/site/index.html")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
