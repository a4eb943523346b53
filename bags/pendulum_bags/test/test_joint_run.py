"""What stands in for the machine of several joints, and settings that cannot be run."""

from __future__ import annotations

import pytest

from pendulum_bags.experiments.joint_run import JointSettings, load_stand_in, stand_in_for
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.mechanism_parameters import load_mechanism

GIVEN = ("gravity", "gear_ratio", "elbow.effort_limit", "shoulder.stribeck_velocity")
"""What nobody has to identify."""


def test_a_stand_in_is_off_in_every_value_that_has_to_be_identified_and_in_no_other() -> None:
    plant = load_mechanism("acrobot")
    machine = stand_in_for(plant, share=0.1, delay=0.003, seed=4)
    assert machine.name == "acrobot_stand_in"
    off = {name: machine.numbers[name] / value - 1.0 for name, value in plant.numbers.items() if value}
    assert {name for name, share in off.items() if share == 0.0} == set(GIVEN) | {"elbow.stribeck_velocity"}
    assert max(map(abs, off.values())) <= 0.1
    assert machine.value("elbow.transport_delay") == 0.003
    assert stand_in_for(plant, share=0.1, delay=0.003, seed=4) == machine
    assert stand_in_for(plant, share=0.1, delay=0.003, seed=5) != machine
    assert stand_in_for(plant, share=0.0, delay=0.0, seed=4).numbers == plant.numbers


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plant": "thesis"}, "plant is 'thesis', which has one joint; expected one of several, such as cart_pole"),
        ({"plant": "acrobot", "joint": "shoulder"}, "joint is 'shoulder'; expected one that is driven: elbow"),
        ({"amplitude": 0.0}, "amplitude is 0.0; expected a finite number > 0"),
        ({"duration": float("nan")}, "duration is nan; expected a finite number > 0"),
        ({"hold_time": float("inf")}, "hold_time is inf; expected a finite number > 0"),
    ],
)
def test_settings_that_cannot_be_run_are_refused_before_anything_starts(values: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        JointSettings(**values)


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_a_share_that_makes_no_plant_is_refused(share: float) -> None:
    with pytest.raises(ParameterError, match=r"share is .*; expected 0 to less than 1"):
        stand_in_for(load_mechanism("cart_pole"), share=share, delay=0.0, seed=1)


def test_the_noise_is_on_the_first_driven_joint_unless_another_is_named() -> None:
    assert JointSettings("double_pendulum").joint == "shoulder"
    assert JointSettings("double_pendulum", "elbow").joint == "elbow"


@pytest.mark.parametrize(
    ("plant", "other", "message"),
    [
        ("cart_pole", "furuta", "has model furuta; expected cart_pole"),
        ("acrobot", "pendubot", "has driven joints shoulder; expected elbow"),
        ("cart_pole", "thesis", "has model pendulum; expected cart_pole"),
    ],
)
def test_a_machine_with_other_equations_or_other_motors_is_refused(plant: str, other: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        load_stand_in(other, load_mechanism(plant))


def test_a_machine_with_other_values_is_taken() -> None:
    assert load_stand_in("acrobot_frictionless", load_mechanism("acrobot")).name == "acrobot_frictionless"
