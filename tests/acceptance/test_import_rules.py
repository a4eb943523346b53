"""The import rules bite: each kind of offence, put into one copy of the packages, is found and named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import grimp
import pytest

from pendulum_testing.fixtures import PROJECT
from tests.import_rules import RoomsContract

FOLDERS = [
    "pendulum_msgs_py",
    "pendulum_sim",
    "pendulum_lqr",
    "pendulum_hw_bridge",
    "bags/pendulum_rosbag",
    "bags/pendulum_bags",
    "bags/pendulum_console",
    "bags/pendulum_learning",
    "bags/pendulum_course",
]

OFFENCES = {
    "a core that imports ROS": (
        "pendulum_lqr/pendulum_lqr/offender.py",
        "import rclpy",
        "line 1: import rclpy",
    ),
    "a core that imports messages in a function": (
        "pendulum_lqr/pendulum_lqr/late_offender.py",
        "def late():\n    from sensor_msgs.msg import JointState\n    return JointState",
        "line 2: from sensor_msgs.msg import JointState",
    ),
    "a core that imports a shell": (
        "pendulum_lqr/pendulum_lqr/shell_offender.py",
        "from pendulum_msgs_py.ros import qos",
        "pendulum_lqr.shell_offender, line 1",
    ),
    "a robot that imports the simulator": (
        "pendulum_hw_bridge/pendulum_hw_bridge/offender.py",
        "import pendulum_sim",
        "pendulum_hw_bridge.offender -> pendulum_sim",
    ),
    "a vocabulary that imports what stands on it": (
        "pendulum_msgs_py/pendulum_msgs_py/offender.py",
        "import pendulum_bags",
        "pendulum_msgs_py.offender -> pendulum_bags",
    ),
    "a recorder that imports what reads runs": (
        "bags/pendulum_rosbag/pendulum_rosbag/offender.py",
        "import pendulum_bags",
        "pendulum_rosbag.offender -> pendulum_bags",
    ),
    "a recorder that imports the control": (
        "bags/pendulum_rosbag/pendulum_rosbag/control_offender.py",
        "import pendulum_lqr",
        "pendulum_rosbag.control_offender -> pendulum_lqr",
    ),
    "a writer of bags that imports a reader": (
        "bags/pendulum_rosbag/pendulum_rosbag/storage/offender.py",
        "import pendulum_rosbag.reader",
        "pendulum_rosbag.storage.offender -> pendulum_rosbag.reader",
    ),
    "equations that import the contract": (
        "pendulum_msgs_py/pendulum_msgs_py/dynamics/offender.py",
        "import pendulum_msgs_py.contract.names",
        "pendulum_msgs_py.dynamics.offender -> pendulum_msgs_py.contract.names",
    ),
    "recordings that reach into the robot": (
        "bags/pendulum_bags/pendulum_bags/offender.py",
        "import pendulum_hw_bridge",
        "pendulum_bags.offender -> pendulum_hw_bridge",
    ),
    "a module that imports itself through another": (
        "pendulum_msgs_py/pendulum_msgs_py/errors.py",
        "def late():\n    from pendulum_msgs_py import parameters",
        "pendulum_msgs_py.errors, line 2: from pendulum_msgs_py import parameters",
    ),
    "a room of recordings that imports one that stands on it": (
        "bags/pendulum_bags/pendulum_bags/runs/room_offender.py",
        "import pendulum_bags.comparison",
        "pendulum_bags.runs.room_offender imports pendulum_bags.comparison",
    ),
    "theory that imports the controllers' table": (
        "pendulum_lqr/pendulum_lqr/linear/offender.py",
        "import pendulum_lqr.controller_interface.controller",
        "pendulum_lqr.linear.offender -> pendulum_lqr.controller_interface.controller",
    ),
    "stepped plants that import the simulator's engines": (
        "pendulum_sim/pendulum_sim/stepping/offender.py",
        "import pendulum_sim.simulator.engines",
        "pendulum_sim.stepping.offender -> pendulum_sim.simulator.engines",
    ),
    "a drive that imports the bridge": (
        "pendulum_hw_bridge/pendulum_hw_bridge/drive/offender.py",
        "import pendulum_hw_bridge.bridge.module",
        "pendulum_hw_bridge.drive.offender -> pendulum_hw_bridge.bridge.module",
    ),
    "a room of the vocabulary that its layers forget": (
        "pendulum_msgs_py/pendulum_msgs_py/attic/__init__.py",
        "",
        "pendulum_msgs_py.attic",
    ),
    "mechanisms that import programs": (
        "pendulum_msgs_py/pendulum_msgs_py/mechanisms/offender.py",
        "import pendulum_msgs_py.programs.options",
        "pendulum_msgs_py.mechanisms.offender -> pendulum_msgs_py.programs.options",
    ),
    "a simulator that imports the vendor's library": (
        "pendulum_sim/pendulum_sim/offender.py",
        "import hebi",
        "pendulum_sim.offender -> hebi",
    ),
}


@pytest.fixture(scope="module")
def linted(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """Spoil a copy of the packages by all offences, each in a module of its own, and look at it by the rules."""
    root = tmp_path_factory.mktemp("spoilt")
    for folder in FOLDERS:
        shutil.copytree(PROJECT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (root / "tests").mkdir()
    for name in ("pyproject.toml", "tests/__init__.py", "tests/import_rules.py"):
        shutil.copyfile(PROJECT / name, root / name)
    for where, code, _ in OFFENCES.values():
        (root / where).parent.mkdir(exist_ok=True)
        (root / where).write_text(f"{code}\n", encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(root / folder) for folder in FOLDERS)}
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("offence", OFFENCES)
def test_an_offence_is_found_and_named(linted: subprocess.CompletedProcess[str], offence: str) -> None:
    _, _, named = OFFENCES[offence]
    assert linted.returncode == 1, linted.stdout
    assert named in " ".join(linted.stdout.split()), linted.stdout


CIRCLES = {
    "two rooms": ("p.a.x -> p.b.x", "p.b.y -> p.a.y"),
    "three rooms": ("p.a.x -> p.b.x", "p.b.y -> p.c.x", "p.c.y -> p.a.y"),
    "the room itself": ("p.a.x -> p.b", "p.b -> p.a.y"),
    "a module beside the rooms": ("p.a.x -> p.helper", "p.helper -> p.b.x", "p.b.y -> p.a.y"),
    "rooms within a room": ("p.a.one.x -> p.a.two.x", "p.a.two.y -> p.a.one.y"),
    "a room and the one within it": ("p.a.x -> p.a.one.x", "p.a.one.y -> p.a.x"),
    "a command in a core subpackage": ("p.a.x_cli -> p.b.x", "p.b.y -> p.a.y"),
}
ONE_WAY = {
    "one way": ("p.a.x -> p.b.x", "p.a.y -> p.b.y", "p.b.x -> p.c.x", "p.a.x -> p.c.y"),
    "commands above": ("p.commands.x_cli -> p.a.x", "p.commands.x_cli -> p.b.x", "p.__main__ -> p.commands.x_cli"),
    "within one room": ("p.a.x -> p.a.y", "p.a.y -> p.a.z"),
}


def _offences(imports: tuple[str, ...]) -> list[str]:
    graph = grimp.ImportGraph()
    for told in imports:
        for module in told.split(" -> "):
            parts = module.split(".")
            for depth in range(1, len(parts) + 1):
                graph.add_module(".".join(parts[:depth]))
        importer, imported = told.split(" -> ")
        graph.add_import(importer=importer, imported=imported)
    contract = RoomsContract("rooms", {"root_packages": ["p"]}, {"packages": ["p"]})
    found: list[str] = contract.check(graph, verbose=False).metadata["offences"]
    return found


@pytest.mark.parametrize("circle", CIRCLES)
def test_a_circle_of_rooms_is_found_in_whatever_way_it_goes(circle: str) -> None:
    found = _offences(CIRCLES[circle])
    assert found
    assert set(found) <= {told.replace(" -> ", " imports ") for told in CIRCLES[circle]}


@pytest.mark.parametrize("way", ONE_WAY)
def test_rooms_that_import_each_other_one_way_keep_the_rule(way: str) -> None:
    assert _offences(ONE_WAY[way]) == []
