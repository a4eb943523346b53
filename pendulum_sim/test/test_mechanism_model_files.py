"""Mechanisms against MuJoCo, which reads the exported file and knows none of our equations; and compiled."""

from __future__ import annotations

import cmath
from xml.etree import ElementTree

import numba
import numpy as np
import pytest

from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import MECHANISM_PRESETS, load_mechanism
from pendulum_sim.batches.compiling import compile_tree
from pendulum_sim.exports.model_files import main, mjcf, urdf

mujoco = pytest.importorskip("mujoco")
_SMOOTH = ("cart_pole", "double_pendulum", "acrobot", "pendubot", "furuta", "reaction_wheel", "triple_pendulum")


@pytest.mark.parametrize("name", _SMOOTH)
def test_mujoco_reads_the_mjcf_and_finds_the_same_acceleration(name: str) -> None:
    plant = load_mechanism(name).with_values({})
    model = mujoco.MjModel.from_xml_string(mjcf(plant))
    # Dry friction and end stops are no part of the smooth equations.
    model.dof_frictionloss[:] = 0.0
    model.jnt_limited[:] = 0
    data = mujoco.MjData(model)
    n, driven = len(plant.joints), plant.coordinates.driven
    for state in np.random.default_rng(2).uniform(-3.0, 3.0, (50, 3, n)):
        q, v, torque = state
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = q, v
        limits = np.array(plant.effort_limits)
        data.ctrl[:] = np.clip(torque[list(driven)], -limits, limits)
        mujoco.mj_forward(model, data)
        expected = plant.acceleration(tuple(q), tuple(v), plant.coordinates.spread(tuple(data.ctrl)))
        np.testing.assert_allclose(data.qacc, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", _SMOOTH)
def test_the_tip_that_is_drawn_is_where_mujoco_has_it(name: str) -> None:
    plant = load_mechanism(name)
    model = mujoco.MjModel.from_xml_string(mjcf(plant))
    data = mujoco.MjData(model)
    for q in np.random.default_rng(3).uniform(-3.0, 3.0, (10, len(plant.joints))):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.geom_xpos[-1], plant.mechanism.chain(tuple(q), plant.packed)[-1], atol=1e-9)


@pytest.mark.parametrize("name", MECHANISM_PRESETS)
def test_a_urdf_is_read_by_mujoco_with_the_joints_of_the_model_in_their_order(name: str) -> None:
    plant = load_mechanism(name)
    text = urdf(plant)
    model = mujoco.MjModel.from_xml_string(text)
    assert [model.joint(index).name for index in range(model.njnt)] == list(plant.coordinates.names)
    efforts = [float(limit.get("effort", "")) for limit in ElementTree.fromstring(text).iter("limit")]
    assert tuple(value for value in efforts if value > 0.0) == plant.effort_limits


def test_without_rotors_the_urdf_moves_as_the_equations_do() -> None:
    plant = load_mechanism("double_pendulum_frictionless")
    model = mujoco.MjModel.from_xml_string(urdf(plant))
    model.opt.gravity[:] = 0.0, 0.0, -9.81
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (0.5, 1.0), (2.0, -3.0)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, plant.acceleration((0.5, 1.0), (2.0, -3.0), (0.0, 0.0)), rtol=1e-6)


def test_the_command_exports_a_mechanism(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--plant", "acrobot", "--format", "mjcf"]) == 0
    assert capsys.readouterr().out == mjcf(load_mechanism("acrobot"))
    assert main(["--plant", "cart_pole"]) == 0
    assert 'type="prismatic"' in capsys.readouterr().out
    assert main(["--plant", "acrobot", "--ros2-control", "gz"]) == 2
    assert "expected a plant of one joint" in capsys.readouterr().err


def test_a_link_that_no_body_can_have_is_simulated_but_not_exported() -> None:
    plant = load_mechanism("acrobot").with_values({"inertia_2": 0.038})
    with pytest.raises(ParameterError, match=r"lower_link of plant 'acrobot' has -0.0029 kg m\^2 about its centre"):
        mjcf(plant)


@pytest.mark.parametrize("name", ["thesis", "cart_pole", "acrobot", "furuta", "triple_pendulum"])
def test_compiled_with_numba_in_any_arithmetic_the_acceleration_is_that_of_python(name: str) -> None:
    plant = load_mechanism(name)
    forward, p, n = plant.mechanism.forward, plant.packed, len(plant.joints)
    compiled, vector = compile_tree(forward), compile_tree(forward, vector=True)
    by_complex = numba.njit(in_arithmetic(forward, cmath)) if n > 1 else None
    for state in np.random.default_rng(4).uniform(-9.0, 9.0, (20, 3, n)):
        q, v, torque = (tuple(row) for row in state.tolist())
        expected = forward(q, v, torque, p)
        assert compiled(q, v, torque, p) == pytest.approx(expected, rel=1e-12, abs=1e-12)
        assert vector(q, v, torque, p) == pytest.approx(expected, rel=1e-12, abs=1e-12)
        if by_complex is not None:
            rotated = by_complex(tuple(complex(value) for value in q), v, torque, p)
            assert [value.real for value in rotated] == pytest.approx(expected, rel=1e-12, abs=1e-12)
