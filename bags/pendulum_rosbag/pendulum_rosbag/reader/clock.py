"""Steps back of the clock inside a recording, and times that continue across them.

A recorder writes a topic's messages in order of arrival, so log times that go back in file order reveal its clock.
Sorting by them would mix the messages before and after the step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pendulum_rosbag.reader.batches import Int64, Source

__all__ = ["CLOCK_JUMP", "ClockStep", "find_steps", "go_on", "pass_order", "set_stamps", "steps_back"]

CLOCK_JUMP = 0.05
"""Smallest lasting step that counts as a jump of the clock [s]."""
_MOST = 20
"""Number of steps on a topic, and one in 50 messages, from which the messages count as unordered."""
_AROUND = 20
"""Messages on either side of a small step that must confirm it."""
_NEXT_BUFFER = 1 << 40


@dataclass(slots=True)
class ClockStep:
    """A step back of the recorder's clock.

    Args:
        size_ns: Shift of later messages so that their times continue [ns].
        after_ns: Time from the first message to the step, by the clock before it [ns].
        rows: Topic -> number of its messages before the step, in file order.
    """

    size_ns: int
    after_ns: int
    rows: dict[str, int] = field(default_factory=dict)


def steps_back(times: Int64) -> list[int]:
    """Return where times [ns] in arrival order, shape (n,), step back for good; a late message is no step."""
    intervals = np.diff(times)
    if not len(intervals) or int(intervals.min()) >= 0:
        return []
    period = _period(times)
    sizes = period - intervals
    large = sizes > CLOCK_JUMP * 1e9
    # Steady messages also show smaller steps, unless these are among the usual irregularities.
    small = ~large & (sizes > max(1.5 * period, 10 * float(np.quantile(np.abs(sizes), 0.9))))
    limit = min(_MOST, 1 + len(times) // 50)
    back = np.zeros(len(sizes), bool)
    for kind in (large, small):
        backward = kind & (intervals < 0)
        back |= backward if np.sum(backward) <= limit else False
    found = []
    for place in np.flatnonzero(back).tolist():
        if small[place] and not _lasts(times, place + 1, period, int(sizes[place])):
            continue
        # The message after a late one makes up for the step.
        following = int(intervals[place + 1]) if place + 1 < len(intervals) else -1
        if 0 <= following < max(-int(intervals[place]) / 2, 1.5 * period):
            found.append(place + 1)
    return found


def _lasts(times: Int64, step: int, period: int, size: int) -> bool:
    """Return whether most messages on both sides of a step, not just a few, differ by its size."""
    regular = times - period * np.arange(len(times))
    before, after = regular[max(step - _AROUND, 0) : step], regular[step : step + _AROUND]
    return bool(np.median(before) - np.median(after) > size / 2)


def _period(times: Int64) -> int:
    intervals = np.diff(times)
    ascending = intervals[intervals > 0]
    return int(np.median(ascending)) if len(ascending) else 0


def go_on(times: Int64, step: int) -> int:
    """Return the shift after which times from a step on follow one period later [ns]."""
    return int(times[step - 1]) - int(times[step]) + _period(times)


def pass_order(times: Int64, steps: Iterable[int]) -> Int64:
    """Return the order of messages by time within each pass between steps, shape (n,)."""
    passes = np.zeros(len(times), np.int64)
    for step in steps:
        passes[step:] += 1
    return np.lexsort((times, passes))


def find_steps(
    wanted: Iterable[tuple[Source, Mapping[int, str]]], span: tuple[int | None, int | None]
) -> list[ClockStep]:
    """Return where the recorder's clock stepped back, in file order.

    Topics whose messages are too rare to show a step are cut where the others are. ``wanted`` are storage files in
    order with their channels and topics; ``span`` is as for ``Source.batches`` [ns].
    """
    places, times = _sequences(wanted, span)
    found: list[tuple[int, int, str, int]] = []
    for topic, values in times.items():
        found += [(int(places[topic][row]), int(places[topic][row - 1]), topic, row) for row in steps_back(values)]
    steps: list[ClockStep] = []
    cuts: list[int] = []
    for place, before, topic, row in sorted(found):
        if not cuts or before >= cuts[-1]:
            cuts.append(place)
            steps.append(ClockStep(0, 0))
        steps[-1].rows[topic] = row
    for cut, step in zip(cuts, steps, strict=True):
        clearest = max(step.rows, key=lambda topic: len(times[topic]))
        row = step.rows[clearest]
        step.size_ns = go_on(times[clearest], row)
        step.after_ns = int(times[clearest][row - 1] - times[clearest][0])
        for topic, at in places.items():
            step.rows.setdefault(topic, int(np.searchsorted(at, cut)))
    return steps


def _sequences(
    wanted: Iterable[tuple[Source, Mapping[int, str]]], span: tuple[int | None, int | None]
) -> tuple[dict[str, Int64], dict[str, Int64]]:
    places: dict[str, list[Int64]] = {}
    times: dict[str, list[Int64]] = {}
    number, buffer = 0, None
    for source, topics in wanted:
        for batch in source.batches(set(topics), *span):
            if batch.buffer is not buffer:
                number, buffer = number + 1, batch.buffer
            places.setdefault(topics[batch.channel], []).append(number * _NEXT_BUFFER + batch.offsets)
            times.setdefault(topics[batch.channel], []).append(batch.times)
    joined = {topic: (np.concatenate(places[topic]), np.concatenate(times[topic])) for topic in places}
    return {topic: pair[0] for topic, pair in joined.items()}, {topic: pair[1] for topic, pair in joined.items()}


def set_stamps(log_times: Int64, stamps: Int64) -> npt.NDArray[np.bool_]:
    """Return which stamps were set, shape (n,): none if all are equal, else all but zeros."""
    if len(stamps) > 2 and bool((stamps == stamps[0]).all()) and bool((log_times != log_times[0]).any()):
        return np.zeros(len(stamps), bool)
    # Simulated time begins at 0.
    unset = (stamps == 0) & (np.max(stamps, initial=0) > 3600 * 10**9)
    return ~unset
