"""Experiments over the real middleware: determinism in lockstep, identifications, frequencies, a course, studies."""

from __future__ import annotations

import contextlib
import json
import math
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.experiments import lockstep
from pendulum_bags.experiments.host_pool import HostedProgram, HostPool, share_pool
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings
from pendulum_bags.studies.leaderboard_hardware import evaluate_hardware
from pendulum_bags.verdict import Layer, read_layers
from pendulum_course.course_cli import main as course_main
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_lqr.responses.measured_response import read_response
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_msgs_py.programs.executables import run_package
from pendulum_rosbag.reader import read_bag, same_messages
from pendulum_testing.policies import linear_policy
from tests.acceptance.test_docs import JOINTS
from tests.acceptance.test_readme import FROM_STAIRS


def run_experiment(*arguments: str | Path | float, timeout: float = 150.0) -> subprocess.CompletedProcess[str]:
    """Run ``python -m pendulum_bags experiment``; its output is in the message of a failure."""
    command = [sys.executable, "-m", "pendulum_bags", "experiment", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def run_command(words: Sequence[str], *more: str) -> None:
    """Run ``python -m PACKAGE PROGRAM ...`` of a page in this process, whose hosts it shares."""
    assert list(words[:2]) == ["python", "-m"]
    assert run_package(words[2], [*words[3:], *more]) == 0


def _program(name: str) -> psutil.Process:
    """Return the process of a program that this process has started, and that has it to itself."""
    for one in psutil.Process().children(recursive=True):
        # One may end while it is asked.
        with contextlib.suppress(psutil.Error):
            if name in one.cmdline():
                return one
    raise LookupError(f"no {name} runs")


@pytest.fixture(scope="module", autouse=True)
def kept_hosts(hosts: HostPool) -> Iterator[None]:
    """Let all runs that a test carries out in its own process use the hosts of tests, commands of ours among them."""
    with share_pool(hosts):
        yield


@pytest.fixture
def pids(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Return which process runs a program, as soon as one was started."""
    found: dict[str, int] = {}
    start = HostPool.start

    def noted(pool: HostPool, command: Sequence[str], **more: Any) -> HostedProgram | None:
        program = start(pool, command, **more)
        if program is not None:
            found[command[3]] = program.pid
        return program

    monkeypatch.setattr(HostPool, "start", noted)
    return found


def test_lockstep_runs_of_a_policy_on_the_emulated_hardware_with_one_seed_are_identical(
    domain_id: int, tmp_path: Path, hosts: HostPool, pids: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_policy(tmp_path / "upright.npz", linear_policy(load_plant("thesis"), 20.0, 1.0))
    first_bag = tmp_path / "first"
    run_experiment("lockstep", "--side", "hw", "--bag", first_bag, "--seed", 5, "--duration", "1", "--controller", path)
    # A bridge offers its services before its emulator is compiled, half a minute on a busy machine the first time, and
    # is waited for as long as any start. Here a call that does not say how long it waits waits for nothing.
    monkeypatch.setattr(Orchestrator.call, "__defaults__", (0.0,))
    ran_in = []
    # In one domain: what is left of the first run would be counted among those who hear the second.
    for name, seed in (("other", 6), ("in_the_same_processes", 5)):
        settings = RegulationSettings(controller=str(path), noise=NoiseSettings(seed=seed, duration=1.0))
        spec = settings.run("hw")
        lockstep.record_run(tmp_path / name, spec, domain=domain_id, hosts=hosts)
        ran_in.append(dict(pids))
    assert ran_in[0] == ran_in[1]
    assert len(set(ran_in[0].values())) == 4
    first, second, other = (read_bag(tmp_path / name) for name in ("first", "in_the_same_processes", "other"))
    topics = ["joint_states", "effort_command", "disturbance", "applied_effort", "actuator/feedback"]
    topics = [f"/hw/{topic}" for topic in topics] + ["/clock"]

    assert same_messages(first, second, topics=topics)
    assert not same_messages(first, other, topics=topics)
    assert first.metadata["pendulum.run"]["controller"] == {"kind": "policy", "policy": str(path)}
    states, commands = first["/hw/joint_states"], first["/hw/effort_command"]
    assert len(states) == 101
    assert abs(states["position"] - math.pi).max() < 0.1
    # What it answers, wherever a state was answered: u = -20 sin(x) - 1 x', on what the policy saw every 10 ms.
    answered = dict(zip(commands["stamp_ns"], commands["effort"], strict=True))
    expected = 20.0 * np.sin(states["position"]) - states["velocity"]
    pairs = [(answered[stamp], u) for stamp, u in zip(states["stamp_ns"], expected, strict=True) if stamp in answered]
    assert len(pairs) > 50
    assert np.median(np.abs(np.diff(np.array(pairs[len(pairs) // 2 :]), axis=1))) < 1e-5


def test_a_lockstep_run_is_waited_for_as_long_as_it_goes_on_and_no_longer(
    domain_id: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, newest, now, asking = 0, 0, 0.0, False
    counts: list[int] = []
    recorders: list[RecorderClient] = []
    wait_for, received = Orchestrator.wait_for, RecorderClient.received

    def noted(orchestrator: Orchestrator, what: str, *arguments: Any, **more: Any) -> Any:
        nonlocal looks
        looks += what == "the end of a run of 20 s of simulated time"
        if looks and not recorders:
            recorders.append(RecorderClient(orchestrator, "/sim"))
        return wait_for(orchestrator, what, *arguments, **more)

    def counted(recorder: RecorderClient, topic: str) -> int:
        counts.append(received(recorder, topic))
        return counts[-1]

    def hold() -> None:
        """Let the plant go on until enough has come for the first look and the second, and not before the third.

        When all of it has been counted, the time of a look is over, however late others are; a run at full speed would
        only cost more.
        """
        nonlocal now, newest, asking
        if not looks or asking:
            return
        assert looks < 10, "a run that stands still is taken for a live one"
        # To ask is to wait, which calls this again.
        asking = True
        before, newest = newest, received(recorders[0], "/sim/joint_states")
        asking = False
        simulator = _program("simulator")
        if looks < 3 and newest < sum(counts[-1:]) + 10:
            simulator.resume()
            return
        simulator.suspend()
        if newest == before:
            now += lockstep._PATIENCE

    monkeypatch.setattr(Orchestrator, "wait_for", noted)
    monkeypatch.setattr(RecorderClient, "received", counted)
    monkeypatch.setattr(lockstep, "time", SimpleNamespace(monotonic=lambda: now))
    # The orchestrator knows the state of one joint only, and looks away from any.
    spec = RunSpec(plant="cart_pole", design_plant="cart_pole", duration=20.0)
    with pytest.raises(
        FaultError,
        match=rf"waited {lockstep._PATIENCE:g} s for 10 more states of a run of 20 s of simulated time, in vain",
    ):
        lockstep.record_run(tmp_path / "frozen", spec, on_wait=hold)
    # Patience counts from the last look. A recorder that a busy machine keeps waiting has states to count after the
    # plant has stopped: then the look behind the third is the one that finds none.
    came = np.diff([0, *counts])
    assert len(came) == looks >= 3
    assert (came[:-1] >= 10).all()
    assert came[-1] < 10


def test_a_run_of_which_the_recorder_received_nothing_on_a_topic_fails_and_names_it(
    tmp_path: Path, hosts: HostPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It knows of a publisher that does not know of it yet: what that says goes to nobody."""
    deaf = "^/diagnostics$|/transition_event$|/disturbance$"
    start, heard = HostPool.start, RecorderClient.heard

    def start_deaf(pool: HostPool, command: Sequence[str], **more: Any) -> HostedProgram | None:
        words = [deaf if before == "--exclude" else word for before, word in zip(["", *command], command, strict=False)]
        return start(pool, words, **more)

    monkeypatch.setattr(HostPool, "start", start_deaf)
    monkeypatch.setattr(RecorderClient, "heard", lambda recorder: {*heard(recorder), "/sim/disturbance"})
    monkeypatch.setattr(RecorderClient.wait_for_all, "__defaults__", (3.0,))
    # The recorder is no listener of it.
    monkeypatch.setitem(lockstep._RUN_LISTENERS, "disturbance", 1)
    spec = RegulationSettings(noise=NoiseSettings(duration=0.2)).run("sim")
    with pytest.raises(FaultError, match=r"the recorder has 0 of 100 messages of /sim/disturbance after 3 s"):
        lockstep.record_run(tmp_path / "run", spec, hosts=hosts)


def test_several_joints_and_what_stands_in_for_their_machine_end_in_one_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    words = shlex.split(JOINTS)
    monkeypatch.chdir(tmp_path)
    # As its page has it, with more delay, and for less time.
    run_command(words, "--delay", "0.02", "--signal-period", "1", "--json")
    out = tmp_path / words[words.index("--out") + 1]
    content = json.loads(capfd.readouterr().out)
    assert list(content["joints"]) == ["cart", "pole"]
    delays = [
        test for one in content["joints"].values() for test in one["verdict"]["tests"] if test["quantity"] == "delay"
    ]
    # 20 ms in the loop, as far as the motion shows them.
    assert [test["outcome"] for test in delays] == ["not equivalent"] * 2
    assert all(12.0 < test["estimate"] < 25.0 for test in delays)
    assert content["answer"]["mark"] == "no"
    assert "emulated hardware" in content["answer"]["sentence"]
    for side in ("sim", "hw"):
        bag = read_bag(out / side)
        states = bag.joints(f"/{side}/joint_states")
        assert len(states.stamp_ns) == 1001
        assert abs(states.position - (0.0, math.pi)).max() < 0.2
        assert bag.joints(f"/{side}/disturbance").names == ("cart",)
    layers = {layer["layer"]: layer for layer in content["answer"]["layers"]}
    assert layers["same_plant"]["mark"] != "not measured"
    assert layers["same_choice"]["mark"] == "not measured"
    late = next(row for row in layers["same_plant"]["evidence"] if row["quantity"].startswith("extra delay"))
    assert 18.0 < late["estimate"] < 28.0
    designs = [row for row in layers["which_controllers"]["evidence"] if row["quantity"].startswith("margin b")]
    assert len(designs) == 4
    measured = read_response(out)
    assert measured.joints == ("cart", "pole")
    assert (measured.facts["blocks"], measured.facts["block_length_s"], measured.frequency[0]) == (3, 1.0, 1.0)
    assert (out / "report.html").is_file()
    machine, plant = load_mechanism(out / "machine.yaml"), load_mechanism("cart_pole")
    assert machine.value("cart.transport_delay") == 0.02
    assert 0.0 < abs(machine.value("cart_mass") / plant.value("cart_mass") - 1.0) <= 0.05


def test_a_policy_that_cannot_play_is_refused_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_policy(tmp_path / "other.npz", linear_policy(load_plant("dfki"), 2.0, 0.1))
    for arguments, reason in (
        ((tmp_path / "none.npz",), "none.npz does not exist"),
        ((other, "--q", "50", "0.01"), "which has no such parameter"),
    ):
        assert main(["thesis", "--out", str(tmp_path / "run"), "--controller", *map(str, arguments)]) == 2
        assert reason in capsys.readouterr().err
        assert not (tmp_path / "run").exists()


def test_a_lockstep_run_of_the_simulator_gives_the_numbers_of_one_process_to_the_last_bit(
    domain_id: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "logs" / "bag" / "sim_simulator.log"
    frozen: list[psutil.Process] = []
    resume = PlantClient.resume

    def freeze_the_controller(plant: PlantClient, timeout: float) -> None:
        """Let it answer late, so that the plant publishes a state again."""
        frozen.append(_program("controller"))
        frozen[0].suspend()
        resume(plant, timeout)

    def go_on() -> None:
        if frozen and "publishing it again" in log.read_text():
            frozen[0].resume()

    monkeypatch.setattr(PlantClient, "resume", freeze_the_controller)
    settings = RegulationSettings(noise=NoiseSettings(seed=7, duration=1.0, hold_time=0.002))
    lockstep.run_lockstep(tmp_path / "bag", settings, on_wait=go_on)
    assert "publishing it again" in log.read_text()
    bag = read_bag(tmp_path / "bag")
    assert bag.metadata["pendulum.recorder.counts"]["/sim/joint_states"]["repeated"] > 0
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


def test_the_two_experiments_of_the_thesis_give_back_its_coefficients(
    domain_id: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["inertia_damping", "--out", "hand", "--trials", "1"]) == 0
    # As its page has it: stairs, and then a controller designed for what they tell.
    for command in FROM_STAIRS.split("&&"):
        run_command(shlex.split(command))

    hand = json.loads((tmp_path / "hand" / "identified.json").read_text())["intervals"]
    stairs = json.loads((tmp_path / "stairs" / "identified.json").read_text())["intervals"]
    assert hand["damping"][0] < 11.77 < hand["damping"][1]
    assert hand["inertia"][0] < 0.055 < hand["inertia"][1]
    assert stairs["gravity"][0] < 1.678 < stairs["gravity"][1]

    bag = read_bag(tmp_path / "stairs" / "trial_1")
    steps = [event["name"] for event in bag.events() if event["name"] in {"dynamic", "static"}]
    assert steps == ["dynamic", "static"] * 4
    quantities = bag["/hw/actuator/feedback"][0].message.name
    recorded = {"position", "velocity", "effort", "position_command", "velocity_command", "effort_command"}
    assert recorded | {"pwm_command", "motor_current", "winding_current"} <= set(quantities)


def test_both_plants_are_measured_in_lockstep_and_designs_certified(domain_id: int, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["--signal-period", "1", "--lowest", "1", "--periods", "3", "--lines", "12"]
    assert main(["frequency_response", "--out", str(folder), *words, "--design", "q=100,0.01 r=0.1"]) == 0
    measured = read_response(folder)
    assert measured.period == pytest.approx(0.01)
    assert measured.coherence[0][:6].min() > 0.99
    simulated = read_response(folder / "sim_response.json")
    # Both had the same torque as a function of time, sampled at 500 and at 100 Hz.
    assert simulated.period == pytest.approx(0.002)
    assert list(simulated.frequency) == pytest.approx(list(measured.frequency))
    assert [layer.layer for layer in read_layers(folder)] == [Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS]
    numbers = json.loads((folder / "frequency_response.json").read_text(encoding="utf-8"))
    assert numbers["designs"][0]["certified"]
    assert (folder / "frequency_response.html").is_file()


def test_a_course_names_the_controller_that_wins_on_the_machine(
    domain_id: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    course = ["--course", str(tmp_path / "course")]
    assert course_main(["make", "--seed", "1", "--out", course[1]]) == 0
    capfd.readouterr()
    assert course_main(["check", "winner", "b", *course]) == 0
    assert capfd.readouterr().out.startswith("right:")


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


def test_a_swing_up_brings_the_emulated_machine_up_for_the_board(hosts: HostPool) -> None:
    line = evaluate_hardware("energy_swing_up", duration=9.0, robustness=False, hosts=hosts)
    assert line.reason == ""
    assert line.success
