"""A plant that runs on the graph already, as one side of an experiment, which neither starts nor ends it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.errors import FaultError, ParameterError

if TYPE_CHECKING:
    from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient

__all__ = ["PREFIX", "find_plant", "join", "running_namespace"]

PREFIX = "ros:"
_NAMESPACE = re.compile(r"(?:/[A-Za-z][A-Za-z0-9_]*)+")
_PATIENCE = 20.0
"""Longest wait for a node's response [s]."""
_HALF_TURN = 3.15
"""Largest distance from hanging at 0 at the start of a ramp to upright, including noise [rad]."""
_COMMANDS = (*names.EFFORT_TOPICS[:2], *names.VOLTAGE_TOPICS[:2], names.JOINT_TRAJECTORY)
_OURS = ("controller", "disturbance", names.RECORDER)
"""Names of the nodes that an experiment starts with a plant."""


def running_namespace(name: str) -> str | None:
    """Return the namespace in ``ros:/namespace``; None for other names, a ParameterError if it is invalid."""
    if not name.startswith(PREFIX):
        return None
    namespace = name.removeprefix(PREFIX)
    if not _NAMESPACE.fullmatch(namespace):
        raise ParameterError(f"plant is {name!r}; expected {PREFIX}/NAMESPACE of a running plant, such as {PREFIX}/lab")
    return namespace


def find_plant(orchestrator: Orchestrator, namespace: str) -> str:
    """Return the name of the node with an e-stop in a namespace, the plant; a FaultError if there is none."""
    space = namespace.rstrip("/")

    def found() -> list[str]:
        ends = f"/{names.E_STOP.removeprefix('~/')}"
        return [
            name.removeprefix(f"{space}/").removesuffix(ends)
            for name, _ in orchestrator.node.get_service_names_and_types()
            if name.startswith(f"{space}/") and name.endswith(ends)
        ]

    return orchestrator.wait_for(f"a plant in {namespace}", found, _PATIENCE)[0]


def join(orchestrator: Orchestrator, space: str, coordinates: Coordinates = ONE_JOINT) -> PlantClient:
    """Return a client of a running plant that is at rest and has no other commander; nothing is sent to it.

    A FaultError if there is none, or it has another commander, is armed, has other joints, or, as a pendulum, does not
    hang near 0.
    """
    from pendulum_bags.experiments.orchestrator_node import PlantClient

    node = find_plant(orchestrator, space)
    _refuse_others(orchestrator, space)
    client = PlantClient(orchestrator, space, node, joints=coordinates.names)
    client.wait_until_ready(_PATIENCE, controller=False, disturbance=False)
    orchestrator.spin(0.5)
    # The commander may be discovered later than the plant.
    _refuse_others(orchestrator, space)
    if client.is_armed():
        raise FaultError(
            f"{space} is armed already; expected it at rest and disarmed (if no other program uses it: "
            f"python -m pendulum_bags move down --namespace {space})"
        )
    assert client.sample is not None
    if coordinates == ONE_JOINT and abs(angle := client.sample.position[0]) > _HALF_TURN:
        raise FaultError(
            f"{space} is at {angle:.2f} rad; expected it within half a turn of hanging at 0: reset its zero"
        )
    return client


def _refuse_others(orchestrator: Orchestrator, space: str) -> None:
    for name, namespace in orchestrator.node.get_node_names_and_namespaces():
        if namespace == space and name in _OURS:
            raise FaultError(f"{space}/{name} runs already, and this experiment starts its own; end that one first")
    ours = [publisher.topic_name for publisher in orchestrator.node.publishers]
    for topic in _COMMANDS:
        if count := orchestrator.node.count_publishers(f"{space}/{topic}") - ours.count(f"{space}/{topic}"):
            raise FaultError(
                f"{space}/{topic} has {count} publisher{'s' * (count > 1)}: another program commands this plant; "
                "expected no other commander"
            )
