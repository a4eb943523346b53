"""Runs that keep the wall's time: an excitation on a running plant, a rehearsal with a lab file."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_rosbag.reader import read_bag
from tests.processes import ProcessGroup


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
