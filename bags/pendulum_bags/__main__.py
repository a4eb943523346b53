"""Run a program of this package: ``python -m pendulum_bags EXE ARGS`` is ``ros2 run pendulum_bags EXE ARGS``."""

from pendulum_msgs_py.executables import run_package

raise SystemExit(run_package("pendulum_bags"))
