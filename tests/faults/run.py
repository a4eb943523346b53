"""``make faults``: try every fault several times, print a table, write ``build/faults.json``."""

from __future__ import annotations

import json
import random
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress, track
from rich.table import Table

from pendulum_bags.experiment.domain import reserve_domain
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.executables import cli_main
from tests.faults.bridge_rig import SCENARIOS, run_scenario
from tests.faults.campaign import CAMPAIGN, MACHINE_PATIENCE, MAX_TIME_TO_ZERO, Fault, Outcome, try_fault
from tests.faults.fuzz import fuzz_all
from tests.faults.live import LiveSystem
from tests.faults.network import cut_cable, why_not

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command(epilog="Example: python -m tests.faults.run --repetitions 3 --seed 7")
def campaign(
    repetitions: Annotated[int, typer.Option(help="How often each fault is tried.", min=1)] = 5,
    seed: Annotated[int, typer.Option(help="Seed of the moments at which faults come.")] = 1,
    minutes: Annotated[float, typer.Option(help="How long each parser is attacked [min].", min=0.0)] = 1.0,
    out: Annotated[Path, typer.Option(help="Where the table is written.")] = Path("build", "faults.json"),
) -> int:
    """Attack the running system and count what it stood."""
    rows = [
        *_bridge_rows(max(repetitions, 20)),
        *_live_rows(repetitions, seed),
        *_network_rows(),
        *_parser_rows(minutes, seed),
    ]
    table = Table("fault", "tried", "survived", "data lost", "longest time to zero", "remarks", title="Faults")
    for row in rows:
        table.add_row(
            row["fault"],
            str(row["tried"]),
            str(row["survived"]),
            "–" if row["lost_s"] is None else f"{row['lost_s']:.3f} s",
            "–" if row["time_to_zero_s"] is None else f"{row['time_to_zero_s'] * 1e3:.0f} ms",
            row["remarks"],
        )
    console = Console()
    # A file or a pipe has no width: there, rows stay whole.
    (console if console.is_terminal else Console(width=160)).print(table)
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


def _live_rows(repetitions: int, seed: int) -> list[dict[str, Any]]:
    rows = []
    generator = random.Random(seed)
    with (
        reserve_domain() as domain,
        tempfile.TemporaryDirectory(prefix="pendulum_faults_") as folder,
        LiveSystem(Path(folder), domain) as system,
        Progress(transient=True) as progress,
    ):
        task = progress.add_task("", total=len(CAMPAIGN) * repetitions)
        for fault in CAMPAIGN:
            outcomes = []
            for _ in range(repetitions):
                progress.update(task, description=fault.name)
                outcomes.append(_try(system, fault, generator))
                progress.advance(task)
            rows.append(_row(fault, outcomes))
    return rows


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
    told = [outcome for outcome in outcomes if not outcome.survived] or list(outcomes)
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
