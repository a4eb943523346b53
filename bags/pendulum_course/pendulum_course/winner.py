"""Which of two controllers wins on the emulated machine: both run there under one noise, judged by theta."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from pendulum_bags.experiments.host_pool import HostPool, open_pool
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.runs.run_data import read_run
from pendulum_course.checks import WEIGHTS, Judgement
from pendulum_course.tasks import Tasks
from pendulum_msgs_py.errors import ParameterError, PlantStoppedError

__all__ = ["check_winner", "spread_on_machine"]

DURATION = 5.0
"""Length of each run [s]."""


def check_winner(tasks: Tasks, name: str, folder: Path, on_run: Callable[[str], None] = lambda name: None) -> Judgement:
    """Run both controllers on the emulated machine, and judge the predicted winner ``name``, a or b.

    ``on_run`` is called with a controller's name before it runs. A FaultError if a program failed.
    """
    weights = {"a": tasks.controller_a, "b": tasks.controller_b}
    if name not in weights:
        raise ParameterError(f"winner is {name!r}; expected a or b")
    spreads = {}
    with open_pool() as hosts:
        for letter, r in weights.items():
            on_run(letter)
            spreads[letter] = spread_on_machine(folder / letter, r, tasks.noise_seed, hosts)
    best = min(spreads, key=spreads.__getitem__)
    deviations = ", ".join(
        f"{letter.upper()} {f'leaves {value:.3g} rad' if math.isfinite(value) else 'drives the bridge into a fault'}"
        for letter, value in spreads.items()
    )
    return Judgement(name == best, f"on the emulated machine {deviations} (standard deviation of theta)")


def spread_on_machine(bag: Path, r: float, seed: int, hosts: HostPool | None = None) -> float:
    """Return the standard deviation of theta of an LQR on the emulated machine under noise of 2.5 N m [rad].

    ``r`` is R [1/(N m)^2], ``seed`` of the noise. Returns inf if the bridge faults, which counts as a loss.
    """
    spec = RunSpec(
        side="hw",
        controller="lqr",
        controller_parameters={"q": list(WEIGHTS), "r": r},
        disturbance={"kind": "uniform", "amplitude": 2.5, "hold_time": 0.01, "duration": DURATION},
        duration=DURATION,
        seed=seed,
    )
    try:
        recorded = record_run(bag, spec, hosts=hosts)
    except PlantStoppedError as error:
        # Only the bridge's own fault is a result.
        if error.mode == "fault":
            return math.inf
        raise
    return float(read_run(recorded).window.position.std(ddof=1))
