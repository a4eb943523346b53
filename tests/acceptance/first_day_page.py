"""The section of a page that shows a first day in a lab: its commands and their output."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

__all__ = ["PAGE", "Step", "skeleton", "steps_of", "text_of", "write_page"]

PAGE = Path(__file__).resolve().parents[2] / "pendulum_hw_bridge" / "docs" / "run_on_hardware.md"
_BEGIN, _END = "<!-- the day -->\n", "<!-- end of the day -->\n"


@dataclass(frozen=True)
class Step:
    """One command of the day.

    Attributes:
        heading: Heading above it, or nothing.
        words: What a reader should know before.
        command: As it is typed.
        output: What the program said, and in square brackets what the person did.
        code: Exit code.
    """

    heading: str
    words: str
    command: str
    output: str
    code: int


def _compact(output: str) -> str:
    """Return output whose tables have no rules and no padding, which would take a third of the page."""
    lines = []
    for line in output.splitlines():
        if not set(line) & set("┃│┏┡└"):
            lines.append(line.strip() if line.startswith("     ") else line)
        elif set(line) & set("┃│"):
            lines.append(" ".join(re.sub("[┃│]", "|", line).split()))
    return "".join(f"{line}\n" for line in lines)


def text_of(steps: list[Step]) -> str:
    """Return the day in Markdown."""
    text = ""
    for step in steps:
        text += f"\n### {step.heading}\n" if step.heading else ""
        text += f"\n{step.words}\n" if step.words else ""
        text += f"\n```console\n$ {step.command}\n{_compact(step.output)}```\n"
    return text


def skeleton(text: str) -> tuple[str, ...]:
    """Return what must be the same on each day: commands and what they say, without numbers and rules of tables.

    What the bridge logs all the while is left out: a busy computer adds tries to it.
    """
    found = []
    for line in text.splitlines():
        if line.startswith("$ "):
            found.append(line)
        elif not line.startswith(("#", "[INFO]", "[WARN]", "[ERROR]")):
            bare = re.sub(r"[┏┓┗┛┡┩┳┻╇┴└┘━─│┃+-]", " ", line)
            found.append(" ".join(re.sub(r"[\d.:]+", " ", bare).split()))
    return tuple(line for line in found if line)


def steps_of(page: str) -> set[tuple[str, ...]]:
    """Return the skeleton of each command that a page shows."""
    return {skeleton(block) for block in re.findall(r"(?ms)^```console$.*?^```$", page)}


def write_page(steps: list[Step]) -> None:
    """Put the day into the page."""
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(_BEGIN)[0], page.split(_END)[1]
    PAGE.write_text(head + _BEGIN + text_of(steps) + "\n" + _END + tail, encoding="utf-8")
