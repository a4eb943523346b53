"""Spoil files at random and read them: ``python -m tests.tools.faults.fuzz --minutes 10`` (each parser gets that long).

Each parser is tried in a process of its own whose memory is bounded, so that a file that blows it up is a finding and
not the end of the machine.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from tests.tools.faults.parsers import PARSERS, Parser, copy_of, mutate

__all__ = ["HEADROOM", "PATIENCE", "bound_memory", "fuzz_all", "fuzz_one", "too_slow"]

HEADROOM = 512 << 20
"""Memory that a parser may take for a small file, beyond what the interpreter and its libraries take [bytes]."""
PATIENCE = 20.0
"""Longest time of computing that one small file may take to read [s]; waiting, ten times as long."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def bound_memory(headroom: int = HEADROOM) -> None:
    """Let this process take no more memory than it has now and some."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * os.sysconf("SC_PAGE_SIZE") + headroom
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def fuzz_one(parser: Parser, seconds: float, seed: int, keep: Path | None = None) -> dict[str, Any]:
    """Spoil files of one kind for some time and return how often that was tried, and every kind of finding.

    Args:
        parser: What to try.
        seconds: For how long [s].
        seed: Seed of the spoiling.
        keep: Folder for files that were findings.
    """
    generator = random.Random(seed)
    findings: dict[str, int] = {}
    tried, slowest = 0, 0.0
    with tempfile.TemporaryDirectory(prefix="pendulum_fuzz_") as place:
        folder = Path(place)
        (folder / "good").mkdir()
        (folder / "spoilt").mkdir()
        good = parser.make(folder / "good")
        data = good.read_bytes()
        problem = parser.survives(good)
        if problem:
            findings[f"the good file: {problem}"] = 1
        target = copy_of(good, folder / "spoilt")
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline or tried < 10:
            spoilt = mutate(data, generator, text=parser.text)
            target.write_bytes(spoilt)
            started = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, PATIENCE)  # a machine that others use may let us wait for long
            signal.setitimer(signal.ITIMER_REAL, 10.0 * PATIENCE)
            problem = parser.survives(target)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            slowest = max(slowest, time.process_time() - started)
            tried += 1
            if problem:
                kind = problem.split(": ")[0]
                if kind not in findings and keep is not None:
                    keep.mkdir(parents=True, exist_ok=True)
                    name = parser.name.replace(" ", "_").replace(":", "")
                    (keep / f"{name}_{tried}{good.suffix}").write_bytes(spoilt)
                findings[kind] = findings.get(kind, 0) + 1
    return {"parser": parser.name, "tried": tried, "findings": findings, "slowest_s": slowest}


def too_slow(*_: object) -> None:
    """Raise a TimeoutError: a handler of the signals that tell that reading takes too long."""
    raise TimeoutError(f"reading took more than {PATIENCE} s of computing, or ten times that of waiting")


def fuzz_all(seconds: float, seed: int, keep: Path | None = None, only: str = "") -> Iterator[dict[str, Any]]:
    """Try every parser, each in a process of its own, and yield a row for each."""
    for parser in PARSERS:
        if only and only not in parser.name:
            continue
        arguments = ["--child", parser.name, "--minutes", repr(seconds / 60.0), "--seed", str(seed)]
        if keep is not None:
            arguments += ["--keep", str(keep)]
        done = subprocess.run(
            [sys.executable, "-m", "tests.tools.faults.fuzz", *arguments],
            capture_output=True,
            text=True,
            timeout=seconds + 120.0,
            check=False,
        )
        if done.returncode == 0:
            yield json.loads(done.stdout.splitlines()[-1])
        else:
            tail = (done.stderr.strip().splitlines() or ["no word"])[-1]
            row = {"parser": parser.name, "tried": 0, "findings": {f"ended with {done.returncode}: {tail}": 1}}
            yield {**row, "slowest_s": 0.0}


@app.command(epilog="Example: python -m tests.tools.faults.fuzz --minutes 10 --seed 7")
def fuzz(
    minutes: Annotated[float, typer.Option(help="Time for each parser [min].", min=0.0)] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of the spoiling.")] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for files that a parser did not stand.")] = None,
    only: Annotated[str, typer.Option(help="Only parsers with this in their name.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
    child: Annotated[str, typer.Option(hidden=True)] = "",
) -> int:
    """Read files that are wrong in random ways; only the project's own errors may come out."""
    if child:
        signal.signal(signal.SIGALRM, too_slow)
        signal.signal(signal.SIGPROF, too_slow)
        parser = next(parser for parser in PARSERS if parser.name == child)
        bound_memory()
        print(json.dumps(fuzz_one(parser, minutes * 60.0, seed, keep)))
        return 0
    rows = list(fuzz_all(minutes * 60.0, seed, keep, only))
    if as_json:
        print(json.dumps(rows, indent=2))
        return 1 if any(row["findings"] for row in rows) else 0
    table = WholeTable("parser", "files", "findings", "slowest", title="Spoilt files")
    for row in rows:
        found = "; ".join(f"{kind} ({count})" for kind, count in row["findings"].items())
        table.add_row(row["parser"], str(row["tried"]), found or "none", f"{row['slowest_s'] * 1e3:.0f} ms")
    make_console().print(table)
    return 1 if any(row["findings"] for row in rows) else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.fuzz")


if __name__ == "__main__":
    raise SystemExit(main())
