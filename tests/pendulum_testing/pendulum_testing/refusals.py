"""What programs of nodes refuse at their start, asked one after the other in one process.

A start of each would take longer than all that is looked at; in the test's own process they would change how it takes
signals, and all that it starts later.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence

from pendulum_msgs_py.programs.executables import tables_of

__all__ = ["Refused", "not_refused"]

Refused = tuple[tuple[str, str], Sequence[str], str]
"""Package and program, its parameters, and the sentence with which it has to end."""


def not_refused(cases: Sequence[Refused], *, namespace: str = "/sim") -> list[str]:
    """Return which cases did not end with code 2 and their sentence, and what they said instead.

    Args:
        cases: Programs that must not run.
        namespace: Of the nodes.
    """
    asked = [
        (*program, ["--ros-args", "-r", f"__ns:={namespace}", *(word for one in parameters for word in ("-p", one))])
        for program, parameters, _ in cases
    ]
    done = subprocess.run(
        [sys.executable, __file__, json.dumps(asked)],
        capture_output=True, text=True, timeout=60.0 + 20.0 * len(cases), check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    answers = json.loads(done.stdout.splitlines()[-1])
    return [
        f"{program} {parameters}: code {code}, {said!r}; expected {sentence!r}"
        for (program, parameters, sentence), (code, said) in zip(cases, answers, strict=True)
        if code != 2 or sentence not in said or "Traceback" in said
    ]


def _ask(package: str, program: str, arguments: Sequence[str]) -> tuple[int, str]:
    kept = {stream: os.dup(stream) for stream in (1, 2)}
    with tempfile.TemporaryFile() as said:
        try:
            for stream in kept:
                os.dup2(said.fileno(), stream)
            module, _, function = tables_of(package)[program].partition(":")
            code = getattr(importlib.import_module(module), function)(arguments)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for stream, own in kept.items():
                os.dup2(own, stream)
                os.close(own)
        said.seek(0)
        return code, said.read().decode()


if __name__ == "__main__":
    print(json.dumps([_ask(*each) for each in json.loads(sys.argv[1])]))
