"""The launch files: what they would start is checked everywhere, that launch loads them where launch is installed."""

from __future__ import annotations

import importlib
import importlib.util
import itertools
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from pendulum_hw_bridge.bridge.node_specs import SPECS as BRIDGE_SPECS
from pendulum_lqr.controller_interface.controller import COMMON_PARAMETERS, controller_parameters
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS
from pendulum_lqr.disturbances.disturbance_node import NODE_SPECS as DISTURBANCE_NODE_SPECS
from pendulum_lqr.nodes.bringup import ARGUMENTS, SIDES, parameter_file, programs
from pendulum_lqr.nodes.controller_node import NODE_SPECS as CONTROLLER_SPECS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import PRESETS, load_plant
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_sim.exports import model_files
from pendulum_sim.pictures import markers_node, viewer_node
from pendulum_sim.simulator import simulator_node
from pendulum_testing.fixtures import PROJECT

LAUNCH_FILES = sorted(PROJECT.glob("pendulum_*/launch/*.launch.py"))
DEFAULTS = {argument.name: argument.default for argument in ARGUMENTS}
LAB = {"lab": str(PROJECT / "pendulum_hw_bridge" / "config" / "lab_example.yaml")}


def _specs(program: NodeProgram) -> Any:
    if program.executable == "controller":
        own = controller_parameters(str(program.parameters["controller"]))
        return {spec.name: spec for spec in (*CONTROLLER_SPECS, *COMMON_PARAMETERS, *own)}.values()
    table = {
        "simulator": simulator_node.SPECS,
        "viewer": viewer_node.SPECS,
        "markers": markers_node.SPECS,
        "bridge": BRIDGE_SPECS,
        "disturbance": DISTURBANCE_SPECS + DISTURBANCE_NODE_SPECS,
    }
    return table[program.executable]


def test_there_are_launch_files() -> None:
    assert {path.name for path in LAUNCH_FILES} == {"bringup.launch.py", "rviz.launch.py"}


@pytest.mark.parametrize("plant", SIDES)
def test_every_choice_starts_nodes_that_know_their_parameters(plant: str) -> None:
    choices = {it.name: it.choices for it in ARGUMENTS if it.name in {"controller", "disturbance", "start", "viewer"}}
    lab = LAB if plant == "hebi" else {}
    # The lab file is read anew each time: a few combinations of all do.
    for combination in itertools.islice(itertools.product(*choices.values()), 0, None, 7 if lab else 1):
        value = {**DEFAULTS, **lab, "plant": plant, **dict(zip(choices, combination, strict=True))}
        found = programs(value)
        assert len({program.full_name for program in found}) == len(found)
        for program in found:
            validate(_specs(program), dict(program.parameters), where=program.full_name)


def test_both_plants_differ_by_namespace_only_for_controller_and_disturbance() -> None:
    found = programs({**DEFAULTS, "plant": "both", "disturbance": "uniform"})
    names = [program.full_name for program in found]
    assert names == [
        *("/sim/simulator", "/sim/controller", "/sim/disturbance"),
        *("/hw/bridge", "/hw/controller", "/hw/disturbance"),
    ]
    periods = {it.namespace: it.parameters["period"] for it in found if it.executable == "controller"}
    assert periods == {"/sim": 0.002, "/hw": 0.01}


def test_a_real_actuator_is_never_given_its_position() -> None:
    bridge = programs({**DEFAULTS, **LAB, "plant": "hebi", "start": "top"})[0]
    assert bridge.parameters == {"lab_file": LAB["lab"], "feedback_rate": 100.0}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"plant": "hebi"}, "without a lab file; expected lab:=FILE"),
        ({"plant": "hebi", "lab": "none.yaml"}, "lab file none.yaml does not exist"),
        ({"plant": "sim", **LAB}, "expected plant:=hebi"),
    ],
)
def test_a_real_actuator_is_brought_up_only_with_the_file_that_says_which(given: dict[str, str], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        programs({**DEFAULTS, **given})


def test_controller_and_bridge_keep_the_rate_of_the_lab_file(tmp_path: Path) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text("format: pendulum_lab/1\ndrive:\n  feedback_rate: {value: 200, unit: Hz}\n", encoding="utf-8")
    found = programs({**DEFAULTS, "plant": "hebi", "lab": str(lab)})
    assert [it.parameters.get("feedback_rate", it.parameters.get("period")) for it in found] == [200.0, 0.005]


@pytest.mark.parametrize(("name", "text"), [("sim_rate", "fast"), ("sim_rate", "-1"), ("seed", "1.5")])
def test_a_number_that_is_none_is_refused_by_name(name: str, text: str) -> None:
    with pytest.raises(ParameterError, match=f"{name} is '{text}'"):
        programs({**DEFAULTS, "disturbance": "uniform", name: text})


@pytest.mark.parametrize("file", ["lqr_thesis.yaml", "ros2_control_lqr.yaml"])
def test_the_parameter_file_fits_the_nodes(file: str) -> None:
    text = (PROJECT / "pendulum_lqr" / "config" / file).read_text(encoding="utf-8")
    for key, content in yaml.safe_load(text).items():
        values = {name: value for name, value in content["ros__parameters"].items() if name != "use_sim_time"}
        program = NodeProgram("pendulum_lqr", key.split("/")[-1], parameters=values)
        assert validate(_specs(program), values, where=key)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("", "is empty; expected a mapping"),
        ("bridge: {effort_limit: 1.0}", "has no section with ros__parameters"),
        ("/**/brigde: {ros__parameters: {effort_limit: 1.0}}", "which no node reads; did you mean 'bridge'"),
        ("/hw: {plant: {ros__parameters: {effort_limit: 1.0}}}", "section '/hw/plant', which no node reads"),
        ("bridge: {ros__parameters: {effort_limit: 1.0, effort_limit: 2.0}}", "key 'effort_limit' is given twice"),
    ],
)
@pytest.mark.parametrize("plant", SIDES)
def test_a_plant_is_not_started_without_the_limits_that_its_file_should_hold(
    plant: str, text: str | None, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "limits.yaml"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(ParameterError, match=r"limits\.yaml") as caught:
        programs({**DEFAULTS, "plant": plant, "params_file": str(file)})
    assert message in str(caught.value)


@pytest.mark.parametrize("section", ["/**", "/hw/*", "bridge", "/lab/hw/bridge"])
def test_a_parameter_file_for_a_node_of_the_launch_is_found_from_any_folder(
    section: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "limits.yaml").write_text(f"{section}: {{ros__parameters: {{effort_limit: 1.0}}}}", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert parameter_file("limits.yaml") == parameter_file("~/limits.yaml") == str(tmp_path / "limits.yaml")


@pytest.mark.parametrize(
    ("given", "waits"),
    [
        ({"plant": "sim"}, {"/sim": False}),
        ({"plant": "both"}, {"/sim": False, "/hw": True}),
        ({"plant": "emulator", "start": "top"}, {"/hw": False}),
        ({"plant": "hebi", "start": "top", **LAB}, {"/hw": True}),
        ({"plant": "hebi", "controller_waits": "false", **LAB}, {"/hw": False}),
        ({"plant": "sim", "controller_waits": "true"}, {"/sim": True}),
    ],
)
def test_a_controller_waits_where_its_torque_would_keep_the_bridge_from_being_armed(
    given: dict[str, str], waits: dict[str, bool]
) -> None:
    found = {it.namespace: it for it in programs({**DEFAULTS, **given}) if it.executable == "controller"}
    assert {space: not it.parameters["autoactivate"] for space, it in found.items()} == waits


_PLUGINS = ("Grid", "RobotModel", "MarkerArray", "TF", "MoveCamera", "Measure", "Orbit")
_RVIZ_CLASSES = {*(f"rviz_default_plugins/{it}" for it in _PLUGINS), "rviz_common/Displays", "rviz_common/Views"}
"""Of those that RViz of Jazzy has: ``plugins_description.xml`` of rviz_default_plugins, panels of rviz_common."""


def _classes(node: object) -> set[str]:
    if isinstance(node, dict):
        own = {str(node["Class"])} if node.get("Class") else set()
        return own.union(*(_classes(value) for value in node.values()))
    return set().union(*(_classes(value) for value in node)) if isinstance(node, list) else set()


def test_rviz_is_asked_for_plugins_that_it_has() -> None:
    configuration = yaml.safe_load((PROJECT / "pendulum_sim/rviz/pendulum.rviz").read_text(encoding="utf-8"))
    assert _classes(configuration) == _RVIZ_CLASSES


def test_rviz_shows_what_is_published() -> None:
    configuration = yaml.safe_load((PROJECT / "pendulum_sim/rviz/pendulum.rviz").read_text(encoding="utf-8"))
    displays = configuration["Visualization Manager"]["Displays"]
    topics = {display[key]["Value"] for display in displays for key in ("Topic", "Description Topic") if key in display}
    assert topics == {
        # Relative, so that a namespace around the launch moves them along with the plants.
        f"{side}/{topic}"
        for side in ("sim", "hw")
        for topic in ("markers", "robot_description")
    }


@pytest.mark.parametrize("model", PRESETS)
def test_the_urdf_of_every_preset_has_the_joint_of_the_contract(model: str) -> None:
    robot = ElementTree.fromstring(model_files.urdf(load_plant(model)))
    joint = robot.find("joint")
    assert joint is not None
    assert joint.get("name") == "pendulum_joint"
    assert {link.get("name") for link in robot.findall("link")} >= {"base_link", "pendulum_link"}


def test_the_arc_of_a_torque_turns_the_way_of_the_joint() -> None:
    points = markers_node.arc_points(2.0, 13.0, 0.1)
    assert points[0] == pytest.approx((0.0, 0.0, 0.1))
    assert points[1][0] < 0.0
    assert markers_node.arc_points(0.0, 13.0, 0.1) == []


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_launch_loads_the_file(path: Path) -> None:
    # Not "launch": the folders of launch files make an empty package of that name here.
    why = "launch is not among the wheels; it needs a full ROS installation"
    pytest.importorskip("launch_ros", reason=why)
    launch = importlib.import_module("launch")
    spec = importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert isinstance(module.generate_launch_description(), launch.LaunchDescription)
