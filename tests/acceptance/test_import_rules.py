"""The import rules bite: each kind of offence, put into one copy of the packages, is found and named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fixtures import PROJECT

FOLDERS = [
    "pendulum_msgs_py",
    "pendulum_sim",
    "pendulum_lqr",
    "pendulum_hw_bridge",
    "bags/pendulum_rosbag",
    "bags/pendulum_bags",
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
        "import pendulum_lqr.laws.controller",
        "pendulum_lqr.linear.offender -> pendulum_lqr.laws.controller",
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
        (root / where).write_text(f"{code}\n", encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(root / folder) for folder in FOLDERS)}
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("offence", OFFENCES)
def test_an_offence_is_found_and_named(linted: subprocess.CompletedProcess[str], offence: str) -> None:
    _, _, named = OFFENCES[offence]
    assert linted.returncode == 1, linted.stdout
    assert named in " ".join(linted.stdout.split()), linted.stdout
