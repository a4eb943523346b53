"""The compiler's process: ``python -m pendulum_msgs_py.loops.compile_loop FILE MODULE:BUILDER [CHOICE ...]``.

Without arguments it caches the loops of the thesis's experiment, so that no program has to wait for them.
"""

from __future__ import annotations

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pendulum_msgs_py.loops.machine_code import NoMachineCodeError, compile_loop, keep_loop

__all__ = ["COMMON"]

COMMON = (
    ("pendulum_sim.simulator.loop_kernel:rigid_loop", "etd4"),
    ("pendulum_sim.simulator.loop_kernel:rigid_loop", "euler"),
    ("pendulum_lqr.nodes.controller_kernel:law_loop", "pendulum_lqr.controllers.lqr:lqr_law"),
    ("pendulum_lqr.disturbances.disturbance_kernel:uniform_loop",),
    ("pendulum_hw_bridge.emulation.kernel_loop:actuator_loop",),
)
"""Plant (default and thesis's integrator), controller, noise and emulated actuator of the thesis's experiment."""


def _keep_common() -> None:
    def keep(loop: tuple[str, ...]) -> None:
        try:
            keep_loop(*loop)
        # Programs report this themselves, and run interpreted.
        except NoMachineCodeError as error:
            print(f"note: {' '.join(loop)} is not compiled: {error}", file=sys.stderr)

    began = time.monotonic()
    # Each is compiled by a process of its own.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(keep, COMMON))
    if (spent := time.monotonic() - began) > 1.0:
        print(f"compiled the loops of {len(COMMON)} programs in {spent:.0f} s")


if __name__ == "__main__":
    if len(sys.argv) == 1:
        _keep_common()
    else:
        compile_loop(Path(sys.argv[1]), *sys.argv[2:])
