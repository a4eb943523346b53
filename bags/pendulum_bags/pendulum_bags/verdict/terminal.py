"""The answer on the terminal: one sentence, a table of the layers, the tests, and what to do next."""

from __future__ import annotations

import math
import textwrap

from rich.console import Console
from rich.markup import escape
from rich.table import Column
from rich.text import Text

from pendulum_bags.comparison import Comparison, Verdict
from pendulum_bags.figures.terminal_table import number_table
from pendulum_bags.verdict.layers import Answer, Mark
from pendulum_bags.verdict.naming import name_hardware
from pendulum_bags.verdict.same_run import seen_note
from pendulum_msgs_py.programs.terminal import WholeTable
from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["layers_table", "print_answer", "print_sentence", "print_tests", "tests_table"]

SIGNS = {Mark.YES: "✓ yes", Mark.NO: "✗ no", Mark.UNDECIDED: "? undecided", Mark.NOT_MEASURED: "– not measured"}
"""Marks that differ in shape and in words, so that colour is not needed."""
_WIDTH = 78
"""Width of the longest column of the layers' table; the others need 40 more."""
_STYLES = {Mark.YES: "bold green", Mark.NO: "bold red", Mark.UNDECIDED: "bold yellow", Mark.NOT_MEASURED: "dim"}


def layers_table(answer: Answer, title: str = "The layers of the answer") -> WholeTable:
    """Return the table of the layers: question, mark, sentence."""
    table = WholeTable("layer", "answer", "because", title=title, title_justify="left")
    for number, result in enumerate(answer.layers, start=1):
        mark = Text(SIGNS[result.mark], _STYLES[result.mark])
        because = Text(textwrap.fill(result.layer.question, _WIDTH), "italic")
        because.append("\n" + textwrap.fill(as_typed(result.sentence), _WIDTH), "not italic")
        table.add_row(f"{number} {result.layer.title}", mark, because)
    return table


def tests_table(verdict: Verdict, *, emulated: bool) -> WholeTable:
    """Return the table of the tests of the first layer."""
    title = verdict.tests[0].interval.title if verdict.tests else "interval"
    what = name_hardware("Tests of the same run: hardware against simulation", emulated=emulated)
    table = number_table(what, "quantity", "estimate", title, "margin", Column("result"))
    for test in verdict.tests:
        interval = test.interval
        unit = "" if test.unit == "-" else f" \\[{test.unit}]"
        table.add_row(
            test.quantity + unit,
            f"{interval.estimate:.3g}" if math.isfinite(interval.estimate) else "–",
            f"{interval.low:.3g} to {interval.high:.3g}",
            test.margin_text().removeprefix("margin "),
            test.outcome.value,
        )
    return table


def print_tests(console: Console, comparison: Comparison) -> None:
    """Print the tests of the first layer, and which samples they use."""
    console.print(tests_table(comparison.verdict, emulated=comparison.is_emulated))
    console.print(name_hardware(seen_note(comparison), emulated=comparison.is_emulated), highlight=False, markup=False)


def print_answer(console: Console, answer: Answer) -> None:
    """Print layers, the answer in one sentence, and the next steps, near the prompt."""
    console.print(layers_table(answer))
    print_sentence(console, answer)


def print_sentence(console: Console, answer: Answer) -> None:
    """Print the answer in one sentence, and the next steps."""
    console.print("\nIs the simulation good enough to design a controller on?")
    console.print(Text(answer.sentence, _STYLES[answer.mark]), highlight=False)
    if answer.next_steps:
        console.print("What to do next:")
        for step in answer.next_steps:
            console.print(f"  - {escape(as_typed(step))}", highlight=False, soft_wrap=True)
