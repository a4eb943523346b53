"""Plants of any number of joints as the simulator's node takes them."""

from __future__ import annotations

import numpy as np
import pytest

from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant
from pendulum_sim.stepping.plants import random_start


@pytest.mark.parametrize("stops", [(0.0, 1.0), (-0.02, 0.03), (0.4, 0.9), (-3.0, -2.0)])
def test_a_random_start_is_one_that_the_plant_takes_wherever_its_stops_are(stops: tuple[float, float]) -> None:
    changes = dict(zip(("cart.lower_stop", "cart.upper_stop"), stops, strict=True))
    plant = MechanismPlant(load_mechanism("cart_pole").with_values(changes), 2e-3)
    generator = np.random.default_rng(0)
    angles = set()
    for _ in range(50):
        state = plant.reset(*random_start(plant, generator))
        angles.add(state.position[1] > 0.0)
    assert angles == {False, True}
