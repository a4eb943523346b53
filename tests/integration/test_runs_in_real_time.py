"""Runs that keep the wall's time: an excitation on a running plant, a rehearsal with a lab file."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.experiments.orchestrator_node import PlantClient
from pendulum_bags.experiments.processes import Child
from pendulum_bags.experiments.session import LOOP_NICENESS, conduct
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_msgs_py.contract.trajectory import thesis_ramp
from pendulum_msgs_py.errors import FaultError, PlantStoppedError
from pendulum_msgs_py.programs.executables import run_package
from pendulum_rosbag.reader import read_bag
from pendulum_testing.fixtures import wait_for
from pendulum_testing.processes import ProcessGroup

SLOW = ("--ros-args", "-p", "rate_hz:=100.0")


def test_an_excitation_is_played_alone_on_a_running_plant_and_ends_at_zero_torque(
    processes: ProcessGroup, domain_id: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    zero = tmp_path / "zero.csv"
    zero.write_text("time,effort\n0,0\n1,0\n", encoding="utf-8")
    simulator = processes.start("pendulum_sim", "simulator", *SLOW, "-r", "__ns:=/sim", "-p", "plant:=dfki")
    playback = ("--ros-args", "-r", "__ns:=/sim", "-p", "controller:=playback", "-p", f"file:={zero}")
    other = processes.start("pendulum_lqr", "controller", *playback)
    simulator.wait_for_output("commanded by /sim/controller", 60)
    bag = tmp_path / "excited"
    command = ["excite", "--plant", "dfki", "--max-angle", "0.5", "--duration", "1", "--trials", "3"]
    command += ["--out", str(tmp_path / "e.csv"), "--bag", str(bag), "--play", "--on", "running"]

    assert run_package("pendulum_bags", command) == 2
    assert "/sim/effort_command has a publisher, /sim/controller; expected none" in capfd.readouterr().err
    assert not bag.exists()

    other.interrupt()
    assert other.wait(20) == 0
    assert run_package("pendulum_bags", command) == 0, capfd.readouterr()
    recorded = read_bag(bag)
    applied = recorded["/sim/applied_effort"]["effort"]
    assert 0.1 < np.max(np.abs(applied)) <= 0.75
    assert np.all(applied[-20:] == 0.0)
    assert {"inertia", "gravity"} <= recorded.metadata["pendulum.excitation"]["predicted"].keys()


def test_what_breaks_a_session_off_disarms_a_plant_that_it_drives_and_no_other(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    simulators = {
        namespace: processes.start("pendulum_sim", "simulator", *SLOW, "-r", f"__ns:={namespace}")
        for namespace in ("/sim", "/other", "/done")
    }
    ended: list[Child] = []

    def run(ending: type[BaseException]) -> None:
        with conduct(tmp_path / "logs", domain_id) as session:
            plants = [PlantClient(session.orchestrator, namespace, "simulator") for namespace in simulators]
            for plant in plants:
                plant.wait_until_ready(60.0, controller=False, disturbance=False)
            plants[0].arm()
            ended.append(session.processes.start("beside", [sys.executable, "-c", "import time; time.sleep(60)"]))
            session.drives(plants[0], plants[2])
            session.leaves(plants[2])
            raise ending

    for times, ending in enumerate((KeyboardInterrupt, FaultError), 1):
        with pytest.raises(ending):
            run(ending)
        # Nobody else ends these: one was disarmed by whoever drove it, and the others still are armed.
        wait_for(
            lambda times=times: simulators["/sim"].output.count(": disarmed: ") == times,  # type: ignore[misc]
            10.0,
            "the plant to be disarmed",
        )
        for other in ("/other", "/done"):
            assert "disarmed" not in simulators[other].output
    assert [child.process.poll() is not None for child in ended] == [True, True]


def test_a_move_that_a_stopped_plant_refuses_is_reported_by_what_stopped_it(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    processes.start("pendulum_sim", "simulator", *SLOW, "-r", "__ns:=/sim")
    with conduct(tmp_path / "logs", domain_id) as session:
        plant = PlantClient(session.orchestrator, "/sim", "simulator")
        plant.wait_until_ready(60.0, controller=False, disturbance=False)
        plant.call("simulator/e_stop")
        session.orchestrator.wait_for(
            "the stop", lambda: any(event.get("mode") == "e_stop" for event in plant.events), 20.0
        )
        plant.follow(thesis_ramp(0.0, 0.5), "ramp_up")
        with pytest.raises(PlantStoppedError) as stopped:
            session.orchestrator.wait_for("the end of the move", plant.trajectory_finished, 20.0)
    assert stopped.value.mode == "e_stop"


def test_a_rehearsal_with_a_lab_file_checks_asks_and_moves_the_machine_of_the_file(
    domain_id: int, tmp_path: Path, processes: ProcessGroup
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    # A module has a processor of its own.
    module = processes.start("pendulum_hw_bridge", "emulator", "--address", address, niceness=LOOP_NICENESS)
    module.wait_for_output("listens on", 60.0)
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        f"format: pendulum_lab/1\nmodule: {{backend: emulator_process, emulator_address: '{address}'}}\n"
        "limits:\n  effort: {value: 6.0, unit: N m}\n",
        encoding="utf-8",
    )
    backend = EmulatorProcessBackend(address)
    before = backend.connect()
    command = ["gravity", "--hardware", "hebi", "--lab", lab, "--out", tmp_path / "run", "--trials", "1"]
    command += ["--step", "5", "--top", "5", "--hold", "0.5"]
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
    assert np.degrees(states["position"]).max() == pytest.approx(5.0, abs=1.0)
    assert np.abs(bag["/hw/applied_effort"]["effort"]).max() <= 6.0
