"""Pictures of plants from the points of their chain, for environments, viewer and pages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.contract.joints import Joint, Vector
from pendulum_msgs_py.mechanisms.mechanism import Point
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_sim.pictures.canvas import BACKGROUND, BOB, DISTURBANCE, GREY, INK, LINK, TORQUE, Colour, Picture
from pendulum_sim.pictures.joint_frames import JointFrame, full_effort, joint_frames

__all__ = ["PlantPicture"]

_LINKS = (LINK, BOB)
_LINES = 20, 26
"""Lines of text in a picture of one joint, and of several."""
_RAIL = 10.0
"""Half the length of a rail without stops [m]."""


class PlantPicture(Picture):
    """Draws a plant from the side, or in space from above; driven joints are filled, passive ones open."""

    def __init__(self, parameters: PlantParameters, size: tuple[int, int] = (600, 600), *, trail: int = 60) -> None:
        super().__init__(size, trail=trail, lines=_LINES[len(parameters.joints) > 1])
        self.parameters = parameters
        self._joints = parameters.mechanism.joints
        self._slides = self._joints[0].unit == "m"
        self._in_space = parameters.mechanism.in_space
        still = (0.0,) * len(self._joints)
        points = parameters.mechanism.chain(still, parameters.packed)
        reach = sum(math.dist(first, second) for first, second in pairwise(points))
        self._ends = tuple(stop if math.isfinite(stop) else math.copysign(_RAIL, stop) for stop in parameters.stops[0])
        width, height = self.canvas.get_size()
        self._origin = np.array([0.5 * width, 0.52 * height])
        self._length = 0.36 * min(width, height)
        self._scale = self._length / reach
        if self._slides:
            track = max((abs(stop) for stop in parameters.stops[0] if math.isfinite(stop)), default=0.0)
            self._scale = min(self._length / reach, 0.45 * width / max(1.2 * reach, track))

    def draw(
        self,
        position: Vector,
        *,
        velocity: Vector = (),
        effort: Mapping[str, float] | None = None,
        disturbance: Mapping[str, float] | None = None,
        time: float | None = None,
        note: str | None = None,
    ) -> None:
        """Draw the plant at n positions [rad or m].

        Args:
            position: The positions.
            velocity: n velocities as text; empty for none.
            effort: Efforts of driven joints by name, drawn as arcs, of a cart as an arrow [N m or N].
            disturbance: Pushes on joints by name, drawn as arrows at the ends of their links [N m or N].
            time: Time as text [s]; None for none.
            note: A line of text; None for the plant's name.
        """
        self.canvas.fill(BACKGROUND)
        mechanism = self.parameters.mechanism
        chain = mechanism.chain(position, self.parameters.packed)
        self._trail.append(chain)
        if self._slides:
            self._draw_rail()
        elif self._in_space:
            self._draw_circle(self._pixel)
        else:
            self.draw_dial(self._origin, self._length)
        self.draw_trail([self._pixel(points[-1]) for points in self._trail], 0.045 * self._length)
        frames = joint_frames(self.parameters, position)
        self._draw_links([self._pixel(point) for point in chain])
        given, pushed = effort or {}, disturbance or {}
        for index, (joint, frame) in enumerate(zip(self._joints, frames, strict=True)):
            largest = full_effort(self.parameters, index)
            self._draw_effort(joint, frame, given.get(joint.name, 0.0) / largest)
            self._draw_disturbance(joint, frame, pushed.get(joint.name, 0.0) / largest)
        if self._in_space:
            self._draw_from_above(chain)
        rows = self._rows(position, velocity, given, pushed)
        rows = rows if time is None else [(f"{time:.3f} s", INK), *rows]
        self.draw_text(rows, self.parameters.name if note is None else note)
        self.finish()

    # --- parts ---------------------------------------------------------------------------------------------

    def _draw_rail(self) -> None:
        line, thick = self.pygame.draw.line, 0.022 * self._length
        left, right = (self._pixel((end, 0.0, 0.0)) for end in self._ends)
        line(self.canvas, GREY, left, right, max(2, round(thick)))
        for end, stop in zip((left, right), self.parameters.stops[0], strict=True):
            if math.isfinite(stop):
                tall = np.array([0.0, 4.0 * thick])
                line(self.canvas, INK, end - tall, end + tall, max(3, round(1.5 * thick)))

    def _draw_circle(self, pixel: Any) -> None:
        """Draw the circle of an arm's end, and its position 0."""
        start, end, *_ = self.parameters.mechanism.chain((0.0,) * len(self._joints), self.parameters.packed)
        arm = math.dist(start, end)
        ring = [
            pixel((arm * math.cos(turn), arm * math.sin(turn), 0.0)) for turn in np.linspace(0.0, 2.0 * math.pi, 73)
        ]
        self.pygame.draw.lines(self.canvas, GREY, False, ring, max(2, round(0.01 * self._length)))
        self.pygame.draw.circle(self.canvas, GREY, ring[0], 0.015 * self._length)

    def _draw_links(self, points: list[NDArray[np.float64]]) -> None:
        draw, length = self.pygame.draw, self._length
        if self._slides:
            cart = self.pygame.Rect(0, 0, 0.36 * length, 0.18 * length)
            cart.center = tuple(points[0])
            draw.rect(self.canvas, _LINKS[0], cart, border_radius=round(0.03 * length))
        # A cart has no link: its pole is the second.
        first = 1 if self._slides else 0
        for index, (start, end) in enumerate(pairwise(points), first):
            self._draw_link(start, end, _LINKS[index % 2], 0.028 * length)
        driven = self.parameters.coordinates.driven
        for index, point in enumerate(points[: len(self._joints) - first], first):
            draw.circle(self.canvas, INK, point, 0.055 * length)
            draw.circle(self.canvas, BACKGROUND, point, (0.022 if index in driven else 0.042) * length)
        draw.circle(self.canvas, BOB, points[-1], (0.08 if len(self._joints) > 1 else 0.1) * length)

    def _draw_link(self, start: Any, end: Any, colour: Colour, half: float) -> None:
        along = end - start
        reach = float(np.hypot(*along))
        if reach > 0.0:
            across = half * np.array([-along[1], along[0]]) / reach
            corners = [start + across, end + across, end - across, start - across]
            self.pygame.draw.polygon(self.canvas, colour, corners)

    def _draw_effort(self, joint: Joint, frame: JointFrame, share: float) -> None:
        origin = self._pixel(frame.origin)
        if joint.unit == "m":
            # Below the cart, where neither pole nor disturbance hides it.
            low = origin + np.array([0.0, 0.16 * self._length])
            self.draw_force(low, self._pixel(frame.origin + frame.axis) - origin, share, self._length)
            return
        radius = 0.27 * self._length / self._scale
        right, up = (self._pixel(frame.origin + radius * way) - origin for way in (frame.right, frame.up))
        self.draw_arc(origin, right, up, share, self._length)

    def _draw_disturbance(self, joint: Joint, frame: JointFrame, share: float) -> None:
        origin = self._pixel(frame.tip)
        way = frame.axis if joint.unit == "m" else np.cross(frame.axis, frame.tip - frame.origin)
        self.draw_arrow(origin, self._pixel(frame.tip + way) - origin, share, self._length)

    def _draw_from_above(self, chain: tuple[Point, ...]) -> None:
        """Draw a spatial plant small, from above too: from the side, an arm along the view is a point."""
        width, height = self.canvas.get_size()
        middle, scale = np.array([width - 0.5 * self._length, height - 0.55 * self._length]), 0.5 * self._scale

        def pixel(point: Any) -> NDArray[np.float64]:
            return middle + scale * np.array([point[0], -point[1]])

        self._draw_circle(pixel)
        points = [pixel(point) for point in chain]
        for index, (start, end) in enumerate(pairwise(points)):
            self._draw_link(start, end, _LINKS[index % 2], 0.014 * self._length)
        self.pygame.draw.circle(self.canvas, INK, points[0], 0.03 * self._length)
        self.pygame.draw.circle(self.canvas, BOB, points[-1], 0.04 * self._length)

    def _rows(
        self, position: Vector, velocity: Vector, effort: Mapping[str, float], disturbance: Mapping[str, float]
    ) -> list[tuple[str, Colour]]:
        rows: list[tuple[str, Colour]] = []
        if len(self._joints) == 1:
            rows = [(f"theta {position[0]:+.4f} rad", INK), (f"from upright {from_upright(position[0]):+.4f} rad", INK)]
            rows += [(f"theta' {value:+.3f} rad/s", INK) for value in velocity]
            rows += [(f"torque {value:+.3f} N m", TORQUE) for value in effort.values()]
            return rows + [(f"disturbance {value:+.3f} N m", DISTURBANCE) for value in disturbance.values() if value]
        for index, (joint, value) in enumerate(zip(self._joints, position, strict=True)):
            speed = f", {velocity[index]:+.3f} {joint.velocity_unit}" if velocity else ""
            rows.append((f"{joint.name} {value:+.4f} {joint.unit}{speed}", INK))
        rows += [
            (f"{joint.name} {effort[joint.name]:+.3f} {joint.effort_unit}", TORQUE)
            for joint in self._joints
            if joint.name in effort
        ]
        rows += [
            (f"disturbance {joint.name} {disturbance[joint.name]:+.3f} {joint.effort_unit}", DISTURBANCE)
            for joint in self._joints
            if disturbance.get(joint.name)
        ]
        return rows

    def _pixel(self, point: Any) -> NDArray[np.float64]:
        x, height = self.parameters.mechanism.seen((point[0], point[1], point[2]))
        return self._origin + self._scale * np.array([x, -height])
