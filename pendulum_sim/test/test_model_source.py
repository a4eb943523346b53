"""Numbers of a model file by name: where they stand, and the same file with others there."""

from __future__ import annotations

import difflib
from pathlib import Path

import numpy as np
import pytest

from pendulum_msgs_py.errors import ParameterError

mujoco = pytest.importorskip("mujoco")

from pendulum_sim.foreign.model_source import WRITTEN, ModelSource  # noqa: E402

MJCF = """<?xml version="1.0"?>
<!-- a robot > of the lab -->
<mujoco>
  <include file="./parts/classes.xml"/>
\t<worldbody>
    <body name='link'  pos="0 0 1">
      <!-- <joint name="arm" damping="9"/> -->
      <joint axis="0 1 0" name="arm"   frictionloss = '0.10' class="geared"/>
      <inertial pos="0 0.0  -0.40" mass="0.6" diaginertia="0.02 0.02 0.0005"/>
      <body name="tip" pos="0 0 -1"><joint name="wrist" axis="0 1 0"/>
        <geom name="ball" type="sphere" size="0.1" mass="0.5" pos="0 0 -0.2"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="arm" gear="2 0 0 0 0 0"/></actuator>
</mujoco>
"""
CLASSES = """<mujocoinclude><default><joint armature="0.01"/><default class="geared"><joint damping="0.3"/></default>
</default></mujocoinclude>
"""
URDF = """<robot name="r"><link name="base"/>
  <link name="pole"><inertial><origin xyz="0 0 -0.3"/><mass value="1.5"/>
    <inertia ixx="0.1" ixy="0" ixz="0.01" iyy="0.1" iyz="0" izz="0.02"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="pole"/><axis xyz="0 1 0"/></joint></robot>
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "classes.xml").write_text(CLASSES)
    path = tmp_path / "robot.xml"
    path.write_text(MJCF)
    return path


def changed(path: Path, out: Path, values: dict[str, float]) -> tuple[list[str], ModelSource]:
    """Write a file with other numbers; return the lines that differ, and what it is then."""
    source = ModelSource(path)
    parameters = [source.parameter(name) for name in values]
    source.write(out, parameters, list(values.values()), [f"{WRITTEN} by a test -- see there", "second line"])
    lines = difflib.ndiff(path.read_text().splitlines(), out.read_text().splitlines())
    return [line for line in lines if line[0] in "+-"], ModelSource(out)


def test_only_the_characters_of_the_numbers_change(robot: Path) -> None:
    values = {
        "joint/arm/frictionloss": 0.125,
        "body/link/mass": 0.75,
        "body/link/ipos/z": -0.5,
        "actuator/arm/gear": 3.0,
    }
    lines, again = changed(robot, robot.with_name("new.xml"), values)

    assert lines == [
        "+ <!-- Identified by output error by a test - - see there",
        "+      second line -->",
        '-       <joint axis="0 1 0" name="arm"   frictionloss = \'0.10\' class="geared"/>',
        '+       <joint axis="0 1 0" name="arm"   frictionloss = \'0.125\' class="geared"/>',
        '-       <inertial pos="0 0.0  -0.40" mass="0.6" diaginertia="0.02 0.02 0.0005"/>',
        '+       <inertial pos="0 0.0  -0.5" mass="0.75" diaginertia="0.02 0.02 0.0005"/>',
        '-   <actuator><motor joint="arm" gear="2 0 0 0 0 0"/></actuator>',
        '+   <actuator><motor joint="arm" gear="3 0 0 0 0 0"/></actuator>',
    ]
    assert {name: again.parameter(name).value for name in values} == values
    assert again.model.body("link").mass[0] == 0.75
    assert again.model.joint("arm").damping[0] == 0.3


def test_a_number_of_a_default_is_put_into_the_element_itself(robot: Path) -> None:
    one = ModelSource(robot).parameter("joint/wrist/armature")
    assert one.place == "attribute armature of joint wrist itself, which had it from a default"
    _, again = changed(robot, robot.with_name("new.xml"), {"joint/wrist/armature": 0.02})

    assert again.model.joint("wrist").armature[0] == 0.02
    assert again.model.joint("arm").armature[0] == 0.01


def test_inertia_and_distance_scale_as_a_whole_and_mass_of_geoms_becomes_an_inertial_element(robot: Path) -> None:
    before = ModelSource(robot).model.body("tip")
    values = {"body/link/inertia": 0.03, "body/link/ipos": 0.5, "body/tip/mass": 0.7}
    lines, again = changed(robot, robot.with_name("new.xml"), values)

    np.testing.assert_allclose(again.model.body("link").inertia, [0.03, 0.03, 0.00075])
    np.testing.assert_allclose(again.model.body("link").ipos, [0.0, 0.0, -0.5])
    assert again.model.body("tip").mass[0] == 0.7
    np.testing.assert_allclose(again.model.body("tip").inertia, before.inertia, rtol=1e-8)
    np.testing.assert_allclose(again.model.body("tip").ipos, before.ipos, atol=1e-9)
    assert any('<inertial pos="0 0 -0.2" quat="1 0 0 0" mass="0.7" ' in line for line in lines)


def test_a_number_in_an_included_file_is_written_to_a_copy_of_that_file(robot: Path) -> None:
    part = robot.parent / "parts" / "classes.xml"
    part.write_text('<mujoco><worldbody><body name="far"><joint name="x" type="slide" damping="1"/>\n'
                    '<geom size="0.1" mass="1"/></body></worldbody></mujoco>')  # fmt: skip
    robot.write_text(MJCF.replace(' class="geared"', ""))
    lines, again = changed(robot, robot.with_name("new.xml"), {"joint/x/damping": 1.5})

    assert lines[-1] == '+   <include file="parts/new_classes.xml"/>'
    assert again.model.joint("x").damping[0] == 1.5
    assert 'damping="1"/>' in part.read_text()


def test_urdf_has_its_own_elements(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(URDF)
    values = {
        "joint/hinge/damping": 0.2,
        "joint/hinge/frictionloss": 0.3,
        "body/pole/mass": 2.0,
        "body/pole/inertia": 0.2,
    }
    lines, again = changed(path, tmp_path / "new.urdf", {**values, "body/pole/ipos": 0.4})

    assert '<inertia ixx="0.2" ixy="0" ixz="0.02" iyy="0.2" iyz="0" izz="0.04"/>' in "".join(lines)
    assert (again.model.joint("hinge").damping[0], again.model.joint("hinge").frictionloss[0]) == (0.2, 0.3)
    assert (again.model.body("pole").mass[0], again.model.body("pole").ipos[2]) == (2.0, -0.4)
    with pytest.raises(ParameterError, match="URDF does not have"):
        ModelSource(path).parameter("joint/hinge/armature")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("damping", "expected KIND/NAME/ATTRIBUTE"),
        ("joint/elbow/damping", r"states no joint 'elbow'; expected one of: arm, wrist"),
        ("joint/wrist/dampin", "expected one of these: armature, axis, damping, frictionloss, stiffness"),
        ("body/link/volume", "expected mass, inertia or ipos"),
        ("geom/ball/density", "does not state density; expected one of these: mass, pos, size, type"),
        ("geom/ball/size/3", "size has 1 numbers"),
        ("geom/ball/type", "type is 'sphere'"),
    ],
)
def test_a_name_of_nothing_is_refused(robot: Path, name: str, said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        ModelSource(robot).parameter(name)


def test_the_file_itself_and_a_folder_without_its_parts_are_refused(robot: Path, tmp_path: Path) -> None:
    source = ModelSource(robot)
    (tmp_path / "elsewhere").mkdir()
    for out, said in (
        (robot, "the model itself"),
        (tmp_path / "elsewhere" / "new.xml", "expected --out in its folder"),
    ):
        with pytest.raises(ParameterError, match=said):
            source.write(out, [source.parameter("body/link/mass")], [1.0], ["x"])
    assert robot.read_text() == MJCF


def test_only_a_file_that_was_written_here_is_overwritten_and_its_line_ends_stay(robot: Path) -> None:
    robot.write_bytes(MJCF.replace("\n", "\r\n").encode())
    _, first = changed(robot, robot.with_name("new.xml"), {"body/link/mass": 0.7})
    _, again = changed(robot, first.path, {"body/link/mass": 0.8})
    assert again.parameter("body/link/mass").value == 0.8
    text = first.path.read_bytes()
    assert text.count(b"\n") == text.count(b"\r\n")
    mine = robot.with_name("mine.xml")
    mine.write_text("<mujoco/>")
    for out, said in ((mine, "has not written"), (robot, "the model itself"), (robot.with_name("new.urdf"), "ends in")):
        with pytest.raises(ParameterError, match=said):
            changed(robot, out, {"body/link/mass": 0.7})
    assert mine.read_text() == "<mujoco/>"


def test_joints_in_frames_are_found_and_replicated_ones_are_no_candidates(tmp_path: Path) -> None:
    path = tmp_path / "frames.xml"
    link = '<body name="{0}"><frame><joint axis="0 1 0" damping="0.1"/></frame><geom size="0.1" pos="0 0 -0.3"/></body>'
    copies = f'<replicate count="2" offset="1 0 0">{link.format("copy")}</replicate>'
    path.write_text(f"<mujoco><worldbody>{link.format('link')}{copies}</worldbody></mujoco>")
    source = ModelSource(path)
    named = {one.name for one in source.candidates(range(source.model.njnt))}
    assert {"joint/link/damping", "body/link/mass"} <= named
    assert not any("copy" in name for name in named)
    with pytest.raises(ParameterError, match="states no joint 'copy0'; expected one of: link"):
        source.parameter("joint/copy0/damping")
