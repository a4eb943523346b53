"""Which friction model is taken, by what little correlated data can say."""

from typing import Any

import numpy as np
import pytest

from pendulum_bags.identification.model import TORQUES, FitModel
from pendulum_bags.identification.output_error import _determined
from pendulum_bags.identification.selection import Candidate, choose


def candidate(friction: str, parameters: int, mean_cost: float, effective: float) -> Candidate:
    unused: Any = None
    free = tuple(f"p{number}" for number in range(parameters))
    return Candidate(friction, free, unused, 0.1, None, mean_cost, effective)


@pytest.mark.parametrize(("effective", "chosen"), [(12.0, "viscous"), (1000.0, "stribeck")])
def test_nine_parameters_are_not_taken_on_a_dozen_independent_samples(effective: float, chosen: str) -> None:
    # A fourth of the cost: by Akaike's criterion without its correction both counts are enough.
    few, many = candidate("viscous", 3, 1.0, effective), candidate("stribeck", 9, 0.25, effective)
    assert choose([few, many]).friction == chosen


@pytest.mark.parametrize(("amplitudes", "taken"), [((5.0, 0.0), False), ((6.0, 0.0), True), ((0.0, -6.0), True)])
def test_a_torque_is_taken_where_the_fits_without_a_fold_agree_on_an_amplitude(
    amplitudes: tuple[float, float], taken: bool
) -> None:
    # Four fits one unit off each: a jackknife error of sqrt(3) units, times Student's 3.18 of 3 degrees: 5.5 units.
    names = TORQUES["a torque of twice the angle"]
    model = FitModel(dict(zip(names, amplitudes, strict=True)))
    vectors = np.tile(model.vector, (4, 1))
    vectors[:, model.index(names)] += np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    assert _determined(model, vectors, names) is taken
