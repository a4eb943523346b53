"""Controllers of plants of several joints, ranked on both sides: real plants in this process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.joint_run import JointSettings, default_amplitude, surrogate_for
from pendulum_bags.experiments.repeats import record_simulation
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import NoiseSettings
from pendulum_bags.ranking.joint_choice import joint_cost_parts
from pendulum_bags.whole.contenders import (
    OWN_NOISE,
    contender_specs,
    keep_run,
    place_of,
    rank_folders,
    simulate_contenders,
)
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, write_plant
from pendulum_sim.stepping.mechanism_plant import MechanismPlant


def settings_of(plant: str) -> JointSettings:
    return JointSettings(plant, noise=NoiseSettings(amplitude=default_amplitude(plant), duration=2.0))


@pytest.mark.parametrize("plant", ["cart_pole", "double_pendulum"])
def test_contenders_of_several_joints_differ_in_what_they_command(plant: str) -> None:
    run = settings_of(plant).run("sim")
    found = contender_specs(run, replace(run, side="hw"), 6, 3, seeds=2)
    assert len(found) == 6
    assert next(iter(found)).startswith("LQR q=(")
    commands = [simulate(replace(both[0][0], duration=0.5)).command for both in found.values()]
    for i, own in enumerate(commands):
        assert not any(np.allclose(own, other, rtol=1e-6, equal_nan=True) for other in commands[:i])
    assert all([(a.seed - OWN_NOISE, b.seed) for a, b in both] == [(3, 3), (4, 4)] for both in found.values())


def test_a_plant_near_the_simulated_one_picks_the_same_controller_and_one_that_fell_is_none(tmp_path: Path) -> None:
    drawn = surrogate_for(load_mechanism("cart_pole"), share=0.02, delay=0.0, seed=1)
    machine = write_plant(tmp_path / "machine.yaml", drawn, provenance={})
    run = settings_of("cart_pole").run("sim")
    # Simulated, the machine's side is read as one that has run.
    specs = contender_specs(run, replace(run, plant=str(machine)), 4, 1)
    simulate_contenders(tmp_path / "sim", {name: [sim for sim, _ in both] for name, both in specs.items()})
    worst = list(specs)[-1]
    for name, both in specs.items():
        for sim, of_machine in both:
            hw, place = replace(sim, side="hw"), place_of(tmp_path / "hw", name, replace(sim, side="hw"))
            place.mkdir(parents=True)
            np.savez(place / "run.npz", **vars(simulate(of_machine)))
            keep_run(place, name, hw, "fell" if name == worst else "")
    found, case = rank_folders(tmp_path / "sim", tmp_path / "hw")
    assert found.pick == found.best != worst
    assert found.hw[found.names.index(worst)] == np.inf
    assert np.isfinite(found.regret_share.high)
    assert case.simulation.startswith("cart_pole (")


def test_the_cost_is_that_of_the_plants_own_weights_about_upright_from_bag_and_arrays_alike(tmp_path: Path) -> None:
    spec = RunSpec(
        plant="cart_pole", design_plant="cart_pole", duration=1.0, disturbance={"amplitude": 3.0, "joints": ["cart"]}
    )
    arrays = simulate(spec)
    np.savez(tmp_path / "run.npz", **vars(arrays))
    away = arrays.position - (0.0, np.pi)
    expected = [
        float(np.mean(away**2, axis=0) @ (10.0, 100.0)),
        float(np.mean(np.sum(arrays.velocity**2, axis=1))),
        0.1 * float(np.mean(arrays.command**2)),
    ]
    assert joint_cost_parts(tmp_path, spec) == pytest.approx(expected, rel=1e-12)
    (tmp_path / "run.npz").unlink()
    record_simulation(tmp_path / "bag", spec)
    assert joint_cost_parts(tmp_path, spec) == pytest.approx(expected, rel=1e-12)


def test_a_plant_that_fell_has_no_cost(tmp_path: Path) -> None:
    spec = RunSpec(
        plant="cart_pole", design_plant="cart_pole", duration=2.0, disturbance={"amplitude": 30.0, "joints": ["cart"]}
    )
    arrays = simulate(spec)
    states = MechanismPlant(load_mechanism("cart_pole"), spec.period)
    states.reset((0.0, 3.0))
    fallen = np.array([states.step((0.0,)).position for _ in arrays.stamp_ns])
    np.savez(tmp_path / "run.npz", **{**vars(arrays), "position": fallen})
    assert joint_cost_parts(tmp_path, spec) is None
