"""How much delay and loss the network between plant and controller may have before the pendulum falls.

Plant and controller stand in two network namespaces, joined by a cable whose delay grows step by step until the upright
pendulum is lost. What the loop met is read from the plant's own bag: the age of each command when it arrived, on the
plant's clock. Beside it stands the delay at which the linear analysis of pendulum_lqr says the loop turns unstable.

    python -m tests.tools.faults.delay_margin
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.processes import ProcessSet, start_recorder
from pendulum_bags.runs.run_folder import write_json
from pendulum_lqr.linear.analysis import delayed_spectral_radius, loop_margins
from pendulum_lqr.linear.design import continuous_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, pendulum_plant, write_plant
from pendulum_msgs_py.programs import graph
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.network import (
    PEER_ADDRESS,
    PLANT_ADDRESS,
    Inside,
    cable_environment,
    two_machines,
    wait_for_torque,
    why_not,
)
from tests.tools.faults.slow_cable import SlowCable

__all__ = [
    "LIGHT",
    "LOSSES",
    "LossReport",
    "MarginReport",
    "Step",
    "find_delay_margin",
    "predicted_margin",
    "survive_loss",
]

LIGHT = pendulum_plant(inertia=0.1495, damping=0.1, gravity=2.996955, effort_limit=100.0, name="light")
"""A pendulum that feels delay: the preset ``dfki`` without dry friction, with a motor that does not saturate."""
Q, R = (1000.0, 1.0), 0.1
PERIOD = 0.002

_FALLEN = 0.3
_SETTLE_NS = 1_000_000_000
_RECENT_NS = 1_000_000_000
_POLL = 0.3
_NOISE = 0.3
_STATES, _COMMANDS, _APPLIED = "/sim/joint_states", "/sim/effort_command", "/sim/applied_effort"
LOSSES = (0.01, 0.05, 0.2)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Step:
    """One delay, held for some seconds.

    Attributes:
        delay: One-way delay of the cable [s].
        age: Median age of the commands when they reached the plant [s].
        std_theta: Standard deviation of the angle [rad].
        held: Whether the pendulum was still up at the end.
    """

    delay: float
    age: float
    std_theta: float
    held: bool


@dataclass(frozen=True)
class MarginReport:
    """What was found.

    Attributes:
        steps: In the order in which they were tried; the last one lost the pendulum.
        predicted: Delay at which the sampled linear loop turns unstable [s].
        continuous: Delay margin of the continuous loop, without sampling [s].
        means: How the cable delays.
    """

    steps: Sequence[Step]
    predicted: float
    continuous: float
    means: str

    @property
    def held(self) -> float:
        """Largest age of the commands at which the pendulum stayed up [s]."""
        return max(step.age for step in self.steps if step.held)

    @property
    def lost(self) -> float:
        """Age of the commands at which it was lost [s]."""
        return next(step.age for step in self.steps if not step.held)

    def sentence(self) -> str:
        """Return the result in words."""
        return (
            f"the pendulum stands with commands {self.held * 1e3:.1f} ms old and falls at {self.lost * 1e3:.1f} ms; "
            f"the linear analysis says {self.predicted * 1e3:.1f} ms at a period of {PERIOD * 1e3:g} ms "
            f"({self.continuous * 1e3:.1f} ms without sampling); delayed by {self.means}"
        )


@dataclass(frozen=True)
class LossReport:
    """A run over a cable that loses frames.

    Attributes:
        loss: Share of frames lost, each way.
        std_theta: [rad].
        longest: Longest time without torque [s].
        idle: Share of the states at which no torque acted: commands had become too old.
        held: Whether the pendulum stayed up.
    """

    loss: float
    std_theta: float
    longest: float
    idle: float
    held: bool


def predicted_margin(plant: PlantParameters = LIGHT) -> tuple[float, float]:
    """Return the delays at which the sampled and the continuous linear loop turn unstable [s]."""
    model = linearise(plant, UPRIGHT)
    K = continuous_lqr(model, Q, R).K
    continuous = loop_margins(model, K).delay
    low, high = 0.0, 2.0 * continuous
    for _ in range(40):
        middle = 0.5 * (low + high)
        if delayed_spectral_radius(model, K, PERIOD, middle) < 1.0:
            low = middle
        else:
            high = middle
    return low, continuous


def find_delay_margin(folder: Path, *, first: float = 0.008, step: float = 0.0015, hold: float = 4.0) -> MarginReport:
    """Raise the cable's delay until the pendulum is lost.

    Args:
        folder: For logs and the bag.
        first: Smallest one-way delay [s].
        step: Growth of the one-way delay from step to step [s].
        hold: How long each is held [s].

    Raises:
        FaultError: The network cannot be made, or torque does not come.
    """
    predicted, continuous = predicted_margin()
    spans: list[tuple[float, int, int]] = []
    with _loop(folder) as (bag, cable, processes):
        for number in itertools.count():
            delay = 0.0 if number == 0 else first + (number - 1) * step
            if delay > continuous:
                raise FaultError(f"the pendulum still stands at a one-way delay of {delay * 1e3:.1f} ms")
            cable.set(delay)
            began = time.time_ns()
            fallen = _hold(bag, processes, hold)
            spans.append((delay, began, time.time_ns()))
            if fallen:
                break
        means = cable.means
    if len(spans) == 1:
        raise FaultError("the pendulum falls without any delay of the cable: this machine is too busy to measure one")
    steps = [_step(bag, *span, held=index + 1 < len(spans)) for index, span in enumerate(spans)]
    return MarginReport(steps, predicted, continuous, means)


def survive_loss(folder: Path, losses: Sequence[float], *, delay: float = 0.005, hold: float = 5.0) -> list[LossReport]:
    """Hold the pendulum upright over a cable that delays and loses frames.

    Args:
        folder: For logs and the bag.
        losses: Shares of frames to lose, each way, one after the other.
        delay: One-way delay [s].
        hold: How long each is held [s].
    """
    spans = []
    with _loop(folder) as (bag, cable, processes):
        for loss in losses:
            cable.set(delay, loss)
            began = time.time_ns()
            fallen = _hold(bag, processes, hold)
            spans.append((loss, began, time.time_ns(), not fallen))
            if fallen:
                break
    return [_loss(bag, *span) for span in spans]


@contextmanager
def _loop(folder: Path) -> Iterator[tuple[Path, SlowCable, ProcessSet]]:
    """Start plant and recorder on the one machine, the controller on the other, and wait for torque."""
    logs, bag = folder / "logs", folder / "bag"
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "metadata.json", {"pendulum.run": {"experiment": "network"}})
    plant_file = str(write_plant(folder / "light.yaml", LIGHT))
    processes = Inside(logs, cable_environment(logs, static_peer=PEER_ADDRESS))
    with two_machines(slow=True) as (plant, peer, cable), processes:
        assert cable is not None
        processes.namespace = plant
        start_recorder(processes, bag, "/sim", folder / "metadata.json", "mcap")
        processes.start_node(
            graph.simulator("/sim", initial_theta=math.pi, plant=plant_file, rate_hz=1.0 / PERIOD, method="etd4")
        )
        # Beside the plant: only the controller is to feel the cable.
        processes.start_node(
            graph.disturbance("/sim", kind="uniform", amplitude=_NOISE, hold_time=0.01, autostart=True)
        )
        processes.namespace = peer
        processes.environment = cable_environment(logs, static_peer=PLANT_ADDRESS)
        processes.start_node(
            graph.controller("/sim", controller="lqr", plant=plant_file, q=list(Q), r=R, period=PERIOD)
        )
        wait_for_torque(bag, processes, time.time_ns())
        yield bag, cable, processes


def _hold(bag: Path, processes: ProcessSet, seconds: float) -> bool:
    """Wait, and return whether the pendulum fell."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        processes.check()
        time.sleep(_POLL)
        with read_bag(bag, [_STATES], start=time.time_ns() - _RECENT_NS) as opened:
            if _STATES in opened.topics and _has_fallen(opened.array(_STATES)["position"]):
                return True
    return False


def _has_fallen(position: Array) -> bool:
    return bool(np.any(np.abs(wrap(position - UPRIGHT)) > _FALLEN))


def _step(bag: Path, delay: float, began_ns: int, ended_ns: int, *, held: bool) -> Step:
    # What was under way when the delay changed belongs to the delay before.
    start = began_ns + min(_SETTLE_NS, (ended_ns - began_ns) // 3)
    with read_bag(bag, [_STATES, _COMMANDS], start=start, stop=ended_ns) as opened:
        position, commands = opened.array(_STATES)["position"], opened.array(_COMMANDS)
    ages = (commands["log_time_ns"] - commands["stamp_ns"]) / NANOSECONDS
    return Step(delay, float(np.median(ages)), float(np.std(wrap(position - UPRIGHT))), held)


def _loss(bag: Path, loss: float, began_ns: int, ended_ns: int, held: bool) -> LossReport:
    start = began_ns + min(_SETTLE_NS, (ended_ns - began_ns) // 3)
    with read_bag(bag, [_STATES, _APPLIED], start=start, stop=ended_ns) as opened:
        states, applied = opened.array(_STATES), opened.array(_APPLIED)
    driven = applied["stamp_ns"][applied["effort"] != 0.0]
    return LossReport(
        loss=loss,
        std_theta=float(np.std(wrap(states["position"] - UPRIGHT))),
        longest=max(float(np.max(np.diff(driven), initial=0) / NANOSECONDS) - PERIOD, 0.0),
        idle=float(np.mean(applied["effort"] == 0.0)),
        held=held,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Find the margin and print every step."""
    del argv
    if reason := why_not():
        sys.stdout.write(f"not tried: {reason}\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="pendulum_delay_") as folder:
        report = find_delay_margin(Path(folder, "delay"))
        for step in report.steps:
            sys.stdout.write(
                f"cable {step.delay * 1e3:5.1f} ms each way: commands {step.age * 1e3:5.1f} ms old, "
                f"std of theta {step.std_theta:.4f} rad, {'stands' if step.held else 'falls'}\n"
            )
        sys.stdout.write(f"{report.sentence()}\n")
        for lost in survive_loss(Path(folder, "loss"), LOSSES):
            sys.stdout.write(
                f"{100.0 * lost.loss:g} % of frames lost each way, 5 ms delay: no torque in {100.0 * lost.idle:.1f} % "
                f"of the periods, at most for {lost.longest * 1e3:.0f} ms, std of theta {lost.std_theta:.4f} rad, "
                f"{'stands' if lost.held else 'falls'}\n"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
