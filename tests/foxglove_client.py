"""A viewer as tests have one: a process of the public JavaScript client of the Foxglove WebSocket protocol."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pendulum_testing.npm import node_process

__all__ = ["FoxgloveClient", "foxglove_client"]

_FOLDER = Path(__file__).resolve().parent / "foxglove_js"


class FoxgloveClient:
    """A connected client; each method asks it and waits for the answer.

    Args:
        process: It.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a command of ``client.mjs`` and return its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"command": command, **arguments}) + "\n")
        self._process.stdin.flush()
        answer = self.line()
        assert "error" not in answer, answer
        return answer

    def line(self) -> dict[str, Any]:
        """Return the next thing that it says."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the client has ended"
        return dict(json.loads(line))

    def subscribe(self, *topics: str, stamps: bool = False) -> None:
        """Subscribe to topics that it knows; with ``stamps``, those of the headers are kept."""
        self.ask("subscribe", topics=topics, stamps=stamps)

    def call(self, service: str, **request: Any) -> dict[str, Any]:
        """Call a service and return ``response`` or ``failure``."""
        return self.ask("call", service=service, request=request)

    def parameters(self, *names: str) -> dict[str, Any]:
        """Return parameters by their names; all of them where none is named."""
        return {found["name"]: found.get("value") for found in self.ask("get", names=names)["parameters"]}

    def set(self, name: str, value: Any) -> dict[str, Any]:
        """Set a parameter and return what the server says of it then."""
        found: Sequence[dict[str, Any]] = self.ask("set", parameters=[{"name": name, "value": value}])["parameters"]
        return {each["name"]: each.get("value") for each in found}


@contextmanager
def foxglove_client(address: str) -> Iterator[FoxgloveClient]:
    """Connect; skip the test where Node.js or its packages cannot be had."""
    with node_process(
        _FOLDER / "client.mjs", address, what="the JavaScript client of the Foxglove WebSocket protocol"
    ) as process:
        yield FoxgloveClient(process)
