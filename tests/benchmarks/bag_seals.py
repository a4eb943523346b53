"""What sealing costs after hours of recording; rows for ``bench_bags``."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from tests.benchmarks import Row, measured

__all__ = ["seal_rows"]

_SEALS_PER_HOUR = 72_000  # one every 0.05 s, as the recorder does
_SETTLE_EVERY = 100  # and a sync every 5 s


def seal_rows(folder: Path, hours: float) -> Iterator[Row]:
    """Seal as often as a recorder does in some hours, and compare the last seals with the first."""
    seals = round(hours * _SEALS_PER_HOUR)
    part = seals // 20
    data = encode_joint_state(5, position=1.0, velocity=2.0, effort=3.0)
    costs: list[tuple[float, float]] = []
    memory = 0.0
    begin_memory = 0.0
    with BagWriter(folder / "seals") as writer:
        writer.add_topic("/a", "sensor_msgs/msg/JointState")
        file = writer._file
        begin, written = time.perf_counter(), _written_bytes()
        for number in range(1, seals + 1):
            writer.write("/a", 50_000_000 * number, data)
            file.seal()  # (metadata.yaml, which is replaced at each seal too, has the same size all the time)
            if number % _SETTLE_EVERY == 0:
                file.settle()
            if number % part == 0:
                now, total = time.perf_counter(), _written_bytes()
                costs.append(((now - begin) / part, (total - written) / part))
                memory = _resident_bytes()
                begin_memory = begin_memory or memory
                begin, written = now, total
    assert len(read_bag(folder / "seals")["/a"]) == seals
    (first_time, first_bytes), (last_time, last_bytes) = costs[0], costs[-1]
    what = f"a seal at the end of {hours:g} h beside one at its start"
    yield measured(f"{what}: bytes written", last_bytes / first_bytes, "x", at_most=1.5, note=f"{last_bytes:.0f} bytes")
    yield measured(f"{what}: time", last_time / first_time, "x", at_most=2.0, note=f"{1e6 * last_time:.0f} us")
    growth = (memory - begin_memory) / 1e6 / (0.95 * hours)
    yield measured("growth of the resident set of a writer, per hour", growth, "MB", at_most=2.0)


def _written_bytes() -> int:
    return _field("/proc/self/io", "wchar:")


def _resident_bytes() -> int:
    return 1024 * _field("/proc/self/status", "VmRSS:")


def _field(path: str, name: str) -> int:
    line = next(line for line in Path(path).read_text().splitlines() if line.startswith(name))
    return int(line.split()[1])
