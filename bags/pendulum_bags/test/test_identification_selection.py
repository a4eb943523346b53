"""Which friction model is taken, by what little correlated data can say."""

from typing import Any

import pytest

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
