"""Studies: nodes in lockstep against the clock, a million closed loops, maps, Dask clusters, a network that delays."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from pendulum_bags.analyse.bag_table import analyse_bags, find_pieces
from pendulum_bags.studies.chunks import cluster_client
from pendulum_bags.studies.monte_carlo import MonteCarlo, run_chunk, run_monte_carlo
from pendulum_bags.studies.region_map import RegionMap, run_map
from tests.benchmarks import Row, measured, peer
from tests.benchmarks.bench_sim import _mujoco_rollout, _numpy_speed
from tests.tools.faults.delay_margin import find_delay_margin
from tests.tools.faults.network import why_not

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
disturbances:
  noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}
seeds: {first: 1, count: 20}
"""


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    with tempfile.TemporaryDirectory() as folder:
        yield from _monte_carlo(Path(folder))
        yield from _region(Path(folder))
        yield from _dask(Path(folder))
        yield from _network(Path(folder))
        yield from _study(Path(folder))


def _study(folder: Path) -> Iterator[Row]:
    file = folder / "study.yaml"
    file.write_text(STUDY, encoding="utf-8")
    began = time.perf_counter()
    _experiment("study", file, "--out", folder / "study")
    wall = time.perf_counter() - began
    yield measured(
        "study of 2 plants x 2 controllers x 20 seeds of 5 s over DDS, recorded: simulated per wall time",
        400.0 / wall,
        "s/s",
        at_least=4.0,
        note=f"{wall:.0f} s, the start of the first nodes included",
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
    settings = MonteCarlo(runs=400_000, chunk=20_000)
    results, walls = {}, {}
    for workers in (1, 2):
        with cluster_client(workers=workers) as client:
            connect = partial(nullcontext, client)
            # Start and compilation happen once for each process, whatever the work: they are no question of scaling.
            client.run(run_chunk, replace(settings, runs=100, duration=0.1), 0, 1)
            began = time.perf_counter()
            results[workers] = run_monte_carlo(folder / f"dask_{workers}", settings, connect=connect)
            walls[workers] = time.perf_counter() - began
    if results[1] != results[2]:
        raise AssertionError("one worker and two gave different results")
    yield measured(
        "Dask, 4 x 10^5 runs: efficiency of two single-threaded workers, t1 / (2 t2)",
        walls[1] / (2.0 * walls[2]),
        "-",
        at_least=0.8,
        note=f"{walls[1]:.1f} s on one, {walls[2]:.1f} s on two, started and compiled before; the client, which writes "
        "Parquet and sums up, shares the two cores; the same bits",
    )
    lost = []
    with cluster_client(workers=2) as client:
        connect = partial(nullcontext, client)
        victim = max(client.run(os.getpid).values())

        def kill(done: int, total: int) -> None:
            if done == total // 3:
                os.kill(victim, signal.SIGKILL)
                lost.append(done)

        result = run_monte_carlo(folder / "dask_killed", settings, connect=connect, on_progress=kill)
        gone = victim not in client.run(os.getpid).values()
    if not lost or not gone:
        raise AssertionError("no worker was killed")
    same = all(
        (folder / "dask_killed" / path.name).read_bytes() == path.read_bytes()
        for path in (folder / "dask_1").glob("*.parquet")
    )
    yield measured(
        "Dask, one of two workers killed mid-run: runs lost",
        float(settings.runs - result["runs"]) if same and result == results[1] else float("nan"),
        "runs",
        at_most=0.0,
        note=f"SIGKILL after {lost[0]} of {settings.chunks} chunks; every Parquet file has the same bits",
    )
    yield from _bags_on_dask(folder)


def _bags_on_dask(folder: Path) -> Iterator[Row]:
    examples = Path(__file__).parents[2] / "bags" / "examples"
    for number in range(12):
        for side in ("sim", "hw"):
            shutil.copytree(examples / f"regulation_{side}", folder / "bags" / f"{number:02}" / side)
    pieces = find_pieces([folder / "bags"], ["metrics", "identify"])
    here = analyse_bags(folder / "analysed", pieces, ["metrics", "identify"])
    walls = {}
    for workers in (1, 2):
        with cluster_client(workers=workers) as client:
            connect = partial(nullcontext, client)
            warm = folder / f"warm_{workers}"
            for _ in range(workers):
                analyse_bags(warm, pieces[:2], ["metrics", "identify"], connect=connect)
                shutil.rmtree(warm)
            table = analyse_bags(folder / f"analysed_{workers}", pieces, ["metrics", "identify"], connect=connect)
        if table != here:
            raise AssertionError("a cluster and this process gave different tables")
        walls[workers] = table.wall
    yield measured(
        "Dask, metrics and identification of 24 bags: efficiency of two single-threaded workers",
        walls[1] / (2.0 * walls[2]),
        "-",
        note=f"{here.wall:.1f} s in one process, {walls[1]:.1f} s on one worker, {walls[2]:.1f} s on two; same bits",
    )


def _network(folder: Path) -> Iterator[Row]:
    what = "LQR upright, controller on another host: age of the commands at which the pendulum falls"
    reason = why_not()
    if reason:
        yield Row(what, "ms", note=reason)
        return
    report = find_delay_margin(folder / "network")
    yield measured(
        what,
        report.lost * 1e3,
        "ms",
        peer=peer("sampled linear analysis", lambda: report.predicted * 1e3),
        less_is_better=False,
        at_least=0.8 * report.predicted * 1e3,
        at_most=1.4 * report.predicted * 1e3,
        note=report.sentence(),
    )


def _region(folder: Path) -> Iterator[Row]:
    settings = RegionMap(plants=100)
    run_map(folder / "warm", replace(settings, plants=1, points=3, duration=0.1))
    began = time.perf_counter()
    result = run_map(folder / "region", settings)
    wall = time.perf_counter() - began
    if result.counterexamples or result.share_inside < 1.0:
        raise AssertionError("a start of the proven ellipse does not reach upright")
    yield measured(
        "region of attraction: 61 x 61 starts, 100 plants each, 8 s at 2 ms, written to Parquet",
        wall,
        "s",
        note=f"{settings.plants * result.share.size} runs; the proof of the ellipse is part of it",
    )


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
