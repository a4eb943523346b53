"""A stop that stays in force: repeated to every plant until each has confirmed and the operator acknowledges.

A plant may be frozen, restarting or unreachable at the time of the stop: every plant that is known or appears gets
requests until it confirms, and further ones in case it restarts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

__all__ = ["ASK_AGAIN", "SILENT_AFTER", "StopOrder"]

ASK_AGAIN = 0.2
"""Period of requests to a plant that has not confirmed [s]."""
CONFIRM_AGAIN = 0.5
"""Period of requests to a plant that has confirmed: it may have restarted [s]."""
SILENT_AFTER = 1.5
"""Age of the newest response at which a plant counts as silent [s]."""


@dataclass
class _Row:
    """Requests to and responses of one plant [s of the caller's clock]."""

    pressed: float
    asked: float = float("-inf")
    answered: float = float("-inf")
    first_answer: float | None = None
    text: str = ""


class StopOrder:
    """The plants to stop, and their responses, independent of ROS. Plants are node names, ``now`` is in [s]."""

    def __init__(self) -> None:
        self._rows: dict[str, _Row] = {}
        self._left_alone: set[str] = set()
        self._pressed: float | None = None
        self._everybody = False

    @property
    def in_force(self) -> bool:
        """Whether plants are to be stopped."""
        return self._pressed is not None

    def press(self, plants: Iterable[str], now: float) -> None:
        """Order the plants on the graph, and those of an order in force, to stop."""
        self._pressed = now
        self._everybody = True
        self._left_alone.clear()
        for plant in {*plants, *self._rows}:
            self._rows[plant] = _Row(now)

    def press_one(self, plant: str, now: float) -> None:
        """Order one plant to stop, whether it is on the graph or not; orders to others remain."""
        self._pressed = now
        self._left_alone.discard(plant)
        self._rows[plant] = _Row(now)

    def due(self, plants: Iterable[str], now: float) -> list[str]:
        """Record and return the plants to request a stop of now; an order to all includes new plants."""
        if self._pressed is None:
            return []
        for plant in plants if self._everybody else ():
            if plant not in self._rows and plant not in self._left_alone:
                self._rows[plant] = _Row(now)
        found = []
        for plant, row in self._rows.items():
            fresh = now - row.answered < SILENT_AFTER
            if now - row.asked >= (CONFIRM_AGAIN if fresh else ASK_AGAIN):
                row.asked = now
                found.append(plant)
        return found

    def holds(self, plant: str) -> bool:
        """Return whether a plant is to be stopped."""
        return plant in self._rows

    def answer(self, plant: str, text: str, now: float) -> None:
        """Record that a plant confirmed its stop."""
        row = self._rows.get(plant)
        if row is not None:
            row.answered, row.text = now, text
            if row.first_answer is None:
                row.first_answer = now

    def problem(self, plant: str, text: str) -> None:
        """Record why a plant cannot be reached, or its other response."""
        row = self._rows.get(plant)
        if row is not None:
            row.text = text

    def release(self, plant: str) -> None:
        """End the requests to a plant, because the operator resets its e-stop, or gives it up."""
        self._rows.pop(plant, None)
        self._left_alone.add(plant)
        self._end_without_rows()

    def acknowledge(self, now: float) -> list[str]:
        """End the order for the plants that confirmed their stop; return those without response."""
        for plant in [plant for plant, row in self._rows.items() if now - row.answered < SILENT_AFTER]:
            self.release(plant)
        self._end_without_rows()
        return list(self._rows)

    def state(self, now: float) -> dict[str, Any] | None:
        """Return the state to show; None without a stop in force.

        ``since`` is the time since the order [s], ``all`` whether it was for all plants. A row's ``state`` is ``asked``
        (no response yet), ``stopped`` or ``silent`` (once confirmed), ``after`` the time to the first response and
        ``silent_for`` that since the last [s].
        """
        if self._pressed is None:
            return None
        rows = {}
        for plant, row in sorted(self._rows.items()):
            never = row.first_answer is None
            silent = now - (row.pressed if never else row.answered)
            rows[plant] = {
                "state": "asked" if never else "stopped" if silent < SILENT_AFTER else "silent",
                "after": None if row.first_answer is None else round(row.first_answer - row.pressed, 3),
                "silent_for": round(silent, 1),
                "text": row.text,
            }
        return {"since": round(now - self._pressed, 1), "all": self._everybody, "rows": rows}

    def _end_without_rows(self) -> None:
        if not self._rows:
            self._pressed = None
            self._everybody = False
            self._left_alone.clear()
