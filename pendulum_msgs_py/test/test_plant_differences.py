"""The plant designed for against the plant that runs: told with values and units, and silent where it is the same."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.joint_parameters import DRIVETRAIN_SPECS, SeriesElasticParameters
from pendulum_msgs_py.plants.plant_differences import describe_plants, plant_differences, plant_mismatch, read_plants
from pendulum_msgs_py.plants.plant_parameters import (
    PLANT_SPECS,
    PRESETS,
    load_mechanism,
    load_plant,
    pendulum_plant,
)

THESIS = load_plant("thesis")
X5_9 = load_plant("x5_9")


@pytest.mark.parametrize("preset", PRESETS)
def test_a_plant_that_says_what_it_is_is_read_back_as_it_is(preset: str) -> None:
    plant = load_plant(preset)
    (again,) = read_plants(describe_plants([plant]))
    assert again == plant
    assert again.name == plant.name
    assert plant_mismatch(plant, [again]) == ""


@pytest.mark.parametrize("spec", PLANT_SPECS, ids=lambda spec: spec.name)
def test_every_parameter_of_the_plant_is_compared(spec: ParameterSpec) -> None:
    # Static friction is at least the sliding one: both go up from the same side.
    base = pendulum_plant(0.05, 0.1, 1.0, coulomb_friction=0.1, static_friction=0.2, actuator_time_constant=0.01)
    other = base.with_values(**{spec.name: getattr(base, spec.name) * 1.1 + 1e-3})
    (found,) = plant_differences(base, other)
    assert (found.name, found.designed, found.running, found.unit) == (
        spec.name,
        getattr(base, spec.name),
        getattr(other, spec.name),
        spec.unit,
    )


@pytest.mark.parametrize("spec", DRIVETRAIN_SPECS, ids=lambda spec: spec.name)
def test_every_parameter_of_the_drivetrain_is_compared(spec: ParameterSpec) -> None:
    base = SeriesElasticParameters()
    values = {spec.name: getattr(base, spec.name) * 1.1 + 1e-3}
    other = replace(base, **values)
    (found,) = plant_differences(X5_9.with_values(drivetrain=base), X5_9.with_values(drivetrain=other))
    assert found.name == f"drivetrain.{spec.name}"
    assert found.unit == spec.unit


def test_the_differences_are_reported_with_names_values_and_units() -> None:
    running = THESIS.with_values(damping=5.0, transport_delay=0.004, name="worn")
    assert plant_mismatch(THESIS, [running]) == (
        "designed for plant 'thesis', but 'worn' runs: designed for damping 11.77, runs 5 N m s/rad; "
        "transport_delay 0, runs 0.004 s"
    )


def test_a_motor_that_the_design_does_not_know_is_named_once() -> None:
    told = plant_mismatch(THESIS, [THESIS.with_values(drivetrain=X5_9.drivetrain, name="geared")])
    assert told.endswith("designed for drivetrain rigid, runs series elastic")
    assert "drivetrain series elastic, runs rigid" in plant_mismatch(X5_9, [THESIS])


def test_a_name_and_a_rounded_value_are_no_difference() -> None:
    assert plant_mismatch(THESIS, [THESIS.with_values(name="mine", damping=11.77 * 1.0005)]) == ""
    assert plant_mismatch(THESIS, [THESIS.with_values(damping=11.77 * 1.002)]) != ""


def test_one_description_that_fits_is_enough_and_none_says_nothing() -> None:
    machine = X5_9.with_values(inertia=0.2)
    assert plant_mismatch(THESIS, [machine, THESIS]) == ""
    assert plant_mismatch(machine, [machine, THESIS]) == ""
    assert plant_mismatch(THESIS, read_plants(describe_plants([]))) == ""
    close = THESIS.with_values(damping=5.0, name="close")
    assert "'close' runs" in plant_mismatch(THESIS, [machine, close])


@pytest.mark.parametrize("text", ["", "{", "[1]", "3", '[{"inertia":1}]', '[{"colour":1}]', "[" * 100_000])
def test_what_is_no_description_is_refused(text: str) -> None:
    with pytest.raises(ParameterError):
        read_plants(text)


def test_plants_of_several_joints_are_described_and_compared_by_the_names_of_their_files() -> None:
    acrobot = load_mechanism("acrobot")
    (again,) = read_plants(describe_plants([acrobot]))
    assert again == acrobot
    assert plant_mismatch(acrobot, [again]) == ""
    other = acrobot.with_values({"mass_2": 0.7, "elbow.coulomb_friction": 0.0})
    told = plant_mismatch(acrobot, read_plants(describe_plants([other])))
    assert "mass_2 0.625568" in told
    assert "runs 0.7 kg" in told
    assert "elbow.coulomb_friction 0.12, runs 0 N m" in told
    assert "model double_pendulum, runs cart_pole" in plant_mismatch(acrobot, [load_mechanism("cart_pole")])
    assert "model double_pendulum, runs pendulum" in plant_mismatch(acrobot, [THESIS])
    assert "elbow.effort_limit 6, runs none" in plant_mismatch(acrobot, [load_mechanism("pendubot")])


def test_a_description_of_a_mechanism_that_nobody_knows_is_refused() -> None:
    with pytest.raises(ParameterError, match="no description of plants"):
        read_plants('[{"model": "triple_pendulum", "values": [], "joints": []}]')
