"""Two plants with a known difference under one controller and noise, simulated in this process."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.runs.run_data import RunData
from pendulum_bags.runs.series import Series, Signal
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.noise import uniform_array
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches.compiling import compile_tree
from pendulum_sim.stepping.dry_friction import acceleration_with_friction, advance_dry, is_dry
from pendulum_sim.stepping.integrators import get_integrator
from pendulum_sim.stepping.plant import pack
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_sim.stepping.sensors import Sensors

K = (33.345265, 0.158993)
"""Gain of the thesis's design [N m/rad, N m s/rad]."""
STEP = 0.001
"""Step of the simulations [s]."""
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
    step = STEP
    per_state = round(1.0 / rate / step)
    if abs(per_state * step * rate - 1.0) > 1e-9:
        raise ValueError(f"rate is {rate} Hz; expected whole milliseconds")
    model = make_pendulum(plant, step)
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
            seen = sensors.measure(i, (state.theta,), (state.theta_dot,), (0.0,))
            assert seen is not None
            (position,), (velocity,) = seen.position, seen.velocity
            command = -K[0] * from_upright(position) - K[1] * velocity
            rows[i // per_state] = i * step, position, velocity, command, push
        torque = gain * (command + push)
        if waiting:
            waiting.append(torque)
            torque = waiting.pop(0)
        state = model.step(torque)
    return _run(rows, rate, seed, label)


def _run(rows: NDArray[np.float64], rate: float, seed: int, label: str) -> RunData:
    t, position, velocity, effort, disturbance = rows.T
    series = Series(t, position, velocity, effort, label)
    return RunData(
        label,
        series,
        series,
        Signal(t, disturbance),
        None,
        None,
        np.full(t.size - 1, 1.0 / rate),
        rate,
        0,
        metadata={"pendulum.run": {"seed": seed, "plant": "emulator" if label == "hardware" else "thesis"}},
        source=f"{label}_{seed}",
    )


def record_compiled(
    plant: PlantParameters,
    *,
    rate: float,
    seed: int,
    duration: float,
    gain: float = 1.0,
    sensor_seed: int | None = None,
    amplitude: float = 2.5,
    label: str = "simulation",
    late: float = 0.0,
) -> RunData:
    """Return what :func:`record` returns, forty times as fast; compiling takes some seconds, once.

    Args:
        plant: The plant; rigid, without a delay or a lag of its own.
        rate: Of its states and of the loop [Hz].
        seed: Seed of the noise.
        duration: Length [s].
        gain: Torque that acts per torque that is asked for.
        sensor_seed: Seed of the sensors of an X5-9; None for the truth.
        amplitude: Of the noise [N m].
        label: Name.
        late: By how much this plant gets torques later [s].
    """
    if plant.drivetrain is not None or plant.transport_delay or plant.actuator_time_constant:
        raise ValueError(f"plant {plant.name!r} has a spring, a delay or a lag; expected none")
    count, per_state = round(duration / STEP), round(1.0 / rate / STEP)
    noise = uniform_array(seed, 0, round(duration / HOLD) + 1, amplitude)
    states = -(-count // per_state)
    seen, step = np.zeros(states), 0.0
    if sensor_seed is not None:
        # The stream of the velocity's noise, as Sensors spawns it.
        generator = np.random.default_rng(sensor_seed).spawn(5)[1]
        seen, step = generator.normal(0.0, SENSORS["velocity_noise"], states), SENSORS["position_step"]
    rows = np.empty((states, 5))
    _kernel()(
        pack(plant),
        plant.effort_limit,
        count,
        per_state,
        round(HOLD / STEP),
        noise,
        seen,
        step,
        gain,
        round(late / STEP),
        rows,
    )
    return _run(rows[: count // per_state], rate, seed, label)


@cache
def _kernel() -> Any:
    """Return the loop of :func:`record`, compiled from the simulator's own functions."""
    import numba

    integrator = get_integrator("etd4")
    one_step = compile_tree(integrator.step, inline=True)
    coefficients_of = compile_tree(integrator.coefficients, inline=True)
    acceleration = compile_tree(acceleration_with_friction, inline=True)
    advance = compile_tree(advance_dry, inline=True)
    has_dry_friction = compile_tree(is_dry, inline=True)

    @numba.njit(error_model="numpy")
    def run(plant, limit, count, per_state, held, noise, seen, step, gain, late, rows):
        c = coefficients_of(plant[1] / plant[0], STEP)
        dry = has_dry_friction(plant)
        theta, theta_dot, command = UPRIGHT, 0.0, 0.0
        waiting = np.zeros(late + 1)
        for i in range(count):
            push = noise[i // held]
            if i % per_state == 0:
                k = i // per_state
                position = np.rint(theta / step) * step if step > 0.0 else theta
                velocity = theta_dot + seen[k]
                command = -K[0] * (position - UPRIGHT) - K[1] * velocity
                rows[k, 0], rows[k, 1], rows[k, 2], rows[k, 3], rows[k, 4] = i * STEP, position, velocity, command, push
            waiting[i % (late + 1)] = gain * (command + push)
            torque = min(limit, max(-limit, waiting[(i + 1) % (late + 1)]))
            if dry:
                theta, theta_dot = advance(
                    one_step, coefficients_of, acceleration, theta, theta_dot, torque, torque, 0.0, STEP, c, plant
                )
            else:
                theta, theta_dot = one_step(acceleration, theta, theta_dot, torque, torque, torque, 0.0, STEP, c, plant)

    made_of = (acceleration_with_friction, advance_dry, is_dry, integrator.step, integrator.coefficients)
    return keep_kernel(run, "pairs", *made_of)


def pair(
    seed: int,
    duration: float = 5.0,
    plant: PlantParameters = SIMULATED,
    *,
    compiled: bool = True,
    **hardware: Any,
) -> tuple[RunData, RunData]:
    """Return one run of the simulation at 500 Hz and of the machine at 100 Hz with an actuator's sensors.

    Args:
        seed: Makes all noise.
        duration: Length [s].
        plant: The machine.
        compiled: Compile the loop.
        hardware: In what else the machine differs, arguments of :func:`record`.
    """
    common: dict[str, Any] = {"seed": seed, "duration": duration}
    machine: dict[str, Any] = {"rate": 100.0, "label": "hardware", **common, **hardware}
    if compiled:
        simulation = record_compiled(SIMULATED, rate=500.0, **common)
        return simulation, record_compiled(plant, sensor_seed=seed + 77, **machine)
    sensors = Sensors(np.random.default_rng(seed + 77), **SENSORS)
    return record(SIMULATED, rate=500.0, **common), record(plant, sensors=sensors, **machine)
