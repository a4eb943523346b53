"""The console's card of the last comparison: the verdict in one sentence, and each layer's result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from nicegui import ui

from pendulum_bags.verdict.layers import Mark
from pendulum_bags.verdict.terminal import SIGNS
from pendulum_console.console.jobs import Jobs, NewestPage

__all__ = ["LayersCard", "read_answer"]

SUMMARY = "summary.json"


def read_answer(folder: Path) -> dict[str, Any]:
    """Return the verdict in a run's summary with ``sentence`` and ``layers``; empty if there is none."""
    try:
        answer = json.loads((folder / SUMMARY).read_text(encoding="utf-8")).get("answer", {})
        layers = [(one["name"], SIGNS[Mark(one["mark"])], one["sentence"]) for one in answer["layers"]]
        return {"sentence": str(answer["sentence"]), "layers": layers}
    # A summary of another version, or another file, is not shown.
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


class LayersCard:
    """The verdict and the four layers with marks and reasons of the run compared last."""

    def __init__(self, jobs: Jobs) -> None:
        self._newest = NewestPage(jobs, SUMMARY)

    def build(self) -> None:
        """Build the card, hidden until a run was compared."""
        with ui.element("div").classes("certified") as self._place:
            ui.html("<h3>Is the simulation good enough to design a controller on?</h3>", sanitize=False)
            self._sentence = ui.label().props('role="status"')
            self._layers = ui.element("dl").classes("layers")
            self._run = ui.label().classes("small")
        self._place.set_visibility(False)

    def refresh(self) -> None:
        """Show the run that was compared last."""
        if not self._newest.changed():
            return
        folder = self._newest.folder
        answer = read_answer(folder) if folder is not None else {}
        self._place.set_visibility(bool(answer))
        if folder is None or not answer:
            return
        self._sentence.text = answer["sentence"]
        self._run.text = f"of the run {folder.name}"
        self._layers.clear()
        with self._layers:
            for number, (name, sign, sentence) in enumerate(answer["layers"], start=1):
                with ui.element("dt"):
                    ui.label(f"{number} {name}: {sign}")
                with ui.element("dd"):
                    ui.label(sentence).classes("small")
