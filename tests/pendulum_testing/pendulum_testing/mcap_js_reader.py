"""The JavaScript readers of MCAP, as tests ask them: those with which Foxglove and its kin open our files."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pendulum_testing.npm import node_process

__all__ = ["McapJs", "mcap_js_process"]

_FOLDER = Path(__file__).resolve().parents[2] / "mcap_js"


@dataclass
class McapJs:
    """A process that reads one file after the other."""

    process: subprocess.Popen[str]

    def read(self, file: Path) -> dict[str, Any]:
        """Return what ``byIndex`` and ``inOrder`` found, each with ``count`` and ``sha256`` of the data, or error."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{file}\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        assert line, f"the JavaScript reader ended at {file}"
        return dict(json.loads(line))

    def counts(self, file: Path) -> tuple[int, int]:
        """Return how many messages the reader by index and the reader in order found; both must open the file."""
        answer = self.read(file)
        for name, found in answer.items():
            assert "error" not in found, f"{name}: {found['error']}"
        assert answer["inOrder"]["done"], "the reader in order waits for more"
        return answer["byIndex"]["count"], answer["inOrder"]["count"]


@contextmanager
def mcap_js_process() -> Iterator[McapJs]:
    """Start the readers; skip the test where Node.js or its packages cannot be had."""
    if not _FOLDER.is_dir():
        pytest.skip("the JavaScript readers of MCAP are fetched by the repository's lock, which is not here")
    with node_process(_FOLDER / "read.mjs", what="the JavaScript readers of MCAP") as process:
        yield McapJs(process)
