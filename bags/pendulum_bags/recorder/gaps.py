"""Counting messages that never arrived, from the sequence numbers that publishers give them."""

from __future__ import annotations

__all__ = ["GapCounter"]

_LARGEST_GAP = 1_000_000  # beyond this a number is taken for that of another publisher


class GapCounter:
    """Follows the sequence numbers of one topic and counts what is missing between them.

    DDS numbers the samples of each publisher from 1 on, but rclpy does not tell which publisher a sample is from.
    So every publisher seen so far is remembered by its last number, and a sample belongs to the one that it
    continues. A sample that continues none is from a new publisher while there are fewer of them known than the
    graph says; otherwise it leaves a gap behind the nearest lower number.
    """

    def __init__(self) -> None:
        self.missing = 0
        self._last: list[int] = []

    def see(self, sequence: int, publishers: int = 1) -> int:
        """Take note of a sample and return how many are missing before it.

        Args:
            sequence: Its number at its publisher.
            publishers: Publishers of the topic now.
        """
        last = self._last
        before = sequence - 1
        if last and last[0] == before:  # by far the most frequent case
            last[0] = sequence
            return 0
        for index, number in enumerate(last):
            if number == before:
                last[index] = sequence
                return 0
        lower = [(number, index) for index, number in enumerate(last) if number < sequence]
        if sequence == 1 or not lower or len(last) < publishers:
            last.append(sequence)
            # Publishers that have left must not swallow gaps for ever.
            del last[: max(len(last) - max(publishers, 1) - 1, 0)]
            return 0
        number, index = max(lower)
        gap = sequence - number - 1
        last[index] = sequence
        if gap > _LARGEST_GAP:
            return 0
        self.missing += gap
        return gap
