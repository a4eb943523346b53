"""Position trajectories: the thesis's smooth ramp, and interpolation between points."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field

from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "MAX_POSITION",
    "MAX_RAMP_STEPS",
    "MAX_RAMP_VELOCITY",
    "MAX_TRAJECTORY_POINTS",
    "RAMP_INCREMENT",
    "RAMP_PERIOD",
    "Trajectory",
    "TrajectoryPoint",
    "thesis_ramp",
]

RAMP_INCREMENT = 0.002
"""Position step of the thesis's ramp [rad]."""
RAMP_PERIOD = 0.01
"""Time between two steps of the ramp, 100 Hz [s]."""
MAX_RAMP_VELOCITY = 0.3
"""Amplitude of the half-sine of commanded velocity [rad/s]."""
MAX_POSITION = 1e6
"""Largest position [rad]: differences of larger ones lose precision."""
MAX_RAMP_STEPS = 1_000_000
"""Longest ramp, 2.8 h at 100 Hz: a wrong unit must not fill the memory."""
MAX_TRAJECTORY_POINTS = 20_000
"""Most points in one message, 200 s at 100 Hz: reading more would block the plant."""


@dataclass(frozen=True, slots=True)
class TrajectoryPoint:
    """One point of a trajectory: time from its start [s], position [rad], velocity [rad/s]."""

    time: float
    position: float
    velocity: float


@dataclass(frozen=True)
class Trajectory:
    """Points at increasing times, with linear interpolation of position and velocity.

    Linear, not cubic: the thesis commands a linear ramp and a half sine that is not its derivative. ``lowest`` and
    ``highest`` are positions [rad]; ``max_speed`` is the largest, as commanded or as the positions imply [rad/s].
    """

    points: tuple[TrajectoryPoint, ...]
    lowest: float = field(init=False, repr=False, compare=False)
    highest: float = field(init=False, repr=False, compare=False)
    max_speed: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.points:
            raise ParameterError("trajectory has 0 points; expected at least one")
        previous = -math.inf
        for index, point in enumerate(self.points):
            if not (math.isfinite(point.time) and math.isfinite(point.position) and math.isfinite(point.velocity)):
                raise ParameterError(f"trajectory point {index} is {point}; expected finite numbers")
            if abs(point.position) > MAX_POSITION:
                raise ParameterError(
                    f"trajectory point {index} is at {point.position} rad; expected at most {MAX_POSITION:g} rad"
                )
            if point.time < 0.0 or point.time <= previous:
                least = f"later than {previous} s" if index else ">= 0 s"
                raise ParameterError(f"trajectory point {index} is at {point.time} s; expected {least}")
            previous = point.time
        positions = [point.position for point in self.points]
        speed = max(abs(point.velocity) for point in self.points)
        for before, after in zip(self.points, self.points[1:], strict=False):
            speed = max(speed, abs(after.position - before.position) / (after.time - before.time))
        for name, value in (("lowest", min(positions)), ("highest", max(positions)), ("max_speed", speed)):
            object.__setattr__(self, name, value)

    @property
    def duration(self) -> float:
        """Time of the last point [s]."""
        return self.points[-1].time

    @property
    def start(self) -> float:
        """First position [rad]."""
        return self.points[0].position

    @property
    def goal(self) -> float:
        """Last position [rad]."""
        return self.points[-1].position

    def from_position(self, position: float) -> Trajectory:
        """Return the trajectory from a joint position [rad] to a first point that lies ahead in time.

        So does ``joint_trajectory_controller`` of ros2_control. A single point at rest is reached on half a cosine,
        whose velocity does not jump; the first of several points linearly.
        """
        first = self.points[0]
        if first.time == 0.0:
            return self
        start = TrajectoryPoint(0.0, position, 0.0)
        if len(self.points) > 1 or first.velocity != 0.0:
            return Trajectory((start, *self.points))
        steps = min(MAX_TRAJECTORY_POINTS, max(2, math.ceil(first.time / RAMP_PERIOD)))
        distance = first.position - position
        phases = [math.pi * index / steps for index in range(1, steps)]
        between = tuple(
            TrajectoryPoint(
                first.time * phase / math.pi,
                position + 0.5 * distance * (1.0 - math.cos(phase)),
                0.5 * distance * math.pi / first.time * math.sin(phase),
            )
            for phase in phases
        )
        return Trajectory((start, *between, first))

    def at(self, time: float) -> tuple[float, float]:
        """Return position [rad] and velocity [rad/s] at a time from the start [s]; at rest before and after."""
        if time < self.points[0].time:
            return self.points[0].position, 0.0
        if time >= self.duration:
            # At the end the hold begins: the thesis then commands a velocity of zero.
            return self.goal, 0.0
        index = bisect.bisect_right(self.points, time, key=lambda point: point.time)
        before, after = self.points[index - 1], self.points[index]
        share = (time - before.time) / (after.time - before.time)
        return (
            before.position + share * (after.position - before.position),
            before.velocity + share * (after.velocity - before.velocity),
        )


def thesis_ramp(
    start: float,
    goal: float,
    *,
    increment: float = RAMP_INCREMENT,
    period: float = RAMP_PERIOD,
    max_velocity: float = MAX_RAMP_VELOCITY,
) -> Trajectory:
    """Return the thesis's smooth move: positions in steps of 0.002 rad at 100 Hz, velocity half a sine.

    Positions and ``increment`` > 0 in [rad], ``period`` > 0 between two steps in [s]; ``max_velocity`` >= 0 is the
    amplitude of the sine [rad/s], smaller for a short move.

    Raises:
        ParameterError: A value is outside its domain, or the ramp has more than ``MAX_RAMP_STEPS`` steps.

    Source:
        Thesis, section "Determination of Gravitational force coefficient of the system".
    """
    for name, value in (
        ("start", start),
        ("goal", goal),
        ("increment", increment),
        ("period", period),
        ("max_velocity", max_velocity),
    ):
        if not math.isfinite(value):
            raise ParameterError(f"ramp {name} is {value}; expected a finite number")
    if increment <= 0.0 or period <= 0.0:
        raise ParameterError(f"ramp increment is {increment} rad and period {period} s; expected both > 0")
    if max_velocity < 0.0:
        raise ParameterError(f"ramp max_velocity is {max_velocity} rad/s; expected >= 0")
    distance = goal - start
    if not abs(distance) / increment < MAX_RAMP_STEPS:
        raise ParameterError(
            f"ramp from {start} to {goal} rad in steps of {increment} rad is too long; "
            f"expected fewer than {MAX_RAMP_STEPS} steps"
        )
    steps = max(1, math.ceil(abs(distance) / increment - 1e-9))
    # The mean of a half sine is 2/pi of its peak: no more speed than the move needs.
    peak = min(max_velocity, 0.5 * math.pi * abs(distance) / (steps * period))
    direction = math.copysign(1.0, distance) if distance else 0.0
    return Trajectory(
        tuple(
            TrajectoryPoint(
                time=index * period,
                position=start + distance * index / steps,
                velocity=direction * peak * math.sin(math.pi * index / steps),
            )
            for index in range(steps + 1)
        )
    )
