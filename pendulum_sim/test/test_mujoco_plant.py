"""Model files of others as plants: what is read off them, how they move, and what is refused."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.exports.model_files import mjcf, urdf
from pendulum_sim.foreign.mujoco_mapping import JointMapping, MujocoMapping, load_mujoco_mapping
from pendulum_sim.foreign.mujoco_plant import load_mujoco_plant
from pendulum_sim.stepping.plant import RigidPlant
from pendulum_sim.stepping.plants import JointPlant, OneJoint, make_plant

pytest.importorskip("mujoco")

STANDING = """
<mujoco model="lab">
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="pole" pos="0 0 1">
      <joint name="{joint}" type="hinge" axis="0 1 0" damping="0.3" frictionloss="{friction}"/>
      <geom type="sphere" pos="0 0 0.4" size="0.05" mass="1.5"/>
    </body>
    {more}
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
"""A pendulum as others write it: it stands at 0 and has names of its own."""
MOTOR = '<motor name="torque" joint="{joint}" gear="2" ctrlrange="-4 4" ctrllimited="true"/>'
WEIGHT = 1.5 * 9.81 * 0.4
INERTIA = 1.5 * 0.4**2 + 0.4 * 1.5 * 0.05**2


def write(
    folder: Path,
    actuator: str = MOTOR,
    joint: str = "hinge",
    timestep: float = 0.001,
    integrator: str = "implicitfast",
    more: str = "",
    friction: float = 0.0,
) -> Path:
    path = folder / "lab.xml"
    text = STANDING.format(
        timestep=timestep,
        integrator=integrator,
        joint=joint,
        more=more,
        friction=friction,
        actuator=actuator.format(joint=joint),
    )
    path.write_text(text, encoding="utf-8")
    return path


def run(plant: JointPlant, theta: float, effort: float, push: float = 0.0) -> list[float]:
    plant.reset((theta,), (0.0,))
    return [plant.step((effort,), (push,)).position[0] for _ in range(250)]


def test_the_pendulums_equation_and_its_zero_are_read_off_the_file(tmp_path: Path) -> None:
    plant = load_mujoco_plant(write(tmp_path, friction=0.1))
    read = plant.parameters
    assert read.inertia == pytest.approx(INERTIA)
    assert (read.damping, read.coulomb_friction) == (0.3, 0.1)
    assert read.gravity == pytest.approx(WEIGHT)
    # A gear of 2 and a control of 4.
    assert read.effort_limit == 8.0
    assert read.angle_offset == 0.0
    assert plant.dt == pytest.approx(0.002)
    assert "its 3.14159 rad are our 0" in plant.remarks[0]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("actuator", ["", "none"])
def test_it_moves_as_that_equation_says(tmp_path: Path, actuator: str, sign: int) -> None:
    mapping = MujocoMapping(JointMapping(actuator=actuator, sign=sign, effort_limit=8.0))
    theirs = load_mujoco_plant(write(tmp_path, timestep=0.0002), mapping)
    ours = OneJoint(RigidPlant(theirs.parameters, theirs.dt))
    for effort in (0.0, 2.5, -7.0, 30.0):
        # Past the limit only a push acts: 30 N m of command are 8, 1 N m by hand are 1.
        assert run(theirs, 2.0, effort, 1.0) == pytest.approx(run(ours, 2.0, effort, 1.0), abs=2e-3)
        assert theirs.state.effort[0] == pytest.approx(max(-8.0, min(8.0, effort)))


@pytest.mark.parametrize("name", ["thesis", "x5_9", "dfki"])
@pytest.mark.parametrize("write_model", [mjcf, urdf])
def test_an_exported_model_needs_no_mapping(tmp_path: Path, name: str, write_model: object) -> None:
    parameters = load_plant(name).with_values(angle_offset=0.2)
    path = tmp_path / "own.xml"
    path.write_text(write_model(parameters), encoding="utf-8")  # type: ignore[operator]
    plant = load_mujoco_plant(path)
    assert plant.parameters.angle_offset == pytest.approx(0.2, abs=1e-9)
    if parameters.drivetrain is None:
        for value in ("inertia", "damping", "gravity", "coulomb_friction", "effort_limit"):
            # URDF knows no gravity of its own: MuJoCo's is 9.81 m/s^2.
            assert getattr(plant.parameters, value) == pytest.approx(getattr(parameters, value), rel=5e-4), value
    if write_model is mjcf:
        assert plant.parameters.effort_limit == parameters.effort_limit
        ours = make_plant(
            parameters.with_values(static_friction=parameters.coulomb_friction, load_friction=0.0), plant.dt
        )
        assert run(plant, 1.0, 2.0) == pytest.approx(run(ours, 1.0, 2.0), abs=0.05)


@pytest.mark.parametrize("delay", [0.01, 0.0113])
def test_an_exported_delay_is_read_back_and_acts(tmp_path: Path, delay: float) -> None:
    parameters = load_plant("dfki").with_values(transport_delay=delay)
    path = tmp_path / "own.xml"
    path.write_text(mjcf(parameters), encoding="utf-8")
    plant = load_mujoco_plant(path)
    assert plant.parameters.transport_delay == delay
    moves = [plant.step((1.0,), (0.0,)).velocity != (0.0,) for _ in range(10)]
    assert moves.index(True) in {5, 6}


def test_an_actuator_with_several_controls_before_the_motor_shifts_no_index(tmp_path: Path) -> None:
    pid = '<pid name="servo" joint="{joint}" kp="0"/>'
    plant = load_mujoco_plant(write(tmp_path, actuator=pid + MOTOR), MujocoMapping(JointMapping(actuator="torque")))
    assert plant.parameters.effort_limit == 8.0
    alone = load_mujoco_plant(write(tmp_path))
    assert run(plant, 2.0, 3.0) == run(alone, 2.0, 3.0)


def test_damping_and_armature_of_the_motor_are_in_the_equation(tmp_path: Path) -> None:
    motor = MOTOR.replace("gear", 'damping="0.2" armature="0.05" gear')
    found = load_mujoco_plant(write(tmp_path, actuator=motor)).parameters
    assert found.damping == pytest.approx(0.3 + 0.2 * 2.0**2)
    assert found.inertia == pytest.approx(INERTIA + 0.05 * 2.0**2)


@pytest.mark.parametrize(("rest", "springref"), [(0.0, 0.0), (0.7598908, 90.0)])
def test_a_hinge_with_a_spring_hangs_where_it_comes_to_rest(tmp_path: Path, rest: float, springref: float) -> None:
    path = tmp_path / "spring.xml"
    path.write_text(
        f'<mujoco><worldbody><body><joint name="h" axis="0 1 0" damping="1" stiffness="2" springref="{springref}"/>'
        '<geom size="0.02" pos="0 0 -0.4" mass="0.6"/></body></worldbody><actuator><motor joint="h" ctrlrange="-8 8"/>'
        "</actuator></mujoco>",
        encoding="utf-8",
    )
    plant = load_mujoco_plant(path)
    assert f"it hangs at {rest:.6g}"[:18] in plant.remarks[0]
    assert abs(plant.reset((0.0,), (0.0,)).position[0]) < 1e-9
    assert max(abs(plant.step((0.0,), (0.0,)).position[0]) for _ in range(500)) < 1e-4


def test_gravity_compensation_is_no_weight(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace('name="pole"', 'name="pole" gravcomp="1"'))
    plant = load_mujoco_plant(path)
    assert plant.parameters.gravity == 0.0
    assert run(plant, 1.0, 0.0)[-1] == pytest.approx(1.0, abs=1e-9)


MESH = (
    '<robot name="bench"><link name="world"/><link name="link"><inertial><origin xyz="0 0 -0.4"/><mass value="0.6"/>'
    '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial><collision><geometry>'
    '<mesh filename="package://bench_description/meshes/link.stl"/></geometry></collision></link>'
    '<joint name="shoulder" type="continuous"><parent link="world"/><child link="link"/><axis xyz="0 1 0"/>'
    '<limit effort="8" velocity="20"/></joint></robot>'
)
TETRAHEDRON = [[(0, 0, 0), (0, 1, 0), (1, 0, 0)], [(0, 0, 0), (1, 0, 0), (0, 0, 1)]]
TETRAHEDRON += [[(0, 0, 0), (0, 0, 1), (0, 1, 0)], [(1, 0, 0), (0, 1, 0), (0, 0, 1)]]


@pytest.mark.parametrize("place", ["", "bench_description/meshes", "bench_description/urdf/../meshes"])
def test_meshes_of_a_ros_package_are_found_or_left_out_with_a_word(tmp_path: Path, place: str) -> None:
    folder = tmp_path / "bench_description" / "urdf"
    folder.mkdir(parents=True)
    (folder / "bench.urdf").write_text(MESH, encoding="utf-8")
    if place:
        mesh = (tmp_path / place).resolve() / "link.stl"
        mesh.parent.mkdir(exist_ok=True)
        faces = [np.array([(0, 0, 0), *face], dtype="<f4").tobytes() + b"\0\0" for face in TETRAHEDRON]
        mesh.write_bytes(bytes(80) + len(faces).to_bytes(4, "little") + b"".join(faces))
    plant = load_mujoco_plant(folder / "bench.urdf")
    assert plant.parameters.gravity == pytest.approx(0.6 * 9.81 * 0.4)
    told = [remark for remark in plant.remarks if "link.stl is left out" in remark]
    assert len(told) == (0 if place else 1)


def test_a_source_for_xacro_says_how_it_becomes_a_model(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf.xacro"
    path.write_text('<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="arm"/>', encoding="utf-8")
    with pytest.raises(ParameterError, match=r"takes the URDF that it makes: xacro arm\.urdf\.xacro > arm\.urdf"):
        load_mujoco_plant(path)


def test_a_timestep_longer_than_our_period_makes_the_rate(tmp_path: Path) -> None:
    path = write(tmp_path, timestep=0.02)
    assert load_mujoco_plant(path).dt == pytest.approx(0.02)
    assert load_mujoco_plant(path, MujocoMapping(timestep=0.0005), rate_hz=100.0).dt == pytest.approx(0.01)


def test_a_reset_forgets_everything(tmp_path: Path) -> None:
    plant = load_mujoco_plant(write(tmp_path))
    first = run(plant, 2.0, 3.0, 0.5)
    assert run(plant, 2.0, 3.0, 0.5) == first


def test_a_simulation_that_blows_up_says_so_and_does_not_start_anew(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write(
        tmp_path,
        integrator="Euler",
        timestep=0.02,
        actuator=MOTOR.replace("4 4", "1e300 1e300").replace("-4", "-1e300"),
    )
    plant = load_mujoco_plant(path, MujocoMapping(JointMapping(effort_limit=1e200)))
    with pytest.raises(FaultError, match="is a timestep of 20 ms too long"):
        [plant.step((1e200,), (0.0,)) for _ in range(5)]
    assert [found.name for found in tmp_path.iterdir()] == ["lab.xml"]


SERVO = '<position name="servo" joint="{joint}" kp="10"/>'
FREE = '<motor name="torque" joint="{joint}"/>'
ARM = '<body name="arm"><joint name="elbow" type="hinge"/><geom type="sphere" size="0.1" mass="1"/></body>'


@pytest.mark.parametrize(
    ("file", "mapping", "sentence"),
    [
        (
            {"actuator": SERVO},
            {},
            "actuator 'servo' of .* is no source of torque .*; expected a motor, or actuator: none",
        ),
        ({"actuator": FREE}, {}, "has no limit of torque at its joint 'hinge'; expected effort_limit"),
        (
            {"actuator": MOTOR.replace("-4 4", "0 5")},
            {},
            "actuator 'torque' of .* gives 0 to 10 N m; expected torque both ways, or actuator: none and effort_limit",
        ),
        ({"more": ARM}, {}, r"has 2 hinges \(hinge, elbow\); expected one, or joint in a mapping file"),
        ({"more": ARM}, {"joint": "elbow"}, "has no actuator on joint 'elbow'; .* none, or one of torque"),
        ({}, {"joint": "knee"}, "has no hinge 'knee'; expected one of its hinges: hinge"),
        ({}, {"actuator": "motor"}, "has no actuator 'motor'; expected none or one of: torque"),
        ({}, {"effort_limit": 9.0}, "effort_limit is 9 N m, the actuator of .* gives 8 N m; expected at most that"),
        ({"actuator": MOTOR * 2}, {}, "MuJoCo refuses model"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_sentence(
    tmp_path: Path, file: dict[str, str], mapping: dict[str, object], sentence: str
) -> None:
    path = write(tmp_path, **file)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match=sentence) as refused:
        load_mujoco_plant(path, MujocoMapping(JointMapping(**mapping)))  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)


def test_a_rate_that_no_whole_timesteps_make_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"rate_hz is 300 Hz, .* expected whole timesteps of .*, 1 ms each"):
        load_mujoco_plant(write(tmp_path), rate_hz=300.0)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("joint: hinge", "format is missing or another; expected 'pendulum_simulation/1'"),
        ("format: pendulum_simulation/1\njoints: hinge", "unknown parameter 'joints'; did you mean 'joint'"),
        ("format: pendulum_simulation/1\nzero: {value: 180, unit: deg}", "zero: unit is 'deg'; expected 'rad'"),
        ("format: pendulum_simulation/1\nsign: 2", "sign is 2; expected 1 or -1"),
        ("format: pendulum_simulation/1\nactuator: 3", "actuator is 3; expected a name"),
        ("format: pendulum_simulation/1\neffort_limit: {value: 0, unit: N m}", "effort_limit is 0.0 N m; expected > 0"),
    ],
)
def test_a_mapping_file_is_refused_with_its_entry(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=sentence):
        load_mujoco_mapping(path)


def test_a_mapping_file_says_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(
        "format: pendulum_simulation/1\njoint: hinge\nactuator: none\nsign: -1\nzero: {value: 3.1, unit: rad}\n"
        "effort_limit: {value: 5, unit: N m}\ntimestep: {value: 0.002, unit: s}\n",
        encoding="utf-8",
    )
    expected = MujocoMapping(JointMapping("hinge", "none", -1, 3.1, 5.0), 0.002)
    assert load_mujoco_mapping(path) == expected
    assert load_mujoco_plant(write(tmp_path), expected).parameters.angle_offset == pytest.approx(3.1 - math.pi)


def test_without_mujoco_one_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ParameterError, match=r"mujoco is not installed, .* pip install 'pendulum_sim\[mujoco\]'"):
        load_mujoco_plant(write(tmp_path))


def test_parameters_are_those_of_a_plant_file(tmp_path: Path) -> None:
    assert isinstance(load_mujoco_plant(write(tmp_path)).parameters, PlantParameters)
