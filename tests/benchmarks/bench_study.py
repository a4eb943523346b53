"""Studies: nodes in lockstep against the clock, a million closed loops, and the same on a Dask cluster."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from pendulum_bags.study.monte_carlo import MonteCarlo, run_chunk, run_monte_carlo
from tests.benchmarks import Row, measured, peer
from tests.benchmarks.bench_sim import _mujoco_rollout, _numpy_speed

MILLION = 1_000_000
STUDY = """format: pendulum_study/1
name: bench
duration: 5.0
plants:
  sim: {}
  hw: {side: hw}
controllers:
  lqr: {q: [100.0, 0.01], r: 0.1}
  pid: {}
  lqi: {}
disturbances:
  noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}
seeds: {first: 1, count: 5}
"""


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    with tempfile.TemporaryDirectory() as folder:
        yield from _monte_carlo(Path(folder))
        yield from _dask(Path(folder))
        yield from _study(Path(folder))


def _study(folder: Path) -> Iterator[Row]:
    file = folder / "study.yaml"
    file.write_text(STUDY, encoding="utf-8")
    began = time.perf_counter()
    _experiment("study", file, "--out", folder / "study", "--workers", 2)
    wall = time.perf_counter() - began
    yield measured(
        "study of 2 plants x 3 controllers x 5 seeds of 5 s over DDS, recorded, 2 at once: simulated per wall time",
        150.0 / wall,
        "s/s",
        note=f"{wall:.0f} s, the start of 150 nodes included",
    )


def _monte_carlo(folder: Path) -> Iterator[Row]:
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    began = time.perf_counter()
    text = _experiment("monte_carlo", "--runs", MILLION, "--sobol", 0, "--json", "--out", folder / "million")
    wall = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
    result = json.loads(text)
    if not (0.9 < result["probability_inside"] < 1.0 and result["not_finite"] == 0):
        raise AssertionError(f"a Monte Carlo gave {result['probability_inside']} and {result['not_finite']} lost runs")
    what = "10^6 closed-loop runs of 5 s at 2 ms, each a plant of its own"
    yield measured(f"{what}: wall time, start, compilation and Parquet included", wall, "s", at_most=20.0)
    note = "" if before < 1024.0 * peak else "an earlier child of this process was larger"
    yield measured(f"{what}: peak memory", peak, "MiB", at_most=1024.0, note=note)
    settings = MonteCarlo(runs=100_000, chunk=100_000, method="euler")
    run_chunk(replace(settings, duration=0.01), 0)
    began = time.perf_counter()
    run_chunk(settings, 0)
    speed = settings.runs * settings.steps / (time.perf_counter() - began)
    what = "a chunk of 10^5 such runs, Euler as the peers, compiled before"
    rollout = peer("mujoco.rollout", _mujoco_rollout)
    yield measured(what, speed, "steps/s", peer=rollout, at_least_times_peer=100.0)
    yield measured(what, speed, "steps/s", peer=peer("numpy", _numpy_speed), at_least_times_peer=4.0)


def _dask(folder: Path) -> Iterator[Row]:
    settings = MonteCarlo(runs=200_000, chunk=10_000)
    run_chunk(replace(settings, runs=10, duration=0.1), 0)
    walls = {}
    results = {}
    for workers in (1, 2):
        began = time.perf_counter()
        results[workers] = run_monte_carlo(folder / f"dask_{workers}", settings, workers=workers)
        walls[workers] = time.perf_counter() - began
    if results[1] != results[2]:
        raise AssertionError("one worker and two gave different results")
    yield measured(
        "Dask, 2 x 10^5 runs: efficiency of two workers",
        walls[1] / (2.0 * walls[2]),
        "-",
        note=f"{walls[1]:.1f} s on one, {walls[2]:.1f} s on two, cluster and compilation included; the same bits",
    )
    killer = threading.Timer(max(2.0, 0.5 * walls[2]), _kill_a_worker)
    killer.start()
    result = run_monte_carlo(folder / "dask_killed", settings, workers=2)
    killer.cancel()
    yield measured(
        "Dask, a worker killed mid-run: runs lost",
        float(settings.runs - result["runs"]) if result == results[1] else float("nan"),
        "runs",
        at_most=0.0,
        note="the result has the same bits",
    )


def _kill_a_worker() -> None:
    import psutil

    workers = [
        child
        for child in psutil.Process(os.getpid()).children(recursive=True)
        if "multiprocessing.spawn" in " ".join(child.cmdline()) or "spawn_main" in " ".join(child.cmdline())
    ]
    if workers:
        workers[-1].kill()


def _experiment(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_bags", "experiment", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip()[-500:])
    return done.stdout
