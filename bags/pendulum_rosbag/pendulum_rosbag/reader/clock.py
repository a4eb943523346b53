"""Clocks that step back inside a recording: where, and times that go on across the step.

A recorder writes the messages of a topic in the order in which they arrive, so that log times which go back in the
order of the file tell of its clock. Sorted by them, what came before the step and what came after would be mixed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from pendulum_rosbag.reader.batches import Int64, Source

__all__ = ["CLOCK_JUMP", "ClockStep", "find_steps", "go_on", "pass_order", "set_stamps", "steps_back"]

CLOCK_JUMP = 0.05
"""A lasting step of a clock counts as a jump from this size [s]."""
_MOST = 20
"""Steps of a topic, and one of 50 messages, from which they count as stored in no order."""
_AROUND = 20
"""Messages on either side of a small step that have to confirm it."""
_NEXT_BUFFER = 1 << 40


@dataclass(slots=True)
class ClockStep:
    """A step back of the recorder's clock.

    Args:
        size_ns: By how much the next messages are to be moved so that they go on [ns].
        after_ns: How long after the first message it was, by the clock before it [ns].
        rows: Topic -> number of its messages before the step, in the order of the files.
    """

    size_ns: int
    after_ns: int
    rows: dict[str, int] = field(default_factory=dict)


def steps_back(times: Int64) -> list[int]:
    """Return at which messages times step back for good, as indices; a single late message is no step.

    Args:
        times: In the order of arrival [ns], shape (n,).
    """
    intervals = np.diff(times)
    if not len(intervals) or int(intervals.min()) >= 0:
        return []
    period = _period(times)
    sizes = period - intervals
    large = sizes > CLOCK_JUMP * 1e9
    # Of steady messages a smaller step shows, too, as long as it is none of the usual irregularities.
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
        # What follows a late message makes up for the step.
        following = int(intervals[place + 1]) if place + 1 < len(intervals) else -1
        if 0 <= following < max(-int(intervals[place]) / 2, 1.5 * period):
            found.append(place + 1)
    return found


def _lasts(times: Int64, step: int, period: int, size: int) -> bool:
    """Return whether most messages around a step, and not one or a few alone, stand apart by its size."""
    regular = times - period * np.arange(len(times))
    before, after = regular[max(step - _AROUND, 0) : step], regular[step : step + _AROUND]
    return bool(np.median(before) - np.median(after) > size / 2)


def _period(times: Int64) -> int:
    intervals = np.diff(times)
    ascending = intervals[intervals > 0]
    return int(np.median(ascending)) if len(ascending) else 0


def go_on(times: Int64, step: int) -> int:
    """Return by how much times from a step on are to be moved so that they follow one period later [ns]."""
    return int(times[step - 1]) - int(times[step]) + _period(times)


def pass_order(times: Int64, steps: Iterable[int]) -> Int64:
    """Return the order of messages by time within each pass between two steps, shape (n,)."""
    passes = np.zeros(len(times), np.int64)
    for step in steps:
        passes[step:] += 1
    return np.lexsort((times, passes))


def find_steps(
    wanted: Iterable[tuple[Source, Mapping[int, str]]], span: tuple[int | None, int | None]
) -> list[ClockStep]:
    """Return where the clock of a recorder stepped back, in the order of the files.

    Topics whose messages are too rare to show a step are cut where the others are.

    Args:
        wanted: Storage files in order, each with its channels and their topics.
        span: Log times to read [ns], as ``Source.batches`` takes them.
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
    """Return where the messages of each topic stand among all others, and their log times, in order of the files."""
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
    """Return which messages have a stamp that was set, shape (n,): none where all are equal, else all but zeros."""
    if len(stamps) > 2 and bool((stamps == stamps[0]).all()) and bool((log_times != log_times[0]).any()):
        return np.zeros(len(stamps), bool)
    # Stamps of a simulated time begin at 0 and go on from there.
    unset = (stamps == 0) & (np.max(stamps, initial=0) > 3600 * 10**9)
    return ~unset
