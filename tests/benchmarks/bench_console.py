"""What the console costs: two plants at 500 Hz, seen by nobody, by the server, by a reader, by a browser."""

from __future__ import annotations

import os
from collections.abc import Iterator

from tests.benchmarks import Peer, Row, measured
from tests.benchmarks.console_cost import CHROMIUM, looks

__all__ = ["rows"]

SECONDS = float(os.environ.get("PENDULUM_BENCH_SECONDS", "15"))
"""Length of each measurement [s]."""


def rows() -> Iterator[Row]:
    """Yield rate, jitter, pictures and CPU for each way of looking."""
    ways = ("nobody", "console", "reader", *(("browser",) if CHROMIUM.is_file() else ()))
    alone: Peer | None = None
    jitter: Peer | None = None
    for look in looks(SECONDS, ways):
        told = "; ".join(f"fault: {reason}" for reason in look.faults)
        if look.way == "nobody":
            alone, jitter = Peer("without console", look.rate), Peer("without console", look.jitter)
            continue
        what = {
            "console": "console runs, nobody looks",
            "reader": "a client takes every picture",
            "browser": "Chromium (nice 10) draws on the same cores",
        }[look.way]
        share = 0.95 if look.way == "browser" else 0.99
        yield measured(
            f"{what}: rate of the slower loop", look.rate, "Hz", peer=alone, at_least_times_peer=share, note=told
        )
        yield measured(
            f"{what}: jitter of the worse loop, 99 %",
            look.jitter,
            "us",
            peer=jitter,
            less_is_better=True,
            at_least_times_peer=0.2 if look.way == "browser" else 0.5,
        )
        yield measured(f"{what}: CPU of the console", look.console_cpu, "% of a core", at_most=20.0)
        if look.way != "console":
            yield measured(f"{what}: pictures", look.pictures, "1/s", at_least=57.0)
        if look.way == "browser":
            yield measured(f"{what}: CPU of the browser", look.browser_cpu, "% of a core", at_most=60.0)
