"""``viewer``: show any plant's ``joint_states`` in a window, as PNG or as GIF."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS, JointSample
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import (
    command_from_bytes,
    fields_from_bytes,
    plant_mode,
    plant_value,
    sample_from_bytes,
)
from pendulum_msgs_py.ros.parameters import NodeParameters
from pendulum_msgs_py.ros.runner import run_node
from pendulum_msgs_py.ros.timers import create_wall_timer
from pendulum_sim.pictures.drawing import Window, save_gif, save_png
from pendulum_sim.pictures.plant_picture import PlantPicture
from pendulum_sim.pictures.shown_plant import ShownPlant, shown_pendulum
from pendulum_sim.pictures.shown_torques import SHOWN_TOPICS, ShownTorques

__all__ = ["SPECS", "ViewerNode", "main"]

SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("window", True, "", "Open a window; without one, PNG and GIF are still written.", read_only=True),
    ParameterSpec("width", 600, "px", "Width of the picture.", minimum=120, maximum=4096, read_only=True),
    ParameterSpec("height", 600, "px", "Height of the picture.", minimum=120, maximum=4096, read_only=True),
    ParameterSpec("fps", 30.0, "Hz", "Pictures per second.", minimum=1.0, maximum=120.0, read_only=True),
    ParameterSpec(
        "effort_scale", 13.0, "N m", "Torque at which the arc is full; with several joints it is each motor's limit.",
        minimum=0.0, exclusive_minimum=True, read_only=True,
    ),
    ParameterSpec("trail", 60, "-", "Positions that the trail shows.", minimum=1, maximum=1000, read_only=True),
    ParameterSpec("png", "", "", "File for a picture at the end and on ~/snapshot; empty for none.", read_only=True),
    ParameterSpec(
        "gif", "", "", "File for an animation of the last seconds, at the end; empty for none.", read_only=True
    ),
    ParameterSpec(
        "gif_fps", 12.5, "Hz", "Pictures per second of the animation.", minimum=1.0, maximum=50.0, read_only=True
    ),
    ParameterSpec("gif_duration", 8.0, "s", "Length of the animation.", minimum=0.1, maximum=60.0, read_only=True),
    ParameterSpec("duration", 0.0, "s", "Time after which to end; 0 for never.", minimum=0.0, read_only=True),
)  # fmt: skip
_DISTURBING = (names.DISTURBANCE, names.PUSH)


class ViewerNode(Node):
    """Shows a plant, publishes nothing; a ParameterError without a display for its window."""

    def __init__(self, stop: Callable[[], None]) -> None:
        super().__init__("viewer")
        self._stop = stop
        values = NodeParameters(self, SPECS).values
        self._values = values
        self._topic = self.resolve_topic_name(names.JOINT_STATES)
        self._namespace = self._topic.rpartition("/")[0]
        pendulum = shown_pendulum(values["effort_scale"])
        self._plant = ShownPlant(self._topic, pendulum)
        self._size: tuple[int, int] = (values["width"], values["height"])
        self._picture = PlantPicture(pendulum, self._size, trail=values["trail"])
        self._window = Window(self._size, self._topic) if values["window"] else None
        self._sample: JointSample | None = None
        self._start_ns: int | None = None
        self._torques = ShownTorques()
        self._drawn = 0
        self._every = max(1, round(values["fps"] / values["gif_fps"]))
        kept = max(1, round(values["gif_duration"] * values["fps"] / self._every)) if values["gif"] else 1
        self._frames: deque[NDArray[np.uint8]] = deque(maxlen=kept)
        self.create_subscription(JointState, names.JOINT_STATES, self._on_state, qos.NEWEST_STATE, raw=True)
        self.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)
        for topic in SHOWN_TOPICS:
            self.create_subscription(JointState, topic, self._receiver(topic), qos.NEWEST_STATE, raw=True)
        self.create_service(Trigger, "~/snapshot", self._on_snapshot)
        create_wall_timer(self, 1.0 / values["fps"], self._on_timer)
        if values["duration"] > 0.0:
            create_wall_timer(self, values["duration"], stop)

    def close(self) -> None:
        """Write the files, close the window."""
        self._draw()
        if self._values["png"]:
            save_png(self._values["png"], self._picture.array())
        if self._values["gif"] and self._frames:
            save_gif(self._values["gif"], list(self._frames), self._values["fps"] / self._every)
        if self._window is not None:
            self._window.close()

    # --- callbacks -----------------------------------------------------------------------------------------

    def _on_state(self, data: bytes) -> None:
        fields = fields_from_bytes(data)
        if fields is None:
            return
        joints = self._plant.joints
        self._plant.take_names(fields.joints)
        if joints != self._plant.joints:
            self._sample = None
        sample = sample_from_bytes(data, self._plant.joints)
        if sample is None or not sample.is_finite():
            return
        if self._sample is None or self._start_ns is None or sample.stamp_ns < self._start_ns:
            # A first state, or a restarted plant: the trail is of another run.
            self._start_ns = sample.stamp_ns
            self._picture.clear_trail()
        self._sample = sample

    def _receiver(self, topic: str) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            command = command_from_bytes(data)
            if command is not None:
                self._torques.note(topic, command)

        return receive

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self._torques.mode = plant_mode(message, self._namespace) or self._torques.mode
        self._plant.take_description(plant_value(message, self._namespace, PLANT_PARAMETERS))

    def _on_timer(self) -> None:
        self._draw()
        self._drawn += 1
        if (
            self._values["gif"]
            and self._drawn % self._every == 0
            and self._sample is not None
            and not self._plant.missing
        ):
            self._frames.append(self._picture.array())
        if self._window is not None and self._window.closed:
            self._stop()

    def _on_snapshot(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            if not self._values["png"]:
                raise ParameterError("png is empty; expected the file to write")
            response.message = str(Path(save_png(self._values["png"], self._picture.array())).resolve())
            response.success = True
        except PendulumError as error:
            response.success, response.message = False, str(error)
        return response

    # --- picture -------------------------------------------------------------------------------------------

    def _draw(self) -> None:
        if (plant := self._plant.parameters) is None:
            self._picture.show_text(self._plant.missing)
        else:
            self._draw_plant(plant, self._sample)
        if self._window is not None:
            self._window.show(self._picture)

    def _draw_plant(self, plant: PlantParameters, sample: JointSample | None) -> None:
        if self._picture.parameters != plant:
            self._picture = PlantPicture(plant, self._size, trail=self._values["trail"])
        if sample is None:
            self._picture.draw((0.0,) * len(plant.joints), note=f"waiting for {self._topic}")
            return
        disturbance: Counter[str] = Counter()
        for topic in _DISTURBING:
            disturbance.update(self._torques.acting_on(topic, sample.stamp_ns, self._plant.joints))
        self._picture.draw(
            sample.position,
            velocity=sample.velocity,
            effort=self._torques.acting_on(names.APPLIED_EFFORT, sample.stamp_ns, plant.coordinates.driven_names),
            disturbance=disturbance,
            time=(sample.stamp_ns - (self._start_ns or 0)) / NANOSECONDS,
            note=self._topic,
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the viewer."""
    return run_node(
        ViewerNode,
        argv,
        program="pendulum_sim viewer",
        description="Shows a plant: links, torques, disturbance, trail and numbers; also writes PNG and GIF.",
        specs=SPECS,
        example="python -m pendulum_sim viewer --ros-args -r __ns:=/sim -p gif:=sim.gif",
    )
