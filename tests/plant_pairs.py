"""Two plants with a known difference under one controller and noise, simulated in this process."""

from __future__ import annotations

from typing import Any

import numpy as np

from pendulum_bags.runs.run_data import RunData
from pendulum_bags.runs.series import Series, Signal
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.noise import uniform_array
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.plants import make_plant
from pendulum_sim.sensors import Sensors

K = (33.345265, 0.158993)
"""Gain of the thesis's design [N m/rad, N m s/rad]."""
HOLD = 0.01
"""Time for which a noise sample is held [s]."""
SENSORS = {"position_step": 1e-4, "velocity_noise": 0.004}
"""Feedback of an X5-9."""

SIMULATED = load_plant("thesis")
MACHINE = SIMULATED.with_values(coulomb_friction=0.05, static_friction=0.05)
"""The same with dry friction: what the pairs differ from."""


def record(
    plant: PlantParameters,
    *,
    rate: float,
    seed: int,
    duration: float,
    gain: float = 1.0,
    sensors: Sensors | None = None,
    amplitude: float = 2.5,
    label: str = "simulation",
    late: float = 0.0,
) -> RunData:
    """Regulate a plant upright under the noise of a seed and return what a bag of it would hold.

    Args:
        plant: The plant.
        rate: Of its states and of the loop [Hz].
        seed: Seed of the noise.
        duration: Length [s].
        gain: Torque that acts per torque that is asked for.
        sensors: What the controller sees.
        amplitude: Of the noise [N m].
        label: Name.
        late: By how much this plant gets torques later, beyond its own delay, rounded to its steps of 1 ms [s].
    """
    step = 0.001
    per_state = round(1.0 / rate / step)
    if abs(per_state * step * rate - 1.0) > 1e-9:
        raise ValueError(f"rate is {rate} Hz; expected whole milliseconds")
    model = make_plant(plant, step)
    state = model.reset(UPRIGHT, 0.0)
    count = round(duration / step)
    noise = uniform_array(seed, 0, round(duration / HOLD) + 1, amplitude)
    held = round(HOLD / step)
    sensors = sensors or Sensors()
    waiting = [0.0] * round(late / step)
    rows = np.empty((count // per_state, 5))
    command = 0.0
    for i in range(count):
        push = float(noise[i // held])
        if i % per_state == 0:
            seen = sensors.measure(i, state.theta, state.theta_dot, 0.0)
            assert seen is not None
            command = -K[0] * from_upright(seen.position) - K[1] * seen.velocity
            rows[i // per_state] = i * step, seen.position, seen.velocity, command, push
        torque = gain * (command + push)
        if waiting:
            waiting.append(torque)
            torque = waiting.pop(0)
        state = model.step(torque)
    t, position, velocity, effort, disturbance = rows.T
    series = Series(t, position, velocity, effort, label)
    return RunData(
        label, series, series, Signal(t, disturbance), None, None, np.full(t.size - 1, 1.0 / rate), rate, 0,
        metadata={"pendulum.run": {"seed": seed, "plant": "emulator" if label == "hardware" else "thesis"}},
        source=f"{label}_{seed}",
    )  # fmt: skip


def pair(
    seed: int, duration: float = 5.0, plant: PlantParameters = SIMULATED, **hardware: Any
) -> tuple[RunData, RunData]:
    """Return one run of the simulation at 500 Hz and of the machine at 100 Hz with an actuator's sensors."""
    sensors = Sensors(np.random.default_rng(seed + 77), **SENSORS)
    simulation = record(SIMULATED, rate=500.0, seed=seed, duration=duration)
    return simulation, record(
        plant, rate=100.0, seed=seed, duration=duration, sensors=sensors, label="hardware", **hardware
    )
