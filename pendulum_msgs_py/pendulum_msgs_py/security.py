"""Who may say and hear what: least permissions of each node, and the SROS 2 policy that grants them.

``python -m pendulum_msgs_py.security > policy.xml`` writes the policy of both plants for ``ros2 security``
(https://design.ros2.org/articles/ros2_access_control_policies.html). What a node needs is stated here once, from the
names that the nodes themselves use; a test compares it with what the nodes do on a running graph.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from pendulum_msgs_py import names

__all__ = ["NODES", "Permissions", "permissions", "policy", "resolve"]

_PARAMETERS = (
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/get_type_description",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
)
_LIFECYCLE = (
    "~/change_state",
    "~/get_available_states",
    "~/get_available_transitions",
    "~/get_state",
    "~/get_transition_graph",
)
_LOGGER = ("~/get_logger_levels", "~/set_logger_levels")
_EVERY_PUBLISHER = ("/parameter_events", "/rosout")
_EVERY_SUBSCRIPTION = (names.CLOCK, "/parameter_events")
_PLANT_SUBSCRIPTIONS = (names.EFFORT_COMMAND, names.DISTURBANCE, names.PUSH, names.JOINT_TRAJECTORY)
_PLANT_PUBLISHERS = (names.JOINT_STATES, names.APPLIED_EFFORT, names.EVENTS, names.DIAGNOSTICS)
_PLANT_SERVICES = (names.ARM, names.E_STOP, names.E_STOP_RESET)


@dataclass(frozen=True)
class Permissions:
    """What one node may do; names as the node writes them: relative, private (``~/``) or absolute.

    Attributes:
        publish: Topics that it may speak on.
        subscribe: Topics that it may hear.
        reply: Services that it may offer.
        request: Services that it may call.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()


NODES: dict[str, Permissions] = {
    "simulator": Permissions(
        publish=(*_PLANT_PUBLISHERS, names.CLOCK),
        subscribe=(*_PLANT_SUBSCRIPTIONS, "~/set_state"),
        reply=(*_PLANT_SERVICES, "~/reset", "~/pause", "~/step"),
    ),
    "bridge": Permissions(
        publish=(
            *_PLANT_PUBLISHERS,
            names.CLOCK,
            "actuator/feedback",
            "actuator/winding_temperature",
            "actuator/supply",
            "~/transition_event",
        ),
        subscribe=_PLANT_SUBSCRIPTIONS,
        reply=(*_PLANT_SERVICES, *_LIFECYCLE),
    ),
    "controller": Permissions(
        publish=(names.EFFORT_COMMAND, names.DIAGNOSTICS, "~/transition_event"),
        subscribe=(names.JOINT_STATES,),
        reply=(*_LIFECYCLE, *_LOGGER),
    ),
    "disturbance": Permissions(
        publish=(names.DISTURBANCE, names.EVENTS, names.DIAGNOSTICS),
        subscribe=(names.JOINT_STATES,),
        reply=("~/start", "~/stop", *_LOGGER),
    ),
}
"""Permissions of the nodes that move a pendulum, beyond those of every node (parameters, log, clock)."""


def resolve(name: str, node: str, namespace: str) -> str:
    """Return a name in full: ``~/arm`` of ``simulator`` in ``/sim`` is ``/sim/simulator/arm``."""
    if name.startswith("/"):
        return name
    base = namespace.rstrip("/")
    return f"{base}/{node}/{name[2:]}" if name.startswith("~/") else f"{base}/{name}"


def permissions(node: str) -> Permissions:
    """Return all that a node may do, with what every node may.

    Raises:
        KeyError: No node of that name is in :data:`NODES`.
    """
    own = NODES[node]
    return Permissions(
        (*own.publish, *_EVERY_PUBLISHER),
        (*own.subscribe, *_EVERY_SUBSCRIPTION),
        (*own.reply, *_PARAMETERS),
        own.request,
    )


def policy(sides: Iterable[tuple[str, str]] = (("/sim", "simulator"), ("/hw", "bridge"))) -> str:
    """Return the SROS 2 policy of plants, each with its controller and disturbance: one enclave for each node.

    Args:
        sides: Namespace and plant of each side.
    """
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    for namespace, plant in sides:
        for node in (plant, "controller", "disturbance"):
            allowed = permissions(node)
            enclave = ElementTree.SubElement(enclaves, "enclave", path=f"{namespace}/{node}")
            profiles = ElementTree.SubElement(enclave, "profiles")
            profile = ElementTree.SubElement(profiles, "profile", ns=namespace, node=node)
            for kind, rule, entries in (
                ("topics", "publish", allowed.publish),
                ("topics", "subscribe", allowed.subscribe),
                ("services", "reply", allowed.reply),
                ("services", "request", allowed.request),
            ):
                if not entries:
                    continue
                group = ElementTree.SubElement(profile, kind, {rule: "ALLOW"})
                for name in sorted(resolve(entry, node, namespace) for entry in entries):
                    ElementTree.SubElement(group, kind[:-1]).text = name
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def main(_: Sequence[str] | None = None) -> int:
    """Write the policy to the standard output."""
    sys.stdout.write(policy())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
