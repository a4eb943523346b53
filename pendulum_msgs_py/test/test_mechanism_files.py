"""Plant files of several joints: read back as written, and what they refuse."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import (
    MECHANISM_PRESETS,
    PLANT_SPECS,
    PRESETS,
    PlantParameters,
    is_mechanism,
    load_mechanism,
    load_plant,
    load_plant_file,
    pack_joints,
    resolve_plant,
    write_plant,
)
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run
from pendulum_testing.joint_plants import without_friction


def _changed(tmp_path: Path, old: str, new: str, preset: str = "acrobot") -> Path:
    text = resolve_plant(preset).read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "plant.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


@pytest.mark.parametrize("preset", MECHANISM_PRESETS)
def test_every_preset_loads_bears_its_name_and_is_read_back_to_the_last_bit(preset: str, tmp_path: Path) -> None:
    plant = load_mechanism(preset)
    assert plant.name == preset
    interval = {plant.mechanism.parameters[0].name: (0.1, 0.9), f"{plant.coordinates.names[1]}.damping": (0.0, 1.0)}
    path = write_plant(tmp_path / "copy.yaml", plant, provenance={"method": "by hand"}, intervals=interval)
    copy, provenance = load_plant_file(path)
    assert copy == plant
    assert copy.name == plant.name
    assert provenance == {"method": "by hand", "intervals": {key: list(value) for key, value in interval.items()}}


def test_acrobot_pendubot_and_both_motors_are_one_model_in_three_files() -> None:
    plants = {name: load_mechanism(name) for name in ("acrobot", "pendubot", "double_pendulum")}
    assert {plant.packed for plant in plants.values()} == {plants["acrobot"].packed}
    driven = {name: plant.coordinates.driven_names for name, plant in plants.items()}
    assert driven == {"acrobot": ("elbow",), "pendubot": ("shoulder",), "double_pendulum": ("shoulder", "elbow")}


def test_a_whole_number_is_a_value_too() -> None:
    plant = load_mechanism("acrobot").with_values({"elbow.damping": 1, "elbow.effort_limit": 5, "elbow.upper_stop": 2})
    assert [plant.value(f"elbow.{key}") for key in ("damping", "effort_limit", "upper_stop")] == [1.0, 5.0, 2.0]
    with pytest.raises(ParameterError, match=r"'shoulder.effort_limit' is not given for plant 'acrobot'"):
        plant.value("shoulder.effort_limit")
    with pytest.raises(ParameterError, match=r"'elbow.actuator' is not given"):
        plant.value("elbow.actuator")


def test_the_benchmarks_plants_come_with_and_without_friction() -> None:
    plain, rough = load_mechanism("acrobot_frictionless"), load_mechanism("acrobot")
    assert not plain.has_dry_friction
    assert plain.value("rotor_inertia") == 0.0
    assert (rough.value("shoulder.coulomb_friction"), rough.value("elbow.coulomb_friction")) == (0.16, 0.12)
    assert without_friction(rough).with_values({"rotor_inertia": 0.0}) == plain


@pytest.mark.parametrize("preset", [name for name in PRESETS if load_plant(name).drivetrain is None])
def test_a_plant_file_of_one_joint_is_read_as_the_mechanism_pendulum(preset: str) -> None:
    plant, single = load_mechanism(preset), load_plant(preset)
    assert plant.mechanism.name == "pendulum"
    assert plant.packed == (single.inertia, single.gravity, single.damping)
    assert plant.effort_limits == (single.effort_limit,)
    assert plant.joints[0].breakaway == single.static_friction


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  elbow:", "  wrist:", "joints has 'wrist'; expected shoulder, elbow, the joints of double_pendulum"),
        ("  elbow:", "  shoulder:", "key 'shoulder' is given twice"),
        ("  shoulder:", "  elbow_:", "joints has 'elbow_'"),
        (
            "model: double_pendulum",
            "model: double_pendulm",
            "model is 'double_pendulm'; did you mean 'double_pendulum'",
        ),
        ("model: double_pendulum\n", "model: [cart_pole]\n", "model is ['cart_pole']; did you mean 'cart_pole'"),
        ("format: pendulum_plant/2\n", "format: [1]\n", "format is [1]; expected 'pendulum_plant/1' or"),
        ("model: double_pendulum\n", "", "model is missing; expected one of pendulum, cart_pole"),
        ("unit: kg m^2", "unit: g m^2", "inertia_1: unit is 'g m^2'; expected 'kg m^2'"),
        ("value: 0.001, unit: N m s/rad", "value: 0.001, unit: N s/m", "damping: unit is 'N s/m'"),
        ("value: 0.001", "value: -0.001", "damping is -0.001 N m s/rad; expected"),
        ("mass_2: {value: 0.6255677234174437, unit: kg}", "", "parameters.mass_2 is missing; expected a value in kg"),
        ("mass_2:", "mass_3:", "unknown parameter 'mass_3'; did you mean 'mass_"),
        ("effort_limit: {value: 6.0, unit: N m}", "", "actuator.effort_limit is missing; expected a value in N m"),
        ("effort_limit: {value: 6.0", "effort_limit: {value: 0.0", "effort_limit is 0.0 N m; expected"),
        ("effort_limit: {value: 6.0", "effort_limit: {value: 60000.0", "is 60000.0 N m; expected > 0 and <= 10000"),
        ("effort_limit: {value: 6.0", "effort_limit: {value: .nan", "effort_limit is nan N m; expected a finite"),
        ("    actuator:", "    motor:", "unknown parameter 'motor'; expected one of damping"),
        ("0.05086984812807257", "0.00086984812807257", "give no positive inertia at shoulder = 0 rad, elbow ="),
        ("name: acrobot", "name: 3", "name is 3; expected text"),
        ("format: pendulum_plant/2", "format: pendulum_plant/3", "format is 'pendulum_plant/3'; expected"),
    ],
)
def test_a_wrong_plant_file_is_refused_with_the_entry(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(message)):
        load_mechanism(_changed(tmp_path, old, new))


def test_swapped_and_missing_joints_are_refused_with_the_order_of_the_model(tmp_path: Path) -> None:
    document = yaml.safe_load(resolve_plant("acrobot").read_text(encoding="utf-8"))
    joints = document["joints"]
    path = tmp_path / "plant.yaml"
    for names, message in (
        (("elbow", "shoulder"), "joints are elbow, shoulder; expected them in the order of double_pendulum: shoulder"),
        (("shoulder",), "joints.elbow is missing; expected an entry for each of shoulder, elbow"),
    ):
        document["joints"] = {name: joints[name] for name in names}
        path.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        with pytest.raises(ParameterError, match=re.escape(message)):
            load_mechanism(path)


def test_end_stops_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    path = _changed(tmp_path, "lower_stop: {value: -1.8", "lower_stop: {value: 2.0", "cart_pole")
    with pytest.raises(ParameterError, match=r"cart: lower_stop is 2.0 m; expected < upper_stop = 1.8"):
        load_mechanism(path)


def test_a_pendulum_with_what_the_equations_of_any_joints_have_not_says_what(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="series elastic; expected a rigid one"):
        pack_joints(load_mechanism("x5_9"))
    path = _changed(tmp_path, "parameters:\n", "parameters:\n  angle_offset: {value: 0.1, unit: rad}\n", "thesis")
    with pytest.raises(ParameterError, match=r"angle_offset of plant 'thesis' is 0.1 rad; expected 0"):
        pack_joints(load_mechanism(path))


@pytest.mark.parametrize("name", [spec.name for spec in PLANT_SPECS])
def test_a_pendulum_with_an_end_stop_is_a_mechanism_and_loses_nothing(name: str, tmp_path: Path) -> None:
    plant = load_plant("dfki")
    changed = plant.with_values({name: plant.value(name) + 0.5})
    if name in {"load_friction", "torque_offset", "angle_offset"}:
        with pytest.raises(ParameterError, match=f"{name} of plant 'dfki' is 0.5.*; expected 0 for the equations"):
            changed.with_values(upper_stop=3.0)
        return
    stopped = changed.with_values(upper_stop=3.0)
    assert (changed.is_pendulum, stopped.is_pendulum) == (True, False)
    path = write_plant(tmp_path / "stopped.yaml", stopped, intervals={name: (0.0, 9.0)})
    copy, provenance = load_plant_file(path)
    assert (copy, provenance["intervals"]) == (stopped, {name: [0.0, 9.0]})
    assert is_mechanism(path)
    assert copy.with_values(upper_stop=None) == changed


def test_a_program_for_one_joint_says_that_a_plant_has_several() -> None:
    with pytest.raises(ParameterError, match=r"describes a mechanism \(double_pendulum\); expected a plant of one"):
        load_plant("acrobot")
    # Simulators run any, and they alone open sealed ones.
    assert load_plant_to_run("acrobot") == (load_mechanism("acrobot"), False)


def test_values_are_changed_by_name_and_checked() -> None:
    plant = load_mechanism("acrobot")
    changed = plant.with_values({"mass_2": 1.0, "shoulder.damping": 0.5, "elbow.effort_limit": 2.0})
    assert (changed.value("mass_2"), changed.value("shoulder.damping")) == (1.0, 0.5)
    assert changed.value("elbow.effort_limit") == changed.effort_limits[0] == 2.0
    assert changed.packed[-2:] == (0.5, 0.001)
    for name in ("mass", "wrist.damping", "elbow.drag", "shoulder.effort_limit"):
        with pytest.raises(ParameterError, match=rf"unknown parameter '{name}'; expected one of mass_1"):
            plant.with_values({name: 1.0})
    with pytest.raises(ParameterError, match=r"static_friction is 0.01 N m; expected >= coulomb_friction = 0.12"):
        plant.with_values({"elbow.static_friction": 0.01})
    with pytest.raises(ParameterError, match="12 values and 2 joints; expected 11 and 2"):
        PlantParameters(plant.mechanism, (*plant.values, 1.0), plant.joints)
