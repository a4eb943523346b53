"""Run a program of this package, as ``ros2 run pendulum_console EXE`` does."""

from pendulum_msgs_py.programs.executables import run_package

raise SystemExit(run_package("pendulum_console"))
