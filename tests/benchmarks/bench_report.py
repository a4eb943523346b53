"""How long a report takes: of one experiment with all its figures, and of a hundred runs pooled."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from pendulum_bags.comparison import compare_folders
from pendulum_bags.report import write_report
from pendulum_testing.synthetic_runs import write_run_folder
from tests.benchmarks import Row, measured

RUNS = 50
"""Runs of the pooled report: two bags each."""


def rows() -> Iterator[Row]:
    """Yield the times of both reports, of the comparison alone, and the size of the page."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = write_run_folder(Path(scratch, "one"), seed=1)
        started = time.perf_counter()
        comparison = compare_folders([folder])
        yield measured("compare a 2 x 5 s experiment, bags to verdict", time.perf_counter() - started, "s", at_most=1.0)
        assert comparison.is_paired
        started = time.perf_counter()
        page = write_report(folder, recordings=[])
        elapsed = time.perf_counter() - started
        assert len(list((folder / "figures").iterdir())) >= 28
        yield measured("report of a 2 x 5 s experiment: page, PNG and PDF figures", elapsed, "s", at_most=10.0)
        yield measured("size of that page, everything included", page.stat().st_size / 1e6, "MB", at_most=5.0)

        folders = [write_run_folder(Path(scratch, str(seed)), seed, ramps=False) for seed in range(1, RUNS + 1)]
        started = time.perf_counter()
        page = write_report(Path(scratch, "pooled"), folders=folders, recordings=[])
        elapsed = time.perf_counter() - started
        assert f"{RUNS} runs" in page.read_text(encoding="utf-8")
        yield measured(f"report of {2 * RUNS} bags pooled, all figures", elapsed, "s", at_most=60.0)
