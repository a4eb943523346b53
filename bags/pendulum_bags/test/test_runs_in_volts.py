"""Runs of a plant in volts: simulated, recorded, read back, and exported."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pendulum_bags.analyse.questions.metrics import answer as metrics
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.repeats import record_simulation
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.frequency_response.record import INPUT_UNIT, record_of_joints
from pendulum_bags.identification.identify import RATIOS, identify_joints
from pendulum_bags.identification.joint_recordings import read_joints
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.replay.joint_replay import replay_joints
from pendulum_bags.runs.run_data import joints_of, read_run
from pendulum_msgs_py.contract.names import VOLTAGE_TOPICS
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.joint_parameters import Actuator, Motor
from pendulum_msgs_py.plants.plant_parameters import (
    PlantParameters,
    load_mechanism,
    load_plant_file,
    pendulum_plant,
    write_plant,
)
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.tables import export_bag

QUBE = load_mechanism("qube_servo").with_values({"arm.inductance": 0.0})
SPEC = RunSpec(
    plant="qube_servo", design_plant="qube_servo", duration=1.0, method="auto",
    disturbance={"amplitude": 1.0, "joints": ["arm"], "volts": True},
)  # fmt: skip


def test_a_run_in_volts_is_recorded_and_read_back_in_volts(tmp_path: Path) -> None:
    bag = record_simulation(tmp_path / "sim", SPEC)
    run = simulate(SPEC)
    with read_bag(bag) as opened:
        assert {f"/sim/{name}" for name in VOLTAGE_TOPICS} <= set(opened.topics)
        assert not {"/sim/effort_command", "/sim/disturbance", "/sim/applied_effort"} & set(opened.topics)
        export_bag(opened, tmp_path / "tables", format="csv")
    arm = read_run(bag, joint="arm")
    assert arm.window.effort_unit == "V"
    assert arm.window.effort_word == "voltage"
    count = arm.window.effort.size
    np.testing.assert_array_equal(arm.window.effort, run.command[:count, 0])
    assert arm.applied is not None
    np.testing.assert_array_equal(arm.applied.value, run.applied[: arm.applied.value.size, 0])
    record = record_of_joints({name: read_run(bag, joint=name) for name in ("arm", "pendulum")}, "arm")
    assert record.facts[INPUT_UNIT] == "V"
    assert np.abs(record.excitation).max() == pytest.approx(1.0, rel=0.1)
    commands = pd.read_csv(tmp_path / "tables" / "sim__voltage_command.csv")
    assert "effort" not in commands
    assert commands["voltage"].tolist() == pytest.approx(run.command[: len(commands), 0].tolist())
    states = pd.read_csv(tmp_path / "tables" / "sim__joint_states.csv")
    assert {"applied_voltage", "disturbance_voltage"} <= set(states)


def test_one_joint_in_volts_is_read_by_joint_so_that_no_page_shows_newton_metres(tmp_path: Path) -> None:
    plant = pendulum_plant(0.05, 0.02, 1.2)
    (own,) = plant.joints
    link = replace(own, actuator=Actuator(1.0, motor=Motor(2.0, 0.05, 6.0, gear_ratio=14.0)))
    file = str(write_plant(tmp_path / "link.yaml", PlantParameters(plant.mechanism, plant.values, (link,), "link")))
    spec = replace(SPEC, plant=file, design_plant=file, disturbance={"amplitude": 0.5})
    bag = record_simulation(tmp_path / "sim", spec)
    (joint,) = joints_of(bag)
    assert read_run(bag, joint=joint).window.effort_unit == "V"
    found = metrics(Reading.of(bag), "/sim")
    assert "max_abs_u" not in found
    assert 0.0 < found[f"{joint}.max_abs_u"] <= 6.0


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[PlantParameters, Path]:
    """Return a plant in volts, and a recording of it under the LQR of the preset."""
    folder = tmp_path_factory.mktemp("volts")
    truth = QUBE.with_values({"arm.damping": 4e-4, "pendulum_inertia": 1.45e-4})
    files = [str(write_plant(folder / f"{name}.yaml", plant)) for name, plant in (("truth", truth), ("design", QUBE))]
    spec = replace(SPEC, plant=files[0], design_plant=files[1], duration=5.0)
    return truth, record_simulation(folder / "sim", replace(spec, disturbance={"amplitude": 3.0, "hold_time": 0.02}))


def test_a_plant_is_identified_from_voltages_with_its_motor_given(
    recorded: tuple[PlantParameters, Path], tmp_path: Path
) -> None:
    truth, bag = recorded
    result = identify_joints(QUBE, [read_joints(bag, QUBE.coordinates)], extras="friction")
    assert not result.refused
    found = result.plant()
    assert found.coordinates.volts
    for name in ("arm_inertia", "pendulum_inertia", "arm.damping", "pendulum.damping"):
        assert found.value(name) == pytest.approx(truth.value(name), rel=1e-3)
    assert found.actuators == truth.actuators
    said = " ".join(result.sentences())
    assert "The motor of arm was given: 0.005 per volt" in said
    assert RATIOS in said
    again, provenance = load_plant_file(result.write(tmp_path / "own.yaml"))
    assert provenance["scale"] == "ratios only: fixed by the gain of the given motors"
    assert again == found
    # Of the damping without back EMF, as its value is.
    low, high = provenance["intervals"]["arm.damping"]
    assert low == pytest.approx(4e-4, rel=1e-3)
    assert low < found.value("arm.damping") < high
    replay = replay_joints(bag, found, window=0.1)
    assert replay.score.share < 0.05
    assert replay_joints(bag, QUBE, window=0.1).score.share > 2.0 * replay.score.share


def test_an_identified_damping_below_the_back_emf_is_another_motors() -> None:
    weaker = QUBE.torque_plant.with_values({"arm.damping": 1e-4})
    with pytest.raises(ParameterError, match=r"arm\.damping is 0\.0001; expected at least 0\.00021, the back"):
        weaker.with_motors(QUBE)
    assert QUBE.torque_plant.with_motors(QUBE).packed == pytest.approx(QUBE.packed)


def test_volts_are_no_input_of_a_plant_driven_by_a_torque_and_the_reverse(
    recorded: tuple[PlantParameters, Path], tmp_path: Path
) -> None:
    with pytest.raises(DataError, match="the input of arm is a voltage; expected an effort in N m"):
        read_joints(recorded[1], load_mechanism("furuta").coordinates)
    torque = replace(SPEC, plant="furuta", design_plant="furuta", disturbance={"amplitude": 0.01})
    bag = record_simulation(tmp_path / "sim", torque)
    with pytest.raises(DataError, match="the input of arm is an effort; expected a voltage"):
        read_joints(bag, QUBE.coordinates)
