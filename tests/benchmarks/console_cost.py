"""Measures what looking costs the loops: both plants, without the console, with it, with a reader, with a browser."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil
import websockets

from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.benchmarks.plant_listener import PlantListener, cpu_time
from tests.benchmarks.two_plants import two_plants

__all__ = ["CHROMIUM", "Look", "looks", "start_console"]

CHROMIUM = Path("/usr/bin/chromium")
_WARM_UP = 4.0
_START_TIMEOUT = 60.0
_AS_A_PERSON = "setpriv --bounding-set=-sys_nice" if os.geteuid() == 0 and shutil.which("setpriv") else ""
"""Root's Chromium raises its own priority above every loop's; a person's cannot."""
_NICENESS = 10
"""Of the browser, as a person would start one beside a loop on a small machine."""
_BROWSER_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]


@dataclass(frozen=True)
class Look:
    """What one way of looking cost.

    Attributes:
        way: ``nobody``, ``console``, ``reader`` or ``browser``.
        rate: Slower plant's rate [Hz].
        jitter: 99th percentile of the jitter, of the worse plant [us].
        loop_cpu: CPU of plants, controllers and disturbances [% of a core].
        console_cpu: CPU of the console's process [% of a core].
        browser_cpu: CPU of the browser [% of a core].
        pictures: Pictures that reached the one who looks [1/s].
        faults: Reasons of the plants that are in a fault at the end.
    """

    way: str
    rate: float
    jitter: float
    loop_cpu: float
    console_cpu: float = 0.0
    browser_cpu: float = 0.0
    pictures: float = 0.0
    faults: Sequence[str] = ()


def looks(duration: float, ways: Sequence[str] = ("nobody", "console", "reader", "browser")) -> Iterator[Look]:
    """Run both plants under noise and yield what each way of looking costs.

    Args:
        duration: Length of each measurement [s].
        ways: Which ways, in this order.
    """
    with two_plants() as running:
        processes = {"loops": [psutil.Process(program.pid) for program in running.programs]}
        address = ""
        for way in ways:
            if way != "nobody" and not address:
                console, address = start_console(running.group, running.environment, running.folder / "runs")
                processes["console"] = [psutil.Process(console.pid)]
            with contextlib.ExitStack() as stack:
                count: Callable[[], float] = float
                processes["browser"] = []
                if way == "reader":
                    count = stack.enter_context(_Reader(address)).count
                elif way == "browser":
                    count, processes["browser"] = stack.enter_context(_browser(address))
                running.loops.spin(_WARM_UP)
                yield _measure(way, duration, running.loops, processes, count)


def _measure(
    way: str,
    duration: float,
    loops: PlantListener,
    processes: dict[str, list[psutil.Process]],
    count: Callable[[], float],
) -> Look:
    loops.clear()
    before = {name: cpu_time(group) for name, group in processes.items()}
    seen, wall = count(), time.monotonic()
    loops.let_run(duration)
    elapsed = time.monotonic() - wall
    cpu = {name: 100.0 * (cpu_time(group) - before[name]) / elapsed for name, group in processes.items()}

    def median(key: str) -> list[float]:
        return [statistics.median(float(row[key]) for row in rows) for rows in loops.rows.values()]

    return Look(
        way,
        rate=min(median("rate_hz")),
        jitter=max(median("jitter_p99_us")),
        loop_cpu=cpu["loops"],
        console_cpu=cpu.get("console", 0.0),
        browser_cpu=cpu["browser"],
        pictures=(count() - seen) / elapsed,
        faults=[rows[-1]["reason"] for rows in loops.rows.values() if rows[-1]["mode"] == "fault"],
    )


def start_console(group: ProcessGroup, environment: dict[str, str], runs: Path) -> tuple[RunningProgram, str]:
    """Start a console on a free port; return it with its address.

    Args:
        group: Starts and ends it.
        environment: For its process.
        runs: Folder of its runs.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    console = group.start("pendulum_console", "console", "--port", str(port), "--runs", runs, env=environment)
    console.wait_for_output(r"console at http://localhost", _START_TIMEOUT)
    return console, f"localhost:{port}"


class _Reader:
    """Takes every picture and draws none."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._seen = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._read()), daemon=True)

    def count(self) -> float:
        return float(self._seen)

    async def _read(self) -> None:
        async with websockets.connect(f"ws://{self._address}/stream") as socket_:
            while not self._stop.is_set():
                await socket_.recv()
                self._seen += 1

    def __enter__(self) -> _Reader:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)


@contextlib.contextmanager
def _browser(address: str) -> Iterator[tuple[Callable[[], float], list[psutil.Process]]]:
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder:
        niced = Path(folder, "chromium")
        niced.write_text(f'#!/bin/sh\nexec {_AS_A_PERSON} nice -n {_NICENESS} {CHROMIUM} "$@"\n', encoding="utf-8")
        niced.chmod(0o755)
        with sync_playwright() as play:
            chromium = play.chromium.launch(executable_path=str(niced), args=_BROWSER_FLAGS)
            page = chromium.new_page(viewport={"width": 1280, "height": 860})
            page.goto(f"http://{address}/")
            page.wait_for_function("Object.keys(pendulumConsole.plants).length == 2", timeout=60_000)
            here = psutil.Process(os.getpid())
            children = [it for it in here.children(recursive=True) if "chrom" in it.name()]
            yield (lambda: float(page.evaluate("pendulumConsole.drawn"))), children
            chromium.close()
