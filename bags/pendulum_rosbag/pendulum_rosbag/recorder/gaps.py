"""Counting messages that never arrived, from the sequence numbers that publishers give them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["GapCounter"]

_LARGEST_GAP = 1_000_000  # beyond this a number is taken for that of another publisher
_MOST_STREAMS = 64
_PATIENCE = 200
"""Messages of a topic after which an open sample counts as the silent publisher's next one, after a gap."""


@dataclass
class _Doubt:
    """The two explanations of a sample that continues no publisher, by the last number of the nearest one.

    Attributes:
        gap: Samples that are missing, if it belongs to that publisher.
        unmet: Samples that came before it, if it is the first of another.
        patience: Samples of the topic until it is taken for the former.
    """

    gap: int
    unmet: int
    patience: int = _PATIENCE


class GapCounter:
    """Follows the sequence numbers of one topic and counts what is missing between them.

    DDS numbers the samples of each publisher from 1 on, but rclpy does not report which publisher a sample is from.
    So every publisher seen so far is remembered by its last number, and a sample belongs to the one that it
    continues. A sample that continues none is the first of a new publisher (which may have published before it was
    matched), or there is a gap before it. If more publishers were matched than received from, both are possible, and
    later samples decide: the publisher that it could have continued sends more, or has left, or the gap was real.

    Args:
        matched: Returns how many publishers were matched since the beginning, and how many are now.

    Attributes:
        missing: Samples that are missing between others of their publisher.
        unmet: Samples that publishers had sent before the first that was received from them.
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
        """Take over the publishers of another subscription to the topic, by their last numbers."""
        self._last = list(before._last)
        self._heard = len(before._last)

    def see(self, sequence: int) -> int:
        """Take note of a sample, by its number at its publisher, and return how many are found to be missing."""
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
        # A first sample may come before the middleware has reported the match; one that is no later than all others is
        # another publisher's in any case.
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
        """Settle the open case of a publisher that sends more; return the gaps of those that were silent for long."""
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
