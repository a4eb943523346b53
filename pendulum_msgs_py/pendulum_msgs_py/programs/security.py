"""Least permissions of each node, and the SROS 2 policy that grants them.

``python -m pendulum_msgs_py.programs.security > policy.xml`` writes the policy of both plants for ``ros2 security``
(https://design.ros2.org/articles/ros2_access_control_policies.html). A test compares it with a running graph. The
player has no permissions: it republishes all of a bag, and belongs on a domain without plants.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from xml.etree import ElementTree

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import ParameterError

__all__ = ["NODES", "OTHER_NODES", "PLANTS", "Permissions", "enclaves", "granted", "policy"]

_PARAMETERS = (
    "~/describe_parameters", "~/get_parameter_types", "~/get_parameters", "~/get_type_description", "~/list_parameters",
    "~/set_parameters", "~/set_parameters_atomically",
)  # fmt: skip
_NO_PARAMETERS = ("~/get_type_description",)
_LIFECYCLE = (
    "~/change_state", "~/get_available_states", "~/get_available_transitions", "~/get_state", "~/get_transition_graph",
)  # fmt: skip
_LOGGER = ("~/get_logger_levels", "~/set_logger_levels")
_SILENT_PUBLISHER = ("/parameter_events",)
_EVERY_PUBLISHER = (*_SILENT_PUBLISHER, "/rosout")
_EVERY_SUBSCRIPTION = (names.CLOCK, "/parameter_events")
_COMMANDS, _DISTURBANCES, _APPLIED = zip(names.EFFORT_TOPICS, names.VOLTAGE_TOPICS, strict=True)
_PLANT_SUBSCRIPTIONS = (*_COMMANDS, *_DISTURBANCES, names.PUSH, names.JOINT_TRAJECTORY, names.ENABLE_INPUT)
_PLANT_PUBLISHERS = (names.JOINT_STATES, *_APPLIED, names.EVENTS, names.DIAGNOSTICS)
_PLANT_SERVICES = (names.ARM, names.E_STOP_RESET)


_PLANT = "{plant}/"
"""Prefix of a service of the plant on each side."""
_SIDE = "{side}/"
"""Prefix of a name on each side."""
_PROCEDURE = "{procedure}/"
"""Prefix of a service of the procedure on each side that has one."""
_ANY = "{any}/"
"""Prefix of a service of every node with parameters."""
_RECORDED = "{recorded}"
"""All topics that a side's nodes publish there."""
_READ_PARAMETERS = (_ANY + "list_parameters", _ANY + "get_parameters")
_WATCHED = (*names.EFFORT_TOPICS, names.PUSH)


@dataclass(frozen=True)
class Permissions:
    """Topics that a node may publish and subscribe to, services that it may offer (``reply``) and call (``request``).

    In :data:`NODES` names are relative, private (``~/``) or absolute, with placeholders for other nodes;
    :func:`granted` resolves them.
    """

    publish: tuple[str, ...] = ()
    subscribe: tuple[str, ...] = ()
    reply: tuple[str, ...] = ()
    request: tuple[str, ...] = ()


_RECORDER = Permissions(
    publish=(names.DIAGNOSTICS,),
    subscribe=(_RECORDED, names.DIAGNOSTICS, names.CLOCK),
    reply=("~/start", "~/stop", "~/annotate", "~/status"),
    request=_READ_PARAMETERS,
)

NODES: dict[str, Permissions] = {
    "simulator": Permissions(
        publish=(*_PLANT_PUBLISHERS, names.CLOCK),
        subscribe=(*_PLANT_SUBSCRIPTIONS, "~/set_state"),
        reply=(*_PLANT_SERVICES, "~/reset", "~/pause", "~/step", *_LOGGER),
    ),
    "simulator_e_stop": Permissions(reply=(_PLANT + "e_stop",)),
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
        reply=(*_PLANT_SERVICES, *_LIFECYCLE, *_LOGGER),
    ),
    "bridge_e_stop": Permissions(reply=(_PLANT + "e_stop",)),
    "bridge_e_stop_input": Permissions(subscribe=(names.E_STOP_INPUT,)),
    "controller": Permissions(
        publish=(*_COMMANDS, names.DIAGNOSTICS, "~/transition_event"),
        subscribe=(names.JOINT_STATES, names.DIAGNOSTICS),
        reply=(*_LIFECYCLE, *_LOGGER),
    ),
    "effort_controller": Permissions(
        publish=(names.EFFORT_COMMAND, names.DIAGNOSTICS),
        subscribe=(names.JOINT_STATES, "~/commands", "joint_commands"),
    ),
    "joint_trajectory_controller": Permissions(
        publish=(names.JOINT_TRAJECTORY,),
        subscribe=(names.JOINT_TRAJECTORY, names.JOINT_STATES, names.EVENTS),
        reply=_LOGGER,
    ),
    "disturbance": Permissions(
        publish=(*_DISTURBANCES, names.EVENTS, names.DIAGNOSTICS),
        subscribe=(names.JOINT_STATES,),
        reply=("~/start", "~/stop", *_LOGGER),
    ),
    "procedure": Permissions(
        publish=(names.EFFORT_COMMAND, names.PUSH, names.JOINT_TRAJECTORY, names.EVENTS),
        subscribe=(names.JOINT_STATES, names.EVENTS),
        reply=("~/start", "~/finish"),
    ),
    "recorder": _RECORDER,
    "viewer": Permissions(subscribe=(names.JOINT_STATES, names.DIAGNOSTICS, *_WATCHED), reply=("~/snapshot",)),
    "markers": Permissions(publish=("markers",), subscribe=(names.DIAGNOSTICS, *_WATCHED)),
    "conductor": Permissions(
        publish=(_SIDE + names.JOINT_TRAJECTORY, _SIDE + names.EVENTS),
        subscribe=(_SIDE + names.JOINT_STATES, _SIDE + names.EVENTS),
        request=(
            *(_PLANT + service for service in ("arm", "e_stop", "pause")),
            _SIDE + "controller/change_state",
            _SIDE + "controller/get_state",
            _SIDE + "disturbance/start",
            _SIDE + "recorder/status",
            _PROCEDURE + "start",
            _PROCEDURE + "finish",
        ),
    ),
    "console": Permissions(
        subscribe=(
            names.DIAGNOSTICS,
            *(_SIDE + name for name in (names.EVENTS, names.JOINT_STATES, *names.EFFORT_TOPICS)),
        ),
        request=(
            *_READ_PARAMETERS,
            *(_PLANT + service for service in ("arm", "e_stop", "e_stop_reset")),
            *(_SIDE + service for service in ("disturbance/start", "disturbance/stop")),
            *(_SIDE + node + "/set_parameters" for node in ("controller", "disturbance")),
        ),
    ),
}
"""Permissions beyond those of every node (parameters, log, clock)."""

PLANTS = {"/sim": "simulator", "/hw": "bridge"}
"""Namespace of each side, and its plant."""

OTHER_NODES = {"conductor": "/conductor", "console": "/console", "recorder": "/recorder"}
"""Nodes for all sides, in the root namespace, and the enclaves of their processes."""

_SIDE_NODES = ("controller", "effort_controller", "disturbance", "recorder", "viewer", "markers")
_IN_PROCESS = {"simulator_e_stop": "simulator", "bridge_e_stop": "bridge", "bridge_e_stop_input": "bridge"}
"""Nodes in the process and enclave of another; they have no log."""
_WITH_PLANT = {"simulator": ("simulator_e_stop",), "bridge": ("procedure", "bridge_e_stop", "bridge_e_stop_input")}
_WITHOUT_PARAMETERS = {"conductor", *_IN_PROCESS}


def _resolve(name: str, node: str, namespace: str) -> str:
    """Return a full name: ``~/arm`` of ``simulator`` in ``/sim`` is ``/sim/simulator/arm``."""
    if name.startswith("/"):
        return name
    base = namespace.rstrip("/")
    return f"{base}/{node}/{name[2:]}" if name.startswith("~/") else f"{base}/{name}"


def granted(plants: Iterable[tuple[str, str]] = tuple(PLANTS.items())) -> dict[str, Permissions]:
    """Return the permissions of each node, in full names, for plants given by namespace and node.

    Raises:
        ParameterError: A node is no plant.
    """
    sides = dict(plants)
    if unknown := set(sides.values()) - set(PLANTS.values()):
        raise ParameterError(f"plant is {min(unknown)}; expected one of {', '.join(PLANTS.values())}")
    nodes = [
        (side, node) for side, plant in sides.items() for node in (plant, *_WITH_PLANT.get(plant, ()), *_SIDE_NODES)
    ]
    with_parameters = [_resolve(node, "", side) for side, node in nodes if node not in _WITHOUT_PARAMETERS]
    with_parameters += [f"/{node}" for node in OTHER_NODES if node not in _WITHOUT_PARAMETERS]

    spoken: set[str] = set()  # the recordable topics, filled below

    def written_out(name: str, node: str, here: str) -> set[str]:
        around = [here] if here != "/" else list(sides)
        if name == _RECORDED:
            return {topic for topic in spoken if any(topic.startswith(_resolve("", "", side)) for side in around)}
        if name.startswith(_ANY):
            return {f"{other}/{name.removeprefix(_ANY)}" for other in with_parameters}
        if name.startswith(_PLANT):
            return {f"{_resolve(sides[side], '', side)}/{name.removeprefix(_PLANT)}" for side in around}
        if name.startswith(_PROCEDURE):
            service = name.removeprefix(_PROCEDURE)
            return {f"{other}/{service}" for other in with_parameters if other.endswith("/procedure")}
        if name.startswith(_SIDE):
            return {_resolve(name.removeprefix(_SIDE), "", side) for side in around}
        return {_resolve(name, node, here)}

    nodes += [("/", node) for node in OTHER_NODES]
    for here, node in nodes:
        spoken |= set().union(*(written_out(name, node, here) for name in NODES[node].publish))
    spoken -= {names.CLOCK, names.DIAGNOSTICS}
    answer = {}
    for here, node in nodes:
        own = NODES[node]
        full = Permissions(
            (*own.publish, *(_SILENT_PUBLISHER if node in _IN_PROCESS else _EVERY_PUBLISHER)),
            (*own.subscribe, *_EVERY_SUBSCRIPTION),
            (*own.reply, *(_NO_PARAMETERS if node in _WITHOUT_PARAMETERS else _PARAMETERS)),
            own.request,
        )
        entries = {
            rule.name: set().union(*(written_out(name, node, here) for name in getattr(full, rule.name)))
            for rule in fields(full)
        }
        me = _resolve(node, "", here)
        # A node does not call its own parameter services.
        entries["request"] = {name for name in entries["request"] if name.rpartition("/")[0] != me}
        answer[me] = Permissions(**{rule: tuple(sorted(found)) for rule, found in entries.items()})
    return answer


def enclaves(plants: Iterable[tuple[str, str]] = tuple(PLANTS.items())) -> dict[str, dict[str, Permissions]]:
    """Return the enclaves, one for each process: path -> full name of the node -> permissions."""
    answer: dict[str, dict[str, Permissions]] = {}
    for full, allowed in granted(plants).items():
        space, _, node = full.rpartition("/")
        path = f"{space}/{_IN_PROCESS.get(node, node)}"
        answer.setdefault(OTHER_NODES.get(path[1:], path), {})[full] = allowed
    return answer


def policy(plants: Iterable[tuple[str, str]] = tuple(PLANTS.items())) -> str:
    """Return the SROS 2 policy for plants given by namespace and node."""
    root = ElementTree.Element("policy", version="0.2.0")
    listed = ElementTree.SubElement(root, "enclaves")
    for path, nodes in enclaves(plants).items():
        enclave = ElementTree.SubElement(listed, "enclave", path=path)
        profiles = ElementTree.SubElement(enclave, "profiles")
        for full, allowed in nodes.items():
            namespace, _, node = full.rpartition("/")
            profile = ElementTree.SubElement(profiles, "profile", ns=namespace or "/", node=node)
            for kind, rule, entries in (
                ("topics", "publish", allowed.publish),
                ("topics", "subscribe", allowed.subscribe),
                ("services", "reply", allowed.reply),
                ("services", "request", allowed.request),
            ):
                group = ElementTree.SubElement(profile, kind, {rule: "ALLOW"}) if entries else profile
                for name in entries:
                    ElementTree.SubElement(group, kind[:-1]).text = name
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def main(_: Sequence[str] | None = None) -> int:
    """Write the policy to the standard output."""
    sys.stdout.write(policy())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
