"""Notices in reply to a click, in the page's header, where they cover and move no control."""

from __future__ import annotations

import re

from nicegui import ui

__all__ = ["Notices"]

_NEWEST = 3
"""Notices visible at once."""
_STAYS = {"bad": 15.0, "good": 4.0}
"""Time for which a notice stays [s]: a refusal long enough to be read, acted on and read again."""

_LONG_WORD = re.compile(r"(\S{60})\S{61,}(\S{60})")
"""Very long input is cut; the words of a refusal and its remedy are shown whole."""


class Notices:
    """The newest notices, newest first; equal texts once, with their count."""

    def __init__(self) -> None:
        self._said: dict[str, tuple[ui.element, int]] = {}

    def build(self) -> None:
        """Build the element."""
        # Long notices scroll, also by keyboard; a screen reader reads them after its present text.
        self._place = ui.element("div").classes("notices").props('role="status" tabindex="0" aria-label="Notices"')

    def say(self, text: str, *, bad: bool = False) -> None:
        """Show a notice of one sentence; ``bad`` marks the reason of a refusal."""
        text = _LONG_WORD.sub(r"\1…\2", text)
        count = self._said[text][1] + 1 if text in self._said else 1
        self._forget(text)
        while len(self._said) >= _NEWEST:
            self._forget(next(iter(self._said)))
        kind = "bad" if bad else "good"
        with self._place, ui.element("div").classes(kind) as line:
            ui.label(f"{text} ({count} times)" if count > 1 else text)
            ui.timer(_STAYS[kind], lambda: self._forget(text), once=True)
        line.move(target_index=0)
        self._said[text] = (line, count)

    def _forget(self, text: str) -> None:
        if text in self._said:
            self._said.pop(text)[0].delete()
