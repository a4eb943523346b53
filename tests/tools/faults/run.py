"""``make faults``: try every fault several times, print a table, write ``build/faults.json`` and ``.md``."""

from __future__ import annotations

import json
import random
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import FaultError, PendulumError
from pendulum_msgs_py.programs.executables import EXIT_INTERRUPTED, cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from tests.tools.faults.bag_property import check_bag
from tests.tools.faults.bridge_table import Cell, bridge_cells, bridge_markdown
from tests.tools.faults.campaign import CAMPAIGN
from tests.tools.faults.clocks import CLOCK_TRIALS
from tests.tools.faults.delay_margin import LOSSES, survive_loss
from tests.tools.faults.fuzz import fuzz_all
from tests.tools.faults.live import EFFORT_LIMIT, LiveSystem
from tests.tools.faults.network import cut_cable, why_not
from tests.tools.faults.outcome import MACHINE_PATIENCE, MAX_TIME_TO_ZERO, Fault, Outcome, Trial, try_fault
from tests.tools.faults.plants import PLANTS, Plant
from tests.tools.faults.resources import RESOURCE_TRIALS
from tests.tools.faults.side_by_side import DOMAIN_TRIALS

_TRIALS = (*CLOCK_TRIALS, *RESOURCE_TRIALS, *DOMAIN_TRIALS)

_HEADINGS = ("fault", "tried", "survived", "data lost", "longest time to zero", "remarks")

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        fault: What was done.
        tried: How often.
        survived: How often everything held that must hold.
        lost_s: Longest stretch of data lost by a killed recorder [s]; None where none was killed.
        time_to_zero_s: Longest time from the last valid command to zero torque [s]; None where commands went on.
        remarks: What did not hold, or a figure worth telling.
    """

    fault: str
    tried: int
    survived: int
    lost_s: float | None = None
    time_to_zero_s: float | None = None
    remarks: str = ""

    def cells(self) -> tuple[str, ...]:
        """Return what stands below ``_HEADINGS``."""
        lost = "–" if self.lost_s is None else f"{self.lost_s:.3f} s"
        to_zero = "–" if self.time_to_zero_s is None else f"{self.time_to_zero_s * 1e3:.0f} ms"
        counts = (str(self.tried), str(self.survived)) if self.tried else ("not tried", "–")
        return self.fault, *counts, lost, to_zero, " ".join(self.remarks.split())


@app.command(epilog="Example: python -m tests.tools.faults.run --repetitions 3 --seed 7")
def campaign(
    repetitions: Annotated[int, typer.Option(help="How often each fault is tried.", min=1)] = 5,
    seed: Annotated[int, typer.Option(help="Seed of the moments at which faults come.")] = 1,
    minutes: Annotated[float, typer.Option(help="How long each parser is attacked [min].", min=0.0)] = 1.0,
    only: Annotated[str, typer.Option(help="Try only the faults whose names match.")] = "",
    keep: Annotated[Path | None, typer.Option(help="New folder that keeps logs and bags.")] = None,
    out: Annotated[Path, typer.Option(help="Where the rows go after each fault; Markdown beside it.")] = Path(
        "build", "faults.json"
    ),
    json_output: Annotated[bool, typer.Option("--json", help="Print the rows as JSON instead of a table.")] = False,
) -> int:
    """Attack the running system and count what it stood."""
    out.parent.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    cells: list[Cell] = []
    interrupted = False
    try:
        for row in _rows(repetitions, seed, minutes, only, keep, cells):
            rows.append(row)
            # What was tried for an hour is kept, whatever ends the next hour.
            write_json(out, [asdict(each) for each in rows])
            out.with_suffix(".md").write_text(_markdown(rows, cells), encoding="utf-8")
            sys.stderr.write(f"{row.fault}: {row.survived} of {row.tried}\n")
    except KeyboardInterrupt:
        interrupted = True
    if json_output:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    else:
        make_console().print(_table(rows))
    if interrupted:
        sys.stderr.write("interrupted: the rows so far are above\n")
        return EXIT_INTERRUPTED
    # What could not be tried has not survived either.
    return 0 if rows and all(row.tried == row.survived > 0 for row in rows) else 1


def _rows(
    repetitions: int, seed: int, minutes: float, only: str, keep: Path | None, cells: list[Cell]
) -> Iterator[Row]:
    """Try everything, the dearest last; faults of the actuator are noted in ``cells`` too."""
    for cell in bridge_cells(max(repetitions, 20), only):
        cells.append(cell)
        told = "; ".join((", ".join(cell.reactions), *cell.complaints[:1]))
        yield Row(
            f"actuator, {cell.case}: {cell.fault} (simulated time)",
            cell.tried,
            cell.survived,
            time_to_zero_s=None if cell.time_to_zero_ms is None else cell.time_to_zero_ms * 1e-3,
            remarks=f"{told}; {cell.beyond_limit:.1f} N m beyond the limit" if cell.beyond_limit else told,
        )
    for plant in PLANTS:
        faults = [fault for fault in CAMPAIGN if plant in fault.plants]
        wanted = [fault for fault in faults if not only or re.search(only, f"{plant.name}: {fault.name}")]
        if wanted:
            yield from _live_rows(plant, wanted, repetitions, seed, keep)
    for trial in _TRIALS:
        if not only or re.search(only, trial.name):
            yield _trial_row(trial, seed, keep)
    if not only:
        yield _network_row("cable between plant and controller out for 1 s and 30 s", _try_cuts)
        yield _network_row("frames lost on the way, 5 ms each way, an upright loop with 27 ms of margin", _try_losses)
        yield from _parser_rows(minutes, seed)


def _table(rows: Sequence[Row]) -> WholeTable:
    table = WholeTable(*_HEADINGS, title="Faults")
    for row in rows:
        table.add_row(*row.cells())
    return table


def _markdown(rows: Sequence[Row], cells: Sequence[Cell]) -> str:
    others = (row.cells() for row in rows if not row.fault.startswith("actuator, "))
    lines = [_HEADINGS, ("---",) * len(_HEADINGS), *others]
    return bridge_markdown(cells) + "".join(
        f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines
    )


def _live_rows(plant: Plant, faults: Sequence[Fault], repetitions: int, seed: int, keep: Path | None) -> Iterator[Row]:
    """Try faults of a running plant, one system for all of them."""
    generator = random.Random(seed)
    with reserve_domain() as domain, tempfile.TemporaryDirectory(prefix="pendulum_faults_") as temporary:
        folder = (keep or Path(temporary)) / plant.name
        with (
            LiveSystem(folder, domain, plant) as system,
            Progress(transient=True, disable=not sys.stdout.isatty()) as progress,
        ):
            task = progress.add_task("", total=sum(fault.tries or repetitions for fault in faults))
            for fault in faults:
                outcomes = []
                for _ in range(fault.tries or repetitions):
                    progress.update(task, description=fault.name)
                    outcomes.append(_try(system, fault, generator))
                    progress.advance(task)
                yield _row(f"{plant.name}: {fault.name}", outcomes)
        # Now that the last bag is closed, too: what came late to its recorder is in it, or counted.
        yield _property_row(plant, folder)


def _trial_row(trial: Trial, seed: int, keep: Path | None) -> Row:
    """Try a fault once on a system of its own."""
    if reason := trial.why_not():
        return Row(trial.name, 0, 0, remarks=f"not tried: {reason}")
    with tempfile.TemporaryDirectory(prefix="pendulum_fault_") as temporary:
        folder = Path(temporary)
        if keep is not None:
            folder = keep / re.sub(r"\W+", "_", trial.name)
            folder.mkdir(parents=True)
        try:
            outcome = trial.act(folder, random.Random(seed))
        except PendulumError as error:
            outcome = Outcome(survived=False, detail=str(error))
    return _row(trial.name, [outcome])


def _property_row(plant: Plant, folder: Path) -> Row:
    """Judge every bag that was recorded on the way by the rule of the last command."""
    outcomes = []
    longest = 0.0
    for bag in sorted(folder.glob("bag_*")):
        outcome = Outcome()
        try:
            records = check_bag(bag, limit=EFFORT_LIMIT, allowance=MACHINE_PATIENCE)
        except PendulumError as error:
            outcome.demand(False, f"{bag.name}: {error}")
        else:
            for record in records:
                longest = max(longest, record.longest)
                outcome.demand(not record.violations, f"{bag.name}: {'; '.join(record.violations)}")
        outcomes.append(outcome)
    row = _row(f"{plant.name}: every bag of these: bounded torque, none without a command", outcomes)
    return replace(row, time_to_zero_s=longest)


def _network_row(what: str, attempt: Callable[[str, Path], Row]) -> Row:
    name = f"network: {what}"
    if reason := why_not():
        return Row(name, 0, 0, remarks=f"not tried: {reason}")
    with tempfile.TemporaryDirectory(prefix="pendulum_network_") as folder:
        try:
            return attempt(name, Path(folder))
        except FaultError as error:
            return Row(name, 1, 0, remarks=str(error))


def _try_cuts(name: str, folder: Path) -> Row:
    cuts = cut_cable(folder, [1.0, 30.0])
    return Row(
        name,
        len(cuts),
        sum(cut.time_to_zero <= MAX_TIME_TO_ZERO + MACHINE_PATIENCE for cut in cuts),
        time_to_zero_s=max(cut.time_to_zero for cut in cuts),
        remarks=f"torque again after {', '.join(f'{cut.time_to_return:.2f}' for cut in cuts)} s",
    )


def _try_losses(name: str, folder: Path) -> Row:
    reports = survive_loss(folder, LOSSES)
    told = "; ".join(f"{100.0 * one.loss:g} %: no torque in {100.0 * one.idle:.1f} % of periods" for one in reports)
    # What follows a fall is not tried any more.
    return Row(name, len(reports), sum(one.held for one in reports), remarks=told)


def _parser_rows(minutes: float, seed: int) -> Iterator[Row]:
    for row in fuzz_all(minutes * 60.0, seed):
        yield Row(
            f"spoilt files: {row['parser']}",
            max(row["tried"], 1),
            max(row["tried"] - sum(row["findings"].values()), 0),
            remarks="; ".join(row["findings"]) or f"slowest read {row['slowest_s'] * 1e3:.0f} ms",
        )


def _try(system: LiveSystem, fault: Fault, generator: random.Random) -> Outcome:
    try:
        return try_fault(system, fault, generator)
    except PendulumError as error:
        return Outcome(survived=False, detail=str(error))


def _row(name: str, outcomes: Sequence[Outcome]) -> Row:
    times = [outcome.time_to_zero for outcome in outcomes if outcome.time_to_zero is not None]
    losses = [outcome.lost for outcome in outcomes if outcome.lost is not None]
    told = [outcome for outcome in outcomes if not outcome.survived] or list(outcomes) or [Outcome()]
    return Row(
        name,
        len(outcomes),
        sum(outcome.survived for outcome in outcomes),
        lost_s=max(losses, default=None),
        time_to_zero_s=max(times, default=None),
        remarks=told[0].detail,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.run")


if __name__ == "__main__":
    raise SystemExit(main())
