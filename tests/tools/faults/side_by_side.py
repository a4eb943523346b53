"""Two complete experiments on one machine at one time: each sees only its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_msgs_py.contract import names
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.outcome import Outcome, Trial

__all__ = ["DOMAIN_TRIALS", "run_side_by_side"]

_TIMEOUT = 240.0


def _command(bag: Path, seed: int, duration: float) -> list[str]:
    command = [sys.executable, "-m", "pendulum_bags", "experiment", "lockstep", "--bag", str(bag)]
    return [*command, "--seed", str(seed), "--duration", repr(duration)]


def run_side_by_side(folder: Path, duration: float, seeds: tuple[int, ...] = (11, 12)) -> Outcome:
    """Run experiments of different seeds at once, none of which is told a domain.

    Under the same names they say different things: one foreign message in a bag, or one foreign torque on a plant,
    and the bag differs from what its seed gives in one process.

    Args:
        folder: For the bags.
        duration: Simulated time [s].
        seeds: One for each experiment.
    """
    environment = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    running = [
        subprocess.Popen(
            _command(folder / str(seed), seed, duration),
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for seed in seeds
    ]
    outcome = Outcome()
    for seed, process in zip(seeds, running, strict=True):
        words, _ = process.communicate(timeout=_TIMEOUT)
        outcome.demand(process.returncode == 0, f"experiment {seed} ended with {process.returncode}: {words[-200:]}")
    if not outcome.survived:
        return outcome
    for seed in seeds:
        spec = RunSpec(
            controller_parameters={"q": [100.0, 0.01], "r": 0.1},
            disturbance={"amplitude": 2.5, "hold_time": 0.002, "duration": duration},
            duration=duration,
            seed=seed,
        )
        arrays = simulate(spec)
        with read_bag(folder / str(seed)) as bag:
            for topic, expected in (
                (names.JOINT_STATES, arrays.position),
                (names.DISTURBANCE, arrays.disturbance),
                (names.EFFORT_COMMAND, arrays.command),
                (names.APPLIED_EFFORT, arrays.applied),
            ):
                column = "position" if topic == names.JOINT_STATES else "effort"
                own = np.array_equal(bag.array(f"/sim/{topic}")[column], expected)
                outcome.demand(own, f"experiment {seed}: {topic} is not its own run's alone")
    return outcome


def collide(folder: Path) -> Outcome:
    """Ask for the domain in which another experiment is under way: refused, and the other is not disturbed."""
    outcome = Outcome()
    with reserve_domain() as domain:
        first = subprocess.Popen(
            [*_command(folder / "first", 21, 5.0), "--domain", str(domain)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            while not (folder / "first").exists() and first.poll() is None:
                time.sleep(0.05)
            second = subprocess.run(
                [*_command(folder / "second", 22, 1.0), "--domain", str(domain)],
                capture_output=True,
                text=True,
                timeout=_TIMEOUT,
                check=False,
            )
            words = second.stdout + second.stderr
            outcome.demand(second.returncode == 2, f"the second ended with {second.returncode}: {words[-200:]}")
            expected = f"ROS domain {domain} is in use"
            outcome.demand(expected in words, f"the second said {words[-200:]!r}; expected {expected!r}")
        finally:
            words, _ = first.communicate(timeout=_TIMEOUT)
    outcome.demand(first.returncode == 0, f"the first ended with {first.returncode}: {words[-200:]}")
    return outcome


DOMAIN_TRIALS: tuple[Trial, ...] = (
    Trial("two complete experiments side by side", lambda folder, _: run_side_by_side(folder, 20.0)),
    Trial("two experiments in one domain", lambda folder, _: collide(folder)),
)
