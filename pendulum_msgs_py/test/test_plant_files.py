"""Plant files: each value with its unit, read back as it was written."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import DRIVETRAIN_SPECS, SeriesElasticParameters
from pendulum_msgs_py.plants.plant_parameters import (
    PLANT_SPECS,
    PRESETS,
    PlantParameters,
    load_plant,
    load_plant_file,
    pendulum_plant,
    write_plant,
)

_POSITIVE = st.floats(1e-9, 1e9)
_NOT_NEGATIVE = st.floats(0.0, 1e9)
_SIGNED = st.floats(-1e9, 1e9)


def _values(specs: tuple, **fixed: st.SearchStrategy) -> st.SearchStrategy[dict[str, float]]:
    kinds = {
        spec.name: _POSITIVE if spec.exclusive_minimum else _SIGNED if spec.minimum is None else _NOT_NEGATIVE
        for spec in specs
    }
    return st.fixed_dictionaries({**kinds, **fixed})


_DRIVETRAINS = _values(DRIVETRAIN_SPECS, motor_static_friction=st.just(1e9)).map(
    lambda values: SeriesElasticParameters(**values)
)
_PLANTS = st.builds(
    lambda values, drivetrain, name: pendulum_plant(**values, drivetrain=drivetrain, name=name),
    _values(PLANT_SPECS, static_friction=st.just(1e9)),
    st.one_of(st.none(), _DRIVETRAINS),
    st.text(max_size=20),
)


@given(_PLANTS)
def test_a_plant_is_read_back_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, plant: PlantParameters) -> None:
    path = tmp_path_factory.getbasetemp() / "plant.yaml"
    assert write_plant(path, plant) == path
    assert load_plant(path) == plant
    assert load_plant(path).name == plant.name


def test_fields_and_tables_agree() -> None:
    assert list(load_plant("thesis").numbers) == [spec.name for spec in PLANT_SPECS]
    drivetrain = SeriesElasticParameters()
    assert {field.name for field in dataclasses.fields(drivetrain)} == {spec.name for spec in DRIVETRAIN_SPECS}
    for spec in DRIVETRAIN_SPECS:
        assert getattr(drivetrain, spec.name) == spec.default


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_loads_and_bears_its_name(preset: str) -> None:
    assert load_plant(preset).name == preset


def test_the_thesis_preset_has_the_numbers_of_the_thesis() -> None:
    plant = load_plant("thesis")
    assert (plant.inertia, plant.damping, plant.gravity) == (0.055, 11.77, 1.678)
    assert plant.drivetrain is None
    assert plant.static_friction == plant.coulomb_friction == 0.0


def test_the_x5_9_preset_shorted_has_the_damping_of_the_thesis() -> None:
    drivetrain = load_plant("x5_9").drivetrain
    assert drivetrain is not None
    hot = 1.0 + drivetrain.resistance_temperature_coefficient * (drivetrain.winding_temperature - 20.0)
    shorted = drivetrain.torque_constant * drivetrain.back_emf_constant * drivetrain.gear_ratio**2
    assert shorted / (drivetrain.winding_resistance * hot) == pytest.approx(11.77, abs=0.01)


def test_provenance_and_intervals_are_read_back(tmp_path: Path) -> None:
    plant = load_plant("thesis")
    path = write_plant(
        tmp_path / "new" / "p.yaml", plant, provenance={"method": "fit"}, intervals={"damping": (11.7, 11.8)}
    )
    assert load_plant_file(path)[1] == {"method": "fit", "intervals": {"damping": [11.7, 11.8]}}


_GOOD = """\
format: pendulum_plant/1
name: test
parameters:
  inertia: {value: 0.055, unit: kg m^2}
  damping: {value: 11.77, unit: N m s/rad}
  gravity: {value: 1.678, unit: N m}
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("unit: kg m^2", "unit: g m^2", "parameters.inertia: unit is 'g m^2'; expected 'kg m^2'"),
        (", unit: kg m^2", "", "parameters.inertia: unit is missing; expected 'kg m^2'"),
        ("value: 0.055", "value: 0", "inertia is 0.0 kg m^2; expected > 0"),
        ("value: 0.055", "value: -1.0", "inertia is -1.0 kg m^2; expected > 0"),
        ("value: 0.055", "value: .nan", "inertia is nan kg m^2; expected a finite number > 0"),
        ("value: 0.055", "value: .inf", "inertia is inf kg m^2; expected a finite number > 0"),
        ("value: 0.055", "value: np.inf", "inertia is 'np.inf'; expected a number > 0"),
        ("value: 0.055", "value: None", "inertia is 'None'; expected a number > 0"),
        ("value: 0.055", "value: null", "inertia is None; expected a number > 0"),
        ("value: 0.055", "value: true", "expected a number > 0"),
        ("value: 0.055, ", "", "parameters.inertia: value is missing; expected a number in kg m^2"),
        ("{value: 0.055, unit: kg m^2}", "0.055", "inertia is 0.055; expected {value: NUMBER, unit: kg m^2}"),
        ("  inertia: {value: 0.055, unit: kg m^2}\n", "", "parameters.inertia is missing"),
        ("inertia", "inertai", "unknown parameter 'inertai'; did you mean 'inertia'?"),
        ("unit: kg m^2", "unit: kg m^2, interval: [2, 1]", "interval is [2, 1]; expected [low, high] in kg m^2"),
        ("unit: kg m^2", "unit: kg m^2, interval: [.nan, 1]", "expected [low, high] in kg m^2"),
        ("unit: kg m^2", f"unit: kg m^2, interval: [1, {'9' * 400}]", "expected [low, high] in kg m^2"),
        ("pendulum_plant/1", "pendulum_plant/3", "format is 'pendulum_plant/3'; expected 'pendulum_plant/1'"),
        ("name: test", "name: [a]", "name is ['a']; expected text"),
        ("name: test", "nmae: test", "unknown parameter 'nmae'; did you mean 'name'?"),
        ("name: test", "drivetrain: [1]", "drivetrain is a list; expected a mapping"),
        ("name: test", "drivetrain: {stiffness: {value: 0, unit: N m/rad}}", "expected > 0"),
    ],
)
def test_a_file_is_refused_with_file_entry_value_and_unit(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(_GOOD, encoding="utf-8")
    assert load_plant(path).inertia == 0.055
    path.write_text(_GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ParameterError) as caught:
        load_plant(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_friction_that_feeds_energy_in_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"static_friction is 0\.1 N m; expected >= coulomb_friction = 0\.2 N m"):
        pendulum_plant(1.0, 1.0, 1.0, coulomb_friction=0.2, static_friction=0.1)
    with pytest.raises(ParameterError, match="motor_static_friction"):
        SeriesElasticParameters(motor_static_friction=0.1)
    assert pendulum_plant(1.0, 1.0, 1.0, coulomb_friction=0.2).static_friction == 0.2


def test_an_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(ParameterError, match=r"plant is 'thesi'; expected one of the presets thesis, dfki, x5_9"):
        load_plant("thesi")


def test_a_file_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(ParameterError, match="cannot be written"):
        write_plant(tmp_path / "taken", load_plant("thesis"))
    with pytest.raises(ParameterError, match="expected plain values"):
        write_plant(tmp_path / "p.yaml", load_plant("thesis"), provenance={"a": object()})
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_with_values_checks_again() -> None:
    with pytest.raises(ParameterError, match=r"damping is -1\.0"):
        load_plant("thesis").with_values(damping=-1.0)
    assert math.isclose(load_plant("thesis").with_values(damping=2).damping, 2.0)


def test_static_friction_follows_the_coulomb_friction_unless_it_is_its_own():
    """A changed Coulomb friction left the old static one behind: a plant that sticks five times as hard."""
    plain = pendulum_plant(0.05, 0.03, 1.5, coulomb_friction=0.05)
    for value in (0.01, 0.2, 0.0):
        assert plain.with_values(coulomb_friction=value).static_friction == value
    assert plain.with_values(coulomb_friction=0.01, static_friction=0.05).static_friction == 0.05
    sticks = plain.with_values(static_friction=0.09)
    assert sticks.with_values(coulomb_friction=0.04).static_friction == 0.09
    with pytest.raises(ParameterError, match=r"static_friction is 0.09 N m; expected >= coulomb_friction"):
        sticks.with_values(coulomb_friction=0.1)


@pytest.mark.parametrize(
    ("name", "root", "way"),
    [
        ("arm.urdf", "<robot/>", r"experiment --simulation FILE"),
        ("arm.urdf.xacro", '<robot xmlns:xacro="x"/>', r"xacro arm\.urdf\.xacro > arm\.urdf"),
    ],
)
def test_a_model_in_place_of_a_plant_file_says_what_takes_it(tmp_path, name, root, way):
    path = tmp_path / name
    path.write_text(f'<?xml version="1.0"?>\n{root}\n')
    with pytest.raises(ParameterError, match=rf"is XML; expected YAML \(.*{way}"):
        load_plant(path)
