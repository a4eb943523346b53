"""LQR designs of plants of several joints, ranked on both sides: real plants in memory, real bags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.experiments.joint_run import JointRun, JointSettings, stand_in_for
from pendulum_bags.frequency_response.designs import read_designs
from pendulum_bags.ranking import joint_choice
from pendulum_bags.ranking.joint_choice import joint_cost_parts, rank_joints, rankable
from pendulum_bags.ranking.present import Words, same_choice
from pendulum_bags.verdict import Mark
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.noise import uniform_array
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError, PlantStoppedError
from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism, write_mechanism
from pendulum_rosbag.storage import BagWriter
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

STATE = "sensor_msgs/msg/JointState"
PERIOD = 0.01
DESIGNS = ("q=10,100,1,1 r=0.1", "q=10,100,1,1 r=1", "q=1,1000,1,1 r=10")


def record(bag: Path, run: JointRun, **_: Any) -> Path:
    """Write what a run gives, in this process: plant, controller as it was tuned, and noise of the run's seed."""
    plant, own = load_mechanism(run.plant), run.settings
    controller = make_controller("lqr", load_mechanism(run.design or own.plant), PERIOD, dict(run.tuning))
    model = MechanismPlant(plant, PERIOD)
    state = model.reset(plant.coordinates.goal)
    noise = uniform_array(own.seed, 0, round(own.duration / PERIOD), float(own.amplitude or 0.0))
    names, driven = plant.coordinates.names, plant.coordinates.driven_names
    with BagWriter(bag, metadata={}) as writer:
        for topic in ("joint_states", "effort_command"):
            writer.add_topic(f"{run.namespace}/{topic}", STATE)
        for k, push in enumerate(map(float, noise)):
            stamp = round((1.0 + k * PERIOD) * NANOSECONDS)
            command = controller.efforts(k * PERIOD, state.position, state.velocity)
            told = encode_joints(stamp, "plant", names, state.position, state.velocity, (0.0, 0.0))
            writer.write(f"{run.namespace}/joint_states", stamp, told)
            writer.write(f"{run.namespace}/effort_command", stamp, encode_joints(stamp, "c", driven, effort=command))
            state = model.step(tuple(u + push for u in command))
    return bag


def designs(*texts: str) -> Any:
    plant = load_mechanism("cart_pole")
    return read_designs(texts, plant, linearise(plant))


@pytest.fixture
def settings() -> JointSettings:
    return JointSettings("cart_pole", duration=3.0, period=PERIOD)


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    drawn = stand_in_for(load_mechanism("cart_pole"), share=0.02, delay=0.0, seed=1)
    return write_mechanism(tmp_path / "machine.yaml", drawn, provenance={})


def test_a_plant_near_the_simulated_one_picks_the_same_design(
    tmp_path: Path, settings: JointSettings, machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(joint_choice, "record_run", record)
    told: list[str] = []
    found = rank_joints(tmp_path / "ranking", settings, machine, designs(*DESIGNS), (1, 2, 3), on_run=told.append)
    assert len(told) == 3 * 3 * 2
    assert len(list((tmp_path / "ranking").glob("design_*_seed_*/*/metadata.yaml"))) == 18
    assert found.pick == found.best
    assert found.pairs == 3
    assert np.isfinite(found.regret_share.high)
    layer = same_choice(found, words=Words("--rank-seeds 10"))
    assert layer.mark in {Mark.YES, Mark.UNDECIDED}


def test_each_design_runs_with_its_own_weights_and_each_seed_is_another_noise(
    tmp_path: Path, settings: JointSettings, machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[str, int, tuple[float, ...], float, str]] = []

    def noted(bag: Path, run: JointRun, **options: Any) -> Path:
        ran.append((run.side, run.settings.seed, tuple(run.tuning["q"]), run.tuning["r"], run.plant))
        return record(bag, run, **options)

    monkeypatch.setattr(joint_choice, "record_run", noted)
    rank_joints(tmp_path / "ranking", settings, machine, designs(*DESIGNS), (4, 5))
    assert len(set(ran)) == len(ran) == 12
    assert {row[1] for row in ran} == {4, 5}
    assert {row[4] for row in ran if row[0] == "hw"} == {str(machine)}
    assert {row[4] for row in ran if row[0] == "sim"} == {"cart_pole"}
    assert {row[2:4] for row in ran} == {((10, 100, 1, 1), 0.1), ((10, 100, 1, 1), 1), ((1, 1000, 1, 1), 10)}


def test_a_design_that_falls_on_the_machine_alone_is_no_choice(
    tmp_path: Path, settings: JointSettings, machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def falls(bag: Path, run: JointRun, **options: Any) -> Path:
        if run.side == "hw" and run.tuning["r"] == 0.1:
            raise PlantStoppedError("/hw", "fault", "position is too far")
        return record(bag, run, **options)

    monkeypatch.setattr(joint_choice, "record_run", falls)
    found = rank_joints(tmp_path / "ranking", settings, machine, designs(*DESIGNS), (1, 2))
    assert found.pick == "LQR q=(10, 100, 1, 1) r=0.1"
    assert found.pick_failed == 2
    layer = same_choice(found, words=Words("--rank-seeds 10", "experiment joints --plant cart_pole"))
    assert layer.mark is Mark.NO
    assert layer.next_steps[0].endswith("works: experiment joints --plant cart_pole")


def test_the_cost_is_that_of_the_plants_own_weights_about_upright(tmp_path: Path, settings: JointSettings) -> None:
    plant = load_mechanism("cart_pole")
    bag = tmp_path / "bag"
    with BagWriter(bag, metadata={}) as writer:
        for topic in ("joint_states", "effort_command"):
            writer.add_topic(f"/sim/{topic}", STATE)
        for k in range(4):
            stamp = NANOSECONDS + k * 10_000_000
            # A whole turn away is as upright.
            states = encode_joints(stamp, "plant", ("cart", "pole"), (0.2, -np.pi + 0.1), (0.5, -2.0), (0.0, 0.0))
            writer.write("/sim/joint_states", stamp, states)
            writer.write("/sim/effort_command", stamp, encode_joints(stamp, "c", ("cart",), effort=(3.0,)))
    parts = joint_cost_parts(bag, "/sim", plant)
    assert parts is not None
    assert parts == pytest.approx([10 * 0.2**2 + 100 * 0.1**2, 0.5**2 + 2.0**2, 0.1 * 3.0**2])


def test_a_plant_that_fell_has_no_cost(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    with BagWriter(bag, metadata={}) as writer:
        for topic in ("joint_states", "effort_command"):
            writer.add_topic(f"/sim/{topic}", STATE)
        for k, angle in enumerate((np.pi, 2.0, 0.0)):
            stamp = NANOSECONDS + k * 10_000_000
            writer.write(
                "/sim/joint_states",
                stamp,
                encode_joints(stamp, "p", ("cart", "pole"), (0.0, angle), (0.0, 0.0), (0, 0)),
            )
            writer.write("/sim/effort_command", stamp, encode_joints(stamp, "c", ("cart",), effort=(0.0,)))
    assert joint_cost_parts(bag, "/sim", load_mechanism("cart_pole")) is None


@pytest.mark.parametrize(
    ("texts", "words"),
    [
        (("k=1,2,3,4", *DESIGNS), "is a gain; expected LQR weights"),
        (DESIGNS[:2], "got 2 designs, 2 of them different; expected at least 3"),
        ((*DESIGNS, DESIGNS[0]), "got 4 designs, 3 of them different"),
    ],
)
def test_designs_that_cannot_be_ranked_are_refused(texts: tuple[str, ...], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        rankable(designs(*texts))
