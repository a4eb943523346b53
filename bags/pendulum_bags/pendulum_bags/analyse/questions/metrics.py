"""What a controller did in a recording: spread, damage, control metrics."""

from __future__ import annotations

from typing import Any

from pendulum_bags.comparison import read_run
from pendulum_bags.comparison.metrics import episode_of, metrics_of
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.run_data import joints_of, plant_summary
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_rosbag.reader import read_bag

__all__ = ["answer"]


def answer(path: Reading, plant: str) -> dict[str, Any]:
    """Return spread, damage and metrics of a plant in a recording, by name."""
    set_point: Any = 0.0
    if path.has_states:
        with read_bag(path) as bag:
            set_point = run_record(bag.metadata).get("set_point", 0.0)
    # A recording without noise has no window: all of it is what the controller did.
    if joints := joints_of(path, plant):
        # What upright is for each joint is not in the bag, so that there is no error to measure.
        runs = {joint: read_run(path, prefix=plant, joint=joint, or_all=True) for joint in joints}
        figures = {joint: plant_summary(run) for joint, run in runs.items()}
        whole = {name: figures[joints[0]][name] for name in ("rate_hz", "samples", "duration_s", "missed_deadlines")}
        of_joints = ("std_theta", "std_theta_dot", "mean_theta", "max_abs_u", "rms_u")
        return whole | {f"{joint}.{name}": figures[joint][name] for joint in joints for name in of_joints}
    run = read_run(path, prefix=plant, or_all=True)
    goal = UPRIGHT + (float(set_point) if isinstance(set_point, (int, float)) else 0.0)
    found = plant_summary(run)
    found["damage"] = "; ".join(found["damage"])
    return {**found, **metrics_of(episode_of(run.window, goal))}
