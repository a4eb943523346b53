"""Scale: the batch engine by threads and on a GPU; rows of hardware that is not here say so."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator

import numpy as np

from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.batches.devices import resolve_device
from tests.benchmarks import Peer, Row, measured, peer
from tests.benchmarks.bench_sim import GAIN

__all__ = ["rows"]

STEPS = 2500
_CORES = 16
_ACROBOT_GAIN = [[-295.0, -124.0, -63.0, -28.5]]


def rows() -> Iterator[Row]:
    """Yield all rows; each figure on a GPU only after a comparison with the processor."""
    cores = len(os.sched_getaffinity(0))
    one, every = (_speed(_link("euler"), 65_536, threads=threads) for threads in (1, cores))
    what = f"batch, Euler 2 ms, {cores} threads"
    target = 10.0 if cores >= _CORES else None
    note = "" if target else f"the target of 10 x holds for {_CORES} cores; here are {cores}"
    yield measured(what, every, "steps/s", peer=Peer("one thread", one), at_least_times_peer=target, note=note)
    if resolve_device("auto") == "cpu":
        yield Row(what="batch on a GPU", note="skipped: numba finds no CUDA GPU here")
        return
    for name, run, count in (
        ("Euler", _link("euler"), 1 << 22),
        ("etd4", _link("etd4"), 1 << 22),
        ("acrobot, RK4", _acrobot, 1 << 20),
    ):
        _check(run)
        processor = peer(f"{cores} threads", lambda run=run: _speed(run, 65_536))  # type: ignore[misc]
        yield measured(f"batch on a GPU, {name} 2 ms", _speed(run, count, device="cuda"), "steps/s", peer=processor)


def _link(method: str) -> Callable[..., np.ndarray]:
    def run(count: int, **options: object) -> np.ndarray:
        seeds, plant = np.arange(count), load_plant("thesis")
        return simulate_batch(
            plant,
            steps=STEPS,
            method=method,
            gain=GAIN,
            seeds=seeds,
            amplitude=2.5,
            **options,  # type: ignore[arg-type]
        ).position

    return run


def _acrobot(count: int, **options: object) -> np.ndarray:
    plant = load_mechanism("acrobot_frictionless")
    return simulate_batch(
        plant,
        steps=STEPS,
        gain=_ACROBOT_GAIN,
        seeds=np.arange(count),
        amplitude=0.5,
        **options,  # type: ignore[arg-type]
    ).position


def _check(run: Callable[..., np.ndarray]) -> None:
    worst = float(np.abs(run(1024, device="cuda") - run(1024)).max())
    if not worst < 1e-9:
        raise AssertionError(f"GPU and processor differ by {worst} rad; expected less than 1e-9")


def _speed(run: Callable[..., np.ndarray], count: int, **options: object) -> float:
    """Return steps a second of the best of three whole calls, copies included, after one that compiles."""
    times = []
    for _ in range(4):
        begin = time.perf_counter()
        run(count, **options)
        times.append(time.perf_counter() - begin)
    return count * STEPS / min(times[1:])
