"""Run a program of this package: ``python -m pendulum_hw_bridge EXE ARGS`` is ``ros2 run pendulum_hw_bridge EXE ARGS``."""

from pendulum_msgs_py.executables import run_package

raise SystemExit(run_package("pendulum_hw_bridge"))
