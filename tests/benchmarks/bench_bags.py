"""Bags beside their peers: reading, writing, memory, what a kill costs, and what the recorder costs.

``BAGS_LONG=1`` records for five minutes instead of twenty seconds, and seals as often as in eight hours instead of one.
"""

from __future__ import annotations

import os
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import BagWriter, typestore
from tests.benchmarks import Peer, Row, measured, peer
from tests.benchmarks.bag_recordings import kill_rows, load_rows
from tests.benchmarks.bag_seals import seal_rows

JOINT_STATE = "sensor_msgs/msg/JointState"
COUNT = 300_000
TOPICS = ("/sim/joint_states", "/sim/effort_command", "/sim/disturbance")
TRUNCATIONS = 50


def rows() -> Iterator[Row]:
    """Yield all rows of the area."""
    with tempfile.TemporaryDirectory(prefix="bench_bags_") as name:
        folder = Path(name)
        messages = _messages()
        yield from _reading(folder, messages)
        yield from _writing(folder, messages)
        yield from _truncation(folder)
        yield from seal_rows(folder, 8.0 if os.environ.get("BAGS_LONG") else 1.0)
        yield from kill_rows(folder)
        yield from load_rows(folder, 300.0 if os.environ.get("BAGS_LONG") else 20.0)


def _messages() -> list[tuple[str, int, bytes]]:
    """Serialise with rclpy, whose padding is whatever was in memory."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import JointState

    message = JointState(name=["pendulum_joint"])
    result = []
    for index in range(COUNT):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(index * 1_000_000, 10**9)
        message.position, message.velocity, message.effort = (
            [0.001 * index],
            [-0.5 * index],
            [float(index % 7)],
        )
        result.append((TOPICS[index % 3], index * 1_000_000 + 17, serialize_message(message)))
    return result


def _median_time(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


# -- reading -----------------------------------------------------------------------------------------------------


def _reading(folder: Path, messages: list[tuple[str, int, bytes]]) -> Iterator[Row]:
    variants = (("mcap", None, 40.0), ("mcap", "zstd", 25.0), ("sqlite3", None, 5.0))
    for storage, compression, target in variants:
        path = folder / f"read_{storage}_{compression}"
        with BagWriter(path, storage, compression) as writer:
            for topic in TOPICS:
                writer.add_topic(topic, JOINT_STATE)
            writer.write_many(messages)
        anyreader, expected = _anyreader(path)
        _check(path, expected)
        ours = COUNT / _median_time(partial(_load, path), 7)
        what = f"read {COUNT:.0e} JointState of 3 topics, {storage}{' ' + compression if compression else ''}"
        yield measured(what, ours, "1/s", peer=Peer("rosbags AnyReader", anyreader), at_least_times_peer=target)
        if storage == "mcap":
            theirs = peer("baglab with its C++ backend", partial(_in_process, _BAGLAB, path))
            factor = None if compression else 10.0
            yield measured(what, ours, "1/s", peer=theirs, at_least_times_peer=factor)
            for name, script in (("mcap-ros2-support", _MCAP_ROS2), ("small-mcap, bytes only", _SMALL_MCAP)):
                theirs = peer(name, partial(_in_process, script, path))
                yield measured(what, ours, "1/s", peer=theirs)
        payload = sum(len(data) for _, _, data in messages)
        theirs = peer(
            "rosbags AnyReader to arrays",
            partial(_in_process_per, payload, _ROSBAGS_MEMORY, path),
        )
        peak = _in_process(_OUR_MEMORY, path)
        yield measured(
            f"peak memory of reading, {storage}{' ' + compression if compression else ''}",
            peak / payload,
            "x payload",
            peer=theirs,
            at_most=2.5,
            note="growth of the resident set, the mapped file included",
        )


def _load(path: Path) -> object:
    return read_bag(path).load()


def _in_process_per(size: float, script: str, path: Path) -> float:
    return _in_process(script, path) / size


def _rate_of(rate: Callable[[Any], float], writer: Callable[[str], Any], storage: str) -> float:
    return rate(writer(storage))


def _anyreader(path: Path) -> tuple[float, dict[str, list[tuple[Any, ...]]]]:
    from rosbags.highlevel import AnyReader

    found: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in TOPICS}
    begin = time.perf_counter()
    with AnyReader([path]) as reader:
        for connection, log_time, data in reader.messages():
            m: Any = reader.deserialize(data, connection.msgtype)
            stamp = m.header.stamp
            found[connection.topic].append(
                (log_time, stamp.sec * 10**9 + stamp.nanosec, m.position[0], m.velocity[0], m.effort[0])
            )
    return COUNT / (time.perf_counter() - begin), found


def _check(path: Path, expected: dict[str, list[tuple[Any, ...]]]) -> None:
    bag = read_bag(path).load()
    for topic, items in expected.items():
        columns = list(zip(*items, strict=True))
        for name, column in zip(bag[topic].dtype.names, columns, strict=True):
            np.testing.assert_array_equal(bag[topic][name], np.array(column))


_BAGLAB = """
import sys, time
import baglab
assert baglab.has_mcap_backend()
begin = time.perf_counter()
bag = baglab.load(sys.argv[1])
total = 0
for topic in bag.topics:
    frame = bag[topic]
    total += len(frame)
print(total / (time.perf_counter() - begin))
"""

_MCAP_ROS2 = """
import sys, time
from pathlib import Path
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
begin = time.perf_counter()
total = 0
with next(Path(sys.argv[1]).glob("*.mcap")).open("rb") as stream:
    for _, _, _, m in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
        row = (m.header.stamp.sec, m.position[0], m.velocity[0], m.effort[0])
        total += 1
print(total / (time.perf_counter() - begin))
"""

_SMALL_MCAP = """
import sys, time
from pathlib import Path
from small_mcap import read_message
begin = time.perf_counter()
total = 0
with next(Path(sys.argv[1]).glob("*.mcap")).open("rb") as stream:
    for _, _, message in read_message(stream):
        total += len(message.data) > 0
print(total / (time.perf_counter() - begin))
"""

# (getrusage is of no use here: a process inherits the peak of the one that started it.)
_PEAK = """
def peak():
    line = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return int(line.split()[1]) * 1024

def start():
    open("/proc/self/clear_refs", "w").write("5")  # forget the peak so far
    return peak()

"""

_OUR_MEMORY = (
    _PEAK
    + """
import sys
from pathlib import Path
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_msgs_py.contract.cdr import encode_joint_state
import tempfile
# A first small bag, so that what is imported late is not counted.
with tempfile.TemporaryDirectory() as name:
    with BagWriter(name + "/bag", sys.argv[2], metadata={"a": 1}) as writer:
        writer.add_topic("/a", "sensor_msgs/msg/JointState")
        writer.write("/a", 1, encode_joint_state(1, position=1.0))
    read_bag(name + "/bag").load()
import zstandard
before = start()
bag = read_bag(sys.argv[1]).load()
print(peak() - before)
"""
)

_ROSBAGS_MEMORY = (
    _PEAK
    + """
import sys
from pathlib import Path
import numpy as np
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    before = start()
    rows = []
    for connection, log_time, data in reader.messages():
        m = reader.deserialize(data, connection.msgtype)
        rows.append((log_time, m.header.stamp.sec, m.position[0], m.velocity[0], m.effort[0]))
    array = np.array(rows)
print(peak() - before)
"""
)


def _in_process(script: str, path: Path) -> float:
    """Run a peer in a process of its own (baglab, for one, changes rosbags for all who share its process)."""
    storage = "sqlite3" if any(path.glob("*.db3")) else "mcap"
    done = subprocess.run(
        [sys.executable, "-c", script, str(path), storage],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1]
        raise (ImportError if "ModuleNotFoundError" in last else RuntimeError)(last)
    return float(done.stdout)


# -- writing -----------------------------------------------------------------------------------------------------


def _writing(folder: Path, messages: list[tuple[str, int, bytes]]) -> Iterator[Row]:
    def ours(storage: str, seal_every: int) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            with BagWriter(path, storage) as writer:
                for topic in TOPICS:
                    writer.add_topic(topic, JOINT_STATE)
                for begin in range(0, COUNT, seal_every):
                    writer.write_many(messages[begin : begin + seal_every])
                    writer.seal()

        return write

    def rosbags(storage: str) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            from rosbags.rosbag2 import StoragePlugin, Writer

            with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
                connections = {t: writer.add_connection(t, JOINT_STATE, typestore=typestore()) for t in TOPICS}
                for topic, log_time, data in messages:
                    writer.write(connections[topic], log_time, data)

        return write

    def mcap_library(path: Path) -> None:
        from mcap.writer import CompressionType, Writer

        path.mkdir()
        with (path / "file.mcap").open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.NONE)
            writer.start("ros2", "")
            schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
            channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in TOPICS}
            for topic, log_time, data in messages:
                writer.add_message(channels[topic], log_time, data, log_time)
            writer.finish()

    def rate(write: Callable[[Path], None]) -> float:
        path = folder / "written"
        times = []
        for _ in range(3):
            shutil.rmtree(path, ignore_errors=True)
            begin = time.perf_counter()
            write(path)
            times.append(time.perf_counter() - begin)
        shutil.rmtree(path)
        return COUNT / statistics.median(times)

    for storage in ("mcap", "sqlite3"):
        theirs = peer(f"rosbags {storage}", partial(_rate_of, rate, rosbags, storage))
        yield measured(f"write {COUNT:.0e} messages, {storage}", rate(ours(storage, COUNT)), "1/s", peer=theirs)
        yield measured(
            f"write {storage}, sealed every 500 messages",
            rate(ours(storage, 500)),
            "1/s",
            peer=theirs,
            note="the peer seals once, at its end" + ("" if storage == "mcap" else "; our time includes the index"),
        )
        if storage == "mcap":
            library = peer("mcap", lambda: rate(mcap_library))
            yield measured(f"write {COUNT:.0e} messages, mcap", rate(ours(storage, COUNT)), "1/s", peer=library)


# -- truncation --------------------------------------------------------------------------------------------------


def _truncation(folder: Path) -> Iterator[Row]:
    """Cut files of three writers at random lengths and count the whole chunks that come back."""
    from mcap.reader import make_reader

    def ours(path: Path) -> None:
        with BagWriter(path) as writer:
            writer.add_topic("/a", JOINT_STATE)
            for index in range(20_000):
                writer.write("/a", index, encode_joint_state(index, position=float(index)))
                if index % 200 == 199:
                    writer.seal()

    def rosbags(path: Path) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection("/a", JOINT_STATE, typestore=typestore())
            for index in range(50_000):
                writer.write(connection, index, encode_joint_state(index, position=float(index)))

    def mcap_library(path: Path) -> None:
        from mcap.writer import Writer

        path.mkdir()
        with (path / "file.mcap").open("wb") as stream:
            writer = Writer(stream, chunk_size=50_000)
            writer.start("ros2", "")
            definition, _ = typestore().generate_msgdef(JOINT_STATE, ros_version=2)
            schema = writer.register_schema(JOINT_STATE, "ros2msg", definition.encode())
            channel = writer.register_channel("/a", "cdr", schema)
            for index in range(20_000):
                writer.add_message(channel, index, encode_joint_state(index, position=float(index)), index)
            writer.finish()

    rng = random.Random(50)
    for name, write in (("ours", ours), ("rosbags", rosbags), ("the mcap library", mcap_library)):
        bag = folder / f"cut_{name.split()[-1]}"
        write(bag)
        (file,) = bag.glob("*.mcap")
        sound = file.read_bytes()
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        chunks = [(c.chunk_start_offset + c.chunk_length, c.message_end_time + 1) for c in summary.chunk_indexes]
        good = 0
        for _ in range(TRUNCATIONS):
            size = rng.randrange(100, len(sound))
            file.write_bytes(sound[:size])
            expected = max((count for end, count in chunks if end <= size), default=0)
            report = repair_bag(bag, folder / "mended")
            mended = read_bag(folder / "mended")
            # Of the chunk that was cut, too, what is whole comes back: the first messages, none missing.
            states = mended["/a"]["position"] if "/a" in mended.topics else []
            whole = list(states) == list(range(len(states))) and len(states) == sum(report.messages.values())
            good += len(states) >= expected and whole and not mended.damage
            shutil.rmtree(folder / "mended")
        yield measured(
            f"files of {name} cut at {TRUNCATIONS} random lengths, all whole chunks back",
            good,
            "",
            at_least=TRUNCATIONS,
        )
