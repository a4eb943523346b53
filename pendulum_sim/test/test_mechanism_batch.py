"""Batches of plants of several joints: each is the single plant."""

from __future__ import annotations

import numpy as np
import pytest

from pendulum_msgs_py.contract.noise import scramble, stream_key, unit_interval
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.stepping.mechanism_plant import MechanismPlant


def _alone(
    plant: PlantParameters, gain: np.ndarray, start: tuple, seed: int, steps: int, amplitude: tuple, hold: int
) -> np.ndarray:
    """The same loop, step by step, in Python."""
    single, coordinates = MechanismPlant(plant, 2e-3), plant.coordinates
    state = single.reset(start)
    key, m = stream_key(seed), len(amplitude)
    for k in range(steps):
        x = np.array([*coordinates.deviation(state.position), *state.velocity])
        noise = [a * unit_interval(scramble(key, (k // hold) * m + i)) for i, a in enumerate(amplitude)]
        state = single.step(tuple(-gain @ x + noise))
    return np.array([*state.position, *state.velocity])


# Each compiles a kernel: ten seconds of a free core.
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("name", "gain", "amplitude"),
    [
        ("double_pendulum_frictionless", [[30.0, 5.0, 5.0, 1.0], [4.0, 20.0, 1.0, 3.0]], (0.5, 0.25)),
        ("acrobot", [[-295.0, -124.0, -63.0, -28.5]], (0.5,)),
    ],
)
def test_a_plant_of_a_batch_moves_as_it_does_alone(name: str, gain: list, amplitude: tuple) -> None:
    plant, size = load_mechanism(name), 260
    starts = np.full((size, 2), (3.1, 0.02))
    starts[0], starts[-1] = (3.15, -0.01), (3.14 - 2.0 * np.pi, 0.0)
    masses, seeds = np.linspace(0.6, 0.65, size), np.arange(size)
    batch = simulate_batch(
        plant,
        variations={"mass_2": masses},
        steps=100,
        position=starts,
        gain=gain,
        seeds=seeds,
        amplitude=amplitude,
        hold=5,
        record=True,
    )
    for index in (0, 1, size - 1):
        own = plant.with_values({"mass_2": float(masses[index])})
        expected = _alone(own, np.array(gain), tuple(starts[index]), index, 100, amplitude, 5)
        found = np.array([*batch.position[index], *batch.velocity[index]])
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7)
    assert batch.trajectories is not None
    assert batch.trajectories.shape == (100, 6, size)
    driven = list(plant.coordinates.driven)
    assert (np.abs(batch.trajectories[:, 4:][:, driven]).max(axis=(0, 2)) <= plant.effort_limits).all()
    assert batch.max_deviation.shape == (size, 2)
    assert batch.max_deviation.max() < np.pi
    assert batch.max_effort.shape == (size, len(driven))


def test_compiled_steps_are_those_of_python_at_large_efforts() -> None:
    plant = load_mechanism("acrobot")
    start, limit = (1.0, 0.5, 2.0, -1.0), plant.effort_limits[0]
    batch = simulate_batch(
        plant, steps=200, position=start[:2], velocity=start[2:], seeds=3, amplitude=limit, hold=20, record=True
    )
    assert batch.trajectories is not None
    single, key = MechanismPlant(plant, 2e-3), stream_key(3)
    single.reset(start[:2], start[2:])
    for k in range(200):
        assert batch.trajectories[k, :2, 0] == pytest.approx(single.state.position, abs=1e-7)
        single.step((limit * unit_interval(scramble(key, k // 20)),))
    assert np.ptp(batch.trajectories[:, 3, 0]) > 10.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"steps": 0}, "steps is 0; expected a whole number >= 1"),
        ({"gain": [1.0, 2.0]}, r"gain has shape \(2,\); expected \(1, 4\) or \(B, 1, 4\)"),
        ({"position": (1.0,)}, r"position has shape \(1,\); expected \(2,\) or \(B, 2\)"),
        ({"velocity": (1.0, np.nan)}, "velocity has a value that is not finite"),
        ({"seeds": [1, 2], "position": np.zeros((3, 2))}, "seeds has 2 entries; expected 1 or 3"),
        ({"seeds": -1}, "seeds has -1; expected whole numbers"),
        ({"amplitude": -1.0}, "amplitude has a value of -1.0; expected >= 0"),
        ({"goal": (1.0,)}, r"goal is \[1.0\]; expected 2 finite numbers"),
        ({"variations": {"mass_3": 1.0}}, "variation 'mass_3' is unknown; expected one of mass_1"),
        ({"variations": {"shoulder.effort_limit": 1.0}}, "variation 'shoulder.effort_limit' is unknown"),
        ({"variations": {"mass_2": [1.0, -1.0]}}, "mass_2 is -1.0 kg; expected > 0"),
        ({"variations": {"inertia_2": [0.05, 1e-4]}}, "plant 1 of the batch give no positive inertia"),
        ({"variations": {"elbow.static_friction": 0.01}}, "static_friction of elbow of plant 0 is 0.01; expected >="),
        ({"variations": {"elbow.damping": [0.0, 500.0]}, "dt": 2e-3}, "on plant 1 of the batch, whose damping decays"),
        ({"variations": {"elbow.upper_stop": [3.0, -1.0]}}, "position of elbow of plant 1 is 0.0 rad; expected"),
    ],
)
def test_what_makes_no_batch_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        simulate_batch(load_mechanism("acrobot"), **{"steps": 1, **arguments})
