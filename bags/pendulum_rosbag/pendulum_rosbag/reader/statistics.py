"""Timing of a recording: rates, gaps, jitter, latencies, duplicates and clock jumps."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.reader.bag import Bag
from pendulum_rosbag.reader.batches import Int64
from pendulum_rosbag.reader.clock import CLOCK_JUMP, set_stamps
from pendulum_rosbag.reader.joint_state import two_motions
from pendulum_rosbag.reader.topic_info import TopicInfo
from pendulum_rosbag.storage.stamps import stamp_reader

__all__ = ["BagStatistics", "Latency", "TopicStatistics", "bag_statistics", "clock_jumps", "time_statistics"]

GAP_FACTOR = 1.5
"""Longest regular interval, in median intervals; a longer one is a gap."""
BURST_FACTOR = 2.0
"""Messages without stamps come in bursts if their mean interval exceeds this many median intervals."""
_LEAST_PERIODIC = 0.5
"""Least share of intervals near the median for messages that have a period; events have none."""
_FEWEST_PERIODIC = 10
TOLERATED = 0.02
"""Share of messages that may be missing or duplicate in a good recording."""
_LASTING = 2.0
"""Time that a step has to last [s]: longer than any pause of a machine, after which messages catch up."""
_LEAST_AFTER = 5
_LEAST_SHARE = 0.5
_TIME_IS_CONTENT = frozenset({"std_msgs/msg/String", "rosgraph_msgs/msg/Clock"})
"""Types whose stamps are content, not the time of the message: the log gives their timing."""
_MS = 1e-6  # nanoseconds to milliseconds


@dataclass(slots=True)
class TopicStatistics:
    """Timing of one topic; times in milliseconds, rates in Hz, NaN if there are too few messages.

    Args:
        rate: Messages per second between the first and the last.
        period: Median interval.
        jitter: Standard deviation of the intervals.
        period_p99: 99th percentile of the intervals.
        longest: Longest interval.
        gaps: Intervals longer than 1.5 median intervals; none without a period (see ``time_statistics``).
        missing: Messages that would fill the gaps at the median interval (a late message leaves none).
        duplicates: Messages with the stamp of an earlier one (of the same sender, if it is named).
        backward: Messages whose stamp lies before the previous one.
        clock_jumps: Steps of more than 50 ms between log time and stamp (see ``clock_jumps``).
        unset: Messages whose stamp was never set; log times are then used, and there is no age.
        stamped: Whether intervals are between stamps rather than log times.
        age: Median of log time minus stamp.
        age_p99: Its 99th percentile.
    """

    type: str
    count: int
    rate: float = np.nan
    period: float = np.nan
    jitter: float = np.nan
    period_p99: float = np.nan
    longest: float = np.nan
    gaps: int = 0
    missing: int = 0
    duplicates: int = 0
    backward: int = 0
    clock_jumps: int = 0
    unset: int = 0
    stamped: bool = False
    age: float = np.nan
    age_p99: float = np.nan


@dataclass(slots=True)
class Latency:
    """Time from a message on topic ``source`` to that on ``answer`` with the same stamp [ms]."""

    source: str
    answer: str
    matched: int
    median: float
    p99: float
    longest: float


@dataclass(slots=True)
class BagStatistics:
    """Timing of a whole bag."""

    path: str
    storage: str
    duration: float
    count: int
    topics: dict[str, TopicStatistics] = field(default_factory=dict)
    latencies: list[Latency] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    """Why the recording is not good, one sentence each; empty for a good one."""


def time_statistics(
    kind: str, log_times: Int64, stamps: Int64 | None = None, senders: npt.NDArray[Any] | None = None
) -> TopicStatistics:
    """Return the timing of one topic of type ``kind``.

    Intervals are between stamps if messages have them (reading in batches cannot blur them), else between log times.
    Messages have no period, and so no gaps, if fewer than half are near the median interval (events), or if they have
    no stamps and come in bursts. Log times ascend [ns]; stamps [ns] may be unset as in ``set_stamps``; senders, if
    known, distinguish equal stamps; all have shape (n,).
    """
    result = TopicStatistics(kind, len(log_times))
    if stamps is not None and len(stamps):
        result.unset = int(np.sum(~set_stamps(log_times, stamps))) if stamps.any() else len(stamps)
    stamped = stamps is not None and len(stamps) > 0 and not result.unset
    times = stamps if stamped and stamps is not None else log_times
    result.stamped = stamped
    if len(times) == 0:
        return result
    if stamped and stamps is not None:
        _stamp_statistics(result, log_times, stamps, senders)
    intervals = np.diff(times)
    ascending = intervals[intervals > 0]
    if len(ascending) == 0:
        return result
    median = float(np.median(ascending))
    result.rate = len(ascending) / float(ascending.sum()) * 1e9
    result.period = median * _MS
    result.jitter = float(np.std(ascending)) * _MS
    result.period_p99 = float(np.quantile(ascending, 0.99)) * _MS
    result.longest = float(ascending.max()) * _MS
    if not stamped and float(np.mean(ascending)) > BURST_FACTOR * median:
        return result
    near = np.mean(np.abs(ascending - median) <= (GAP_FACTOR - 1.0) * median)
    if near < _LEAST_PERIODIC or len(log_times) < _FEWEST_PERIODIC:
        return result
    result.gaps = int(np.sum(ascending > GAP_FACTOR * median))
    # A late message makes a long interval and a short one, which cancel.
    result.missing = max(int(np.sum(np.rint(ascending / median) - 1)), 0)
    return result


def _stamp_statistics(
    result: TopicStatistics, log_times: Int64, stamps: Int64, senders: npt.NDArray[Any] | None
) -> None:
    if senders is not None:
        keys = np.rec.fromarrays([stamps, senders])
        result.duplicates = len(keys) - len(np.unique(keys))
    else:
        result.duplicates = len(stamps) - len(np.unique(stamps))
    result.backward = int(np.sum(np.diff(stamps) < 0))
    ages = (log_times - stamps) * _MS
    result.age = float(np.median(ages))
    result.age_p99 = float(np.quantile(ages, 0.99))
    result.clock_jumps = len(clock_jumps(log_times, stamps))


def clock_jumps(log_times: Int64, stamps: Int64) -> list[int]:
    """Return the indices of messages at which one of the two clocks jumped.

    The age of a message (log time minus stamp [ns], shape (n,) each, log times ascending) is the difference of the
    clocks plus a delay, which is never negative and sometimes small. So the *least* age shows the clocks: a jump is a
    step of more than ``CLOCK_JUMP`` upwards that the least age of the next ``_LASTING`` seconds confirms, or one
    downwards below the least age of the seconds before. Late messages, single or queued, are no jumps.
    """
    ages = (log_times - stamps) * 1e-9
    steps = np.diff(ages)
    intervals = np.diff(stamps)
    ascending = intervals[intervals > 0]
    reach = max(_LEAST_AFTER, round(_LASTING * 1e9 / float(np.median(ascending)))) if len(ascending) else _LEAST_AFTER
    found: list[int] = []
    begin = 0
    for index in (np.flatnonzero(np.abs(steps) > CLOCK_JUMP) + 1).tolist():
        before = float(ages[max(begin, index - reach) : index].min())
        after = ages[index : index + reach]
        if steps[index - 1] < 0.0:
            jumped = float(ages[index]) < before - CLOCK_JUMP
        else:
            jumped = len(after) >= _LEAST_AFTER and float(after.min()) > before + CLOCK_JUMP
        if jumped:
            found.append(index)
            begin = index
    return found


def _latencies(times: dict[str, tuple[Int64, Int64]]) -> list[Latency]:
    """Match stamps between topics that echo each other; ``times`` are log times and stamps by topic [ns]."""
    found = []
    for source, (sent_at, sent) in times.items():
        stamps, first = np.unique(sent, return_index=True)
        for answer, (answered_at, answered) in times.items():
            if source == answer or len(sent) == 0 or len(answered) == 0:
                continue
            place = np.minimum(np.searchsorted(stamps, answered), len(stamps) - 1)
            same = stamps[place] == answered
            if same.sum() < max(2, _LEAST_SHARE * len(answered)):
                continue
            delays = (answered_at[same] - sent_at[first[place[same]]]) * _MS
            if np.median(delays) <= 0:
                continue  # the other direction is the reply (or all log times are the stamps themselves)
            median, p99 = np.quantile(delays, [0.5, 0.99])
            found.append(Latency(source, answer, int(same.sum()), float(median), float(p99), float(delays.max())))
    return found


def _times(bag: Bag, info: TopicInfo) -> tuple[Int64, Int64 | None]:
    readable = info.serialization == "cdr" and info.type not in _TIME_IS_CONTENT
    read = stamp_reader(info.type) if readable else None
    if read is None:
        return bag.log_times(info.name), None
    rows = bag.raw(info.name)
    stamps = [read(data) for _, data in rows]
    log_times = np.array([time for time, _ in rows], np.int64)
    return log_times, None if None in stamps else np.array(stamps, np.int64)


def bag_statistics(bag: Bag) -> BagStatistics:
    """Return rates, gaps, jitter, latencies, duplicates and clock jumps of a bag."""
    total = sum(info.count for info in bag.topics.values())
    result = BagStatistics(
        str(bag.path), bag.storage, (bag.stop_ns - bag.start_ns) * 1e-9, total, damage=list(bag.damage)
    )
    echoes: dict[str, tuple[Int64, Int64]] = {}
    for name, info in bag.topics.items():
        is_joint_state = info.type == "sensor_msgs/msg/JointState" and info.serialization == "cdr"
        values = None
        if is_joint_state:
            # A topic that wrongly claims to be JointState must not cost the others; ``array`` examines the clocks.
            with contextlib.suppress(DataError):
                values = bag[name]
                if isinstance(values, np.ndarray) and (jumps := two_motions(values["position"])):
                    result.problems.append(f"{name}: holds two motions ({jumps})")
                bag.array(name)
        stamps: Int64 | None
        if isinstance(values, np.ndarray):
            log_times, stamps = values["log_time_ns"], values["stamp_ns"]
            senders = values["frame_id"] if "frame_id" in (values.dtype.names or ()) else None
            result.topics[name] = time_statistics(info.type, log_times, stamps, senders)
        else:
            log_times, stamps = _times(bag, info)
            result.topics[name] = time_statistics(info.type, log_times, stamps)
        if is_joint_state and stamps is not None and result.topics[name].stamped:
            echoes[name] = log_times, stamps
    result.latencies = _latencies(echoes)
    result.events = bag.events()
    result.problems = [*result.damage, *bag.clock_notes, *result.problems]
    for name, topic in result.topics.items():
        result.problems += [f"{name}: {sentence}" for sentence in _problems(topic)]
    if not total:
        result.problems.append("there is no message")
    return result


def _problems(topic: TopicStatistics) -> list[str]:
    found = []
    if topic.missing > TOLERATED * topic.count:
        found.append(f"{topic.missing} messages are missing between {topic.count}")
    if topic.gaps and topic.longest > max(10.0 * topic.period, 100.0):
        found.append(f"nothing for {topic.longest / 1000.0:.3f} s")
    if topic.duplicates > TOLERATED * topic.count:
        found.append(f"{topic.duplicates} of {topic.count} messages repeat a stamp")
    if topic.clock_jumps:
        found.append(f"log time and stamp step apart {topic.clock_jumps} times")
    return found
