"""URDF and MJCF: loaded by independent programs, and moving as the plant does."""

from __future__ import annotations

import math
from xml.etree import ElementTree as XML

import pytest

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.plants.plant_parameters import PRESETS, load_plant
from pendulum_sim.model_files import link_shape, main, mjcf, urdf
from pendulum_sim.plant import make_plant

mujoco = pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", PRESETS)
def test_mujoco_loads_mjcf_and_urdf(name: str) -> None:
    parameters = load_plant(name)
    assert mujoco.MjModel.from_xml_string(mjcf(parameters)).joint(JOINT) is not None
    assert mujoco.MjModel.from_xml_string(urdf(parameters)).joint(JOINT) is not None


@pytest.mark.parametrize("name", PRESETS)
def test_the_drawn_link_has_the_inertia_and_weight_of_the_parameters(name: str) -> None:
    parameters = load_plant(name)
    shape = link_shape(parameters)
    assert shape.inertia + shape.mass * shape.length**2 == pytest.approx(parameters.inertia, rel=1e-12)
    assert shape.mass * 9.80665 * shape.length == pytest.approx(parameters.gravity, rel=1e-12)


def test_positive_angles_turn_the_bob_towards_plus_x() -> None:
    parameters = load_plant("thesis")
    model = mujoco.MjModel.from_xml_string(mjcf(parameters))
    data = mujoco.MjData(model)
    data.qpos[0] = math.pi / 2
    mujoco.mj_forward(model, data)
    assert data.xipos[1] == pytest.approx([link_shape(parameters).length, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(("name", "bound"), [("thesis", 1e-3), ("dfki", 2e-2), ("x5_9", 3e-2)])
def test_a_second_of_motion_in_mujoco_is_that_of_the_plant(name: str, bound: float) -> None:
    parameters = load_plant(name).with_values(angle_offset=0.05)
    model = mujoco.MjModel.from_xml_string(mjcf(parameters))
    data = mujoco.MjData(model)
    dt = 2e-3
    plant = make_plant(parameters, dt)
    plant.reset(0.6)
    data.joint(JOINT).qpos[0] = 0.6
    if parameters.drivetrain is not None:
        data.joint("motor_joint").qpos[0] = 0.6 - 0.05 + parameters.gravity * math.sin(0.55) / 100.0
    for k in range(500):
        effort = 1.2 * math.sin(0.02 * k)
        data.ctrl[0] = effort
        for _ in range(round(dt / model.opt.timestep)):
            mujoco.mj_step(model, data)
        state = plant.step(effort)
        assert data.joint(JOINT).qpos[0] == pytest.approx(state.theta, abs=bound)


def test_the_urdf_names_the_joint_of_the_contract_and_its_limits() -> None:
    joint = XML.fromstring(urdf(load_plant("thesis"))).find("joint")
    assert joint is not None
    assert joint.get("name") == JOINT
    limit = joint.find("limit")
    assert limit is not None
    assert float(limit.get("effort", "nan")) == 13.0


def test_the_program_writes_a_file_and_refuses_other_formats(tmp_path, capsys) -> None:
    assert main(["--plant", "dfki", "--format", "mjcf", "--output", str(tmp_path / "a" / "m.xml")]) == 0
    assert "<mujoco" in (tmp_path / "a" / "m.xml").read_text()
    assert main(["--format", "sdf"]) == 2
    assert "format is 'sdf'; expected urdf or mjcf" in capsys.readouterr().err
