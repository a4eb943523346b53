"""A running plant that is stopped or dies in an experiment: told in words, all else at rest, nothing armed again."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.experiments.graph_plant import join
from pendulum_bags.experiments.session import conduct
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.errors import FaultError
from pendulum_testing.fixtures import PROJECT, own_domain, wait_for
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup
from tests.integration.adopting import adopt, start_robot

pytest.importorskip("mujoco")


class Laboratory:
    """A robot of others, the adopter before it, and somebody who watches them.

    Args:
        processes: Their processes.
        domain: Their ROS domain.
        peer: Who watches; commands nothing.
    """

    def __init__(self, processes: ProcessGroup, domain: int, peer: PlantPeer) -> None:
        self.domain, self.peer = domain, peer
        self._processes = processes
        self.robot = start_robot(processes)
        self.adopter = adopt(processes, "/lab")
        self._wait()
        peer.leave_the_command()

    def bring_back(self) -> None:
        """Start again what has died, and take an e-stop back."""
        if self.robot.returncode is not None:
            self.robot = start_robot(self._processes, "robot again")
        if self.adopter.returncode is not None:
            self.adopter = adopt(self._processes, "/lab")
        self._wait()
        if self.peer.diagnostics["mode"] == "e_stop":
            assert self.peer.ask("e_stop_reset").success

    def _wait(self) -> None:
        self.peer.states.clear()
        self.peer.diagnostics.clear()
        self.peer.until(lambda: self.peer.states and self.peer.diagnostics.get("mode"), "the adopted plant")


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    folder = tmp_path_factory.mktemp("lab")
    processes = ProcessGroup(folder, cwd=PROJECT)
    with own_domain(folder) as domain, closing(PlantPeer("/lab")) as peer:
        try:
            yield Laboratory(processes, domain, peer)
        finally:
            assert processes.close() == []


@pytest.fixture
def lab(running: Laboratory) -> Laboratory:
    running.bring_back()
    return running


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("ctrl-c", "^$"),
        ("e-stop", r"^/lab went to e_stop: e-stop pressed$"),
        ("robot", r"^/lab went to fault: measurement is \d+ ms old; expected at most 500 ms"),
        ("adopter", r"^/lab has sent no state for 5 s: .* cut the motor's supply"),
    ],
    ids=["ctrl-c", "e-stop", "robot", "adopter"],
)
def test_a_session_ends_at_once_with_the_plant_that_is_stopped_or_dies_on_its_way_up_and_the_reason(
    what: str, reason: str, lab: Laboratory, tmp_path: Path
) -> None:
    printed = len(lab.adopter.output)

    def stop() -> None:
        if what == "ctrl-c":
            raise KeyboardInterrupt
        if what == "e-stop":
            assert lab.peer.ask("e_stop").success
        else:
            (lab.robot if what == "robot" else lab.adopter).send_signal(signal.SIGKILL)

    def move() -> None:
        with conduct(tmp_path / "logs", lab.domain) as session:
            plant = join(session.orchestrator, "/lab")
            session.drives(plant)
            plant.arm()
            assert plant.sample is not None
            plant.follow(thesis_ramp(plant.sample.position[0], UPRIGHT), "ramp_up")
            session.orchestrator.wait_for("the plant to follow", plant.is_following, 5.0)
            stop()
            session.orchestrator.wait_for("the end of the move", plant.trajectory_finished, 20.0)

    with pytest.raises(KeyboardInterrupt if what == "ctrl-c" else FaultError, match=reason):
        move()
    # What did not die goes on, and a stop stays until somebody takes it back.
    assert (lab.robot.returncode is None) is (what != "robot")
    assert (lab.adopter.returncode is None) is (what != "adopter")
    if what == "ctrl-c":
        # It was on its way up by itself: without a command it would go on to upright.
        disarmed = r"armed_position: following a trajectory\n(?s:.*)\bdisarmed\b"
        wait_for(lambda: re.search(disarmed, lab.adopter.output[printed:]), 10.0, "the adopted plant to be disarmed")
    if what == "e-stop":
        lab.peer.spin(0.5)
        assert lab.peer.diagnostics["mode"] == "e_stop"
        assert not lab.peer.arm().success


def test_a_plant_of_several_joints_is_refused_before_anything_of_it_is_asked(
    processes: ProcessGroup, domain_id: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    at = ["--ros-args", "-r", "__ns:=/lab", "-p", "plant:=acrobot"]
    at += ["-p", "armed_at_start:=false", "-p", "rate_hz:=100.0"]
    plant = processes.start("pendulum_sim", "simulator", *at)
    plant.wait_for_output(r"\[INFO\].*ready", 60)
    words = ["thesis", "--out", str(tmp_path / "run"), "--domain", str(domain_id), "--hardware", "ros:/lab", "--yes"]
    assert main(words) == 2
    error = "error: /lab has the joints shoulder, elbow; expected the one of a pendulum, pendulum_joint\n"
    assert error in capfd.readouterr().err
    assert plant.returncode is None
