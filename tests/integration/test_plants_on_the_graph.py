"""Plants that run already as sides of an experiment: looked at first, armed by a yes alone, and left running."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.experiments.graph_plant import join
from pendulum_bags.experiments.orchestrator_node import Orchestrator
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_rosbag.reader import read_bag
from pendulum_sim.exports.model_files import mjcf
from pendulum_testing.plant_peer import PlantPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.integration.adopting import adopt, adopt_cart_pole, start_robot, write_model

pytest.importorskip("mujoco")

_AT_REST = ("-r", "__ns:=/lab", "-p", "armed_at_start:=false", "-p", "rate_hz:=100.0")


@pytest.fixture
def peer(domain_id: int) -> Iterator[PlantPeer]:
    with closing(PlantPeer("/lab")) as peer:
        yield peer


def experiment(processes: ProcessGroup, domain: int, out: Path, *arguments: str | Path) -> RunningProgram:
    told = ("thesis", "--out", out, "--domain", str(domain), "--duration", "1", "--budget", "0", *arguments)
    return processes.start("pendulum_bags", "experiment", *told, alone=True)


def test_an_adopted_plant_is_compared_with_a_model_file_and_goes_on_running(
    processes: ProcessGroup, domain_id: int, peer: PlantPeer, tmp_path: Path
) -> None:
    model = write_model(tmp_path / "model.xml")
    robot, adopter = start_robot(processes), adopt(processes, "/lab")
    peer.until(lambda: peer.states and peer.diagnostics.get("mode"), "the adopted plant")
    peer.leave_the_command()
    out = tmp_path / "run"

    # As fast as the model's 13 N m turn it against its friction.
    faster = ("--ramp-speed", "0.6")
    run = experiment(processes, domain_id, out, "--simulation", model, "--hardware", "ros:/lab", "--yes", *faster)

    assert run.wait(150.0) == 0, run.output
    asked = "This moves what runs already in /lab on ROS domain"
    assert asked in run.output
    assert run.output.index(asked) < run.output.index("starting")
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["hardware"], summary["emulated"]) == ("ros:/lab", False)
    with read_bag(out / "hw") as bag:
        # Nobody knows more of it than its name.
        assert bag.metadata["pendulum.run"]["plant"] == "ros:/lab"
        assert "stand_in" not in bag.metadata["pendulum.run"]
        assert bag["/lab/joint_states"]["position"].max() == pytest.approx(math.pi, abs=0.1)
        assert bag.metadata["pendulum.run"]["ramp_speed"] == 0.6
        up, down = (stored.message.points[-1].time_from_start for stored in bag.messages("/lab/joint_trajectory"))
        assert [up.sec, down.sec] == [5, 5]
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "the end")
    assert (robot.returncode, adopter.returncode) == (None, None)
    assert peer.states[-1].position[0] == pytest.approx(0.0, abs=0.1)


def test_an_adopted_cart_pole_that_a_hand_holds_is_balanced_and_compared_with_a_model_file(
    processes: ProcessGroup, domain_id: int, peer: PlantPeer, tmp_path: Path
) -> None:
    model, out = tmp_path / "model.xml", tmp_path / "run"
    model.write_text(mjcf(load_mechanism("cart_pole")), encoding="utf-8")
    robot, adopter = start_robot(processes, file="plain_cart_pole.py"), adopt_cart_pole(processes, "/lab")
    peer.until(lambda: peer.states and peer.diagnostics.get("mode"), "the adopted plant")
    peer.leave_the_command()
    sides = ("--plant", "cart_pole", "--simulation", model, "--hardware", "ros:/lab", "--yes")

    run = experiment(processes, domain_id, out, *sides)

    assert run.wait(150.0) == 0, run.output
    assert "waits until you hold the plant upright" in run.output
    assert "Is the simulation good enough to design a controller on?" in run.output
    with read_bag(out / "hw") as bag:
        record = bag.metadata["pendulum.run"]
        assert (record["plant"], record["clock"], record["namespace"]) == ("ros:/lab", "realtime", "/lab")
        states, applied = bag.joints("/lab/joint_states"), bag.joints("/lab/applied_effort")
        first = min(event["stamp_ns"] for event in bag.events() if event["name"] == "noise_start")
    assert states.names == ("cart", "pole")
    assert states.position[0] == pytest.approx([0.0, math.pi], abs=1e-6)
    # Upright for as long as it was controlled, and no effort while it is disarmed.
    held = states.position[states.stamp_ns < first + 1_000_000_000, 1]
    assert np.max(np.abs(held - math.pi)) < 0.5
    assert not np.any(applied.effort[applied.stamp_ns < states.stamp_ns[0] + 100_000_000])
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "the end")
    assert (robot.returncode, adopter.returncode) == (None, None)


def test_a_plant_that_is_armed_or_commanded_or_not_there_is_left_alone(
    processes: ProcessGroup,
    domain_id: int,
    peer: PlantPeer,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    processes.start("pendulum_sim", "simulator", "--ros-args", *_AT_REST)
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "the plant")
    out = tmp_path / "run"

    def refusal(*more: str) -> str:
        words = ["thesis", "--out", str(out), "--domain", str(domain_id), "--hardware", "ros:/lab", *more]
        assert main(words) == 2
        return " ".join(capfd.readouterr().err.split())

    assert "there is no terminal to confirm in; expected one, or --yes; nothing was started" in refusal()
    assert "/lab/effort_command has 1 publisher: another program commands this plant" in refusal("--yes")
    peer.leave_the_command()
    assert peer.arm().success
    assert "/lab is armed already; expected it at rest" in refusal("--yes")
    peer.spin(0.2)
    # Whoever armed it has it still: a refusal disarms nobody's plant.
    assert peer.diagnostics["mode"].startswith("armed")
    assert not (out / "hw").exists()


def test_a_commander_who_is_met_later_than_the_plant_is_noticed(
    processes: ProcessGroup, domain_id: int, peer: PlantPeer, monkeypatch: pytest.MonkeyPatch
) -> None:
    processes.start("pendulum_sim", "simulator", "--ros-args", *_AT_REST)
    peer.until(lambda: peer.diagnostics.get("mode") == "disarmed", "the plant")
    asked: list[str] = []
    with Orchestrator(domain_id) as orchestrator:
        orchestrator.wait_for("the peer", lambda: orchestrator.node.count_publishers("/lab/effort_command"), 30.0)
        count = orchestrator.node.count_publishers

        def late(topic: str) -> int:
            asked.append(topic)
            return count(topic) if asked.count(topic) > 1 else 0

        monkeypatch.setattr(orchestrator.node, "count_publishers", late)
        with pytest.raises(
            FaultError, match="/lab/effort_command has 1 publisher: another program commands this plant"
        ):
            join(orchestrator, "/lab")
