"""What a viewer costs: two plants at 500 Hz, seen by nobody, by a server without clients, and by one that reads all."""

from __future__ import annotations

import os
import socket
import statistics
import time
from collections.abc import Iterator
from typing import Any

import psutil

from tests.benchmarks import Peer, Row, measured
from tests.benchmarks.plant_listener import PlantListener, cpu_time
from tests.benchmarks.two_plants import PLANTS, two_plants
from tests.foxglove_client import FoxgloveClient, foxglove_client

__all__ = ["rows"]

SECONDS = float(os.environ.get("PENDULUM_BENCH_SECONDS", "20"))
"""Length of each measurement [s]."""
_WARM_UP = 3.0
_STATES = ("/sim/joint_states", "/hw/joint_states")


def rows() -> Iterator[Row]:
    """Yield rate, jitter, missed deadlines and CPU for each way of looking, and what a client gets."""
    with two_plants() as running:
        loops = running.loops
        alone = _loops("without a server", loops, None)
        yield from _rows_of(alone, None)

        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        server = running.group.start("pendulum_console", "foxglove", "--port", str(port), env=running.environment)
        for plant in PLANTS:
            server.wait_for_output(rf"^plant {plant}$", 60)
        process = psutil.Process(server.pid)
        yield from _rows_of(_loops("server runs, nobody looks", loops, process), alone)
        with foxglove_client(f"ws://localhost:{port}/") as client:
            client.subscribe(*sorted(client.ask("seen")["topics"]))
            watched = _loops("a client reads all topics", loops, process, client)
            yield from _rows_of(watched, alone)
            got = sum(topic["count"] for topic in client.ask("taken").values())
            server.interrupt()
            sent, lost = server.wait_for_output(r"handed on (\d+) messages; (\d+) were lost", 30).groups()
            # Those on their way when it was asked came later.
            yield measured("a client reads all topics: messages lost between plants and server", int(lost), "")
            yield measured("a client reads all topics: messages not yet there at the end", int(sent) - got, "")


def _loops(
    way: str, loops: PlantListener, server: psutil.Process | None, client: FoxgloveClient | None = None
) -> dict[str, Any]:
    loops.spin(_WARM_UP)
    loops.clear()
    loops.spin(1.0)
    before = {plant: int(rows[-1]["overruns"]) for plant, rows in loops.rows.items()}
    taken = client.ask("taken") if client else {}
    cpu, wall = cpu_time([server]) if server else 0.0, time.monotonic()
    loops.let_run(SECONDS)
    elapsed = time.monotonic() - wall
    found: dict[str, Any] = {
        "way": way,
        "rate": min(statistics.median(float(row["rate_hz"]) for row in rows) for rows in loops.rows.values()),
        "jitter": max(statistics.median(float(row["jitter_p99_us"]) for row in rows) for rows in loops.rows.values()),
        "overruns": sum(int(rows[-1]["overruns"]) - before[plant] for plant, rows in loops.rows.items()),
        "cpu": 100.0 * (cpu_time([server]) - cpu) / elapsed if server else None,
    }
    if client:
        now = client.ask("taken")
        found["messages"] = sum(now[topic]["count"] - taken[topic]["count"] for topic in now) / elapsed
        found["states"] = sum(now[topic]["count"] - taken[topic]["count"] for topic in _STATES) / elapsed
    return found


def _rows_of(found: dict[str, Any], alone: dict[str, Any] | None) -> Iterator[Row]:
    def peer(name: str) -> Peer | None:
        return Peer("without a server", alone[name]) if alone else None

    way = found["way"]
    yield measured(f"{way}: rate of the slower loop", found["rate"], "Hz", peer=peer("rate"), at_least_times_peer=0.99)
    yield measured(
        f"{way}: jitter of the worse loop, 99 %",
        found["jitter"],
        "us",
        peer=peer("jitter"),
        less_is_better=True,
        at_least_times_peer=0.5,
    )
    yield measured(f"{way}: missed deadlines of both plants in {SECONDS:g} s", found["overruns"], "")
    if found["cpu"] is not None:
        yield measured(f"{way}: CPU of the server", found["cpu"], "% of a core", at_most=40.0)
    if "states" in found:
        yield measured(f"{way}: messages that it gets", found["messages"], "1/s")
        yield measured(f"{way}: states of both plants that it gets", found["states"], "1/s")
