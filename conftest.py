"""Fixtures for every test of the repository, beside a package or under ``tests/``: one definition for all."""

import gc
import importlib
import os
import sys
from pathlib import Path

# What is collected stays: the collector of garbage need not look at thousands of tests, neither while they come nor
# while they run.
gc.disable()

pytest_plugins = ["pendulum_testing.fixtures"]

# pytest names a test module after its path, `pendulum_sim.test.test_x`, and would take the repository's folder for the
# package of that name, unless the package is there already.
importlib.import_module("pendulum_msgs_py.programs.one_thread")
for _package in (
    "pendulum_msgs_py",
    "pendulum_sim",
    "pendulum_lqr",
    "pendulum_hw_bridge",
    "pendulum_rosbag",
    "pendulum_bags",
    "pendulum_console",
    "pendulum_learning",
    "pendulum_course",
):
    importlib.import_module(_package)

# xdist tells its workers the width of the terminal in which nobody reads them; tables are whole without one.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.pop("COLUMNS", None)

# As in an activated environment, where printed commands start with plain `python`.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])


def pytest_collection_finish() -> None:
    """Leave all that is there now to itself, and collect the garbage of what runs."""
    gc.freeze()
    gc.enable()
