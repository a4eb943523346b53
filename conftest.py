"""Fixtures for every test of the repository, beside a package or under ``tests/``: one definition for all."""

import importlib
import os

pytest_plugins = ["tests.fixtures"]

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
):
    importlib.import_module(_package)

# xdist tells its workers the width of the terminal in which nobody reads them; tables are whole without one.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.pop("COLUMNS", None)
