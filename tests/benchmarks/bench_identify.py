"""Identification on recordings of real rigs, on known truths, and beside a plain single-shooting fit."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.model import FitModel
from pendulum_bags.identification.options import Options
from pendulum_bags.identification.thesis import fit_gravity, fit_inertia_damping
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.read_recording import read_recording
from pendulum_rosbag.reader import read_bag, same_messages
from pendulum_testing.identification_truths import OUTSIDE, TRUTHS, covered, outside
from tests.benchmarks import Peer, Row, measured, peer
from tests.benchmarks.thesis_trials import hand_recording, staircase_recording

DATA = Path(os.environ.get("PENDULUM_SHARED_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))

SEEDS = int(os.environ.get("PENDULUM_COVERAGE_SEEDS", "50"))
"""Recordings of each kind of truth; 50 take about ten minutes on one core, 200 forty."""


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    if DATA.is_dir():
        yield from _swing_up()
        yield from _disc()
        yield from _servo()
        yield from _double_pendulum()
        yield from _double_pendulum_of_two_joints()
    else:
        yield Row("real rigs", note=f"no recordings of real pendulums at {DATA}")
    yield from _coverage()
    yield from _alarms()
    yield from _thesis_coverage()
    yield _busy_machine()


def _swing_up() -> Iterator[Row]:
    folder = DATA / "dfki_torque_limited_simple_pendulum"
    ddp, pd = (read_recording(folder / f"{name}_measured.csv") for name in ("ddp", "pd"))
    published = FitModel(
        {
            "inertia": 0.0626,
            "gravity": 0.1022 * 9.81,
            "damping": 0.0471,
            "coulomb_friction": 0.1839,
            "torque_offset": 0.0759,
        }
    )
    identify([ddp], profiles=0)  # compiles
    begin = time.perf_counter()
    result = identify([ddp])
    ours = time.perf_counter() - begin
    theirs = Peer("published parameters", window_score(published, ddp).rms)
    yield measured(
        "swing-up, 1 s windows, trained on it",
        window_score(result.model, ddp).rms,
        "rad",
        peer=theirs,
        at_most=0.0036,
    )
    theirs = Peer("published parameters", window_score(published, pd).rms)
    yield measured(
        "PD run by the swing-up's parameters", window_score(result.model, pd).rms, "rad", peer=theirs, at_most=0.038
    )
    intervals = result.uncertainty.intervals
    yield measured(
        "stated uncertainty of the scale of J and m l (half width)",
        intervals["gravity"].relative,
        "-",
        at_least=0.1,
    )
    yield measured(
        "stated uncertainty of w0 over that of the scale",
        intervals["natural_frequency"].relative / intervals["gravity"].relative,
        "-",
        at_most=0.5,
        note=f"half width {100.0 * intervals['natural_frequency'].relative:.1f} %, from fits without a sixth of 6 s",
    )
    other = identify([pd], profiles=0).uncertainty.intervals["natural_frequency"]
    own = intervals["natural_frequency"]
    overlap = min(own.high, other.high) - max(own.low, other.low)
    yield Row(
        what="w0 of the swing-up and of the PD run",
        target="intervals overlap",
        holds=overlap > 0.0,
        note=f"{own.low:.2f} to {own.high:.2f} and {other.low:.2f} to {other.high:.2f} rad/s (4.48 by geometry)",
    )
    yield measured("identification of a 6 s, 500 Hz run, all models", ours, "s", at_most=10.0)
    yield _against_single_shooting(ddp)


def _against_single_shooting(recording: Recording) -> Row:
    """Time one fit of one model beside scipy's least_squares on solve_ivp with finite differences."""
    from pendulum_bags.identification.problem import prepare
    from pendulum_bags.identification.solver import solve

    part = recording.between(0.0, 2.0)
    start = FitModel({"inertia": 0.15, "gravity": 3.0, "damping": 0.02, "coulomb_friction": 0.1})
    free = ("inertia", "damping", "gravity", "coulomb_friction")
    solve(start, [prepare(part, None)], free)
    begin = time.perf_counter()
    solution = solve(start, [prepare(part, None)], free)
    ours = time.perf_counter() - begin
    rms = math.sqrt(solution.cost / part.time.size)
    reached: dict[str, float] = {}

    def theirs() -> float:
        begin = time.perf_counter()
        reached["rms"] = _scipy_single_shooting(part, start, free)
        return time.perf_counter() - begin

    other = peer("scipy least_squares + solve_ivp", theirs)
    note = f"rms {1e3 * rms:.2f} mrad, peer {1e3 * reached.get('rms', math.nan):.2f} mrad"
    if reached and rms > 1.1 * reached["rms"]:
        raise AssertionError(f"our fit is worse than the peer's: {note}")
    return measured(
        "one model, one 2 s window",
        ours,
        "s",
        peer=other,
        at_least_times_peer=1.0,
        less_is_better=True,
        note=note,
    )


def _scipy_single_shooting(part: Recording, start: FitModel, free: Sequence[str]) -> float:
    from scipy.integrate import solve_ivp
    from scipy.optimize import least_squares

    def residual(x: Any) -> Any:
        inertia, damping, gravity, coulomb, theta, omega = x

        def rate(t: float, state: Any) -> tuple[float, float]:
            u = float(np.interp(t, part.input_stamps, part.input))
            dry = coulomb * math.tanh(state[1] / 0.02)
            return state[1], (u - damping * state[1] - gravity * math.sin(state[0]) - dry) / inertia

        found = solve_ivp(
            rate,
            (part.time[0], part.time[-1]),
            (theta, omega),
            t_eval=part.time,
            rtol=1e-5,
            atol=1e-7,
            max_step=0.02,
        )
        return found.y[0] - part.position if found.success else np.full(part.time.size, 1e3)

    first = [*(start[name] for name in free), float(part.position[0]), 0.0]
    found = least_squares(residual, first, x_scale=np.maximum(np.abs(first), 0.1), max_nfev=30)
    return float(np.sqrt(np.mean(found.fun**2)))


def _disc() -> Iterator[Row]:
    disc = read_recording(DATA / "tue_unbalanced_disk" / "first_20000.csv", "voltage_40hz")
    authors = FitModel(
        {
            "inertia": 1.0,
            "gravity": 11.340**2,
            "damping": 1.333,
            "coulomb_friction": 6.063,
            "input_gain": 28.14,
        },
        "voltage",
    )
    held_out = disc.rows(15000)
    result = identify([disc.rows(0, 15000)], profiles=0)
    theirs = Peer("authors' parameters", free_run(authors, held_out).rms)
    note = f"delay {1e3 * result.model['transport_delay']:.2f} ms, angle offset {result.model['angle_offset']:.4f} rad"
    yield measured(
        "unbalanced disk, free run over rows 15001 to 20000",
        free_run(result.model, held_out).rms,
        "rad",
        peer=theirs,
        at_most=0.014,
        note=note,
    )


def _servo() -> Iterator[Row]:
    folder = DATA / "rhoban_bam_xl330"
    logs = [read_recording(path) for path in sorted(folder.glob("*.json"))]
    result = identify(logs, profiles=0)
    ours = float(np.mean([free_run(result.model, log, fitted=False).mean_absolute for log in logs]))
    richest = json.loads((folder / "published_params" / "m6.json").read_text())
    theirs = float(np.mean([published_error(richest, log) for log in logs]))
    yield measured(
        "servo logs, mean absolute error in free run",
        ours,
        "rad",
        peer=Peer("published m6", theirs),
        at_least_times_peer=1.0,
        less_is_better=True,
        note=f"friction {result.fit.chosen.friction}, chosen by cross-validation",
    )
    errors = []
    for i, left_out in enumerate(logs):
        rest = identify([*logs[:i], *logs[i + 1 :]], profiles=0)
        errors.append(free_run(rest.model, left_out, fitted=False).mean_absolute)
    yield measured(
        "servo logs, each predicted from the others",
        float(np.mean(errors)),
        "rad",
        peer=Peer("published m6, which was fitted to them", theirs),
        at_most=0.0557,
        note=", ".join(f"{error:.4f}" for error in errors) + "; 0.0557 rad is the authors' best over all their logs",
    )


def _double_pendulum() -> Iterator[Row]:
    """A joint of a double pendulum is no single pendulum: does the program say so wherever the other one moves?"""
    said = []
    for path in sorted((DATA / "dfki_double_pendulum").glob("*.csv")):
        for joint in (1, 2):
            columns = {
                "time": {"column": "time", "unit": "s"},
                "position": {"column": f"pos_meas{joint}", "unit": "rad"},
                "velocity": {"column": f"vel_meas{joint}", "unit": "rad/s"},
                "input": {"column": f"tau_meas{joint}", "unit": "N m", "hold": "linear"},
            }
            result = identify([read_recording(path, columns)], Options(folds=3, multi_start=False), profiles=0)
            loud = result.refused or result.to_dict()["incomplete"]
            said.append((f"{path.stem} joint {joint}", loud or not result.tests.white, result.explained.share))
    yield Row(
        what="one joint of a double pendulum, the other moving: no clean bill",
        target="8 of 8 doubted",
        holds=all(doubted for _, doubted, _ in said),
        note=", ".join(f"{name} misses {100.0 * share:.0f} %" for name, _, share in said),
    )


def _double_pendulum_of_two_joints() -> Iterator[Row]:
    """Each record predicted by parameters from the other three: 0.5 s windows, the start of each fitted."""
    import numpy as np

    from pendulum_bags.identification.identify import identify_joints
    from pendulum_bags.identification.joint_fit import prepare_windows, scores
    from pendulum_bags.identification.joint_model import JointModel
    from pendulum_bags.identification.joint_recordings import JointRecording
    from pendulum_msgs_py.plants.plant_parameters import load_mechanism

    start = load_mechanism("double_pendulum")
    logs = []
    for path in sorted((DATA / "dfki_double_pendulum").glob("*.csv")):
        table = np.genfromtxt(path, delimiter=",", names=True)
        position, effort = (np.stack([table[f"{n}{i}"] for i in (1, 2)], axis=1) for n in ("pos_meas", "tau_meas"))
        logs.append(JointRecording(path.name, table["time"], position, effort, ("linear", "linear"), str(path)))

    def error(model: JointModel, log: JointRecording, own: tuple[str, ...] = ()) -> float:
        return float(np.sqrt(np.mean(scores(model, [prepare_windows(log, 0.5)], own=own)[0].rms ** 2)))

    targets = (0.0065, 0.0085, 0.012, 0.015)
    plain = (0.0075, 0.0118, 0.0222, 0.0288)
    for i, (log, target, least) in enumerate(zip(logs, targets, plain, strict=True)):
        result = identify_joints(start, [*logs[:i], *logs[i + 1 :]])
        yield measured(
            f"double pendulum, {log.name} by the other three records",
            error(result.model, log, result.fit.own),
            "rad",
            peer=Peer("published parameters", error(JointModel.of(start), log)),
            at_most=target,
            note=f"plain least squares {least} rad; {result.choice}",
        )


def published_error(parameters: Mapping[str, float], log: Recording, *, duty_gain: float = 0.00254) -> float:
    """Return the mean absolute error [rad] of the published servo model on a log, by its authors' protocol.

    The log is resampled to 5 ms and simulated from its first entry with the recorded set points; of the readings
    that the files leave open (sign of the offset, duty per error) this is the one that favours the model most.
    """
    dt = 0.005
    time = np.arange(0.0, log.time[-1], dt)
    position = np.interp(time, log.time, log.position)
    goal = np.interp(time, log.time, log.input)
    assert log.enabled is not None
    enabled = np.interp(time, log.time, log.enabled) > 0.5
    mass, length, kp, vin = (float(log.meta[key]) for key in ("mass", "length", "kp", "vin"))
    get = parameters.get
    kt, resistance = parameters["kt"], parameters["R"]
    inertia = mass * length**2 + parameters["armature"]
    q, dq = float(position[0]), 0.0
    error = 0.0
    for i in range(time.size):
        error += abs(q - position[i])
        duty = min(max((goal[i] - q) * kp * duty_gain, -1.0), 1.0)
        motor = (kt * vin * duty / resistance - kt * kt * dq / resistance) if enabled[i] else 0.0
        bias = -9.80665 * mass * length * math.sin(q + parameters["q_offset"])
        friction = parameters["friction_base"]
        friction += abs(bias * get("load_friction_external", 0.0) - motor * get("load_friction_motor", 0.0))
        if "dtheta_stribeck" in parameters:
            share = math.exp(-(abs(dq / parameters["dtheta_stribeck"]) ** parameters["alpha"]))
            rise = get("friction_stribeck", 0.0)
            rise += abs(
                bias * get("load_friction_external_stribeck", 0.0) - motor * get("load_friction_motor_stribeck", 0.0)
            )
            if bias * motor < 0.0:
                quadratic = (
                    get("load_friction_external_quad", 0.0) * bias**2
                    if abs(bias) < abs(motor)
                    else get("load_friction_motor_quad", 0.0) * motor**2
                )
                rise += quadratic
            friction += share * rise
        friction += parameters["friction_viscous"] * abs(dq)
        stop = inertia / dt * dq + motor + bias
        acceleration = (motor + bias - math.copysign(min(abs(stop), friction), stop)) / inertia
        dq += acceleration * dt
        q += dq * dt + 0.5 * acceleration * dt * dt
    return error / time.size


def _coverage() -> Iterator[Row]:
    """The default path: friction, offsets and delay found unaided, on each kind of truth among the candidates."""
    for kind, truth in TRUTHS.items():
        hits: dict[str, list[bool]] = {}
        for seed in range(SEEDS):
            for name, hit in covered(identify([truth.recording(seed)], profiles=0), truth.plant).items():
                hits.setdefault(name, []).append(hit)
        share = float(np.mean([hit for values in hits.values() for hit in values]))
        listing = ", ".join(f"{name} {100.0 * np.mean(values):.0f} %" for name, values in hits.items())
        what = f"{kind}: 95 % intervals that cover the truth, {SEEDS} seeds"
        yield measured(what, share, "-", at_least=0.90, note=listing)
        yield measured(f"{kind}: the same, not too wide", share, "-", at_most=0.99)


def _alarms() -> Iterator[Row]:
    """Is a torque that no candidate has said to be missing, and is none said to be where there is none?"""
    seeds = max(SEEDS // 10, 3)
    options = Options(friction="coulomb", multi_start=False, folds=2)
    for name in OUTSIDE:
        found = [identify([outside(name, seed)], options, profiles=0) for seed in range(seeds)]
        share = float(np.mean([result.to_dict()["incomplete"] for result in found]))
        yield measured(f"outside the candidates, {name}: said loudly, {seeds} seeds", share, "-", at_least=0.5)
    found = [
        identify([TRUTHS[kind].recording(1000 + seed)], options, profiles=0)
        for kind in ("white noise", "coloured noise", "torque noise")
        for seed in range(seeds)
    ]
    false = float(np.mean([result.to_dict()["incomplete"] for result in found]))
    yield measured(f"false alarms by noise alone, {len(found)} runs", false, "-", at_most=0.05)


def _thesis_coverage(seeds: int = 20) -> Iterator[Row]:
    """The thesis's two experiments on the emulated machine: do their intervals hold its coefficients?"""
    truth = {"inertia": 0.055, "damping": 11.77, "gravity": 1.678}
    hits: dict[str, list[bool]] = {name: [] for name in truth}
    widths: dict[str, list[float]] = {name: [] for name in truth}
    for seed in range(seeds):
        for result in (
            fit_inertia_damping([hand_recording(seed, 1 + trial) for trial in range(6)]),
            fit_gravity([staircase_recording(seed, 1 + trial) for trial in range(3)]),
        ):
            for name, (low, high) in result.intervals.items():
                hits[name].append(low <= truth[name] <= high)
                widths[name].append(0.5 * (high - low))
    for name, unit in (("inertia", "kg m^2"), ("damping", "N m s/rad"), ("gravity", "N m")):
        yield measured(
            f"thesis's method on its machine: 95 % intervals of {name} that cover, {seeds} seeds",
            float(np.mean(hits[name])),
            "-",
            at_least=0.85,
            note=f"half width {np.mean(widths[name]):.2g} {unit}",
        )


def _busy_machine() -> Row:
    """One trial by hand in lockstep, with idle and with busy cores: are the bags the same, message by message?"""
    with tempfile.TemporaryDirectory() as folder:
        bags = []
        for name in ("idle", "busy"):
            burners = [
                subprocess.Popen([sys.executable, "-c", "while True: pass"])
                for _ in range(0 if name == "idle" else 1 + (os.cpu_count() or 1))
            ]
            try:
                out = Path(folder) / name
                command = [
                    sys.executable,
                    "-m",
                    "pendulum_bags",
                    "experiment",
                    "inertia_damping",
                    "--trials",
                    "1",
                ]
                subprocess.run([*command, "--out", str(out)], check=True, capture_output=True, timeout=240)
            finally:
                for burner in burners:
                    burner.kill()
                    burner.wait()
            bags.append(read_bag(out / "trial_1"))
        same = same_messages(bags[0], bags[1], topics=[topic for topic in bags[0].topics if "recorder" not in topic])
        what = "one trial in lockstep on an idle and on a busy machine: the same bag"
        return Row(what=what, target="equal messages", holds=bool(same), note=str(same))
