"""A swing-up from hanging on the bridge with the emulated actuator: it begins, comes up and stays, or is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_msgs_py.plants.plant_parameters import load_plant
from tests.tools.faults.bridge_rig import Rig

SHIPPED: dict[str, Any] = {spec.name: spec.default for spec in SPECS}


def swing_up(kind: str, start_time: float, duration: float) -> Rig:
    """Return the bridge after a controller has answered its states from hanging down on."""
    rig = Rig(seed=3, start=0.0)
    # As the bridge is shipped, but for the time until it gives up.
    first = float(SHIPPED["start_effort_limit"])
    rig.supervisor.limits = replace(rig.supervisor.limits, start_effort=first, starvation=1.0)
    plant = load_plant("thesis")
    law = ControlLoop(make_controller(kind, plant, rig.period, {"start_time": start_time}), math.inf)

    def answer() -> None:
        sample = rig.bridge.sample
        assert sample is not None
        effort = law.answer(sample, sample.stamp_ns)
        if effort is not None:
            rig.send(JointCommand(sample.stamp_ns, effort, "controller"))

    rig.loop.answer = answer
    rig.positions.clear()
    rig.run(duration)
    return rig


def test_with_a_soft_start_a_swing_up_comes_up_and_stays() -> None:
    rig = swing_up("energy_swing_up", 0.2, 11.0)  # it is up after 7.8 s; each costs 0.4 s
    assert rig.supervisor.mode is Mode.EFFORT, rig.supervisor.reason
    off = np.abs(np.remainder(np.array(rig.positions), 2.0 * math.pi) - math.pi)
    assert off[0] > 3.0
    last = off[-2000:]  # the motor is watched each millisecond
    assert last.max() < 0.15


def test_at_once_it_does_not_move_and_the_bridge_disarms_in_words() -> None:
    rig = swing_up("energy_swing_up", 0.0, 3.0)
    assert rig.supervisor.mode is Mode.DISARMED
    assert (
        "expected at most 2.0 N m to begin: bring the plant to where it asks for less, or let its torque rise"
        in rig.supervisor.reason
    )
    assert np.abs(np.array(rig.positions)).max() < 0.05
    assert not any(any(outcome.effort) for outcome in rig.outcomes)
