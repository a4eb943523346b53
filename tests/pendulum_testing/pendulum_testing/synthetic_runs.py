"""Runs of the regulation experiment made in memory, for tests of what reads them: physics without processes.

The motion is that of the real plant models under the real controller law and the real noise; only middleware and wall
clock are missing. "Hardware" is the same plant with dry friction, a delay, coarse feedback and 100 Hz.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.contract.noise import uniform_array
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.storage import BagWriter
from pendulum_sim.stepping.plants import make_pendulum

K = (33.345265, 0.158993)
STATE = "sensor_msgs/msg/JointState"
TEXT = "std_msgs/msg/String"
EPOCH_NS = 1_700_000_000_000_000_000

Columns = dict[str, np.ndarray]


def regulate(
    *,
    rate: float,
    seed: int,
    hold_time: float = 0.01,
    duration: float = 5.0,
    amplitude: float = 2.5,
    hardware: bool = False,
    changes: Mapping[str, float] | None = None,
) -> Columns:
    """Regulate the thesis's plant upright under noise; columns t, position, velocity, command, disturbance, applied."""
    told = tuple(sorted((changes or {}).items()))
    found = _regulated(rate, seed, hold_time, duration, amplitude, hardware, told)
    return {name: column.copy() for name, column in found.items()}


@cache
def _regulated(
    rate: float,
    seed: int,
    hold_time: float,
    duration: float,
    amplitude: float,
    hardware: bool,
    changes: tuple[tuple[str, float], ...],
) -> Columns:
    plant = load_plant("thesis")
    if hardware:
        plant = plant.with_values(coulomb_friction=0.02, static_friction=0.02, transport_delay=0.004, **dict(changes))
    period = 1.0 / rate
    model = make_pendulum(plant, period)
    model.reset(UPRIGHT, 0.0)
    count = round(duration * rate)
    index = (np.arange(count) * period / hold_time + 1e-9).astype(int)
    noise = uniform_array(seed, 0, int(index[-1]) + 1, amplitude)[index]
    sensor = np.random.default_rng(seed + 1)
    rows = np.empty((count, 5))
    state = model.state
    for i in range(count):
        theta, theta_dot = state.theta, state.theta_dot
        if hardware:
            theta = round(theta / 1e-4) * 1e-4
            theta_dot += 0.004 * sensor.standard_normal()
        command = -K[0] * from_upright(theta) - K[1] * theta_dot
        rows[i] = theta, theta_dot, command, noise[i], command + noise[i]
        state = model.step(command + float(noise[i]))
    names = ("position", "velocity", "command", "disturbance", "applied")
    return {"t": np.arange(count) * period, **{name: rows[:, i] for i, name in enumerate(names)}}


def write_bag(
    path: Path,
    columns: Columns,
    prefix: str,
    *,
    metadata: Mapping[str, Any] | None = None,
    ramps: bool = True,
) -> Path:
    """Write a run as a recorder would: ramps around the noise, events, one message for each state."""
    period = float(columns["t"][1] - columns["t"][0])
    lead = thesis_ramp(0.0, UPRIGHT)
    jitter = np.random.default_rng(0)
    with BagWriter(path, metadata=metadata or {}) as bag:
        for topic in ("joint_states", "effort_command", "disturbance", "applied_effort"):
            bag.add_topic(f"{prefix}/{topic}", STATE)
        bag.add_topic(f"{prefix}/events", TEXT)
        start = EPOCH_NS + (round((lead.duration + 1.0) * 1e9) if ramps else 0)

        def stamp(t: float) -> int:
            return start + round(t * 1e9)

        def state(t: float, position: float, velocity: float, effort: float) -> None:
            late = round(2e5 * jitter.random())
            data = encode_joint_state(stamp(t), position=position, velocity=velocity, effort=effort)
            bag.write(f"{prefix}/joint_states", stamp(t) + late, data)

        def effort(topic: str, t: float, value: float) -> None:
            bag.write(
                f"{prefix}/{topic}",
                stamp(t) + 400_000,
                encode_joint_state(stamp(t), frame_id=topic, effort=value),
            )

        def event(t: float, name: str) -> None:
            text = json.dumps({"stamp_ns": stamp(t), "name": name}).encode() + b"\0"
            bag.write(f"{prefix}/events", stamp(t), b"\0\1\0\0" + len(text).to_bytes(4, "little") + text)

        if ramps:
            event(-lead.duration - 1.0, "ramp_up")
            for t in np.arange(0.0, lead.duration, period):
                position, velocity = lead.at(t)
                state(t - lead.duration - 1.0, position, velocity, 1.678 * np.sin(position) + 11.77 * velocity)
            event(-1.0, "regulation")
            for t in np.arange(-1.0, -period / 2, period):
                state(t, UPRIGHT, 0.0, 0.0)
                effort("effort_command", t, 0.0)
        event(0.0, "noise_start")
        for i, t in enumerate(columns["t"]):
            state(t, columns["position"][i], columns["velocity"][i], columns["applied"][i])
            effort("effort_command", t, columns["command"][i])
            effort("disturbance", t, columns["disturbance"][i])
            effort("applied_effort", t, columns["applied"][i])
        end = float(columns["t"][-1]) + period
        event(end, "noise_end")
        if ramps:
            event(end, "ramp_down")
            down = thesis_ramp(UPRIGHT, 0.0)
            for t in np.arange(0.0, down.duration, period):
                position, velocity = down.at(t)
                state(end + t, position, velocity, 1.678 * np.sin(position) + 11.77 * velocity)
            event(end + down.duration, "done")
    return path


def write_events_and_torque(
    path: Path,
    prefix: str,
    events: Sequence[tuple[float, str, Mapping[str, Any]]],
    torque: Callable[[float], float],
    length: float,
    *,
    leave_out: Callable[[str, float], bool] = lambda topic, t: False,
) -> Path:
    """Write a recording at 100 Hz of a plant at rest: events as (time, name, what it says), and the torque applied.

    Messages of a topic at a time [s] for which ``leave_out`` holds are missing.
    """
    with BagWriter(path) as bag:
        for topic in ("joint_states", "applied_effort"):
            bag.add_topic(f"{prefix}/{topic}", STATE)
        bag.add_topic(f"{prefix}/events", TEXT)
        for t, name, told in events:
            stamp = EPOCH_NS + round(t * 1e9)
            text = json.dumps({"stamp_ns": stamp, "name": name, **told}).encode() + b"\0"
            bag.write(f"{prefix}/events", stamp, b"\0\1\0\0" + len(text).to_bytes(4, "little") + text)
        for t in np.arange(0.0, length, 0.01):
            stamp = EPOCH_NS + round(t * 1e9)
            state = encode_joint_state(stamp, position=0.0, velocity=0.0, effort=0.0)
            applied = encode_joint_state(stamp, frame_id="", effort=torque(float(t)))
            for topic, data in (("joint_states", state), ("applied_effort", applied)):
                if not leave_out(topic, float(t)):
                    bag.write(f"{prefix}/{topic}", stamp, data)
    return path


def run_metadata(seed: int, hold_time: float = 0.01) -> dict[str, Any]:
    """Return what a bag says about its run."""
    return {
        "pendulum.run": {
            "experiment": "thesis",
            "strategy": "direct_pwm",
            "seed": seed,
            "disturbance": {
                "kind": "uniform",
                "seed": seed,
                "amplitude": 2.5,
                "hold_time": hold_time,
                "duration": 5.0,
            },
            "controller": {"kind": "lqr", "q": [100.0, 0.01], "r": 0.1},
            "versions": {"python": "3.11.0", "pendulum_bags": "0.1.0"},
            "git_revision": "0123456789ab",
            "plant": "thesis",
        }
    }


def write_run_folder(folder: Path, seed: int = 1, *, ramps: bool = True, **hardware: Any) -> Path:
    """Write a run folder with ``sim``, ``hw`` and ``sim_500hz``; equal ones are simulated and written once."""
    key = json.dumps([seed, ramps, hardware], sort_keys=True)
    if key not in _kept:
        _kept[key] = TemporaryDirectory(prefix="run_folder_")
        _write_run_folder(Path(_kept[key].name), seed, ramps, hardware)
    shutil.copytree(_kept[key].name, folder, dirs_exist_ok=True)
    return folder


_kept: dict[str, TemporaryDirectory[str]] = {}


def _write_run_folder(folder: Path, seed: int, ramps: bool, hardware: Mapping[str, Any]) -> None:
    metadata = run_metadata(seed)
    write_bag(folder / "sim", regulate(rate=500.0, seed=seed), "/sim", metadata=metadata, ramps=ramps)
    hw = regulate(rate=100.0, seed=seed, hardware=True, **hardware)
    write_bag(folder / "hw", hw, "/hw", metadata=metadata, ramps=ramps)
    own = regulate(rate=500.0, seed=seed + 1_000_000, hold_time=0.002)
    write_bag(folder / "sim_500hz", own, "/sim", metadata=run_metadata(seed + 1_000_000, 0.002), ramps=False)
