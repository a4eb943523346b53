"""What a controller of several joints costs, as the plant's own LQR counts it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.arrays import Array
from pendulum_bags.experiments.joint_run import fall_time
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_msgs_py.contract.names import JOINT_STATES
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_rosbag.reader import read_bag

__all__ = ["COST", "cost_of_motion", "joint_cost_parts"]

COST = "Cost: mean of x' Q x + u' R u with the weights of the plant's own LQR, whatever design ran."


def joint_cost_parts(place: Path, spec: RunSpec) -> Array | None:
    """Return the parts of the mean cost of a run in a folder, shape (3,); None where the plant fell.

    The weights are those of the plant's own LQR, whatever ran: one measure for all controllers.
    """
    plant = load_mechanism(spec.design_plant)
    if (place / "run.npz").is_file():
        with np.load(place / "run.npz") as arrays:
            stamps, position, velocity = (arrays[name] for name in ("stamp_ns", "position", "velocity"))
            effort = arrays["command"]
    else:
        with read_bag(place / "bag") as opened:
            states = opened.joints(f"{spec.namespace}/{JOINT_STATES}")
            effort = opened.joints(f"{spec.namespace}/{plant.coordinates.topics.command}").effort
        stamps, position, velocity = states.stamp_ns, states.position, states.velocity
    return cost_of_motion(plant, stamps, position, velocity, effort)


def cost_of_motion(
    plant: PlantParameters, stamps: NDArray[np.int64], position: Array, velocity: Array, effort: Array
) -> Array | None:
    """Return the parts of the mean cost of a motion, shape (3,), by the plant's LQR; None where the plant fell.

    Stamps have shape (s,) [ns], position and velocity (s, n) [rad or m, /s], commands (e, m).
    """
    if fall_time(plant, stamps, position) is not None:
        return None
    q, r = plant.weights
    n = position.shape[1]
    deviation = np.array([plant.coordinates.deviation(tuple(row)) for row in position])
    parts = [
        np.mean(deviation**2, axis=0) @ np.array(q[:n]),
        np.mean(velocity**2, axis=0) @ np.array(q[n:]),
        r * float(np.sum(np.nanmean(effort**2, axis=0))),
    ]
    return np.array(parts, dtype=np.float64)
