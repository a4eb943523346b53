"""The batch engine's loops on a GPU, one plant a thread: the same compiled functions in a kernel of a few lines.

Double precision, as on the processor; results differ by rounding alone, where the compilers fuse other products and
sums, or take another sine. Plants are sent in parts, two of them at a time, so that copies run beside the computation
and the memory of the GPU does not limit the size of a batch.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib import import_module
from threading import Lock
from typing import Any

import numba
import numpy as np
from numba import cuda

from pendulum_sim.batches.batch_kernels import Layout, lane

__all__ = ["run_gpu"]

_THREADS = 128
"""Threads of a block."""
_PART = 1 << 21
"""Most plants in a part: they keep all multiprocessors busy."""
_SHARE_OF_MEMORY = 0.4
"""Most of the free memory that a part may take; two are there at a time."""
_LAUNCH = Lock()
"""Held for a launch: the first one compiles, which one thread does for all."""
_SIMULATED = bool(numba.config.ENABLE_CUDASIM)
if not _SIMULATED:
    # A batch may be small: numba would warn of each.
    import_module("numba.cuda.dispatcher").config.CUDA_LOW_OCCUPANCY_WARNINGS = 0


@cache
def _kernel(layout: Layout, smooth: bool) -> Any:
    """Return the kernel of plants of a layout."""
    compiled = lane(layout, smooth=smooth, gpu=not _SIMULATED)

    def simulated(w: Any, seed: Any, *others: Any) -> None:
        # The loop runs on the processor, and the simulator's arrays are not of numpy.
        compiled(w, seed, *others[:4], *(array._item._ary for array in others[4:]))

    run = simulated if _SIMULATED else compiled
    rows, wanted = layout.starts["end"], layout.starts["results"]

    @cuda.jit
    def kernel(
        constants: Any, source: Any, varied: Any, seeds: Any, results: Any, dt: float, steps: int, hold: int,
        substeps: int, record: Any, lines: Any,
    ) -> None:  # fmt: skip
        i = cuda.grid(1)
        if i < results.shape[1]:
            w = cuda.local.array(rows, numba.float64)
            for row in range(rows):
                w[row] = constants[row] if source[row] < 0 else varied[source[row], i]
            seed = seeds[min(i, seeds.size - 1)]
            run(w, seed, dt, steps, hold, substeps, record[:, :, i : i + 1], lines[:, :, i])
            for row in range(wanted):
                results[row, i] = w[row]

    return kernel


def run_gpu(
    layout: Layout,
    smooth: bool,
    table: tuple[Any, Any, list[Any], Any, Any],
    timing: tuple[float, int, int, int],
    record: Any,
    depth: int,
) -> None:
    """Run a batch on the GPU.

    Args:
        layout: Of its plants.
        smooth: As of :func:`pendulum_sim.batches.batch_kernels.loop`.
        table: Values of all rows that all plants share, where each other row is found, those rows, seeds and results.
        timing: Step [s], steps, steps of a noise sample, sub-steps.
        record: Where the trajectories go, shape (steps or 0, 3 n, B).
        depth: Entries of the delay line; 0 without one.
    """
    constants, source, varied, seeds, results = table
    joints, size = len(layout.turns), results.shape[1]
    each = 8 * (len(varied) + 1 + len(results) + record.shape[0] * record.shape[1] + depth * joints)
    most = size if _SIMULATED else int(_SHARE_OF_MEMORY * cuda.current_context().get_memory_info().free / each)
    part = max(1, min(size, _PART, most))

    def run(first: int) -> None:
        last = min(first + part, size)
        count = last - first
        stream = cuda.stream()
        rows = cuda.device_array((len(varied), count), np.float64, stream=stream)
        for row, values in enumerate(varied):
            rows[row].copy_to_device(np.ascontiguousarray(values[first:last]), stream=stream)
        own = seeds if len(seeds) == 1 else seeds[first:last]
        sent = [cuda.to_device(values, stream=stream) for values in (constants, source)]
        out = cuda.device_array((len(results), count), np.float64, stream=stream)
        motion = cuda.device_array((*record.shape[:2], count), np.float64, stream=stream)
        lines = cuda.device_array((depth, joints, count), np.float64, stream=stream)
        sent.append(rows)
        sent.append(cuda.to_device(own, stream=stream))
        with _LAUNCH:
            launch = _kernel(layout, smooth)[-(-count // _THREADS), _THREADS, stream]
            launch(*sent, out, *timing, motion, lines)
        for row, values in enumerate(results):
            out[row].copy_to_host(values[first:last], stream=stream)
        recorded = motion.copy_to_host(stream=stream) if len(record) else 0.0
        stream.synchronize()
        record[:, :, first:last] = recorded

    with ThreadPoolExecutor(1 if _SIMULATED else 2) as pool:
        # All are waited for, and what one raises is raised here.
        list(pool.map(run, range(0, size, part)))
