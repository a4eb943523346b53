"""The shipped permissions against what the nodes do on a running graph: neither more nor less."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from pendulum_bags.experiment.conductor_node import Conductor
from pendulum_bags.experiment.domain import reserve_domain
from pendulum_bags.experiment.processes import ProcessSet, ros_environment
from pendulum_msgs_py import graph, names
from pendulum_msgs_py.security import NODES, permissions, policy, resolve

_OPTIONAL = {names.CLOCK, "/parameter_events"}
"""A plant publishes the clock in lockstep only; the clock is heard under simulated time only."""


@pytest.mark.timeout(120)
def test_nodes_do_what_the_policy_allows_and_nothing_else(tmp_path: Path) -> None:
    programs = {
        "/sim": (graph.simulator("/sim"), graph.controller("/sim"), graph.disturbance("/sim")),
        "/hw": (graph.bridge("/hw", backend="emulator"),),
    }
    with (
        reserve_domain() as domain,
        ProcessSet(tmp_path, ros_environment(domain, tmp_path)) as processes,
        Conductor(domain) as conductor,
    ):
        for group in programs.values():
            for program in group:
                processes.start_node(program)
        node = conductor.node
        for namespace, group in programs.items():
            for program in group:
                name = program.node_name

                def used(name: str = name, namespace: str = namespace) -> dict[str, set[str]]:
                    found = {
                        "publish": node.get_publisher_names_and_types_by_node(name, namespace),
                        "subscribe": node.get_subscriber_names_and_types_by_node(name, namespace),
                        "reply": node.get_service_names_and_types_by_node(name, namespace),
                        "request": node.get_client_names_and_types_by_node(name, namespace),
                    }
                    return {rule: {topic for topic, _ in entries} for rule, entries in found.items()}

                def allowed(name: str = name, namespace: str = namespace) -> dict[str, set[str]]:
                    rules = permissions(name)
                    return {
                        rule: {resolve(entry, name, namespace) for entry in getattr(rules, rule)}
                        for rule in ("publish", "subscribe", "reply", "request")
                    }

                def complete(name: str = name, namespace: str = namespace) -> bool:
                    try:
                        now = used(name, namespace)
                    except Exception as error:  # noqa: BLE001 (rclpy's NodeNameNonExistentError while it starts)
                        assert "exist" in str(error)  # noqa: PT017
                        return False
                    wanted = allowed(name, namespace)
                    return all(wanted[rule] - _OPTIONAL <= now[rule] for rule in wanted)

                try:
                    conductor.wait_for(f"all endpoints of {name}", complete, 40.0)
                finally:
                    processes.check()
                    now, wanted = used(), allowed()
                    missing = {rule: wanted[rule] - now[rule] - _OPTIONAL for rule in now}
                    extra = {rule: now[rule] - wanted[rule] for rule in now}
                assert not any(missing.values()), f"{name} never uses {missing}"
                assert not any(extra.values()), f"{name} is not allowed {extra}"


def test_the_policy_is_what_sros_2_reads_and_gives_each_node_an_enclave() -> None:
    root = ElementTree.fromstring(policy())
    paths = [enclave.get("path") for enclave in root.iter("enclave")]
    assert paths == [f"{ns}/{node}" for ns, plant in (("/sim", "simulator"), ("/hw", "bridge"))
                     for node in (plant, "controller", "disturbance")]  # fmt: skip
    allowed = {topic.text for topics in root.iter("topics") if topics.get("publish") for topic in topics}
    assert "/sim/push" not in allowed
    assert set(NODES) == {"simulator", "bridge", "controller", "disturbance"}


def test_only_the_controller_may_command_torque() -> None:
    assert [name for name in NODES if names.EFFORT_COMMAND in permissions(name).publish] == ["controller"]
