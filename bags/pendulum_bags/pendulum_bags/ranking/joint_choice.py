"""Would the simulation have picked the right LQR for a plant of several joints? Its designs on both sides, by cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.joint_run import JointRun, JointSettings, design_file, fall_time
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.frequency_response.designs import Design
from pendulum_bags.ranking.contender import contenders_of
from pendulum_bags.ranking.ranking import Ranking, rank
from pendulum_msgs_py.contract.names import EFFORT_COMMAND, JOINT_STATES
from pendulum_msgs_py.errors import ParameterError, PlantStoppedError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism
from pendulum_rosbag.reader import read_bag

__all__ = ["COST", "DURATION", "FOLDER", "joint_cost_parts", "rank_joints", "rankable"]

FOLDER = "ranking"
"""Folder within a run folder that holds the recordings of all designs, and their ranking."""
COST = "Cost: mean of x' Q x + u' R u with the weights of the plant's own LQR, whatever design ran."
DURATION = 5.0
"""Longest noise of each run [s]."""
_LEAST = 3


def rankable(designs: Sequence[Design]) -> Sequence[Design]:
    """Return the designs, if they can be ranked.

    Raises:
        ParameterError: One is no LQR, two are the same, or there are too few.
    """
    for one in designs:
        if one.weights is None:
            raise ParameterError(f"design {one.text!r} is a gain; expected LQR weights, which the controller takes")
    if len({one.name for one in designs}) < max(_LEAST, len(designs)):
        raise ParameterError(
            f"got {len(designs)} designs, {len({one.name for one in designs})} of them different; expected at least "
            f"{_LEAST} to rank, each once"
        )
    return designs


def joint_cost_parts(bag: Path, namespace: str, plant: MechanismParameters) -> Array | None:
    """Return the parts of the mean cost of a run, shape (3,): positions, velocities and the controller's efforts.

    The weights are those of the plant's own LQR, whatever ran: one measure for all designs.

    Args:
        bag: The recording.
        namespace: Of the plant.
        plant: The plant of the design, for upright and weights.

    Returns:
        None where the plant fell.
    """
    with read_bag(bag) as opened:
        states = opened.joints(f"{namespace}/{JOINT_STATES}")
        commands = opened.joints(f"{namespace}/{EFFORT_COMMAND}")
    if fall_time(plant, states.stamp_ns, states.position) is not None:
        return None
    q, r = plant.mechanism.weights
    n = states.position.shape[1]
    deviation = np.array([plant.coordinates.deviation(tuple(position)) for position in states.position])
    parts = [
        np.mean(deviation**2, axis=0) @ np.array(q[:n]),
        np.mean(states.velocity**2, axis=0) @ np.array(q[n:]),
        r * float(np.sum(np.mean(commands.effort**2, axis=0))),
    ]
    return np.array(parts, dtype=np.float64)


def rank_joints(
    folder: Path,
    settings: JointSettings,
    machine: Path,
    designs: Sequence[Design],
    seeds: Sequence[int],
    *,
    hosts: HostPool | None = None,
    on_run: Callable[[str], None] = lambda what: None,
) -> Ranking:
    """Record every design on both sides under every seed, and return the ranking of their costs.

    Args:
        folder: Where the recordings go.
        settings: Plant and noise; the seed is taken from ``seeds``.
        machine: Plant file of the surrogate of the machine.
        designs: As :func:`rankable` returns them.
        seeds: Of the noise; one alone gives no interval.
        hosts: As for :func:`pendulum_bags.experiments.lockstep.record_run`.
        on_run: Called with the text of each run that starts.

    Raises:
        BagError: A bag exists, or cannot be written.
        DataError: Fewer than two designs hold the plant on both sides.
        FaultError: A program ended or did not respond.
    """
    plant = load_mechanism(settings.plant)
    folder.mkdir(parents=True, exist_ok=True)
    linearised = design_file(folder, plant)
    costs: dict[str, dict[str, list[tuple[int, Array | None]]]] = {}
    for number, design in enumerate(designs, 1):
        assert design.weights is not None
        tuning: dict[str, Any] = {"q": list(design.weights[0]), "r": design.weights[1]}
        rows = costs.setdefault(design.name, {"sim": [], "hw": []})
        for seed in seeds:
            own = replace(settings, controller="lqr", seed=seed, duration=min(settings.duration, DURATION))
            for side, runs in (("sim", settings.plant), ("hw", str(machine))):
                on_run(f"design {number} of {len(designs)}, {side}")
                bag = folder / f"design_{number}_seed_{seed}" / side
                run = JointRun(own, side, runs, linearised, tuning=tuning)
                try:
                    record_run(bag, run, hosts=hosts)
                except PlantStoppedError:
                    rows[side].append((seed, None))
                else:
                    rows[side].append((seed, joint_cost_parts(bag, run.namespace, plant)))
    return rank(contenders_of(costs))
