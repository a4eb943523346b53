"""The table of actuator faults: strategy by phase by fault, each tried many times through the bridge's node."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.progress import track

from pendulum_bags.experiments.domain import reserve_domain
from tests.tools.faults.bridge_scenarios import CASES, SCENARIOS, Case, Scenario, run_scenario
from tests.tools.faults.node_rig import ros_of_its_own

__all__ = ["Cell", "bridge_cells", "bridge_markdown"]


@dataclass(frozen=True)
class Cell:
    """One fault in one strategy and phase.

    Attributes:
        fault: What was done.
        case: Strategy and phase.
        tried: How often.
        survived: How often everything held that must hold.
        reactions: What the bridge did, each once.
        time_to_zero_ms: Longest time from the fault to zero torque [ms]; None where torque goes on.
        beyond_limit: Largest torque of the motor beyond the limit [N m].
        complaints: What did not hold.
    """

    fault: str
    case: str
    tried: int
    survived: int
    reactions: tuple[str, ...]
    time_to_zero_ms: float | None
    beyond_limit: float
    complaints: tuple[str, ...]


def bridge_cells(repetitions: int, only: str = "") -> Iterator[Cell]:
    """Try every fault in every strategy and phase in which it can come.

    Args:
        repetitions: How often.
        only: Expression that the name of a fault must match.
    """
    wanted = [
        (scenario, case)
        for scenario in SCENARIOS
        for case in CASES
        if case.phase in scenario.phases and (not only or re.search(only, f"actuator, {case.name}: {scenario.name}"))
    ]
    if not wanted:
        return
    with reserve_domain() as domain, ros_of_its_own(domain):
        for scenario, case in track(wanted, "faults of the actuator", transient=True, disable=not sys.stdout.isatty()):
            yield _cell(scenario, case, repetitions)


def _cell(scenario: Scenario, case: Case, repetitions: int) -> Cell:
    reactions = [run_scenario(scenario, case, repetition) for repetition in range(repetitions)]
    complaints = [reaction.complaints(scenario) for reaction in reactions]
    ended = [reaction.time_to_zero_ms for reaction in reactions if reaction.stays_zero]
    return Cell(
        scenario.name,
        case.name,
        len(reactions),
        sum(not found for found in complaints),
        tuple(sorted({reaction.reaction for reaction in reactions})),
        max(ended) if len(ended) == len(reactions) else None,
        max(reaction.beyond_limit for reaction in reactions),
        tuple(sentence for found in complaints for sentence in found),
    )


def bridge_markdown(cells: Sequence[Cell]) -> str:
    """Return a table for each strategy and phase, in Markdown."""
    text = ""
    for case in dict.fromkeys(cell.case for cell in cells):
        rows = [cell for cell in cells if cell.case == case]
        text += f"### {case[0].upper()}{case[1:]} (simulated time)\n\n"
        text += "| fault | reaction | tried | survived | longest time to zero torque | torque beyond the limit |\n"
        text += "|---|---|---|---|---|---|\n"
        for row in rows:
            to_zero = "goes on" if row.time_to_zero_ms is None else f"{row.time_to_zero_ms:.0f} ms"
            beyond = "none" if row.beyond_limit == 0.0 else f"{row.beyond_limit:.1f} N m"
            reactions = ", ".join(f"`{reaction}`" if "_" in reaction else reaction for reaction in row.reactions)
            text += f"| {row.fault} | {reactions} | {row.tried} | {row.survived} | {to_zero} | {beyond} |\n"
        text += "\n"
    return text
