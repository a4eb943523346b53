"""Swing-ups of a policy on the bridge's emulated machine with one quasi-direct drive, over DDS in lockstep."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.experiments.lockstep import record_run
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_rosbag.reader import read_bag

__all__ = ["emulated_trials"]

_OFF, _LATE = 0.25, 0.004
"""How far each machine is off, as a share, and its longest delay beside that of drive and bus [s]."""
_VARIED = ("inertia", "gravity", "damping", "coulomb_friction")
_KICK, _KICK_LENGTH, _KICKS_A_SECOND = 0.7, 0.05, 0.5
"""Size of a kick as a share of the torque limit, its length [s], and how many come in a second."""


@dataclass(frozen=True)
class _Trial:
    """One swing-up, as :func:`pendulum_bags.experiments.lockstep.record_run` carries it out."""

    machine: Path
    policy: Path
    plant: str
    theta: float
    seed: int
    kick: float
    duration: float = 10.0
    period: float = 0.002
    namespace: str = "/hw"
    storage: str = "mcap"
    simulated_time: bool = True
    has_bridge: bool = True

    @property
    def steps(self) -> int:
        return round(self.duration / self.period)

    def metadata(self) -> dict[str, Any]:
        return {}

    def plant_program(self, listeners: int) -> NodeProgram:
        return graph.bridge(
            self.namespace,
            plant=str(self.machine),
            backend="emulator",
            initial_positions=[self.theta],
            feedback_rate=1.0 / self.period,
            seed=self.seed,
            velocity_limit=25.0,
            clock="lockstep",
            lockstep_inputs=["effort_command", "disturbance"],
            lockstep_subscribers=listeners,
            lockstep_duration=self.duration,
        )

    def controller_program(self, subscribers: int = 0) -> NodeProgram:
        return graph.controller(
            self.namespace,
            controller="policy",
            policy=str(self.policy),
            plant=self.plant,
            period=self.period,
            use_sim_time=True,
            lockstep_subscribers=subscribers,
        )

    def disturbance_program(self, subscribers: int = 0) -> NodeProgram:
        return graph.disturbance(
            self.namespace,
            kind="pulse_train",
            amplitude=self.kick,
            pulse_width=_KICK_LENGTH,
            frequency=_KICKS_A_SECOND,
            start_time=1.0,
            autostart=True,
            use_sim_time=True,
            lockstep_subscribers=subscribers,
        )


def emulated_trials(folder: Path, policy: Path, plant: str, count: int) -> Iterator[float]:
    """Yield the largest angle from upright in the last second of each trial [rad].

    Args:
        folder: Where the recordings go.
        policy: The policy's file.
        plant: Preset of one joint that it was trained for; each machine is another plant near it, from any start.
        count: How many trials.

    Raises:
        FaultError: A plant faulted, or a program ended.
    """
    parameters = load_plant(plant)
    # With an end stop, out of reach, it is a machine with motors of its own, and no link on an X5-9.
    believed = parameters.with_values(upper_stop=1e3)
    for number in range(count):
        drawn = np.random.default_rng(1000 + number)
        changes = {name: believed.value(name) * (1.0 + drawn.uniform(-_OFF, _OFF)) for name in _VARIED}
        changes["transport_delay"] = drawn.uniform(0.0, _LATE)
        place = folder / f"trial_{number}"
        place.mkdir(parents=True)
        machine = write_plant(place / "machine.yaml", believed.with_values(changes), provenance={})
        theta = float(drawn.uniform(-math.pi, math.pi))
        trial = _Trial(machine, policy, plant, theta, number + 1, _KICK * parameters.effort_limit)
        bag = record_run(place / "hw", trial)  # type: ignore[arg-type]  # it has what a run over DDS needs
        with read_bag(bag) as opened:
            position = opened.joints("/hw/joint_states").position[:, 0]
        away = np.abs(np.mod(position, 2.0 * np.pi) - np.pi)
        yield float(away[-round(1.0 / trial.period) :].max())
