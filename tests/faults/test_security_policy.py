"""The shipped permissions against what the nodes do on a running graph: neither more nor less."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.processes import ProcessSet, ros_environment, start_recorder
from pendulum_console.console.console_node import Hub
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.programs.security import NODES, PLANTS, Permissions, enclaves, granted, policy
from tests.acceptance.test_command_lines import nodes

_RULES = ("publish", "subscribe", "reply", "request")
_OPTIONAL = {names.CLOCK, "/parameter_events"}
"""A plant publishes the clock in lockstep only; the clock is heard under simulated time only."""
_PASSING = ("/get_parameters", "/list_parameters")
"""Clients of these services live for as long as an answer takes."""


def used_by(node: Any, full: str) -> dict[str, set[str]]:
    """Return what a node of the running graph speaks on, hears, offers and calls."""
    space, _, name = full.rpartition("/")
    look = (
        node.get_publisher_names_and_types_by_node,
        node.get_subscriber_names_and_types_by_node,
        node.get_service_names_and_types_by_node,
        node.get_client_names_and_types_by_node,
    )
    return {rule: {topic for topic, _ in ask(name, space or "/")} for rule, ask in zip(_RULES, look, strict=True)}


def missing(wanted: Permissions, now: dict[str, set[str]], absent: set[str]) -> dict[str, set[str]]:
    """Return what a node never uses, of what it may; leaving out topics and services of nodes that are not started."""
    rest = {rule: set(getattr(wanted, rule)) - now[rule] - _OPTIONAL for rule in _RULES}
    rest["request"] = {name for name in rest["request"] if not name.endswith(_PASSING)}
    return {rule: {name for name in found if name not in absent} for rule, found in rest.items() if found - absent}


def extra(wanted: Permissions, now: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return what a node uses and may not."""
    return {rule: found for rule in _RULES if (found := now[rule] - set(getattr(wanted, rule)))}


async def _drive(hub: Hub) -> None:
    """Press every button of the console once."""
    await hub.e_stop()
    for space, node in hub.plants().items():
        await hub.trigger(f"{space}/disturbance/start")
        await hub.trigger(f"{space}/disturbance/stop")
        await hub.reset(node)
        await hub.arm(node, on=False)
        await hub.set_parameter(f"{space}/controller", "r", 1.0)
        await hub.set_parameter(f"{space}/disturbance", "amplitude", 1.0)


@pytest.mark.timeout(600)
def test_nodes_do_what_the_policy_allows_and_nothing_else(tmp_path: Path, hosts: HostPool, domain_id: int) -> None:
    programs = [
        graph.simulator("/sim"),
        graph.bridge("/hw", backend="emulator"),
        *(make(side) for side in PLANTS for make in (graph.controller, graph.disturbance)),
        NodeProgram("pendulum_lqr", "effort_adapter", "/sim", name="effort_controller"),
        NodeProgram("pendulum_hw_bridge", "procedure", "/hw"),
        NodeProgram("pendulum_sim", "viewer", "/sim", parameters={"window": False}),
        NodeProgram("pendulum_sim", "markers", "/sim"),
    ]
    metadata = tmp_path / "run.json"
    metadata.write_text("{}", encoding="utf-8")
    allowed = granted()
    with (
        ProcessSet(tmp_path, ros_environment(domain_id, tmp_path), hosts) as processes,
        Orchestrator(domain_id) as orchestrator,
    ):
        for program in programs:
            processes.start_node(program)
        start_recorder(processes, tmp_path / "bag", "/hw", metadata, "mcap")
        hub = Hub()
        try:
            for side, plant in PLANTS.items():
                PlantClient(orchestrator, side, plant).wait_until_ready(100.0)
            RecorderClient(orchestrator, "/hw").heard()
            with pytest.raises(FaultError, match="refuses"):
                PlantClient(orchestrator, "/hw", "bridge").call("procedure/finish")
            orchestrator.wait_for("the console to see both plants", lambda: set(hub.plants()) == set(PLANTS), 60.0)
            asyncio.run(_drive(hub))
            here = {program.full_name for program in programs}
            here |= {"/hw/recorder", "/conductor", "/console", "/hw/bridge_e_stop", "/sim/simulator_e_stop"}
            # Services of nodes that are not there, and of a trial that is not begun here.
            absent = {"/sim/recorder/status", "/hw/procedure/start", "/sim/joint_commands"}
            # Heard where a hold-to-run switch is wanted.
            absent |= {"/hw/enable_input", "/sim/enable_input"}
            # Of plants in volts.
            absent |= {f"{side}/{topic}" for side in PLANTS for topic in names.VOLTAGE_TOPICS}
            found: dict[str, tuple[Any, Any]] = {}

            def as_allowed() -> bool:
                found.clear()
                for full in sorted(here):
                    try:
                        now = used_by(orchestrator.node, full)
                    except Exception as error:  # noqa: BLE001 (rclpy's NodeNameNonExistentError while it starts)
                        assert "exist" in str(error)  # noqa: PT017
                        found[full] = "is not there yet", {}
                        continue
                    # What the recorder hears is what has been said so far: topics without a publisher are not there.
                    # Its diagnostics are those of a black box.
                    own = {"/hw/markers", "/hw/recorder/transition_event", "/diagnostics"}
                    silent = own if full == "/hw/recorder" else set()
                    problems = missing(allowed[full], now, absent | silent), extra(allowed[full], now)
                    if any(problems):
                        found[full] = problems
                return not found

            try:
                orchestrator.wait_for("all endpoints", as_allowed, 100.0)
            except FaultError:
                pytest.fail("\n".join(f"{full}: never uses {a}, is not allowed {b}" for full, (a, b) in found.items()))
        finally:
            hub.close()


def test_the_policy_is_what_sros_2_reads_and_gives_each_process_an_enclave() -> None:
    root = ElementTree.fromstring(policy())
    assert [enclave.get("path") for enclave in root.iter("enclave")] == list(enclaves())
    profiles = {f"{profile.get('ns').rstrip('/')}/{profile.get('node')}" for profile in root.iter("profile")}  # type: ignore[union-attr]
    assert profiles == set(granted())
    # Each node is a process, but for the e-stop's, which must not wait for another process to be there.
    assert len(enclaves()) == len(granted()) - 3
    assert enclaves()["/hw/bridge"].keys() == {"/hw/bridge", "/hw/bridge_e_stop", "/hw/bridge_e_stop_input"}
    assert "/hw/e_stop_input" in granted()["/hw/bridge_e_stop_input"].subscribe
    assert "/hw/bridge/e_stop" in granted()["/hw/bridge_e_stop"].reply
    for rule in ("publish", "subscribe"):
        told = {topic.text for topics in root.iter("topics") if topics.get(rule) == "ALLOW" for topic in topics}
        assert told == {topic for allowed in granted().values() for topic in getattr(allowed, rule)}
    assert all(
        name and name.startswith("/") and "{" not in name for element in root.iter("topic") for name in [element.text]
    )


def test_only_who_drives_a_plant_may_command_torque() -> None:
    torque = {f"{side}/{names.EFFORT_COMMAND}" for side in PLANTS}
    speakers = {name for name, allowed in granted().items() if torque & set(allowed.publish)}
    drivers = {f"{side}/{node}" for side in PLANTS for node in ("controller", "effort_controller")}
    assert speakers == {*drivers, "/hw/procedure"}
    for watcher in ("recorder", "viewer", "markers"):
        allowed = granted()[f"/sim/{watcher}"]
        assert {t for t in allowed.publish if t.startswith("/sim/")} <= {"/sim/markers"}
        assert all(service.endswith(_PASSING) for service in allowed.request)


def test_every_node_has_permissions_but_the_player() -> None:
    programs = {program for _, program in nodes()}
    assert {"simulator", "bridge", "controller"} <= programs
    named_otherwise = {
        "effort_adapter": "effort_controller",
        "trajectory_action": "joint_trajectory_controller",
    } | dict.fromkeys(("mujoco", "gymnasium", "fmu", "adopt"), "simulator")
    assert {named_otherwise.get(program, program) for program in programs} <= NODES.keys()
    assert "player" not in NODES


def test_no_node_of_one_side_speaks_on_the_other() -> None:
    for full, allowed in granted().items():
        side = "/" + full.split("/")[1]
        if side in PLANTS:
            other = next(space for space in PLANTS if space != side)
            assert not [name for name in (*allowed.publish, *allowed.subscribe) if name.startswith(other + "/")]


def test_a_side_without_a_plant_is_refused() -> None:
    with pytest.raises(ParameterError, match="plant is toaster"):
        policy([("/sim", "toaster")])
    assert set(granted([("/left", "bridge")])) >= {"/left/bridge", "/left/controller", "/conductor"}
