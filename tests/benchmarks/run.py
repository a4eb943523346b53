"""Run the benchmarks, print a table and keep the rows in ``build/bench.json``: ``make bench [ONLY=area]``."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import time
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.text import Text

from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from tests.benchmarks import Row

__all__ = ["areas", "main", "measure", "merge"]

RESULTS = Path("build/bench.json")


def areas(folder: Path = Path(__file__).parent) -> list[str]:
    """List the areas that there are, from the names of their modules."""
    return sorted(path.stem.removeprefix("bench_") for path in folder.glob("bench_*.py"))


def measure(area: str) -> Iterator[Row]:
    """Yield an area's rows as they are measured; a failure is a row that does not hold."""
    try:
        module = importlib.import_module(f"tests.benchmarks.bench_{area}")
        for row in module.rows():
            yield replace(row, area=area)
    # One broken area must not hide the others; the row says what happened and the trace goes to standard
    # error.
    except Exception as error:  # noqa: BLE001
        traceback.print_exc()
        note = f"{type(error).__name__}: {error}"
        yield Row(what="this area ended with an error", holds=False, note=note, area=area)


def merge(old: Iterable[dict[str, Any]], new: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Replace the rows of every area that was measured again and keep the others, ordered by area."""
    new = list(new)
    measured_again = {row["area"] for row in new}
    rows = [row for row in old if row["area"] not in measured_again] + new
    return sorted(rows, key=lambda row: str(row["area"]))


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print, store; 1 when an area failed, or, with ``--strict``, when a target was not reached."""
    known = areas()
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    parser.add_argument("--only", metavar="AREA", action="append", help=f"one of {', '.join(known) or '(none yet)'}")
    parser.add_argument("--strict", action="store_true", help="exit with 1 when a target is not reached")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON instead of a table")
    arguments = parser.parse_args(argv)
    chosen = arguments.only or known
    if unknown := [area for area in chosen if area not in known]:
        parser.error(f"area is {unknown[0]!r}; expected one of {', '.join(known)}")

    console = make_console(stderr=arguments.json)
    rows: list[Row] = []
    interrupted = False
    for area in chosen:
        start = time.monotonic()
        of_area = []
        with console.status(f"measuring {area}"):
            try:
                for row in measure(area):
                    of_area.append(row)
                    # Some take minutes: who waits, or has to break off, sees what is there.
                    console.print(f"{row.what}: {_figure(row.ours, row.unit)}", style="dim", markup=False)
            except KeyboardInterrupt:
                interrupted = True
                break
        rows += of_area
        console.print(f"{area}: measured in {time.monotonic() - start:.1f} s", style="dim")
    if arguments.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        console.print(table(rows))
    _store(rows)
    reached = sum(row.holds is True for row in rows)
    missed = [row for row in rows if row.holds is False]
    console.print(f"{reached} targets reached, {len(missed)} not; rows are in {RESULTS}")
    if interrupted:
        console.print("interrupted: the areas that were not finished keep their old rows")
        return 130
    failed = any(row.holds is False and row.ours is None for row in rows)
    return int(failed or (arguments.strict and bool(missed)))


def table(rows: Sequence[Row]) -> WholeTable:
    """Lay the rows out for the terminal."""
    result = WholeTable(title="benchmarks", title_justify="left")
    for heading in ("area", "what"):
        result.add_column(heading, overflow="fold")
    for heading in ("ours", "peer", "ratio"):
        result.add_column(heading, justify="right", no_wrap=True)
    for heading in ("target", "holds"):
        result.add_column(heading)
    for row in rows:
        verdict = {True: Text("yes", "green"), False: Text("no", "bold red"), None: Text("-")}[row.holds]
        theirs = f"{_figure(row.peer, row.unit)}\n{row.peer_name}" if row.peer_name else ""
        what = Text(row.what).append(f"\n{row.note}", "yellow") if row.note else Text(row.what)
        ratio = "" if row.ratio is None else f"{row.ratio:.3g} x"
        result.add_row(row.area, what, _figure(row.ours, row.unit), theirs, ratio, row.target, verdict)
    return result


def _figure(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.4g} {unit}".strip()


def _store(rows: Sequence[Row]) -> None:
    circumstances = {
        "measured_at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
    }
    old = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else []
    RESULTS.parent.mkdir(exist_ok=True)
    whole = merge(old, [asdict(row) | circumstances for row in rows])
    temporary = RESULTS.with_suffix(".tmp")
    temporary.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    os.replace(temporary, RESULTS)


if __name__ == "__main__":
    raise SystemExit(main())
