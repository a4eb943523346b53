"""One answer of all plants that a run compared, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace

from pendulum_bags.verdict import Answer, Layer, Mark
from pendulum_bags.verdict.layers import NOT_MEASURED, WHAT_HOLDS
from pendulum_bags.whole.carry_out import Findings, Simulated

__all__ = ["whole_answer"]


def whole_answer(found: Findings) -> tuple[Answer, list[Answer]]:
    """Return the answer for the given plant, with a sentence and next steps that take all in, and that of each plant.

    Args:
        found: What the run found.
    """
    answers = [plant.answer() for plant in found.plants]
    given = answers[0]
    if len(answers) == 1:
        return given, answers
    identified, name, file = answers[1], found.plants[1].name, shlex.quote(found.plants[1].settings.plant)
    head, holds, rest = given.sentence.partition(WHAT_HOLDS)
    sentence = head.replace(": ", f" with {found.given.name}, the plant that you had: ", 1)
    sentence += f" {identified.mark.value.capitalize()} with {name}, which this run found"
    if identified.mark is Mark.YES:
        sentence += f".{''.join(identified.sentence.partition(NOT_MEASURED)[1:])}"
    else:
        sentence += f":{identified.sentence.partition(':')[2]}"
    sentence += _choice(found.plants, answers) + ("" if identified.mark is Mark.YES else holds + rest)
    steps: Sequence[str] = identified.next_steps
    if identified.mark is Mark.YES:
        design = f"python -m pendulum_lqr design --plant {file}"
        steps = (f"Simulate with that plant from now on, and design on it ({design}).", *steps)
    return replace(given, sentence=sentence, next_steps=tuple(steps)), answers


def _choice(plants: Sequence[Simulated], answers: Sequence[Answer]) -> str:
    """Return which simulation would have picked the right controller, as a sentence; empty where none was asked."""
    marks = [next(one.mark for one in answer.layers if one.layer is Layer.SAME_CHOICE) for answer in answers]
    ranking = plants[-1].ranking
    if ranking is None or Mark.NOT_MEASURED in marks:
        return ""
    of = f" Of these {len(ranking.names)} controllers"
    if marks == [Mark.YES, Mark.YES]:
        return f"{of} the simulation picks the right one with both."
    picks = {
        Mark.YES: "picks the right one",
        Mark.NO: "picks a wrong one",
        Mark.UNDECIDED: "picks one that may be wrong",
    }
    found = (f"{picks[mark]} with {plant.name}" for plant, mark in zip(plants, marks, strict=True))
    return f"{of} the simulation {' and '.join(found)}."
