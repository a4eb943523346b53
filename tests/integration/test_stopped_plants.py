"""A running plant that is stopped or dies in an experiment: told in words, all else at rest, nothing armed again."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_sim.model_files import mjcf
from tests.integration.adopting import adopt, start_robot
from tests.plant_peer import PlantPeer
from tests.processes import ProcessGroup, RunningProgram

pytest.importorskip("mujoco")


@pytest.fixture
def peer(domain_id: int) -> Iterator[PlantPeer]:
    with closing(PlantPeer("/lab")) as peer:
        yield peer


@pytest.fixture
def robot(processes: ProcessGroup, peer: PlantPeer) -> RunningProgram:
    return start_robot(processes)


@pytest.fixture
def adopter(processes: ProcessGroup, peer: PlantPeer, robot: RunningProgram) -> RunningProgram:
    program = adopt(processes, "/lab")
    peer.until(lambda: peer.states and peer.diagnostics.get("mode"), "the adopted plant")
    peer.leave_the_command()
    return program


def begin(processes: ProcessGroup, domain: int, peer: PlantPeer, folder: Path) -> RunningProgram:
    """Start an experiment with the adopted plant as the simulation, and wait until it is on its way up."""
    model, plant = folder / "model.xml", folder / "plant.yaml"
    model.write_text(mjcf(load_plant("thesis")), encoding="utf-8")
    write_plant(plant, load_plant("thesis"))
    run = processes.start(
        "pendulum_bags", "experiment", "thesis", "--out", folder / "run", "--domain", str(domain), "--duration", "1",
        "--budget", "0", "--simulation", "ros:/lab", "--plant", plant, "--hardware", model, "--yes", alone=True,
    )  # fmt: skip
    peer.until(lambda: run.returncode is not None or peer.states[-1].position[0] > 0.3, "the way up")
    assert run.returncode is None, run.output
    return run


@pytest.mark.timeout(200)
@pytest.mark.parametrize("how", ["e-stop", "robot killed", "adopter killed"])
def test_it_ends_at_once_with_the_plant_and_the_reason(
    how: str,
    processes: ProcessGroup,
    domain_id: int,
    peer: PlantPeer,
    robot: RunningProgram,
    adopter: RunningProgram,
    tmp_path: Path,
) -> None:
    run = begin(processes, domain_id, peer, tmp_path)
    if how == "e-stop":
        assert peer.ask("e_stop").success
    else:
        (robot if how == "robot killed" else adopter).send_signal(signal.SIGKILL)
    assert run.wait(60.0) == 2
    (told,) = [line for line in run.output.splitlines() if line.startswith("error: ")]
    assert re.search(
        {
            "e-stop": r"^error: /lab went to e_stop: e-stop pressed$",
            "robot killed": r"^error: /lab went to fault: measurement is \d+ ms old; expected at most 500 ms",
            "adopter killed": r"^error: /lab has sent no state for 5 s: .* cut the motor's supply",
        }[how],
        told,
    )
    # What was not stopped goes on, and the stop stays until somebody takes it back.
    assert (robot.returncode is None) is (how != "robot killed")
    assert (adopter.returncode is None) is (how != "adopter killed")
    if how == "e-stop":
        peer.spin(0.5)
        assert peer.diagnostics["mode"] == "e_stop"
        assert not peer.arm().success


def test_ctrl_c_disarms_a_plant_that_somebody_else_started(
    processes: ProcessGroup,
    domain_id: int,
    peer: PlantPeer,
    robot: RunningProgram,
    adopter: RunningProgram,
    tmp_path: Path,
) -> None:
    run = begin(processes, domain_id, peer, tmp_path)
    run.interrupt()
    assert run.wait(60.0) == 130
    # It was on its way up by itself: without a word it would go on to upright.
    adopter.wait_for_output(r"armed_position: following a trajectory\n(?s:.*)\bdisarmed\b", 10.0)
    assert robot.returncode is None
    assert adopter.returncode is None


def test_a_plant_of_several_joints_is_refused_before_anything_of_it_is_asked(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    at = ["--ros-args", "-r", "__ns:=/lab", "-p", "plant:=acrobot", "-p", "armed_at_start:=false"]
    plant = processes.start("pendulum_sim", "simulator", *at)
    plant.wait_for_output(r"\[INFO\].*ready", 60)
    run = processes.start(
        "pendulum_bags",
        "experiment",
        "thesis",
        "--out",
        tmp_path / "run",
        "--domain",
        str(domain_id),
        "--hardware",
        "ros:/lab",
        "--yes",
        alone=True,
    )
    assert run.wait(60.0) == 2
    assert "error: /lab has the joints shoulder, elbow; expected the one of a pendulum, pendulum_joint\n" in run.output
    assert plant.returncode is None
