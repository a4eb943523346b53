"""The leaderboard for hardware: the nodes of a real X5-9, over DDS, with the emulated module.

Each run is in lockstep in a ROS domain of its own, so results are reproducible; programs stay loaded between runs. A
fault of the bridge is a failure with its reason.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.in_process import RunArrays
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.studies.leaderboard import HARDWARE, Entry, Run, entry_of, model_errors, push_trains
from pendulum_lqr.controllers.policy import START_TIME
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_rosbag.reader import read_bag

__all__ = ["HARDWARE_PERTURBATIONS", "arrays_of_bag", "evaluate_hardware"]

_PLANT = "thesis"
_STRATEGY = "direct_pwm"


def arrays_of_bag(bag: Path, namespace: str) -> RunArrays:
    """Return a recorded run as the board's arrays; a DataError if states and torques do not match."""
    with read_bag(bag) as opened:
        states = opened.array(f"{namespace}/{names.JOINT_STATES}")
        applied = opened.array(f"{namespace}/{names.APPLIED_EFFORT}")
    stamps, first = np.unique(states["stamp_ns"], return_index=True)
    states = states[first]
    common, at, where = np.intersect1d(stamps, applied["stamp_ns"], return_indices=True)
    if common.size < 10 or common.size < stamps.size - 2:
        raise DataError(f"bag {bag} has {stamps.size} states and torques for {common.size}; expected one for each")
    torque = np.zeros(stamps.size)
    torque[at] = applied["effort"][where]
    unknown = np.full(stamps.size, np.nan)
    return RunArrays(stamps, states["position"], states["velocity"], states["effort"], unknown, unknown, torque[:-1])


def _model_error(folder: Path, _duration: float) -> Sequence[Mapping[str, Any]]:
    # The controller is designed on a wrong model of the machine.
    found = []
    for number, changed in enumerate(model_errors(load_plant(_PLANT))):
        path = folder / f"design_{number}.yaml"
        write_plant(path, replace(changed, name=path.stem))
        found.append({"design_plant": str(path)})
    return found


HARDWARE_PERTURBATIONS: Mapping[str, Callable[[Path, float], Sequence[Mapping[str, Any]]]] = {
    "model_error": _model_error,
    "noise": lambda _, __: [{"seed": seed} for seed in (2, 3, 4)],
    "torque_response": lambda _, __: [{"strategy": strategy} for strategy in ("direct_pwm_compensated", "effort_loop")],
    "pushes": lambda _, duration: [{"disturbance": push} for push in push_trains(load_plant(_PLANT), duration)],
}
"""Kind of perturbation -> what it changes of the run. The machine has a delay of its own; seeds vary its noise."""


def evaluate_hardware(
    controller: str,
    *,
    parameters: Mapping[str, Any] | None = None,
    duration: float = 10.0,
    robustness: bool = True,
    hosts: HostPool | None = None,
) -> Entry:
    """Return the line of a controller for ``duration`` [s] from hanging to upright on the emulated machine."""
    spec: dict[str, Any] = {
        "side": "hw",
        "plant": _PLANT,
        "design_plant": _PLANT,
        "strategy": _STRATEGY,
        "controller": controller,
        # A bridge refuses to start with much torque, and a swing-up from hanging needs all of it.
        "controller_parameters": {"start_time": START_TIME, **(parameters or {})},
        "theta": 0.01,
        "duration": duration,
    }

    def perturbed(run: Callable[[RunSpec], RunArrays]) -> Iterator[tuple[str, Sequence[Run]]]:
        with tempfile.TemporaryDirectory(prefix="pendulum_board_") as folder:
            for kind, vary in HARDWARE_PERTURBATIONS.items() if robustness else ():
                yield kind, [partial(run, RunSpec(**{**spec, **change})) for change in vary(Path(folder), duration)]

    # Not the hosts of the parent process: lines are computed at once, in forks of it.
    with HostPool() if hosts is None else nullcontext(hosts) as pool:
        run = partial(_run, hosts=pool)
        return entry_of(HARDWARE, controller, lambda: run(RunSpec(**spec)), perturbed(run))


def _run(spec: RunSpec, hosts: HostPool) -> RunArrays:
    with tempfile.TemporaryDirectory(prefix="pendulum_board_") as folder, _any_domain():
        return arrays_of_bag(record_run(Path(folder, "bag"), spec, hosts=hosts), spec.namespace)


@contextmanager
def _any_domain() -> Iterator[None]:
    """Let a run find a free ROS domain."""
    own = os.environ.pop("ROS_DOMAIN_ID", None)
    try:
        yield
    finally:
        if own is not None:
            os.environ["ROS_DOMAIN_ID"] = own
