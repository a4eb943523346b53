"""Plant files whose actuators are motors, commanded in volts."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, in_units_of, limits_from_parameters
from pendulum_msgs_py.contract.supervisor import PUSH_LIMIT_FACTOR, Input, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_differences import describe_plants, plant_mismatch, read_plants
from pendulum_msgs_py.plants.plant_parameters import (
    load_mechanism,
    read_plant_document,
    require_one_joint,
    resolve_plant,
    write_plant,
)

QUBE = load_mechanism("qube_servo")
NS = 2_000_000_000


def _changed(tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    document = yaml.safe_load(resolve_plant("qube_servo").read_text())
    change(document["joints"]["arm"]["actuator"])
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def test_a_motor_gives_torque_per_volt_and_damps_by_its_back_emf() -> None:
    assert QUBE.coordinates.drive_unit == "V"
    assert QUBE.coordinates.slew_unit == "V/s"
    assert QUBE.coordinates.units[2] == "N m"
    assert QUBE.gains == (0.042 / 8.4,)
    assert QUBE.command_limits == (10.0,)
    assert QUBE.effort_limits == pytest.approx((0.05,))
    assert QUBE.packed[-2:] == pytest.approx((0.00027 + 0.042**2 / 8.4, 5e-5))
    assert QUBE.actuators[0].time_constant == pytest.approx(0.00116 / 8.4)
    assert QUBE.voltage_efforts((2.0,), (10.0, 0.0)) == pytest.approx((2 * 0.005 - 10 * 0.042**2 / 8.4,))
    geared = QUBE.with_values({"arm.gear_ratio": 3.0, "arm.back_emf_constant": 0.05})
    assert geared.gains == pytest.approx((3 * 0.005,))
    assert geared.packed[-2] == pytest.approx(0.00027 + 9 * 0.042 * 0.05 / 8.4)


def test_the_plant_behind_its_motors_has_their_back_emf_and_no_volts() -> None:
    behind = QUBE.torque_plant
    assert not behind.coordinates.volts
    assert behind.packed == QUBE.packed
    assert behind.effort_limits == behind.command_limits == QUBE.effort_limits
    assert behind.torque_plant is behind
    # The weights mean the same: r of a torque is r of the voltage over the gain squared.
    assert QUBE.weights == (behind.weights[0], pytest.approx(behind.weights[1] * 0.005**2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["motor"].pop("resistance"), r"motor\.resistance is missing; expected a value in ohm"),
        (lambda a: a["motor"].pop("torque_constant"), r"motor\.torque_constant is missing; expected a value in N m/A"),
        (lambda a: a["motor"].pop("voltage_limit"), r"motor\.voltage_limit is missing; expected a value in V"),
        (lambda a: a["motor"]["resistance"].update(value=0.0), r"resistance is 0\.0 ohm; expected > 0"),
        (lambda a: a["motor"].update(resistance={"value": 8.4, "unit": "kohm"}), "unit is 'kohm'; expected 'ohm'"),
        (
            lambda a: a.update(effort_limit={"value": 0.09, "unit": "N m"}),
            r"actuator\.effort_limit is given beside a motor; expected it left out: voltage_limit is in its place",
        ),
        (
            lambda a: a.update(time_constant={"value": 0.01, "unit": "s"}),
            r"time_constant is given beside a motor; expected it left out: inductance / resistance is in its place",
        ),
        (
            lambda a: a["motor"].update(dead_band={"value": 10.0, "unit": "V"}),
            r"arm: dead_band is 10\.0 V; expected < voltage_limit = 10\.0 V",
        ),
        (
            lambda a: a["motor"].update(inductance={"value": 20.0, "unit": "H"}),
            r"arm: inductance is 20\.0 H; expected at most .* for this inertia and back EMF",
        ),
        (
            lambda a: a.pop("motor"),
            r"actuator\.effort_limit is missing; expected a value in N m, or a motor for commands in volts",
        ),
    ],
)  # fmt: skip
def test_a_motor_that_is_none_is_refused_in_a_sentence(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    with pytest.raises(ParameterError, match=message):
        load_mechanism(_changed(tmp_path, change))


def test_a_plant_is_driven_in_volts_altogether_or_not() -> None:
    both = yaml.safe_load(resolve_plant("double_pendulum").read_text())
    motor = {"resistance": {"value": 2.0, "unit": "ohm"}, "torque_constant": {"value": 0.05, "unit": "N m/A"},
             "voltage_limit": {"value": 6.0, "unit": "V"}}  # fmt: skip
    both["joints"]["elbow"]["actuator"] = {"motor": motor}
    with pytest.raises(ParameterError, match=r"some actuators of plant .* have a motor, and others none"):
        read_plant_document(both, Path("both.yaml"))


def test_the_file_that_is_written_gives_the_plant_back(tmp_path: Path) -> None:
    changed = QUBE.with_values({"arm.dead_band": 0.3, "arm.back_emf_constant": 0.05, "arm.transport_delay": 0.002})
    path = write_plant(tmp_path / "q.yaml", changed, intervals={"arm.resistance": (8.0, 9.0)})
    assert load_mechanism(path) == changed
    assert yaml.safe_load(path.read_text())["joints"]["arm"]["actuator"]["motor"]["resistance"]["interval"] == [
        8.0,
        9.0,
    ]
    (read,) = read_plants(describe_plants([changed]))
    assert read == changed


def test_a_design_for_a_torque_differs_from_a_plant_in_volts() -> None:
    assert "arm.resistance 8.4, runs none" in plant_mismatch(QUBE, [load_mechanism("furuta")])
    assert "arm.resistance 8.4, runs 9 ohm" in plant_mismatch(QUBE, [QUBE.with_values({"arm.resistance": 9.0})])


def test_one_joint_in_volts_is_no_pendulum_of_the_scalar_equations(tmp_path: Path) -> None:
    document = yaml.safe_load(resolve_plant("qube_servo").read_text())
    one = {
        "format": "pendulum_plant/2",
        "model": "pendulum",
        "parameters": {"inertia": {"value": 1e-3, "unit": "kg m^2"}, "gravity": {"value": 0.05, "unit": "N m"}},
        "joints": {"pendulum_joint": {"actuator": document["joints"]["arm"]["actuator"]}},
    }
    path = tmp_path / "one.yaml"
    path.write_text(yaml.safe_dump(one, sort_keys=False))
    plant = load_mechanism(path)
    assert not plant.is_pendulum
    assert plant.gains == QUBE.gains
    assert plant.with_values({"resistance": 4.2}).gains == (0.01,)
    with pytest.raises(ParameterError, match="which has a motor in volts, or end stops; expected one of one joint"):
        require_one_joint(path, "something else")


def test_limits_are_volts_and_a_push_stays_a_torque() -> None:
    specs = {spec.name: spec.unit for spec in in_units_of(LIMIT_SPECS, QUBE.coordinates)}
    assert {specs[f"{name}_limit"] for name in ("effort", "start_effort", "handover_effort")} == {"V"}
    assert specs["effort_slew_limit"] == "V/s"
    values = validate(LIMIT_SPECS, {"effort_limit": 20.0})
    with pytest.raises(ParameterError, match=r"effort_limit is 20\.0 V; expected at most 10\.0 V, the limit of the"):
        limits_from_parameters(values, QUBE.command_limits, coordinates=QUBE.coordinates, lockstep=False)
    limits = limits_from_parameters(
        validate(LIMIT_SPECS, {}), QUBE.command_limits, push=QUBE.effort_limits, coordinates=QUBE.coordinates,
        lockstep=False,
    )  # fmt: skip
    supervisor = PlantSupervisor(limits, coordinates=QUBE.coordinates)
    sample = JointSample(NS, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
    assert supervisor.arm(NS, sample) == ""
    supervisor.offer(Input.PUSH, JointCommand(NS, (100.0,), "hand", ("pendulum",)), NS)
    assert supervisor.decide(NS, sample).push == (0.0, pytest.approx(PUSH_LIMIT_FACTOR * 0.05))
    supervisor.offer(Input.EFFORT_COMMAND, JointCommand(NS, (3.0,), "lqr", ("arm",)), NS)
    supervisor.decide(NS, sample)
    assert supervisor.reason.startswith("zero torque: lqr asks for 3.00 V; expected at most 2.0 V to begin")


def test_topics_of_volts_and_efforts_have_no_name_in_common() -> None:
    assert QUBE.coordinates.topics == names.VOLTAGE_TOPICS
    assert QUBE.torque_plant.coordinates.topics == names.EFFORT_TOPICS
    assert not set(names.VOLTAGE_TOPICS) & set(names.EFFORT_TOPICS)


@pytest.mark.parametrize(
    ("recorded", "topics"),
    [
        ({"applied_effort", "applied_voltage"}, names.VOLTAGE_TOPICS),
        ({"voltage_command"}, names.VOLTAGE_TOPICS),
        # A controller in volts on a plant that takes efforts: without effect.
        ({"voltage_command", "applied_effort"}, names.EFFORT_TOPICS),
        ({"effort_command", "voltage_command"}, names.EFFORT_TOPICS),
        (set(), names.EFFORT_TOPICS),
    ],
)
def test_a_recording_shows_what_its_plant_was_driven_by(recorded: set[str], topics: names.DriveTopics) -> None:
    assert names.drive_topics({f"/sim/{name}" for name in recorded}, "/sim") is topics


def test_a_push_limit_that_is_none_is_refused() -> None:
    with pytest.raises(ParameterError, match="push is"):
        PlantLimits((1.0,), push=(0.0,))
