"""The controller says when the plant that runs is not the one that it was designed for, and goes on."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from pendulum_testing.graph_peer import GraphPeer

_NAME = "/sim/controller: controller"


class Watcher(GraphPeer):
    """Keeps the newest diagnostics of each node."""

    def __init__(self) -> None:
        super().__init__("watcher")
        self.told: dict[str, DiagnosticStatus] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.told.update({status.name: status for status in message.status})

    def answering(self, *parts: str) -> bool:
        status = self.told.get(_NAME)
        return status is not None and all(part in status.message for part in ("answering", *parts))


@pytest.fixture
def watcher(domain_id: int) -> Iterator[Watcher]:
    peer = Watcher()
    yield peer
    peer.close()


def test_another_plant_is_reported_once_on_the_log_and_as_long_as_it_runs_in_diagnostics(
    watcher: Watcher, processes: Any
) -> None:
    slow = ("--ros-args", "-p", "rate_hz:=100.0")
    here = ("-r", "__ns:=/sim", "-p")
    # Of two plants on the graph, only that of the controller's own states counts.
    processes.start("pendulum_sim", "simulator", *slow, "-r", "__ns:=/hw", "-p", "plant:=x5_9")
    first = processes.start("pendulum_sim", "simulator", *slow, *here, "plant:=dfki")
    controller = processes.start(
        "pendulum_lqr", "controller", "--ros-args", *here, "state_timeout:=2.0", "-p", "period:=0.01"
    )
    told = controller.wait_for_output(r"designed for plant 'thesis', but 'dfki' runs: .*", 60).group()
    assert "damping 11.77, runs " in told
    assert " N m s/rad" in told
    # It goes on answering: whether that is good is for whoever runs it to judge.
    watcher.until(lambda: watcher.answering("but 'dfki' runs"), "answers with a warning")
    assert watcher.told[_NAME].level == DiagnosticStatus.WARN
    watcher.spin(1.2)  # two more looks
    assert controller.output.count("but 'dfki' runs") == 1
    assert "x5_9" not in controller.output
    # The right plant comes instead: the warning goes.
    first.interrupt()
    first.wait(20)
    processes.start("pendulum_sim", "simulator", *slow, *here, "plant:=thesis")
    watcher.until(lambda: watcher.answering() and not watcher.answering("runs"), "answers without a warning", 60)
    assert watcher.told[_NAME].level == DiagnosticStatus.OK
