"""What a viewer costs: two plants at 500 Hz, seen by nobody, by a server without clients, and by one that reads all."""

from __future__ import annotations

import math
import os
import socket
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_msgs_py.programs import graph
from tests.benchmarks import Peer, Row, measured
from tests.benchmarks.plant_listener import PlantListener, cpu_time, domain_environment
from tests.fixtures import PROJECT
from tests.foxglove_client import FoxgloveClient, foxglove_client
from tests.processes import ProcessGroup

__all__ = ["rows"]

SECONDS = float(os.environ.get("PENDULUM_BENCH_SECONDS", "20"))
"""Length of each measurement [s]."""
RATE = 500.0
_WARM_UP = 3.0
_PLANTS = ("/sim/simulator", "/hw/bridge")
_STATES = ("/sim/joint_states", "/hw/joint_states")


def rows() -> Iterator[Row]:
    """Yield rate, jitter, missed deadlines and CPU for each way of looking, and what a client gets."""
    with tempfile.TemporaryDirectory() as scratch, reserve_domain(None) as domain:
        group, loops = ProcessGroup(Path(scratch), PROJECT), PlantListener(domain, *_PLANTS)
        environment = domain_environment(domain)
        try:
            nodes = (
                graph.simulator("/sim", rate_hz=RATE, start="top"),
                graph.bridge("/hw", backend="emulator", feedback_rate=RATE, initial_position=math.pi),
                *(graph.controller(space, period=1.0 / RATE) for space in ("/sim", "/hw")),
                *(graph.disturbance(space, autostart=True) for space in ("/sim", "/hw")),
            )
            for it in nodes:
                group.start(it.package, it.executable, *it.ros_arguments(), env=environment)
            loops.wait_for_loops()
            loops.arm("/hw/bridge")
            alone = _loops("without a server", loops, None)
            yield from _rows_of(alone, None)

            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = probe.getsockname()[1]
            server = group.start("pendulum_bags", "foxglove", "--port", str(port), env=environment)
            for plant in _PLANTS:
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
        finally:
            loops.close()
            group.close()


def _loops(
    way: str, loops: PlantListener, server: psutil.Process | None, client: FoxgloveClient | None = None
) -> dict[str, Any]:
    loops.spin(_WARM_UP)
    loops.clear()
    loops.spin(1.0)
    before = {plant: int(rows[-1]["overruns"]) for plant, rows in loops.rows.items()}
    taken = client.ask("taken") if client else {}
    cpu, wall = cpu_time([server]) if server else 0.0, time.monotonic()
    loops.spin(SECONDS)
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
        f"{way}: jitter of the worse loop, 99 %", found["jitter"], "us",
        peer=peer("jitter"), less_is_better=True, at_least_times_peer=0.5,
    )  # fmt: skip
    yield measured(f"{way}: missed deadlines of both plants in {SECONDS:g} s", found["overruns"], "")
    if found["cpu"] is not None:
        yield measured(f"{way}: CPU of the server", found["cpu"], "% of a core", at_most=40.0)
    if "states" in found:
        yield measured(f"{way}: messages that it gets", found["messages"], "1/s")
        yield measured(f"{way}: states of both plants that it gets", found["states"], "1/s")
