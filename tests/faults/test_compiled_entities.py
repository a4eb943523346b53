"""Compiled loops use what rclpy owns: nothing that is gone, whoever destroys it and when."""

import os
import subprocess
import sys

from pendulum_testing.fixtures import PROJECT


def test_whatever_ends_a_compiled_loop_leaves_a_healthy_process(domain_id: int) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.tools.faults.compiled_entities", "16"],
        cwd=PROJECT,
        # Memory that was freed holds garbage.
        env={**os.environ, "ROS_DOMAIN_ID": str(domain_id), "MALLOC_PERTURB_": "165"},
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
