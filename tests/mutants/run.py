"""``make mutants``: break each safety rule in every small way, and list what the tests that watch it did not notice."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
import yaml
from rich.progress import Progress, TaskID

from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from tests.mutants.operators import Mutant
from tests.mutants.session import TargetError, try_mutants
from tests.mutants.targets import TARGETS, mutants_of_target

_EQUIVALENT = Path(__file__).with_name("equivalent.yaml")
app = typer.Typer(add_completion=False, rich_markup_mode=None)


@dataclass
class Row:
    """What became of a module's mutants."""

    module: str
    mutants: int = 0
    killed: int = 0
    equivalent: int = 0
    survived: int = 0


@app.command(epilog="Example: python -m tests.mutants.run --only supervisor")
def mutants(
    only: Annotated[str, typer.Option(help="Only modules whose name has this in it.")] = "",
    workers: Annotated[int, typer.Option(help="Tests that run at once.", min=1)] = os.cpu_count() or 1,
    out: Annotated[Path, typer.Option(help="Where the result goes; Markdown beside it.")] = Path(
        "build", "mutants.json"
    ),
) -> int:
    """Break the rules and print a table; exit code 1 where a mutant survives that is not listed as equivalent."""
    reasons: dict[str, str] = yaml.safe_load(_EQUIVALENT.read_text(encoding="utf-8")) or {}
    targets = [target for target in TARGETS if only in target.module]
    rows: list[Row] = []
    survivors: list[Mutant] = []
    used: set[str] = set()
    console = make_console()
    with Progress(console=console, transient=True) as progress:
        for target in targets:
            found = mutants_of_target(target)
            row = Row(target.module.removeprefix("pendulum_"), len(found))
            rows.append(row)
            task = progress.add_task(row.module, total=len(found))

            def note(mutant: Mutant, noticed: bool, row: Row = row, task: TaskID = task) -> None:
                progress.advance(task)
                if noticed:
                    row.killed += 1
                    if mutant.key in reasons:
                        print(f"note: listed as equivalent, and noticed: {mutant.key}", file=sys.stderr)
                elif mutant.key in reasons:
                    row.equivalent += 1
                    used.add(mutant.key)
                else:
                    row.survived += 1
                    survivors.append(mutant)
                    print(f"survived: {row.module}, line {mutant.line}: {mutant.key}", file=sys.stderr)

            try:
                try_mutants(target, found, workers, note)
            except TargetError as error:
                print(f"error: {error}", file=sys.stderr)
                return 2
            # A whole run takes an hour: what is known so far is kept, and shown where there is no bar.
            _write(out, rows, survivors, {key: reasons[key] for key in sorted(used)})
            if not console.is_terminal:
                print(f"{row.module}: {row.killed} of {row.mutants} killed, {row.survived} survived", file=sys.stderr)
    table = WholeTable("rules", "mutants", "killed", "equivalent", "survived")
    for row in rows:
        table.add_row(row.module, *(str(value) for value in (row.mutants, row.killed, row.equivalent, row.survived)))
    console.print(table)
    if not only and (gone := sorted(reasons.keys() - used)):
        print("no longer there, strike them off equivalent.yaml: " + "; ".join(gone), file=sys.stderr)
    return int(bool(survivors))


def _write(out: Path, rows: Sequence[Row], survivors: Sequence[Mutant], equivalent: dict[str, str]) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        out,
        {
            "rows": [row.__dict__ for row in rows],
            "survived": [mutant.key for mutant in survivors],
            "equivalent": equivalent,
        },
    )
    lines = ["| rules | mutants | killed | equivalent | survived |", "|---|---|---|---|---|"]
    lines += [f"| `{row.module}` | {row.mutants} | {row.killed} | {row.equivalent} | {row.survived} |" for row in rows]
    lines += ["", "Equivalent, with the reason:", ""] if equivalent else []
    lines += [f"- `{key}`: {reason}" for key, reason in equivalent.items()]
    out.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(cli_main(app, sys.argv[1:], name="make mutants"))
