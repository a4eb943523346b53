"""Counting lost messages from the sequence numbers of publishers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["GapCounter"]

_LARGEST_GAP = 1_000_000  # a larger jump is another publisher's number
_MOST_STREAMS = 64
_PATIENCE = 200
"""Messages of a topic until an ambiguous sample counts as the silent publisher's next one, after a gap."""


@dataclass
class _Doubt:
    """A sample that continues no publisher: ``gap`` samples of the nearest one are missing, or it is another's first.

    ``unmet`` samples came before it in the second case, which is assumed ``patience`` samples later.
    """

    gap: int
    unmet: int
    patience: int = _PATIENCE


class GapCounter:
    """Follows the sequence numbers of one topic and counts the missing ones.

    DDS numbers the samples of each publisher from 1, but rclpy does not report the publisher. So each publisher is
    represented by its last number, and a sample belongs to the publisher that it continues; otherwise it is the first
    of a new publisher or follows a gap. If more publishers were matched than received from, later samples decide.

    Args:
        matched: Returns how many publishers were ever matched, and how many are now.

    Attributes:
        missing: Missing samples between others of their publisher.
        unmet: Samples that publishers sent before the first one received.
    """

    def __init__(self, matched: Callable[[], tuple[int, int]]) -> None:
        self.missing = 0
        self.unmet = 0
        self._matched = matched
        self._last: list[int] = []
        self._heard = 0
        self._departed = 0
        self._doubts: dict[int, _Doubt] = {}

    def go_on_from(self, before: GapCounter) -> None:
        """Take over the publishers of another subscription to the topic."""
        self._last = list(before._last)
        self._heard = len(before._last)

    def see(self, sequence: int) -> int:
        """Count a sample by its number; return how many samples are found missing."""
        last = self._last
        before = sequence - 1
        missing = self._judge_doubts(before) if self._doubts else 0
        if last and last[0] == before:  # by far the most frequent case
            last[0] = sequence
            return missing
        if before in last:
            last.remove(before)
            last.insert(0, sequence)
            return missing
        return missing + self._see_jump(sequence)

    def _see_jump(self, sequence: int) -> int:
        total, _ = self._matched()
        before = sequence - 1
        lower = max((number for number in self._last if number < sequence), default=0)
        gap = before - lower
        # A first sample may precede the report of its match; one below all others is another publisher's in any case.
        another = self._heard < total or not lower
        if another or gap > _LARGEST_GAP:
            if another:
                self._heard += 1
                if lower and gap <= _LARGEST_GAP:
                    self._doubts[lower] = _Doubt(gap, unmet=before)
                else:
                    self.unmet += before
            self._last.insert(0, sequence)
            del self._last[_MOST_STREAMS:]
            return 0
        self._doubts.pop(lower, None)
        self._last.remove(lower)
        self._last.insert(0, sequence)
        self.missing += gap
        return gap

    def _judge_doubts(self, continued: int) -> int:
        if continued in self._doubts:
            self.unmet += self._doubts.pop(continued).unmet
        found = 0
        for number, doubt in list(self._doubts.items()):
            doubt.patience -= 1
            if doubt.patience > 0:
                continue
            del self._doubts[number]
            total, now = self._matched()
            if total - now > self._departed:
                self._departed += 1  # it has left: nothing of it can be missing
                self.unmet += doubt.unmet
                continue
            if number in self._last:
                self._last.remove(number)
            self._heard -= 1
            found += doubt.gap
        self.missing += found
        return found
