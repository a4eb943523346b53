"""URDF and MJCF: loaded by independent programs, and moving as the plant does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree as XML

import pytest

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.plants.plant_parameters import PRESETS, PlantParameters, load_plant
from pendulum_sim.exports.model_files import main, mjcf, urdf
from pendulum_sim.stepping.plants import make_pendulum

mujoco = pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", PRESETS)
def test_mujoco_loads_mjcf_and_urdf(name: str) -> None:
    parameters = load_plant(name)
    assert mujoco.MjModel.from_xml_string(mjcf(parameters)).joint(JOINT) is not None
    assert mujoco.MjModel.from_xml_string(urdf(parameters)).joint(JOINT) is not None


@pytest.mark.parametrize("name", PRESETS)
def test_the_drawn_link_has_the_inertia_and_weight_of_the_parameters(name: str) -> None:
    parameters = load_plant(name)
    (link,) = parameters.mechanism.bodies(parameters.packed)
    length = -link.centre[2]
    assert link.inertia[0] + link.mass * length**2 == pytest.approx(parameters.inertia, rel=1e-12)
    assert link.mass * 9.81 * length == pytest.approx(parameters.gravity, rel=1e-12)


def test_positive_angles_turn_the_bob_towards_plus_x() -> None:
    parameters = load_plant("thesis")
    model = mujoco.MjModel.from_xml_string(mjcf(parameters))
    data = mujoco.MjData(model)
    data.qpos[0] = math.pi / 2
    mujoco.mj_forward(model, data)
    assert data.xipos[1] == pytest.approx(
        [parameters.mechanism.chain((math.pi / 2,), parameters.packed)[1][0], 0.0, 0.0], abs=1e-12
    )


def _smooth(parameters: PlantParameters) -> PlantParameters:
    """Return the plant without what MuJoCo regularises or has no word for, so that the rest shows."""
    parameters = parameters.with_values(coulomb_friction=0.0, static_friction=0.0)
    if parameters.drivetrain is None:
        return parameters
    smooth = {"motor_coulomb_friction": 0.0, "motor_static_friction": 0.0, "hysteresis_torque": 0.0}
    return parameters.with_values(drivetrain=replace(parameters.drivetrain, **smooth))


def _farthest(parameters: PlantParameters, model_of: PlantParameters, effort: Callable[[int], float]) -> float:
    """Return how far the motion of a plant and of a MuJoCo model part within 0.6 s, over what the plant moves."""
    model = mujoco.MjModel.from_xml_string(mjcf(model_of))
    data = mujoco.MjData(model)
    dt = 2e-3
    plant = make_pendulum(parameters, dt, substeps=None if parameters.drivetrain is None else 40)
    plant.reset(0.6)
    data.joint(JOINT).qpos[0] = 0.6
    if parameters.drivetrain is not None:
        weight = parameters.gravity * math.sin(0.6 - parameters.angle_offset)
        data.joint("motor_joint").qpos[0] = 0.6 - parameters.angle_offset + weight / parameters.drivetrain.stiffness
    distance, moved = 0.0, 0.0
    for k in range(300):
        data.ctrl[0] = effort(k)
        for _ in range(round(dt / model.opt.timestep)):
            mujoco.mj_step(model, data)
        state = plant.step(effort(k))
        distance = max(distance, abs(float(data.joint(JOINT).qpos[0]) - state.theta))
        moved = max(moved, abs(state.theta - 0.6))
    return distance / moved


def _push(k: int) -> float:
    # Strong and quick enough to show motor, spring and link.
    return 8.0 * math.sin(0.02 * k) + 4.0 * math.sin(0.09 * k)


@pytest.mark.parametrize("name", PRESETS)
def test_motion_in_mujoco_is_that_of_the_plant(name: str) -> None:
    parameters = _smooth(load_plant(name)).with_values(angle_offset=0.05)
    assert _farthest(parameters, parameters, _push) < 0.01


@pytest.mark.parametrize("name", PRESETS)
def test_dry_friction_in_mujoco_is_nearly_that_of_the_plant(name: str) -> None:
    parameters = load_plant(name)
    assert _farthest(parameters, parameters, _push) < 0.03


@pytest.mark.parametrize(
    "change",
    [
        {"efficiency": 1.0},
        {"motor_damping": 0.0},
        {"back_emf_constant": 0.0},
        {"reflected_inertia": 2.0 * 0.19},
        {"reflected_inertia": 0.25 * 0.19},
        {"stiffness": 50.0},
        {"winding_temperature": 80.0},
    ],
)
def test_a_wrong_motor_or_spring_in_the_model_file_shows_in_the_motion(change: dict[str, float]) -> None:
    parameters = _smooth(load_plant("x5_9"))
    assert parameters.drivetrain is not None
    other = parameters.with_values(drivetrain=replace(parameters.drivetrain, **change))
    assert _farthest(parameters, other, _push) > 0.05


def test_the_urdf_of_the_series_elastic_plant_moves_slowly_as_the_plant_does() -> None:
    parameters = _smooth(load_plant("x5_9"))
    robot = XML.fromstring(urdf(parameters, ros2_control="gz"))
    joint = next(joint for joint in robot.iter("joint") if joint.find("axis") is not None)
    dynamics, limit = joint.find("dynamics"), joint.find("limit")
    assert dynamics is not None
    assert limit is not None
    assert float(dynamics.get("damping", "nan")) == pytest.approx(13.196, abs=1e-3)
    # A joint of that damping, at the motor's torque, creeps as the plant does under a constant command.
    plant = make_pendulum(parameters, 2e-3)
    plant.reset(0.0)
    for _ in range(1000):
        state = plant.step(0.9)
    torque = 0.9 * float(limit.get("effort", "nan")) / parameters.effort_limit
    creep = (torque - parameters.gravity * math.sin(state.theta)) / float(dynamics.get("damping", "nan"))
    assert abs(creep) > 0.01
    assert state.theta_dot == pytest.approx(creep, rel=0.05)


def test_every_link_that_gazebo_has_to_keep_has_inertia() -> None:
    robot = XML.fromstring(urdf(load_plant("thesis"), ros2_control="gz"))
    assert {link.get("name") for link in robot.iter("link") if link.find("inertial") is None} == {"world"}


def test_the_urdf_names_the_joint_of_the_contract_and_its_limits() -> None:
    joint = XML.fromstring(urdf(load_plant("thesis"))).find("joint")
    assert joint is not None
    assert joint.get("name") == JOINT
    limit = joint.find("limit")
    assert limit is not None
    assert float(limit.get("effort", "nan")) == 13.0


def test_the_program_writes_a_file_and_refuses_other_formats(tmp_path, capsys) -> None:
    assert main(["--plant", "dfki", "--format", "mjcf", "--out", str(tmp_path / "a" / "m.xml")]) == 0
    assert "<mujoco" in (tmp_path / "a" / "m.xml").read_text()
    assert main(["--format", "sdf"]) == 2
    assert "format is 'sdf'; expected urdf or mjcf" in capsys.readouterr().err
