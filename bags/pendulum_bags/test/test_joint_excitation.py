"""Excitations of several joints: limits hold on the simulator, and a fit has the intervals that were predicted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands import excite_cli
from pendulum_bags.identification.excitation import Excitation, Limits, design_excitation
from pendulum_bags.identification.identify import identify_joints
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

PERIOD, NOISE = 0.01, 1e-3
LIMITS = Limits(effort=4.0, speed=6.0, angle=2.0, travel=0.4)


def cart_pole() -> PlantParameters:
    return load_mechanism("cart_pole").with_values({"cart.damping": 0.5, "pole.damping": 0.01})


def simulated(plant: PlantParameters, design: Excitation, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion of our simulator, which shares no steps with the design's windows."""
    steps = MechanismPlant(plant, PERIOD, substeps=4)
    states = [steps.reset()]
    for u in design.effort[:-1]:
        effort = tuple(float(u) if i == joint else 0.0 for i in plant.coordinates.driven)
        states.append(steps.step(effort))
    return np.array([state.position for state in states]), np.array([state.velocity for state in states])


@pytest.fixture(scope="module")
def design() -> Excitation:
    return design_excitation(cart_pole(), LIMITS, duration=12.0, period=PERIOD, trials=9, noise=NOISE)


def test_limits_hold_on_the_simulator_joint_by_joint(design: Excitation) -> None:
    position, velocity = simulated(cart_pole(), design, 0)
    np.testing.assert_allclose(design.position, position, atol=1e-4)
    np.testing.assert_allclose(design.velocity, velocity, atol=1e-3)
    assert np.all(np.abs(position).max(axis=0) <= (LIMITS.travel, LIMITS.angle))
    assert np.abs(velocity).max() <= LIMITS.speed
    # One of the limits is used, or all of the effort.
    shares = np.abs(position).max(axis=0) / (LIMITS.travel, LIMITS.angle)
    used = [*shares, np.abs(velocity).max() / LIMITS.speed, np.abs(design.effort).max() / LIMITS.effort]
    assert 0.9 < max(used) <= 1.0


def test_a_fit_has_the_intervals_that_were_predicted(design: Excitation) -> None:
    plant = cart_pole()
    position, _ = simulated(plant, design, 0)
    noisy = position + np.random.default_rng(1).normal(0.0, NOISE, position.shape)
    effort = np.stack([design.effort, np.zeros_like(design.effort)], axis=1)
    recording = JointRecording("played", design.time, noisy, effort, ("zero", "zero"))
    result = identify_joints(plant, [recording], extras="friction")
    assert not result.refused, result.refusal
    for name in ("cart_mass", "pole_centre", "pole_inertia", "cart.damping", "pole.damping"):
        interval = result.intervals[name]
        width = 0.5 * (interval.high - interval.low)
        assert 0.5 < width / design.predicted[name] < 2.0, name


def test_a_wheel_may_turn_freely_and_a_joint_that_is_not_driven_is_not_excited() -> None:
    plant = load_mechanism("reaction_wheel")
    found = design_excitation(plant, Limits(0.02, 200.0, 2.5), duration=5.0, trials=3, parameters=("wheel_inertia",))
    assert np.abs(found.position[:, 1]).max() > 2.5
    assert np.abs(found.position[:, 0]).max() <= 2.5
    assert set(found.predicted) == {"wheel_inertia"}
    with pytest.raises(DataError, match="joint is swing; expected one that is driven: wheel"):
        design_excitation(plant, LIMITS, joint="swing")
    with pytest.raises(DataError, match="parameter is 'inertia'; expected some of "):
        design_excitation(plant, LIMITS, parameters=("inertia",))


def test_the_command_designs_for_one_motor_of_several(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--trials", "1", "--duration", "4", "--out", str(tmp_path / "e.csv")]
    own = ["--plant", "double_pendulum_frictionless", "--joint", "elbow", "--parameters", "inertia_2"]
    assert excite_cli.main([*own, *out, "--kind", "chirp", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["predicted_half_width"]) == ["inertia_2"]
    assert len(told["peak_angle"]) == 2
    assert len(np.loadtxt(tmp_path / "e.csv", delimiter=",", skiprows=1)) == 400
    assert excite_cli.main(["--plant", "acrobot", "--joint", "shoulder", *out]) == 2
    assert "joint is 'shoulder'; expected one that is driven: elbow" in capsys.readouterr().err
