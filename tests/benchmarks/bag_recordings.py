"""The recorder under load and under kill -9, as processes over DDS; rows for ``bench_bags``."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from pendulum_rosbag.reader import Bag, read_bag
from tests.benchmarks import Row, measured

__all__ = ["kill_rows", "load_rows"]

KILLS = 50
_KILL_DOMAINS = (40, 41, 42, 44, 45)
_ENVIRONMENT = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}

_PUBLISHER = """
import sys, time
import rclpy
from pendulum_msgs_py.contract.cdr import encode_joint_state
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

topics, rate, duration, depth = int(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
rclpy.init()
node = rclpy.create_node("load")
publishers = [node.create_publisher(JointState, f"/t{k}", QoSProfile(depth=depth)) for k in range(topics)]
while not all(publisher.get_subscription_count() for publisher in publishers):
    time.sleep(0.05)
time.sleep(1.0)
begin = time.monotonic()
sent = 0
while (elapsed := time.monotonic() - begin) < duration:
    while sent < elapsed * rate:
        data = encode_joint_state(time.time_ns(), position=float(sent), velocity=1.0, effort=2.0)
        for publisher in publishers:
            publisher.publish(data)
        sent += 1
    time.sleep(max((sent + 1) / rate - (time.monotonic() - begin), 0.0))
for publisher in publishers:
    publisher.wait_for_all_acked()
print(sent, flush=True)
time.sleep(1.0)
"""


def _environment(domain: int) -> dict[str, str]:
    return {**os.environ, **_ENVIRONMENT, "ROS_DOMAIN_ID": str(domain)}


def _publisher(domain: int, topics: int, rate: float, duration: float, depth: int = 1000) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", _PUBLISHER, str(topics), str(rate), str(duration), str(depth)],
        stdout=subprocess.PIPE,
        text=True,
        env=_environment(domain),
    )


def _recorder(domain: int, bag: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "pendulum_bags", "record", "-o", str(bag), "--regex", "^/t[0-9]"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=_environment(domain),
    )


# -- kill -9 -----------------------------------------------------------------------------------------------------


def kill_rows(folder: Path) -> Iterator[Row]:
    """Kill recorders of five topics at 500 Hz at random moments; read what they leave with three readers."""
    rng = random.Random(9)
    losses: list[float] = []
    failures: list[str] = []
    for number, domain in enumerate(_KILL_DOMAINS):
        session = folder / f"kills_{number}"
        killed = _kill_session(session, domain, KILLS // len(_KILL_DOMAINS), rng)
        everything = read_bag(session / "witness").load()
        for bag, killed_ns in killed.items():
            try:
                losses.append(_loss(bag, everything, killed_ns))
            except Exception as error:  # noqa: BLE001 - any reader may fail in its own way, and that is the figure
                failures.append(f"{bag.name}: {type(error).__name__}: {error}")
    yield measured(
        f"kill -9 at {KILLS} random moments: opened without repair by rosbags, mcap and us",
        len(losses),
        "",
        at_least=KILLS,
        note="; ".join(failures[:3]),
    )
    middle = f"median {statistics.median(losses):.3f} s" if losses else ""
    yield measured("largest loss at a kill", max(losses, default=float("nan")), "s", at_most=0.2, note=middle)


def _kill_session(folder: Path, domain: int, kills: int, rng: random.Random) -> dict[Path, int]:
    """Kill some recorders, two at a time; return when each was killed [ns].

    One more recorder is left alone. It knows what was published until each kill, so that a publisher that was held up
    is not taken for a loss. A session is short, because a middleware that has lost dozens of participants without a
    farewell no longer serves new ones reliably.
    """
    publisher = _publisher(domain, 5, 500.0, 3600.0)
    witness = _recorder(domain, folder / "witness")
    killed: dict[Path, int] = {}
    try:
        _wait_for_messages(folder / "witness", 5)
        for number in range(kills // 2):
            bags = [folder / f"killed_{number}_{k}" for k in range(2)]
            recorders = [_recorder(domain, bag) for bag in bags]
            for bag in bags:
                _wait_for_messages(bag, 5)
            for bag, recorder in zip(bags, recorders, strict=True):
                time.sleep(rng.uniform(0.0, 0.8))
                killed[bag] = time.time_ns()
                recorder.send_signal(signal.SIGKILL)
            for bag, recorder in zip(bags, recorders, strict=True):
                said, _ = recorder.communicate()
                bag.with_suffix(".log").write_text(said)
        time.sleep(1.0)
    finally:
        publisher.kill()
        publisher.communicate()
        witness.send_signal(signal.SIGINT)
        witness.communicate()
    return killed


def _loss(bag: Path, everything: Bag, killed_ns: int) -> float:
    """Return what is missing at the end of the topic that has lost most [s]."""
    with AnyReader([bag]) as reader:
        count = sum(1 for _ in reader.messages())
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        library = sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())
    ours = read_bag(bag).load()
    if ours.damage:
        raise ValueError(ours.damage[0])
    if not count == library == sum(len(ours[topic]) for topic in ours.topics):
        raise ValueError("three readers count differently")
    losses = []
    for topic in (topic for topic in ours if topic.startswith("/t")):
        published = everything[topic]["stamp_ns"]
        published = published[published <= killed_ns]
        held = ours[topic]["stamp_ns"]
        since = published[published >= held[0]]
        absent = since[: len(held)][~np.isin(since[: len(held)], held)]
        if absent.size:
            first, last = ((int(absent[k]) - int(held[0])) * 1e-9 for k in (0, -1))
            # A publisher that serves others may be heard before it knows of us: such a gap is told, and is no loss.
            log = bag.with_suffix(".log").read_text()
            pattern = rf"(\d+) messages of {topic} are not recorded: they were published before"
            told = sum(map(int, re.findall(pattern, log)))
            if told != absent.size:
                raise ValueError(
                    f"{topic}: {absent.size} of {len(held)} messages are missing, {first:.3f} to {last:.3f} s after "
                    f"the first; the recorder told of {told}"
                )
        losses.append(max(int(published[-1]) - int(held[-1]), 0) * 1e-9)
    return max(losses)


# -- load --------------------------------------------------------------------------------------------------------


def load_rows(folder: Path, duration: float) -> Iterator[Row]:
    """Record ten topics at 500 Hz, then one topic as fast as it goes without loss."""
    sent, lost, share, growth = _run(folder / "load", 47, 10, 500.0, duration)
    work = f"record 10 topics at 500 Hz for {duration:g} s"
    yield measured(f"{work}: lost of {sent}", lost, "", at_most=0.0)
    yield measured(f"{work}: processor", 100.0 * share, "% of a core", at_most=15.0)
    yield measured(f"{work}: growth of the resident set", growth, "MB", at_most=8.0, note="after the first 5 s")
    best = 0.0
    for number, rate in enumerate((10_000.0, 20_000.0, 30_000.0)):
        sent, lost, _, _ = _run(folder / f"ceiling{number}", 48, 1, rate, 5.0, depth=2000)
        if lost or sent < 0.95 * rate * 5.0:
            break
        best = rate
    yield measured("lossless rate on one topic", best, "Hz", at_least=10_000.0)


def _run(
    bag: Path, domain: int, topics: int, rate: float, duration: float, depth: int = 1000
) -> tuple[int, int, float, float]:
    """Return messages sent and lost, the recorder's share of a core, and the growth of its memory [MB]."""
    recorder = _recorder(domain, bag)
    publisher = _publisher(domain, topics, rate, duration, depth)
    process = psutil.Process(recorder.pid)
    try:
        _wait_for_messages(bag, topics)
        begin, used = time.monotonic(), sum(process.cpu_times()[:2])
        time.sleep(min(5.0, duration / 4))
        memory = process.memory_info().rss
        time.sleep(max(duration - (time.monotonic() - begin) - 2.0, 0.5))
        share = (sum(process.cpu_times()[:2]) - used) / (time.monotonic() - begin)
        growth = (process.memory_info().rss - memory) / 1e6
        assert publisher.stdout is not None
        sent = int(publisher.stdout.readline()) * topics
        time.sleep(0.5)
    finally:
        publisher.kill()
        recorder.send_signal(signal.SIGINT)
        recorder.communicate(timeout=60)
        publisher.communicate()
    held = read_bag(bag)
    counts = held.metadata["pendulum.recorder.counts"]
    written = sum(info.count for name, info in held.topics.items() if name.startswith("/t"))
    reported = sum(item["lost"] for item in counts.values())
    # What the recorder says and what the publisher knows must agree: a loss that is not told would be the worst.
    lost = sent - written
    if lost != reported:
        raise ValueError(f"{lost} messages are missing, the recorder says {reported}: {json.dumps(counts)}")
    return sent, lost, share, growth


def _wait_for_messages(bag: Path, topics: int) -> None:
    """Wait until a bag holds messages of each topic of the load (a recorder's own events do not count)."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        held = read_bag(bag).topics if bag.exists() else {}
        if sum(info.count > 0 for name, info in held.items() if name.startswith("/t")) >= topics:
            return
        time.sleep(0.1)
    raise TimeoutError(f"nothing was recorded to {bag} in 60 s")
