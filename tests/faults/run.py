"""``make faults``: try every fault several times, print a table, write ``build/faults.json``."""

from __future__ import annotations

import json
import random
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import Progress, track

from pendulum_bags.experiment.domain import reserve_domain
from pendulum_msgs_py.errors import FaultError, PendulumError
from pendulum_msgs_py.executables import cli_main
from pendulum_msgs_py.terminal import WholeTable, make_console
from tests.faults.bag_property import check_bag
from tests.faults.bridge_rig import SCENARIOS, run_scenario
from tests.faults.campaign import CAMPAIGN
from tests.faults.clocks import CLOCK_TRIALS
from tests.faults.delay_margin import LOSSES, survive_loss
from tests.faults.fuzz import fuzz_all
from tests.faults.live import EFFORT_LIMIT, LiveSystem
from tests.faults.network import cut_cable, why_not
from tests.faults.outcome import MACHINE_PATIENCE, MAX_TIME_TO_ZERO, Fault, Outcome, Trial, try_fault
from tests.faults.resources import RESOURCE_TRIALS
from tests.faults.side_by_side import DOMAIN_TRIALS

_TRIALS = (*CLOCK_TRIALS, *RESOURCE_TRIALS, *DOMAIN_TRIALS)

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command(epilog="Example: python -m tests.faults.run --repetitions 3 --seed 7")
def campaign(
    repetitions: Annotated[int, typer.Option(help="How often each fault is tried.", min=1)] = 5,
    seed: Annotated[int, typer.Option(help="Seed of the moments at which faults come.")] = 1,
    minutes: Annotated[float, typer.Option(help="How long each parser is attacked [min].", min=0.0)] = 1.0,
    only: Annotated[str, typer.Option(help="Try only the faults of running systems whose names match.")] = "",
    keep: Annotated[Path | None, typer.Option(help="New folder that keeps logs and bags.")] = None,
    out: Annotated[Path, typer.Option(help="Where the table is written.")] = Path("build", "faults.json"),
) -> int:
    """Attack the running system and count what it stood."""
    wanted = [fault for fault in CAMPAIGN if not only or re.search(only, fault.name)]
    rows = _live_rows(wanted, repetitions, seed, keep) if wanted else []
    trials = [trial for trial in _TRIALS if not only or re.search(only, trial.name)]
    rows += [_trial_row(trial, seed, keep) for trial in trials]
    if not only:
        rows = [
            *_bridge_rows(max(repetitions, 20)),
            *rows,
            *_network_rows(),
            *_loss_rows(),
            *_parser_rows(minutes, seed),
        ]
    table = WholeTable("fault", "tried", "survived", "data lost", "longest time to zero", "remarks", title="Faults")
    for row in rows:
        table.add_row(
            row["fault"],
            str(row["tried"]),
            str(row["survived"]),
            "–" if row["lost_s"] is None else f"{row['lost_s']:.3f} s",
            "–" if row["time_to_zero_s"] is None else f"{row['time_to_zero_s'] * 1e3:.0f} ms",
            row["remarks"],
        )
    # A file or a pipe has no width: there, rows stay whole.
    make_console().print(table)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    return 0 if all(row["tried"] == row["survived"] for row in rows) else 1


def _bridge_rows(repetitions: int) -> list[dict[str, Any]]:
    rows = []
    for scenario in track(SCENARIOS, "faults of the actuator", transient=True):
        reactions = [run_scenario(scenario, repetition) for repetition in range(repetitions)]
        times = [reaction.time_to_zero_ms * 1e-3 for reaction in reactions]
        survived = [
            reaction.reaction == scenario.expected
            and (not scenario.zero or (reaction.stays_zero and reaction.time_to_zero_ms <= MAX_TIME_TO_ZERO * 1e3))
            and (scenario.own_torque or reaction.uncommanded == 0.0)
            for reaction in reactions
        ]
        rows.append(
            {
                "fault": f"actuator: {scenario.name}",
                "tried": len(reactions),
                "survived": sum(survived),
                "lost_s": None,
                "time_to_zero_s": max(times) if scenario.zero else None,
                "remarks": reactions[0].reaction,
            }
        )
    return rows


def _live_rows(faults: Sequence[Fault], repetitions: int, seed: int, keep: Path | None) -> list[dict[str, Any]]:
    rows = []
    generator = random.Random(seed)
    with (
        reserve_domain() as domain,
        tempfile.TemporaryDirectory(prefix="pendulum_faults_") as temporary,
        LiveSystem(folder := keep or Path(temporary), domain) as system,
        Progress(transient=True) as progress,
    ):
        task = progress.add_task("", total=sum(fault.tries or repetitions for fault in faults))
        for fault in faults:
            outcomes = []
            began = time.monotonic()
            for _ in range(fault.tries or repetitions):
                progress.update(task, description=fault.name)
                outcomes.append(_try(system, fault, generator))
                progress.advance(task)
            rows.append(_row(fault, outcomes))
            if not progress.console.is_terminal:
                took = (time.monotonic() - began) / len(outcomes)
                sys.stderr.write(f"{fault.name}: {rows[-1]['survived']} of {len(outcomes)}, {took:.1f} s each\n")
        rows.append(_property_row(folder))
    return rows


def _trial_row(trial: Trial, seed: int, keep: Path | None) -> dict[str, Any]:
    """Try a fault once on a system of its own."""
    if reason := trial.why_not():
        row = _row(Fault(trial.name, _nothing), [])
        return {**row, "remarks": f"not tried: {reason}"}
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="pendulum_fault_") as temporary:
        folder = Path(temporary)
        if keep is not None:
            folder = keep / re.sub(r"\W+", "_", trial.name)
            folder.mkdir(parents=True)
        try:
            outcome = trial.act(folder, random.Random(seed))
        except PendulumError as error:
            outcome = Outcome(survived=False, detail=str(error))
    sys.stderr.write(f"{trial.name}: {'survived' if outcome.survived else 'NOT survived'}, ")
    sys.stderr.write(f"{time.monotonic() - began:.1f} s\n")
    return _row(Fault(trial.name, _nothing), [outcome])


def _property_row(folder: Path) -> dict[str, Any]:
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
    row = _row(Fault("every bag of these: bounded torque, none without a command", _nothing), outcomes)
    return {**row, "time_to_zero_s": longest}


def _nothing(_system: LiveSystem, _generator: random.Random) -> Outcome:
    return Outcome()


def _network_rows() -> list[dict[str, Any]]:
    name = "network: cable between plant and controller out for 1 s and 30 s"
    row = {"fault": name, "tried": 0, "survived": 0, "lost_s": None, "time_to_zero_s": None, "remarks": why_not()}
    if row["remarks"]:
        return [row]
    with tempfile.TemporaryDirectory(prefix="pendulum_network_") as folder:
        try:
            cuts = cut_cable(Path(folder), [1.0, 30.0])
        except FaultError as error:
            return [{**row, "tried": 1, "remarks": str(error)}]
    longest = max(cut.time_to_zero for cut in cuts)
    row["survived"] = sum(cut.time_to_zero <= MAX_TIME_TO_ZERO + MACHINE_PATIENCE for cut in cuts)
    back = ", ".join(f"{cut.time_to_return:.2f}" for cut in cuts)
    return [{**row, "tried": len(cuts), "time_to_zero_s": longest, "remarks": f"torque again after {back} s"}]


def _loss_rows() -> list[dict[str, Any]]:
    name = "network: frames lost on the way, 5 ms each way, an upright loop with 27 ms of margin"
    row = {"fault": name, "tried": 0, "survived": 0, "lost_s": None, "time_to_zero_s": None, "remarks": why_not()}
    if row["remarks"]:
        return [row]
    with tempfile.TemporaryDirectory(prefix="pendulum_network_") as folder:
        try:
            reports = survive_loss(Path(folder), LOSSES)
        except FaultError as error:
            return [{**row, "tried": 1, "remarks": str(error)}]
    told = "; ".join(f"{100.0 * one.loss:g} %: {100.0 * one.answered:.0f} % of states answered" for one in reports)
    # What follows a fall is not tried any more.
    return [{**row, "tried": len(reports), "survived": sum(one.held for one in reports), "remarks": told}]


def _parser_rows(minutes: float, seed: int) -> list[dict[str, Any]]:
    return [
        {
            "fault": f"spoilt files: {row['parser']}",
            "tried": max(row["tried"], 1),
            "survived": max(row["tried"] - sum(row["findings"].values()), 0),
            "lost_s": None,
            "time_to_zero_s": None,
            "remarks": "; ".join(row["findings"]) or f"slowest read {row['slowest_s'] * 1e3:.0f} ms",
        }
        for row in fuzz_all(minutes * 60.0, seed)
    ]


def _try(system: LiveSystem, fault: Fault, generator: random.Random) -> Outcome:
    try:
        return try_fault(system, fault, generator)
    except FaultError as error:
        return Outcome(survived=False, detail=str(error))


def _row(fault: Fault, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    times = [outcome.time_to_zero for outcome in outcomes if outcome.time_to_zero is not None]
    losses = [outcome.lost for outcome in outcomes if outcome.lost is not None]
    told = [outcome for outcome in outcomes if not outcome.survived] or list(outcomes) or [Outcome()]
    return {
        "fault": fault.name,
        "tried": len(outcomes),
        "survived": sum(outcome.survived for outcome in outcomes),
        "lost_s": max(losses, default=None),
        "time_to_zero_s": max(times, default=None),
        "remarks": told[0].detail,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.faults.run")


if __name__ == "__main__":
    raise SystemExit(main())
