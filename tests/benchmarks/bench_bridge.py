"""The bridge on the emulated X5-9: the emulator against the thesis, every fault, and the loop at three rates."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tests.benchmarks import Peer, Row, measured
from tests.tools.faults.bridge_scenarios import CASES, SCENARIOS, Scenario, run_scenario
from tests.tools.faults.node_rig import ros_of_its_own

__all__ = ["rows"]

SECONDS = float(os.environ.get("PENDULUM_BENCH_SECONDS", "60"))
"""Length of each run of the loop [s]."""
REPETITIONS = 20
"""Repetitions of each fault."""
_THESIS = {"inertia": 0.055, "damping": 11.77, "gravity": 1.678}


def rows() -> Iterator[Row]:
    """Yield all rows."""
    yield from _emulator()
    yield from _identification()
    yield from _faults()
    yield from _loop()


def _emulator() -> Iterator[Row]:
    from pendulum_hw_bridge.emulation.parameters import load_emulator
    from pendulum_hw_bridge.emulation.x5 import EmulatedX5

    parameters = load_emulator("x5_9")
    for temperature, theirs in ((20.0, 11.87), (22.0, 11.77), (40.0, 10.8)):
        damping = parameters.shorted_winding_damping(temperature)
        yield measured(
            f"emulator, damping of the shorted winding at {temperature:g} degC",
            damping,
            "N m s/rad",
            at_least=theirs * 0.995,
            at_most=theirs * 1.005,
            less_is_better=False,
        )
    actuator = EmulatedX5(parameters)
    actuator.advance_to(1_000_000_000)
    begin = time.perf_counter()
    for instant in range(1_000_000_000, 101_000_000_000, 10_000_000):
        actuator.advance_to(instant)
        actuator.feedback(instant)
    speed = 100.0 / (time.perf_counter() - begin)
    yield measured("emulator with feedback at 100 Hz", speed, "x real time", at_least=100.0)


def _identification() -> Iterator[Row]:
    from scipy import stats

    inertia_damping = np.array([_hand_trial(index) for index in range(6)])
    gravity = np.array([_staircase_trial(index) for index in range(3)])
    found = {
        "inertia": (inertia_damping[:, 0], "kg m^2"),
        "damping": (inertia_damping[:, 1], "N m s/rad"),
        "gravity": (gravity, "N m"),
    }
    for name, (values, unit) in found.items():
        mean = float(values.mean())
        spread = float(values.std(ddof=1)) / math.sqrt(len(values))
        half = float(stats.t.ppf(0.975, len(values) - 1)) * spread
        # The staircase's trials differ by noise only: its systematic part is the offset between up and down.
        allowed = max(half, 0.01 * _THESIS[name]) if name != "inertia" else max(half, 0.006)
        yield measured(
            f"emulator, the thesis's experiment finds the {name}",
            mean,
            unit,
            at_least=_THESIS[name] - allowed,
            at_most=_THESIS[name] + allowed,
            less_is_better=False,
            note=f"95 % interval of {len(values)} trials: {mean - half:.5g} to {mean + half:.5g}",
        )


def _hand_trial(index: int) -> tuple[float, float]:
    from pendulum_hw_bridge.backends.emulator import EmulatorBackend
    from pendulum_hw_bridge.emulation.parameters import load_emulator
    from pendulum_hw_bridge.emulation.x5 import EmulatedX5
    from pendulum_hw_bridge.nodes.procedures import hand_trials
    from pendulum_hw_bridge.port.actuator import Command, Strategy
    from pendulum_hw_bridge.port.clocks import SteppedClock

    motion = hand_trials(1)[index]
    port = EmulatorBackend(EmulatedX5(replace(load_emulator("thesis"), flat=True), seed=index), SteppedClock())
    port.connect()
    port.set_strategy(Strategy.DIRECT_PWM)
    records = []
    while port.now_ns() < motion.duration * 1e9:
        feedback = port.read(0.1)
        assert feedback is not None
        port.push(motion.torque(feedback.stamp_ns * 1e-9, feedback.position, feedback.velocity))
        port.write(Command(pwm=0.0))
        records.append((feedback.stamp_ns * 1e-9, feedback.velocity, feedback.effort))
    stamps, velocity, effort = np.array(records).T
    regressors = np.column_stack([np.gradient(velocity, stamps), velocity])
    inertia, damping = np.linalg.lstsq(regressors, -effort, rcond=None)[0]
    return float(inertia), float(damping)


def _staircase_trial(index: int) -> float:
    from pendulum_hw_bridge.backends.emulator import EmulatorBackend
    from pendulum_hw_bridge.emulation.parameters import load_emulator
    from pendulum_hw_bridge.emulation.x5 import EmulatedX5
    from pendulum_hw_bridge.nodes.procedures import staircase
    from pendulum_hw_bridge.port.actuator import Command, Strategy
    from pendulum_hw_bridge.port.clocks import SteppedClock

    port = EmulatorBackend(EmulatedX5(load_emulator("thesis"), seed=100 + index), SteppedClock())
    port.connect()
    port.set_strategy(Strategy.PARALLEL_PWM)
    holds = []
    for phase in staircase(index + 1):
        begin, records = port.now_ns(), []
        while port.now_ns() < begin + (phase.trajectory.duration + phase.hold) * 1e9:
            feedback = port.read(0.1)
            assert feedback is not None
            position, velocity = phase.trajectory.at((port.now_ns() - begin) * 1e-9)
            port.write(Command(position=position, velocity=velocity))
            records.append((math.sin(feedback.position), feedback.effort))
        if phase.name == "static":
            holds.append(np.mean(records, axis=0))
    sine, effort = np.array(holds).T
    return float(sine @ effort / (sine @ sine))


def _faults() -> Iterator[Row]:
    from pendulum_bags.experiments.domain import reserve_domain

    with reserve_domain() as domain, ros_of_its_own(domain):
        yield from (_row_of_fault(scenario) for scenario in SCENARIOS)


def _row_of_fault(scenario: Scenario) -> Row:
    """Return the row of a fault over all strategies and phases in which it can come."""
    cases = [case for case in CASES if case.phase in scenario.phases]
    reactions = [
        run_scenario(scenario, cases[repetition % len(cases)], repetition) for repetition in range(REPETITIONS)
    ]
    seen = sorted({reaction.reaction for reaction in reactions})
    complaints = [complaint for reaction in reactions for complaint in reaction.complaints(scenario)]
    note = f"reaction: {', '.join(seen)}; states: {', '.join(sorted({r.mode for r in reactions}))}"
    note += f"; beyond the limit: {max(reaction.beyond_limit for reaction in reactions):.1f} N m"
    if complaints:
        note += f"; {complaints[0]}"
    what = f"fault: {scenario.name}, largest of {REPETITIONS} in {len(cases)} strategies and phases"
    if scenario.zero and not (scenario.by_motion or scenario.unseen):
        slowest = max(reaction.time_to_zero_ms for reaction in reactions)
        row = measured(f"{what}, time to zero torque", slowest, "ms", at_most=60.0, note=note)
        return replace(row, holds=bool(row.holds) and not complaints)
    return Row(what=what, target="as the table says", holds=not complaints, note=note)


def _loop() -> Iterator[Row]:
    from tests.benchmarks.bridge_loop import loop_figures
    from tests.benchmarks.sim_loop import realtime_figures

    for rate in (100.0, 500.0, 1000.0):
        figures = loop_figures(rate, SECONDS)
        simulated = realtime_figures(SECONDS, rate=rate)
        what = f"loop on the emulator at {rate:g} Hz for {SECONDS:g} s, bridge and controller"
        yield measured(f"{what}: rate", figures.rate, "Hz", at_least=0.99 * rate, less_is_better=False)
        note = f"p99 {figures.jitter_p99:.0f} us, largest {figures.jitter_max:.0f} us; "
        note += "the actuator's own is 5 to 10 % of the period"
        yield measured(f"{what}: jitter of the states, p50", figures.jitter_p50, "us", note=note, less_is_better=True)
        yield measured(
            f"{what}: round trip p50",
            figures.latency_p50,
            "us",
            peer=Peer("the simulator's", simulated.p50),
            at_most_times_peer=1.5 if rate == 1000.0 else None,
            less_is_better=True,
            note=f"p99 {figures.latency_p99:.0f} us; a record is {figures.age_p50:.0f} us old when its answer is taken",
        )
        yield measured(f"{what}: overruns", figures.overruns, "%", at_most=0.5)
        yield measured(f"{what}: CPU, bridge and controller", figures.cpu, "% of a core", less_is_better=True)
        yield measured(f"{what}: faults", figures.faults, "", at_most=0.0)
