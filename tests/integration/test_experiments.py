"""Experiments over the real middleware: determinism in lockstep, the thesis's two identifications, studies."""

from __future__ import annotations

import json
import math
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import EMULATOR_LIFETIME, RunSpec
from pendulum_bags.studies.leaderboard_hardware import evaluate_hardware
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_lqr.policy_file import write_policy
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.reader import read_bag, same_messages
from tests.policies import linear_policy
from tests.processes import ProcessGroup


def run_experiment(*arguments: str | Path | float, timeout: float = 150.0) -> subprocess.CompletedProcess[str]:
    """Run ``python -m pendulum_bags experiment``; its output is in the message of a failure."""
    command = [sys.executable, "-m", "pendulum_bags", "experiment", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def test_lockstep_runs_of_the_emulated_hardware_with_one_seed_are_identical(domain_id: int, tmp_path: Path) -> None:
    for name, seed in (("first", 5), ("second", 5), ("other", 6)):
        run_experiment("lockstep", "--side", "hw", "--bag", tmp_path / name, "--seed", seed, "--duration", "1")
    first, second, other = (read_bag(tmp_path / name) for name in ("first", "second", "other"))
    topics = ["joint_states", "effort_command", "disturbance", "applied_effort", "actuator/feedback"]
    topics = [f"/hw/{topic}" for topic in topics] + ["/clock"]

    assert same_messages(first, second, topics=topics)
    assert not same_messages(first, other, topics=topics)
    states = first["/hw/joint_states"]
    assert len(states) == 101
    assert abs(states["position"] - 3.14159).max() < 0.05


def test_a_policy_file_is_a_controller_like_any_other_in_an_experiment(domain_id: int, tmp_path: Path) -> None:
    path = write_policy(tmp_path / "upright.npz", linear_policy(load_plant("thesis"), 20.0, 1.0))
    for side in ("sim", "hw"):
        bag = tmp_path / side
        run_experiment("lockstep", "--side", side, "--bag", bag, "--duration", "1", "--controller", path)
        recorded = read_bag(bag)
        assert recorded.metadata["pendulum.run"]["controller"] == {"kind": "policy", "policy": str(path)}
        states, commands = recorded[f"/{side}/joint_states"], recorded[f"/{side}/effort_command"]
        assert abs(states["position"] - math.pi).max() < 0.1
        # What it answers, wherever a state was answered: u = -20 sin(x) - 1 x', on what the policy saw every 10 ms.
        answered = dict(zip(commands["stamp_ns"], commands["effort"], strict=True))
        expected = 20.0 * np.sin(states["position"]) - states["velocity"]
        pairs = [
            (answered[stamp], u) for stamp, u in zip(states["stamp_ns"], expected, strict=True) if stamp in answered
        ]
        assert len(pairs) > 50
        differences = np.abs(np.diff(np.array(pairs[len(pairs) // 2 :]), axis=1))
        assert np.median(differences) < (1e-5 if side == "hw" else 0.05)


def test_a_policy_that_cannot_play_is_refused_before_anything_starts(tmp_path: Path) -> None:
    other = write_policy(tmp_path / "other.npz", linear_policy(load_plant("dfki"), 2.0, 0.1))
    for arguments, reason in (
        ((tmp_path / "none.npz",), "none.npz does not exist"),
        ((other, "--q", "50", "0.01"), "which has no such parameter"),
    ):
        command = [sys.executable, "-m", "pendulum_bags", "experiment", "thesis", "--out", str(tmp_path / "run")]
        command += ["--controller", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
        assert done.returncode == 2
        assert reason in done.stderr
        assert not (tmp_path / "run").exists()


def test_lockstep_runs_of_the_simulator_are_identical_and_give_the_numbers_of_one_process_to_the_last_bit(
    domain_id: int, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        run_experiment("lockstep", "--bag", tmp_path / name, "--seed", 7, "--duration", "1")
    bag = read_bag(tmp_path / "first")
    topics = [f"/sim/{topic}" for topic in ("joint_states", "effort_command", "disturbance", "applied_effort")]
    assert same_messages(bag, read_bag(tmp_path / "second"), topics=[*topics, "/clock"])

    spec = RunSpec(
        controller_parameters={"q": [100.0, 0.01], "r": 0.1},
        disturbance={"amplitude": 2.5, "hold_time": 0.002, "duration": 1.0},
        duration=1.0,
        seed=7,
    )
    arrays = simulate(spec)
    states = bag["/sim/joint_states"]
    assert np.array_equal(states["stamp_ns"], arrays.stamp_ns)
    assert np.array_equal(states["position"], arrays.position)
    assert np.array_equal(states["velocity"], arrays.velocity)
    assert np.array_equal(bag["/sim/effort_command"]["effort"], arrays.command)
    assert np.array_equal(bag["/sim/disturbance"]["effort"], arrays.disturbance)
    assert np.array_equal(bag["/sim/applied_effort"]["effort"], arrays.applied)


def test_the_two_experiments_of_the_thesis_give_back_its_coefficients(tmp_path: Path) -> None:
    run_experiment("inertia_damping", "--out", tmp_path / "hand", "--trials", 3)
    run_experiment("gravity", "--out", tmp_path / "stairs", "--trials", 1, "--step", 20, "--top", 60, "--hold", 1)

    hand = json.loads((tmp_path / "hand" / "identified.json").read_text())["intervals"]
    stairs = json.loads((tmp_path / "stairs" / "identified.json").read_text())["intervals"]
    assert hand["damping"][0] < 11.77 < hand["damping"][1]
    assert hand["inertia"][0] < 0.055 < hand["inertia"][1]
    assert stairs["gravity"][0] < 1.678 < stairs["gravity"][1]

    bag = read_bag(tmp_path / "stairs" / "trial_1")
    steps = [event["name"] for event in bag.events() if event["name"] in {"dynamic", "static"}]
    assert steps == ["dynamic", "static"] * 12
    quantities = bag["/hw/actuator/feedback"][0].message.name
    recorded = {"position", "velocity", "effort", "position_command", "velocity_command", "effort_command"}
    assert recorded | {"pwm_command", "motor_current", "winding_current"} <= set(quantities)


def _command_line(process: psutil.Process) -> set[str]:
    """Return the words of a command line, none where the process has just ended."""
    try:
        return set(process.cmdline())
    except psutil.Error:
        return set()


def test_a_run_whose_bridge_stood_still_is_measured_again_and_the_result_says_so(
    processes: ProcessGroup, tmp_path: Path
) -> None:
    # Two runs of the thesis's experiment, whose ramps are as long as they are: nothing shorter has a regulation.
    folder = tmp_path / "run"
    program = processes.start(
        *("pendulum_bags", "experiment", "thesis", "--out", str(folder), "--duration", "1", "--budget", "0")
    )
    program.wait_for_output(r"^regulation \(1 s\)", 120)
    (bridge,) = [
        child
        for child in psutil.Process(program.pid).children(recursive=True)
        if {"pendulum_hw_bridge", "bridge"} <= _command_line(child)
    ]
    # The stimulus: twice as long as an emulator's bridge may stand still.
    bridge.suspend()
    time.sleep(2.0 * EMULATOR_LIFETIME)
    bridge.resume()

    said = program.wait_for_output(r"^This machine stood still \((.*)\); measuring again, run 2 of at most 3\.$", 30)
    assert program.wait(150) == 0, program.output
    reason = said[1]
    assert reason.startswith("/hw went to fault: ")

    # A busy machine may have stood still once more by itself.
    stalls = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["stalls"]
    assert stalls[0] == {"run": "run", "reason": reason, "logs": "logs_stalled_1"}
    assert len(re.findall(r"^regulation \(1 s\)", program.output, re.MULTILINE)) > 1
    told = re.compile(r"broke off before this one and do(es)? not count")
    assert told.search(" ".join(program.output.split()))
    assert told.search((folder / "report.html").read_text(encoding="utf-8"))
    assert (folder / "logs_stalled_1" / "hw_bridge.log").is_file()
    # What counts is the last run alone, whole and at zero torque in the end.
    bag = read_bag(folder / "hw")
    modes = [event.get("mode") for event in bag.events() if event["name"] == "plant_mode"]
    assert "fault" not in modes
    assert bag["/hw/applied_effort"]["effort"][-1] == 0.0
    assert processes.leftovers() == []


def test_an_excitation_is_played_alone_on_a_running_plant_and_ends_at_zero_torque(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    zero = tmp_path / "zero.csv"
    zero.write_text("time,effort\n0,0\n1,0\n", encoding="utf-8")
    simulator = processes.start(
        "pendulum_sim", "simulator", "--ros-args", "-r", "__ns:=/sim", "-p", "plant:=dfki", "-p", "rate_hz:=100.0"
    )
    playback = ("--ros-args", "-r", "__ns:=/sim", "-p", "controller:=playback", "-p", f"file:={zero}")
    other = processes.start("pendulum_lqr", "controller", *playback)
    simulator.wait_for_output("commanded by /sim/controller", 60)
    bag = tmp_path / "excited"
    command = [sys.executable, "-m", "pendulum_bags", "excite", "--plant", "dfki", "--max-angle", "0.5"]
    command += ["--duration", "1", "--trials", "3", "--out", str(tmp_path / "e.csv"), "--bag", str(bag)]
    command += ["--play", "--on", "running"]

    refused = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert refused.returncode == 2
    assert "/sim/effort_command has a publisher, /sim/controller; expected none" in refused.stderr
    assert not bag.exists()

    other.interrupt()
    assert other.wait(20) == 0
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    recorded = read_bag(bag)
    applied = recorded["/sim/applied_effort"]["effort"]
    assert 0.1 < np.max(np.abs(applied)) <= 0.75
    assert np.all(applied[-20:] == 0.0)
    assert {"inertia", "gravity"} <= recorded.metadata["pendulum.excitation"]["predicted"].keys()


def test_a_study_over_dds_runs_in_parallel_and_leaves_a_table(tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(
        "format: pendulum_study/1\nname: small\nduration: 0.5\nplants:\n  sim: {}\n  hw: {side: hw}\n"
        "controllers:\n  lqr: {q: [100.0, 0.01], r: 0.1}\ndisturbances:\n  noise: {amplitude: 2.5, hold_time: 0.01}\n",
        encoding="utf-8",
    )
    run_experiment("study", file, "--out", tmp_path / "out", "--workers", 2)
    rows = (tmp_path / "out" / "runs.csv").read_text().splitlines()
    assert len(rows) == 3
    assert all(",done," in row for row in rows[1:])


@pytest.mark.parametrize(
    ("hold_time", "max_abs_u", "std_theta", "std_theta_dot"),
    [
        # Bands of 200 seeds, 5 to 95 %, and the medians of an independent program (Euler, 2 ms).
        (0.002, (0.152, 0.286), 0.00213, 0.0637),
        (0.010, (0.344, 0.605), 0.00479, 0.100),
    ],
    ids=["noise at 500 Hz", "noise at 100 Hz"],
)
def test_twenty_seeds_reproduce_the_thesis_under_noise(
    hold_time: float, max_abs_u: tuple[float, float], std_theta: float, std_theta_dot: float
) -> None:
    runs = [
        simulate(
            RunSpec(
                controller_parameters={"q": [100.0, 0.01], "r": 0.1},
                disturbance={"amplitude": 2.5, "hold_time": hold_time, "duration": 5.0},
                duration=5.0,
                seed=seed,
            )
        )
        for seed in range(20)
    ]
    low, high = max_abs_u
    assert low < np.median([abs(run.command).max() for run in runs]) < high
    assert np.median([run.position.std() for run in runs]) == pytest.approx(std_theta, rel=0.15)
    assert np.median([run.velocity.std() for run in runs]) == pytest.approx(std_theta_dot, rel=0.05)


def test_a_rehearsal_with_a_lab_file_checks_asks_and_moves_the_machine_of_the_file(
    domain_id: int, tmp_path: Path, processes: ProcessGroup
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes.start("pendulum_hw_bridge", "emulator", "--address", address).wait_for_output("listens on", 60.0)
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        f"format: pendulum_lab/1\nmodule: {{backend: emulator_process, emulator_address: '{address}'}}\n"
        "limits:\n  effort: {value: 6.0, unit: N m}\n",
        encoding="utf-8",
    )
    backend = EmulatorProcessBackend(address)
    before = backend.connect()
    command = ["gravity", "--hardware", "hebi", "--lab", lab, "--out", tmp_path / "run", "--trials", "1"]
    command += ["--step", "10", "--top", "10", "--hold", "0.5"]
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_bags", "experiment", *map(str, command)],
        input="yes\n",
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Type yes to arm" in done.stderr
    # What the module was set to is given back.
    assert before.limits.effort != 6.0
    assert backend.connect().limits == before.limits
    backend.close()
    bag = read_bag(tmp_path / "run" / "trial_1")
    states = bag["/hw/joint_states"]
    assert np.degrees(states["position"]).max() == pytest.approx(10.0, abs=2.0)
    assert np.abs(bag["/hw/applied_effort"]["effort"]).max() <= 6.0


def test_a_swing_up_brings_the_emulated_machine_up_for_the_board() -> None:
    line = evaluate_hardware("energy_swing_up", duration=9.0, robustness=False)
    assert line.reason == ""
    assert line.success
