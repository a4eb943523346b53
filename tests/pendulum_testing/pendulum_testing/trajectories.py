"""Trajectories as tests write them: by columns."""

from __future__ import annotations

from collections.abc import Sequence

from pendulum_msgs_py.contract.trajectory import Trajectory, TrajectoryPoint

__all__ = ["from_points"]


def from_points(times: Sequence[float], positions: Sequence[float], velocities: Sequence[float]) -> Trajectory:
    """Return a trajectory from sequences of one length: times [s], positions [rad], velocities [rad/s]."""
    points = zip(times, positions, velocities, strict=True)
    return Trajectory(tuple(TrajectoryPoint(*point) for point in points))
