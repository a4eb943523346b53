"""The end of a program where a library does not come back from it, and what keeps that rare."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_msgs_py.ros.e_stop import EStopServer
from pendulum_testing.fixtures import PROJECT
from pendulum_testing.processes import ProcessGroup, RunningProgram

DEADLINE = 60.0
_PLANT_NODES = ("simulator", "simulator_e_stop")
_HANGING = """
import ctypes, sys
from rclpy.node import Node
destroy = Node.destroy_node
def destroy_node(node):
    if node.get_name() == {name!r}:
        print("hangs", flush=True)
        ctypes.PyDLL(None).sleep(600)  # with Python's lock held, as the middleware does
    destroy(node)
Node.destroy_node = destroy_node
"""
_SIMULATOR = """
from pendulum_sim.simulator.simulator_node import main
sys.exit(main([]))
"""
_NESTED = """
import ctypes
from pendulum_msgs_py.ros.leaving import leaving_graph
with leaving_graph():
    with leaving_graph():
        pass
    print("hangs", flush=True)
    ctypes.PyDLL(None).sleep(600)
"""
_ORCHESTRATOR = """
from pendulum_bags.experiments.orchestrator_node import Orchestrator
with Orchestrator({domain}):
    pass
"""
_IN_TIME = """
import time
from pendulum_msgs_py.programs.hang_guard import guard_exit, hang_guard
guard_exit()
try:
    with hang_guard(), hang_guard():
        raise ValueError
except ValueError:
    with hang_guard():
        pass
time.sleep(17.0)  # longer than what is guarded may take
"""
_GROUP = """
import ctypes
from pendulum_hw_bridge.backends.hebi import HebiBackend, import_hebi
hebi = import_hebi()
from hebi._internal.ffi import api
def release(group):
    print("hangs", flush=True)
    ctypes.CDLL(None).sleep(600)  # as hebi-py's library does, once in thousands of groups
api.hebiGroupRelease = release
backend = HebiBackend(make_group=lambda: hebi.util.create_imitation_group(1), imitation=True)
backend.connect()
{end}
"""
_GROUP_ENDS = {"closed": "backend.close()", "left": "print('end')"}


@pytest.fixture(scope="module")
def hanging(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, RunningProgram]]:
    """Start all programs that hang while they leave, by what hangs, so that their watchdogs wait side by side."""
    folder = tmp_path_factory.mktemp("hanging")
    processes = ProcessGroup(folder / "processes", cwd=PROJECT)
    programs: dict[str, RunningProgram] = {}
    with contextlib.ExitStack() as domains:

        def start(name: str, code: str) -> None:
            domain = domains.enter_context(reserve_domain())
            environment = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(folder / "ros_log")}
            code = code.format(domain=domain)
            programs[name] = processes.start_command([sys.executable, "-c", code], name="hanging", env=environment)

        for name in _PLANT_NODES:
            start(name, _HANGING.format(name=name) + _SIMULATOR)
        start("orchestrator", _HANGING.format(name="conductor") + _ORCHESTRATOR)
        start("nested", _NESTED)
        start("in time", _IN_TIME)
        if importlib.util.find_spec("hebi"):
            for name, end in _GROUP_ENDS.items():
                start(name, _GROUP.replace("{end}", end))
        for name in _PLANT_NODES:
            programs[name].wait_for_output("ready", DEADLINE)
            programs[name].interrupt()
        yield programs
        leftovers = processes.close()
    assert leftovers == []


@pytest.mark.parametrize("name", _PLANT_NODES)
def test_a_plant_that_cannot_leave_the_graph_ends_all_the_same(name: str, hanging: dict[str, RunningProgram]) -> None:
    simulator = hanging[name]
    assert simulator.wait(DEADLINE) == 1
    # With the plant made safe before, and where it stood.
    assert simulator.output.index("hangs") < simulator.output.index("Timeout")
    assert "in close" in simulator.output or "in _close" in simulator.output


def test_an_experiment_that_cannot_leave_the_graph_ends_all_the_same(hanging: dict[str, RunningProgram]) -> None:
    assert hanging["orchestrator"].wait(DEADLINE) == 1
    assert "hangs" in hanging["orchestrator"].output


def test_the_end_of_one_leaving_does_not_end_the_watch_over_another(hanging: dict[str, RunningProgram]) -> None:
    # A context that shuts down closes an e-stop whose owner was not closed.
    assert hanging["nested"].wait(DEADLINE) == 1
    assert "hangs" in hanging["nested"].output


def test_who_leaves_in_time_is_left_alone(hanging: dict[str, RunningProgram]) -> None:
    assert hanging["in time"].wait(DEADLINE) == 0, hanging["in time"].output


@pytest.mark.parametrize("name", _GROUP_ENDS)
def test_a_program_ends_though_the_hebi_library_does_not_let_its_group_go(
    name: str, hanging: dict[str, RunningProgram]
) -> None:
    pytest.importorskip("hebi", reason="hebi-py is not installed")
    assert hanging[name].wait(DEADLINE) == 1
    assert "hangs" in hanging[name].output
    assert "Timeout" in hanging[name].output


def test_an_e_stop_leaves_when_it_knows_all_of_its_owner(domain_id: int, monkeypatch: pytest.MonkeyPatch) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain_id)
    owner = Node("plant", context=context)
    known: list[list[object]] = []
    destroy = Node.destroy_node

    def views(node: Node) -> list[object]:
        of_owner = (owner.get_name(), owner.get_namespace())
        return [
            node.get_publisher_names_and_types_by_node(*of_owner),
            node.get_subscriber_names_and_types_by_node(*of_owner),
            node.get_service_names_and_types_by_node(*of_owner),
        ]

    def destroy_node(node: Node) -> None:
        if node is not owner:
            known.append(views(node))
        destroy(node)

    monkeypatch.setattr(Node, "destroy_node", destroy_node)
    try:
        for _ in range(3):
            # Ended as soon as it is made: it has been told of nothing yet.
            EStopServer(owner, lambda reason: None).close()
        assert known == [views(owner)] * 3
    finally:
        owner.destroy_node()
        rclpy.shutdown(context=context)


def test_an_e_stop_whose_owner_has_gone_leaves_at_once(domain_id: int) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain_id)
    owner = Node("plant", context=context)
    server = EStopServer(owner, lambda reason: None)
    owner.destroy_node()
    rclpy.shutdown(context=context)  # closes it
    assert not server._thread._thread.is_alive()
    server.close()
