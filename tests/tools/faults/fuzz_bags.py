"""Let atheris look for bags that the reader does not stand: ``python -m tests.tools.faults.fuzz_bags --minutes 10``.

Where ``tests.tools.faults.fuzz`` spoils files at random, libFuzzer watches which lines of the reader a file reaches and
goes on from there. The tool is not part of the lock, for it is large and nothing else needs it::

    .venv/bin/python -m pip install --no-deps --target .venv/atheris atheris==3.0.0
"""

from __future__ import annotations

import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console

__all__ = ["STORAGES", "fuzz_storage", "watch"]

STORAGES = {
    "mcap": "bag: MCAP",
    "mcap-zstd": "bag: MCAP in zstd chunks",
    "mcap-types": "bag: own types",
    "sqlite3": "bag: SQLite",
}
"""What can be fuzzed, and the parser of :mod:`tests.tools.faults.parsers` that reads it."""
ATHERIS = Path(sys.prefix, "atheris")
_PROJECT = Path(__file__).parents[3]
_WORDS = (
    r"\x89MCAP0\x0d\x0a", "zstd", "lz4", "cdr", "ros2msg", "ros2idl", "sensor_msgs/msg/JointState",
    "std_msgs/msg/String", r"SQLite format 3\x00", "topics", "messages", "CREATE TABLE ", "MSG: ",
    "int32", "string<=", "wstring", "[]", "builtin_interfaces/Time", "own/Part", "[<=99]", "=1", r"\x0a",
)  # fmt: skip
"""What stands in bags, in the notation of libFuzzer's dictionaries."""
_WATCHED = {"os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect", "os.remove", "os.rename"}
_LARGEST = 1 << 16
PATIENCE = 20.0
"""Longest time of computing that one bag may take to read [s]."""

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


def watch(inside: Path, found: list[str]) -> None:
    """Note every program that is started, connection that is made, and file that is written outside of a folder."""

    def look(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "os.remove" and arguments[1] >= 0:  # relative to a folder that is open
            arguments = (Path(f"/proc/self/fd/{arguments[1]}").readlink() / os.fsdecode(arguments[0]),)
        if event in _WATCHED and not _within(arguments[0] if arguments else "", inside):
            found.append(f"{event}{arguments[:1]!r}")
        elif event == "open" and isinstance(arguments[2], int):
            writes = arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            if writes and isinstance(arguments[0], (str, bytes)) and not _within(arguments[0], inside):
                found.append(f"open({arguments[0]!r}) for writing")

    sys.addaudithook(look)


def _within(path: object, folder: Path) -> bool:
    name = os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else ""
    return name == os.devnull or Path(os.path.normpath(Path.cwd() / name)).is_relative_to(folder)


def _child(storage: str, place: Path, flags: Sequence[str]) -> None:
    """Fuzz one storage until libFuzzer ends this process."""
    sys.path.insert(0, str(ATHERIS))
    atheris: Any = importlib.import_module("atheris")
    with atheris.instrument_imports(include=["pendulum_rosbag.reader", "pendulum_rosbag.storage", "rosbags"]):
        for module in ("rosbags.serde", "rosbags.typesys"):
            importlib.import_module(module)
        # Not above: what is imported before is not watched.
        from tests.tools.faults.fuzz import too_slow
        from tests.tools.faults.parsers import PARSERS
    parser = next(parser for parser in PARSERS if parser.name == STORAGES[storage])
    (place / "good").mkdir()
    good = parser.make(place / "good")
    corpus = place / "corpus"
    corpus.mkdir()
    (corpus / "good").write_bytes(good.read_bytes())
    target = place / f"target{good.suffix}"
    os.environ["TMPDIR"] = tempfile.tempdir = str(place)
    parser.survives(good)  # so that everything is imported before we watch
    known: set[str] = set()
    watched: list[str] = []
    watch(place, watched)

    def read(data: bytes) -> None:
        target.write_bytes(data)
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)
        problem = parser.survives(target) or (f"reaches out: {watched[0]}" if watched else "")
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        watched.clear()
        kind = re.sub(r"\d+", "#", problem.split(" [")[0])[:120]
        if problem and kind not in known:
            known.add(kind)
            (place / f"finding_{len(known)}{good.suffix}").write_bytes(data)
            with (place / "findings.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(problem) + "\n")

    signal.signal(signal.SIGPROF, too_slow)
    atheris.Setup([sys.argv[0], *flags, str(corpus)], read)
    atheris.Fuzz()


def fuzz_storage(storage: str, seconds: float, seed: int, keep: Path | None = None) -> dict[str, Any]:
    """Fuzz the reader of one storage in a process of its own.

    Args:
        storage: One of :data:`STORAGES`.
        seconds: For how long [s].
        seed: Seed of libFuzzer.
        keep: Folder for files that were findings.

    Returns:
        A row with ``storage``, ``tried``, ``reached`` (edges of the reader's code) and ``findings``.
    """
    shared_memory = Path("/dev/shm")
    base = str(shared_memory) if os.access(shared_memory, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="pendulum_fuzz_", dir=base) as name:
        place = Path(name)
        words = place / "words.dict"
        words.write_text("".join(f'"{word}"\n' for word in _WORDS), encoding="ascii")
        flags = [
            f"-max_total_time={max(1, round(seconds))}",
            f"-seed={seed}",
            f"-max_len={_LARGEST}",
            f"-dict={words}",
            f"-timeout={round(10 * PATIENCE)}",
            "-rss_limit_mb=1500",
            "-print_final_stats=1",
            f"-artifact_prefix={place}/finding_",
        ]
        done = subprocess.run(
            [
                sys.executable, "-m", "tests.tools.faults.fuzz_bags", "--child", storage, "--place", name,
                *(f"--flag={flag}" for flag in flags),
            ],
            cwd=_PROJECT, capture_output=True, text=True, errors="replace", timeout=seconds + 180.0, check=False,
        )  # fmt: skip
        told = place / "findings.jsonl"
        findings = [json.loads(line) for line in told.read_text().splitlines()] if told.exists() else []
        if done.returncode != 0:
            tail = [line for line in done.stderr.splitlines() if "ERROR" in line or "Error" in line]
            findings.append(f"ended with {done.returncode}: {(tail or ['no word'])[0][:200]}")
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            for file in place.glob("finding_*"):
                (keep / f"{storage}_{file.name}").write_bytes(file.read_bytes())
    units = re.findall(r"stat::number_of_executed_units:\s*(\d+)", done.stderr)
    edges = re.findall(r"cov: (\d+)", done.stderr)
    tried, reached = int(units[-1]) if units else 0, int(edges[-1]) if edges else 0
    return {"storage": storage, "tried": tried, "reached": reached, "findings": findings}


@app.command(epilog="Example: python -m tests.tools.faults.fuzz_bags --minutes 10 --only sqlite3")
def fuzz(
    minutes: Annotated[float, typer.Option(help="Time for each storage [min].", min=0.0)] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of libFuzzer.")] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for bags that the reader did not stand.")] = None,
    only: Annotated[str, typer.Option(help=f"One of {', '.join(STORAGES)}.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
    child: Annotated[str, typer.Option(hidden=True)] = "",
    place: Annotated[Path, typer.Option(hidden=True)] = Path(),
    flag: Annotated[list[str] | None, typer.Option(hidden=True)] = None,
) -> int:
    """Let libFuzzer look for bags that end in anything but data or an error of ours, or that reach out."""
    if child:
        _child(child, place, flag or [])
    if only and only not in STORAGES:
        raise PendulumError(f"storage is {only!r}; expected one of {', '.join(STORAGES)}")
    if not (ATHERIS / "atheris").is_dir():
        raise PendulumError(
            f"atheris is not in {ATHERIS}; "
            f"install it with: {sys.executable} -m pip install --no-deps --target {ATHERIS} atheris==3.0.0"
        )
    rows = [fuzz_storage(storage, minutes * 60.0, seed, keep) for storage in STORAGES if only in {"", storage}]
    if as_json:
        print(json.dumps(rows, indent=2))
        return 1 if any(row["findings"] or not row["tried"] for row in rows) else 0
    table = WholeTable("storage", "files", "edges reached", "findings", title="Bags by libFuzzer")
    for row in rows:
        table.add_row(row["storage"], str(row["tried"]), str(row["reached"]), "\n".join(row["findings"]) or "none")
    make_console().print(table)
    return 1 if any(row["findings"] or not row["tried"] for row in rows) else 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.fuzz_bags")


if __name__ == "__main__":
    raise SystemExit(main())
