"""The thesis's two experiments on the emulator, stepped as the bridge does in lockstep, but in one process."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pendulum_bags.runs.datasets import Recording
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.emulation.parameters import TimingParameters, load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.nodes.procedures import hand_trials, staircase
from pendulum_hw_bridge.port.actuator import Command, Feedback, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.contract.values import NANOSECONDS

__all__ = ["PERIOD", "hand_recording", "staircase_recording"]

PERIOD = 0.01
"""Of the feedback [s]."""
_PERIOD_NS = round(PERIOD * NANOSECONDS)
_LEAD_NS = 500_000


def _port(seed: int, *, flat: bool, strategy: Strategy) -> EmulatorBackend:
    still = replace(TimingParameters(), feedback_jitter=0.0, delay_jitter=0.0)
    parameters = replace(load_emulator("thesis"), flat=flat, timing=still)
    actuator = EmulatedX5(parameters, seed=seed, start_ns=-_PERIOD_NS - _LEAD_NS)
    port = EmulatorBackend(actuator, SteppedClock(), seed=seed)
    port.connect()
    port.set_strategy(strategy)
    return port


def _recording(records: list[tuple[float, Feedback]], name: str) -> Recording:
    stamps, feedback = zip(*records, strict=True)
    return Recording(
        np.array(stamps),
        np.array([f.position for f in feedback]),
        np.array([f.velocity for f in feedback]),
        np.array([f.effort for f in feedback]),
        # As out of a bag: position, velocity and effort of one record.
        meta={"source": name, "topic": "/hw/joint_states", "effort": "measured"},
    )


def _read(port: EmulatorBackend) -> Feedback:
    feedback = port.read(0.0)
    assert feedback is not None
    return feedback


def hand_recording(seed: int, trial: int) -> Recording:
    """Return one trial of experiment 1, from 1."""
    motion = hand_trials(seed, trials=trial)[-1]
    port = _port(1000 * seed + trial, flat=True, strategy=Strategy.DIRECT_PWM)
    records: list[tuple[float, Feedback]] = []
    while (time := len(records) * PERIOD) < motion.duration:
        feedback = _read(port)
        port.push(motion.torque(time, feedback.position, feedback.velocity))
        port.write(Command(pwm=0.0))
        records.append((time, feedback))
        port.clock.wait_until(len(records) * _PERIOD_NS)
    return _recording(records, f"hand_{seed}_{trial}")


def staircase_recording(seed: int, trial: int) -> Recording:
    """Return one trial of experiment 2, from 1, with its phases."""
    port = _port(1000 * seed + trial, flat=False, strategy=Strategy.PARALLEL_PWM)
    records: list[tuple[float, Feedback]] = []
    phases: list[tuple[float, str, dict[str, object]]] = []
    begin = 0.0
    for phase in staircase(trial):
        phases.append((begin, phase.name, {}))
        end = begin + (phase.hold or phase.trajectory.duration)
        while (time := len(records) * PERIOD) < end:
            records.append((time, _read(port)))
            position, velocity = phase.trajectory.at(time - begin)
            port.write(Command(position=position, velocity=velocity))
            port.clock.wait_until(len(records) * _PERIOD_NS)
        begin = end
    recording = _recording(records, f"stairs_{seed}_{trial}")
    return replace(recording, meta={**recording.meta, "phases": phases})
