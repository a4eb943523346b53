"""``make experiment`` as its user meets it: a result, a computer that stood still, an interruption, a mistake."""

from __future__ import annotations

import html
import json
import math
import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.experiments.run_spec import EMULATOR_LIFETIME
from pendulum_bags.runs.run_folder import read_stalls
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.reader import read_bag
from pendulum_testing.fixtures import PROJECT, wait_for
from pendulum_testing.processes import ProcessGroup, RunningProgram

pytestmark = pytest.mark.timeout(600)

NOISE = 5.0
SPEED = 0.2
"""Mean speed of the ramps [rad/s], the default: faster ones look like a stuck duty to a busy bridge."""
SHORT = f"--ramp-speed {SPEED} --contenders 3 --seeds 1 --periods 3 --signal-period 2"
"""Each step of the default run, with less of it."""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningProgram]:
    """Run the whole experiment once as its user does, through make; what it leaves is what the tests look at."""
    folder = tmp_path_factory.mktemp("experiment")
    processes = ProcessGroup(folder, cwd=PROJECT)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("ROS_DOMAIN_ID", raising=False)
        program = processes.start_command(
            ["make", "--no-print-directory", "experiment", f"OUT={folder / 'run'}", f"ARGS={SHORT}"]
        )
    try:
        assert program.wait(540) == 0, program.output
        _await_the_end_of_all(processes)
        yield program
    finally:
        assert processes.close() == []


def _await_the_end_of_all(processes: ProcessGroup) -> None:
    """Wait until all that an ended program has started has ended, too; on a busy machine it notices late."""
    wait_for(lambda: not processes.leftovers(), 10.0, "the end of what it started")


@pytest.fixture(scope="module")
def run_folder(experiment: RunningProgram) -> Path:
    """Return the experiment's folder."""
    told = re.search(r"(\S+/run)/report\.html", experiment.output)
    assert told, experiment.output
    return Path(told[1])


def test_what_nobody_disturbs_is_measured_once_and_answered(experiment: RunningProgram, run_folder: Path) -> None:
    summary = json.loads((run_folder / "summary.json").read_text(encoding="utf-8"))
    # A busy machine may stand still by itself: then that is told, and each run that broke off is on record.
    assert len(summary["stalls"]) == experiment.output.count("; measuring again, run ")
    assert len(re.findall(r"^regulation \(1 s\)", experiment.output, re.MULTILINE)) <= 1 + len(summary["stalls"])
    assert summary["answer"]["mark"] in {"yes", "no", "undecided"}
    answer = summary["answer"]["sentence"]
    assert answer in " ".join(experiment.output.split())
    assert "Tests of the same run: " in experiment.output
    assert re.search(r"^│ delay \[ms\] ", experiment.output, re.MULTILINE)
    page = html.unescape(re.sub(r"<[^>]*>", "", (run_folder / "report.html").read_text(encoding="utf-8")))
    # (the page says yes or no by itself, and then why)
    assert answer.partition(": ")[2].lower() in " ".join(page.split()).lower()


def test_experiment_leaves_two_bags_a_summary_figures_and_a_report(run_folder: Path) -> None:
    summary = json.loads((run_folder / "summary.json").read_text())

    for plant in ("sim", "hw"):
        figures = summary["plants"][plant]
        assert {"rate_hz", "missed_deadlines", "std_theta", "std_theta_dot", "max_abs_u"} <= figures.keys()
        # Under one and the same noise held for 10 ms: the bands of 200 simulated seeds, widened for one seed.
        assert 0.002 < figures["std_theta"] < 0.009
        assert 0.2 < figures["max_abs_u"] < 0.9
    assert summary["plants"]["sim"]["rate_hz"] == pytest.approx(500.0, rel=0.1)
    assert summary["plants"]["hw"]["rate_hz"] == pytest.approx(100.0, rel=0.1)
    # Under noise of its own, held for 2 ms: the same bands.
    assert 0.001 < summary["plants"]["sim_500hz"]["std_theta"] < 0.004
    assert {"paired", "unpaired", "seed", "strategy", "versions"} <= summary.keys()
    # What a busy computer's budget ends has the plots of the page alone.
    assert list((run_folder / "figures").glob("*.png")) or summary["left_out"]
    assert (run_folder / "report.html").stat().st_size < 5_000_000


def test_one_run_answers_for_the_given_plant_and_for_the_one_that_it_identifies(run_folder: Path) -> None:
    summary = json.loads((run_folder / "summary.json").read_text(encoding="utf-8"))
    found = summary["identified"]
    # On a busy computer the budget may end it early: then it is said.
    assert found is not None or summary["left_out"]
    if found is None:
        return
    assert load_plant(found["plant"]).inertia > 2.0 * load_plant("thesis").inertia
    assert found["answer"]["layers"][0]["mark"] == "yes"
    assert '<th scope="col">plant.yaml</th>' in (run_folder / "report.html").read_text(encoding="utf-8")
    for answer in (summary["answer"], found["answer"]):
        missing = [layer["layer"] for layer in answer["layers"] if layer["mark"] == "not measured"]
        assert not missing or summary["left_out"]
    # Both simulations are beside one recording of the machine, the second beside noise that its fit has not seen.
    bags = {str(path.parent.relative_to(run_folder)) for path in run_folder.rglob("metadata.yaml")}
    assert {"hw", "repeats/1/hw", "identified/sim", "identified/hw"} <= bags
    assert "identified/frequency_response/hw" not in bags
    seeds = [
        run_record(read_bag(run_folder / name).metadata)["seed"] for name in ("hw", "repeats/1/hw", "identified/hw")
    ]
    assert len(set(seeds)) == 3


def test_both_bags_hold_the_whole_experiment(run_folder: Path) -> None:
    for name in ("sim", "hw"):
        bag = read_bag(run_folder / name)
        states = bag[f"/{name}/joint_states"]
        duration = (states["stamp_ns"][-1] - states["stamp_ns"][0]) * 1e-9
        assert duration > 2 * math.pi / SPEED + NOISE
        assert states["position"].max() == pytest.approx(math.pi, abs=0.05)
        assert abs(states["position"][-1]) < 0.2
        events = [event["name"] for event in bag.events()]
        for phase in ("ramp_up", "regulation", "noise_start", "noise_end", "ramp_down", "done"):
            assert phase in events


def test_hand_over_to_lqr_makes_no_jump_in_torque(run_folder: Path) -> None:
    for name in ("sim", "hw"):
        bag = read_bag(run_folder / name)
        times = {event["name"]: event["stamp_ns"] for event in bag.events()}
        applied = bag[f"/{name}/applied_effort"]
        # The ramp ends at speed: its torque against friction falls until the controller takes over.
        changes = [(str(event.get("reason")), event["stamp_ns"]) for event in bag.events()]
        start = next(stamp for reason, stamp in changes if reason.startswith("commanded by"))
        # On a busy machine a controller may fall silent: its torque ends at once, and what catches the fall is large.
        silences = [stamp for reason, stamp in changes if "no fresh command" in reason and stamp > start]
        end = min([times["noise_start"] - 20_000_000, *silences])
        first, last = np.searchsorted(applied["stamp_ns"], (start, end))
        assert last - first > 50 or silences
        assert np.abs(np.diff(applied["effort"][first - 1 : last])).max(initial=0.0) < 1.0


def test_both_plants_got_the_same_noise(run_folder: Path) -> None:
    signals = {}
    # A torque acts until the next state: the middle of that time says which sample of the noise it is.
    for name, half_period in (("sim", 1_000_000), ("hw", 5_000_000)):
        bag = read_bag(run_folder / name)
        start = next(event["stamp_ns"] for event in bag.events() if event["name"] == "noise_start")
        noise = bag[f"/{name}/disturbance"]
        index = (noise["stamp_ns"] - start + half_period) // 10_000_000
        kept = (index >= 0) & (index < 500)
        signals[name] = dict(zip(index[kept].tolist(), noise["effort"][kept].tolist(), strict=True))
    common = signals["sim"].keys() & signals["hw"].keys()
    # A busy computer misses some; the noise of each is drawn by its number.
    assert len(common) > 100
    equal = sum(signals["hw"][i] == signals["sim"][i] for i in common)
    assert equal > 0.95 * len(common)


def test_ctrl_c_while_programs_start_leaves_no_process(processes: ProcessGroup, domain_id: int, tmp_path: Path) -> None:
    program = processes.start("pendulum_bags", "experiment", "thesis", "--out", tmp_path / "run", alone=True)
    program.wait_for_output("starting", 60)
    program.interrupt()
    assert program.wait(30) == 130
    assert "interrupted" in program.output
    _await_the_end_of_all(processes)


def test_a_run_whose_bridge_stood_still_is_measured_again_and_ctrl_c_leaves_readable_bags_and_its_record(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    program = processes.start("pendulum_bags", "experiment", "thesis", "--out", folder, alone=True)
    program.wait_for_output("ramp up", 120)
    (bridge,) = [
        child
        for child in psutil.Process(program.pid).children(recursive=True)
        if {"pendulum_hw_bridge", "bridge"} <= _command_line(child)
    ]
    # The stimulus: twice as long as an emulator's bridge may stand still.
    bridge.suspend()
    time.sleep(2.0 * EMULATOR_LIFETIME)
    bridge.resume()
    program.wait_for_output(r"^This machine stood still \((.*)\); measuring again, run 2 of at most 3\.$", 60)
    program.wait_for_output(r"measuring again(?s:.*)ramp up", 120)
    program.interrupt()

    assert program.wait(30) == 130
    assert f"interrupted: all programs have ended; what was recorded is in {folder}" in " ".join(program.output.split())
    _await_the_end_of_all(processes)
    # What was broken off first is on record (how a result tells it: test_stalls.py), and its bags do not count.
    stall = read_stalls(folder)[0]
    assert stall["reason"].startswith("/hw went to fault: ")
    assert stall["logs"] == "logs_stalled_1"
    assert (folder / "logs_stalled_1" / "hw_bridge.log").is_file()
    for name in ("sim", "hw"):
        bag = read_bag(folder / name)
        assert bag[f"/{name}/applied_effort"]["effort"][-1] == 0.0
        assert "fault" not in [event.get("mode") for event in bag.events() if event["name"] == "plant_mode"]


FAST = ("--ramp-speed", "0.8", "--duration", "1")
"""A run in real time of a quarter of a minute."""


def test_ctrl_c_behind_the_first_layer_gives_the_answer_so_far(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    # What follows the identification would be recorded already, and is not what is looked at.
    words = ("--out", folder, *FAST, "--only", "identified")
    program = processes.start("pendulum_bags", "experiment", "thesis", *words, alone=True)
    program.wait_for_output(r"^identifying the plant", 300)
    program.interrupt()

    assert program.wait(120) == 130
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    output = " ".join(program.output.split())
    assert summary["answer"]["mark"] == "no"
    assert summary["answer"]["sentence"] in output
    assert summary["left_out"] == ["The run was interrupted: “identifying the plant” and what follows it was left out."]
    assert f"what was recorded is in {folder}" in output
    assert (folder / "report.html").is_file()
    _await_the_end_of_all(processes)


def _command_line(process: psutil.Process) -> set[str]:
    """Return the words of a command line, none where the process has just ended."""
    try:
        return set(process.cmdline())
    except psutil.Error:
        return set()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--plant", "nope"], "plant is 'nope'; expected one of the presets"),
        (["--plant", "/no/such/file.yaml"], "/no/such/file.yaml does not exist"),
        (["--hardware", "arduino"], "hardware is 'arduino'; expected one of emulator, hebi"),
        (["--amplitude", "nan"], "noise amplitude is nan N m; expected"),
        (["--hold-time", "0"], "noise hold time is 0.0 s; expected"),
        (["--out", "."], "exists and is not empty"),
        (["--out", "/proc/run"], "cannot be made"),
        (["--only", "everything"], "--only is everything; expected one of same_run, identified, same_plant"),
        (["--only", "identified", "--budget", "0"], "--only identified needs time after the run; expected --budget"),
        (["--domain", "400"], "ROS domain is 400; expected 0 to 100"),
    ],
)
def test_a_mistake_ends_with_one_sentence_and_leaves_nothing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    expected: str,
) -> None:
    (tmp_path / "something").touch()
    monkeypatch.chdir(tmp_path)
    assert main(["thesis", *arguments]) == 2
    said = capsys.readouterr().err
    assert expected in said
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["something"]
