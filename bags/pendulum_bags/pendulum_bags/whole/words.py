"""One answer of all plants that a run compared, and what to do next."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace

from pendulum_bags.verdict import Answer, Layer, Mark
from pendulum_bags.whole.carry_out import Findings, Simulated

__all__ = ["whole_answer"]


def whole_answer(found: Findings) -> tuple[Answer, list[Answer]]:
    """Return the answer for the given plant, with a text and next steps that take all in, and that of each plant."""
    plants = found.plants
    answers = [plant.answer() for plant in plants]
    given, choice = answers[0], _choice(plants, answers)
    if len(answers) == 1:
        return replace(given, text=f"{given.sentence}{choice}"), answers
    identified, (first, name) = answers[1], (plant.name for plant in plants)
    text = (
        f"{given.mark.value.capitalize()} with {first}, the plant that you had; {identified.mark.value} with {name}, "
        f"which this run found.{choice} With {first}: {given.reasons}."
    )
    if identified.mark is Mark.YES:
        text += replace(given, holds="", missing=identified.missing).remarks()
    else:
        text += f" With {name}: {identified.reasons}."
        text += replace(identified, decides=identified.decides or given.decides).remarks(name)
    steps: Sequence[str] = identified.next_steps
    if identified.mark is Mark.YES:
        design = f"python -m pendulum_lqr design --plant {shlex.quote(plants[1].settings.plant)}"
        steps = (f"Simulate with that plant from now on, and design on it ({design}).", *steps)
    return replace(given, text=text, next_steps=tuple(steps)), answers


def _choice(plants: Sequence[Simulated], answers: Sequence[Answer]) -> str:
    """Return which simulation picked the right controller, as a sentence, or ""."""
    marks = [next(one.mark for one in answer.layers if one.layer is Layer.SAME_CHOICE) for answer in answers]
    ranking = plants[-1].ranking
    if ranking is None or Mark.NOT_MEASURED in marks:
        return ""
    of = f" Of these {len(ranking.names)} controllers"
    if set(marks) == {Mark.YES}:
        return f"{of} the simulation picks the right one{' with both' if len(marks) > 1 else ''}."
    picks = {
        Mark.YES: "picks the right one",
        Mark.NO: "picks a wrong one",
        Mark.UNDECIDED: "picks one that may be wrong",
    }
    found = (f"{picks[mark]} with {plant.name}" for plant, mark in zip(plants, marks, strict=True))
    return f"{of} the simulation {' and '.join(found)}."
