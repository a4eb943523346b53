"""Compares the plant that runs, from its diagnostics, with the one that a node was designed for."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, describe_plants, plant_mismatch, read_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import plant_value
from pendulum_msgs_py.ros.polled import PollingNode

__all__ = ["RunningPlant"]

_SAYS_NOTHING = len(describe_plants([]))


class RunningPlant:
    """The plant behind a node's ``joint_states``; ``mismatch`` is its difference as text, empty if none or unknown.

    Diagnostics are polled, so that no message wakes the node, and parsed only if they are new.
    """

    def __init__(self, node: PollingNode, designed: PlantParameters) -> None:
        self.mismatch = ""
        self._node = node
        self._designed = designed
        self._namespace = node.resolve_topic_name(names.JOINT_STATES).rpartition("/")[0]
        self._here = f"{self._namespace}/".encode()
        self._key = PLANT_PARAMETERS.encode()
        self._heard = b""
        self._source = node.create_polled_input(DiagnosticArray, names.DIAGNOSTICS, qos.DIAGNOSTICS)

    def poll(self) -> None:
        """Read new diagnostics; log a warning if the plant differs."""
        self._source.take(self._on_diagnostics)

    def _on_diagnostics(self, data: bytes, _arrived_ns: int) -> None:
        if self._key not in data or self._here not in data:
            return
        if len(self._heard) > _SAYS_NOTHING and self._heard in data:
            return
        text = plant_value(deserialize_message(data, DiagnosticArray), self._namespace, PLANT_PARAMETERS)
        if not text or text.encode() == self._heard:
            return
        self._heard = text.encode()
        try:
            mismatch = plant_mismatch(self._designed, read_plants(text))
        except ParameterError as error:
            mismatch = f"it is not known whether the plant that runs is the one designed for: {error}"
        if mismatch and mismatch != self.mismatch:
            self._node.get_logger().warning(mismatch)
        self.mismatch = mismatch
