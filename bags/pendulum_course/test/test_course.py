"""The course: one seed one course, a seal that keeps, and checks that tell right from wrong."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pendulum_bags.commands.excite_cli import main as excite_main
from pendulum_course import checks, winner
from pendulum_course.course_cli import main
from pendulum_course.exercises import answers
from pendulum_course.tasks import FAULTS, draw_plant, draw_tasks, read_tasks, write_tasks
from pendulum_msgs_py.errors import FaultError, ParameterError, PlantStoppedError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run, seal_plant
from pendulum_testing.synthetic_runs import write_events_and_torque

SEEDS = range(6)


@pytest.fixture
def course(tmp_path: Path) -> Path:
    folder = tmp_path / "course"
    assert main(["make", "--seed", "2027", "--out", str(folder)]) == 0
    return folder


def test_one_seed_is_one_course_and_another_seed_another(tmp_path: Path) -> None:
    for name, seed in (("first", 7), ("again", 7), ("other", 8)):
        assert main(["make", "--seed", str(seed), "--out", str(tmp_path / name)]) == 0
    for file in ("course.yaml", "hidden.yaml"):
        first, again, other = ((tmp_path / name / file).read_text() for name in ("first", "again", "other"))
        assert first == again != other


def test_a_course_does_not_overwrite_another_one(course: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["make", "--seed", "1", "--out", str(course)]) == 2
    assert (
        "is not empty; expected a new one, so that no answers get lost: name it with --out" in capsys.readouterr().err
    )


def test_no_file_of_a_course_tells_seed_or_parameters(course: Path) -> None:
    hidden = draw_plant(2027)
    text = "".join(path.read_text() for path in course.iterdir())
    assert "2027" not in text
    assert not [value for value in (hidden.inertia, hidden.gravity) if f"{value:.4g}" in text]


def test_a_sealed_plant_is_run_by_a_simulator_and_read_by_nobody_else(course: Path) -> None:
    plant, sealed = load_plant_to_run(course / "hidden.yaml")
    assert (plant, sealed) == (draw_plant(2027), True)
    assert load_plant_to_run("dfki") == (load_plant("dfki"), False)
    with pytest.raises(ParameterError, match="sealed for an exercise, and only a simulator runs it"):
        load_plant(course / "hidden.yaml")


def test_a_damaged_seal_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "hidden.yaml"
    whole = seal_plant(load_plant("dfki"))
    for damaged in (whole.replace("sealed: ", "sealed: x"), re.sub(r"(sealed: .{20}).{4}", r"\1AAAA", whole)):
        path.write_text(damaged)
        with pytest.raises(ParameterError, match="is damaged; expected it as the course wrote it"):
            load_plant_to_run(path)


@pytest.mark.parametrize("seed", SEEDS)
def test_each_drawn_course_can_be_solved_and_needs_work(seed: int) -> None:
    tasks, plant = draw_tasks(seed), draw_plant(seed)
    weight = float(re.findall(r"--r (\S+)", answers(tasks, plant)["1 gains"])[0])
    assert checks.check_gains(tasks, checks.WEIGHTS, weight).right
    assert not checks.check_gains(tasks, checks.WEIGHTS, 0.1).right  # the thesis's choice
    assert checks.check_plant(plant, plant).right
    wrong = checks.check_plant(plant, load_plant("dfki"))
    assert not wrong.right
    assert "inertia" in wrong.reason
    edge = checks.critical_delay(tasks)
    assert checks.check_delay(tasks, edge).right
    assert "still stands" in checks.check_delay(tasks, 0.9 * edge).reason
    assert "has fallen" in checks.check_delay(tasks, 1.1 * edge).reason
    ratio, letter = checks.noise_ratio(tasks), "abcd"[tasks.causes.index("power")]
    assert [cause for cause in "abcd" if checks.check_noise(tasks, ratio, cause).right] == [letter]
    assert checks.check_noise(tasks, 0.85 * ratio, letter).right  # as two runs of a minute may be
    assert not checks.check_noise(tasks, 0.7 * ratio, letter).right
    assert tasks.fault in FAULTS


def test_every_multiple_of_2_ms_up_to_a_tenth_of_a_second_can_be_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "course.yaml"
    for count in range(1, 51):
        write_tasks(path, replace(draw_tasks(5), hold_time=0.002 * count))
        assert checks.noise_ratio(read_tasks(path)) > 0.5


def test_an_answer_is_not_judged_by_a_plant_that_nobody_sealed(
    course: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = course.parent / "found.yaml"
    write_plant(found, load_plant("dfki"))
    write_plant(course / "hidden.yaml", load_plant("dfki"))
    assert main(["check", "plant", str(found), "--course", str(course)]) == 2
    assert "is not sealed; expected it as the course wrote it" in capsys.readouterr().err


def test_a_parameter_that_is_too_far_is_named_and_the_hidden_one_is_not() -> None:
    truth = draw_plant(3)
    found = checks.check_plant(truth, truth.with_values(gravity=1.1 * truth.gravity))
    assert not found.right
    assert found.reason.startswith("outside of the tolerance: gravity (")
    assert f"{truth.gravity:.4g}" not in found.reason


def test_noise_held_longer_spreads_as_the_theory_page_says() -> None:
    # A Lyapunov equation of the loop, worked out apart from this program, gives 0.00235 rad.
    assert checks.std_under_held_noise(0.002) == pytest.approx(0.00235, rel=0.01)
    assert checks.std_under_held_noise(0.01) == pytest.approx(0.00528, rel=0.01)


def test_tasks_are_read_as_they_were_written_and_nonsense_is_refused(tmp_path: Path) -> None:
    path, tasks = tmp_path / "course.yaml", draw_tasks(5)
    write_tasks(path, tasks)
    assert read_tasks(path) == tasks
    for bad, words in (
        (replace(tasks, hold_time=-1.0), "hold_time is -1.0; expected a number > 0"),
        (replace(tasks, hold_time=0.0005), "hold_time is 0.0005 s; expected a multiple of 0.002 s up to 0.1 s"),
        (replace(tasks, hold_time=0.005), "hold_time is 0.005 s; expected a multiple of 0.002 s up to 0.1 s"),
        (replace(tasks, hold_time=1e6), "hold_time is 1000000.0 s; expected a multiple of 0.002 s up to 0.1 s"),
        (replace(tasks, delay_weight=1e300), "delay_weight is 1e+300 1/(N m)^2; expected 0.001 to 1"),
        (replace(tasks, time_constant=1e9), "time_constant is 1000000000.0 s; expected 0.05 to 5"),
        (replace(tasks, controller_a=1e-12), "controller_a is 1e-12 1/(N m)^2; expected 1e-05 to 0.1"),
        (replace(tasks, noise_seed=1.5), "noise_seed is 1.5; expected a whole number"),
        (replace(tasks, fault="gremlin"), "fault is 'gremlin'; expected one of"),
        (replace(tasks, causes=("power",)), "causes is"),
    ):
        write_tasks(path, bad)
        with pytest.raises(ParameterError, match=re.escape(words)):
            read_tasks(path)


def test_no_exercise_is_solved_by_copying_its_own_commands(course: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (course / "exercises.md").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()
    commands = [shlex.split(line) for line in lines if line.startswith("    python -m ")]
    checked = [words[5:] for words in commands if words[3:5] == ["course", "check"]]
    assert [words[0] for words in checked] == ["gains", "plant", "delay", "noise", "winner", "fault"]
    assert [words for words in checked if main(["check", *words]) == 0] == []
    (excited,) = [words[4:] for words in commands if words[3] == "excite"]
    assert excite_main(excited) == 2
    assert "Invalid value for '--duration'" in capsys.readouterr().err


def test_a_check_says_right_or_wrong_by_its_exit_code_too(course: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = course.parent / "found.yaml"
    write_plant(found, draw_plant(2027))
    assert main(["check", "plant", str(found), "--course", str(course)]) == 0
    assert capsys.readouterr().out.startswith("right: ")
    assert main(["check", "delay", "0.01", "--course", str(course), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["right"] is False
    assert main(["check", "gains", "--q", "100,0.01", "--r", "1e6", "--course", str(course)]) == 1
    assert capsys.readouterr().out.startswith("wrong: the time constant of this loop is ")
    assert main(["check", "gains", "--q", "100", "--r", "0.1", "--course", str(course)]) == 2
    assert "--q is '100'; expected 2 numbers, for theta, theta_dot, as 100,0.01" in capsys.readouterr().err
    assert main(["check", "noise", "2", "--because", "e", "--course", str(course)]) == 2
    assert "cause is 'e'; expected one of a, b, c, d" in capsys.readouterr().err
    assert main(["check", "delay", "0.1", "--course", str(course.parent / "none")]) == 2
    assert "make one with: python -m pendulum_course course make" in capsys.readouterr().err
    assert main(["solution", "--seed", "2027", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["6 fault"] == f"emulator_fault {FAULTS[draw_tasks(2027).fault]}"


ARMED = [(0.0, "plant_mode", {"mode": "armed_position", "reason": ""})]


def _broken(
    path: Path,
    reason: str,
    torque_after: float,
    *,
    length: float = 2.0,
    armed: bool = True,
    rearmed: float | None = None,
) -> Path:
    """Write a recording: armed, a fault at 1 s, and a torque from 50 ms after it on."""
    events = [*(ARMED if armed else []), (1.0, "plant_mode", {"mode": "fault", "reason": reason})]
    events += [] if rearmed is None else [(rearmed, "plant_mode", {"mode": "armed_effort", "reason": ""})]
    return write_events_and_torque(path, "/hw", events, lambda t: 0.5 if t < 1.05 else torque_after, length)


def test_a_safely_broken_bridge_is_right_and_every_other_way_is_wrong(tmp_path: Path) -> None:
    tasks = replace(draw_tasks(1), fault="m_stop")
    words = "m_stop: the motion stop is pressed"
    cases = (
        (_broken(tmp_path / "good", words, 0.0), True, "no torque acted"),
        (_broken(tmp_path / "other", "voltage: 18 V", 0.0), False, "expected m_stop"),
        (_broken(tmp_path / "driven", words, 0.4), False, "0.4 N m acted later than 60 ms"),
        (_broken(tmp_path / "short", words, 0.0, length=1.2), False, "ends too early"),
        (_broken(tmp_path / "asleep", words, 0.0, armed=False), False, "was not armed before"),
        (_broken(tmp_path / "unknown", words, math.nan), False, "is not a number"),
        (_broken(tmp_path / "longer", "m_stop_other: a button", 0.0), False, "expected m_stop"),
        (_broken(tmp_path / "rearmed", words, 0.0, rearmed=1.2), False, "was armed again 0.2 s after the fault; leave"),
        (_broken(tmp_path / "rearmed later", words, 0.0, rearmed=1.7), True, "no torque acted"),
    )
    for bag, right, reason in cases:
        found = checks.check_fault(tasks, bag)
        assert (found.right, reason in found.reason) == (right, True), found
    healthy = write_events_and_torque(tmp_path / "healthy", "/hw", ARMED, lambda t: 0.5, 2.0)
    assert "never went into fault; its states were: armed_position" in checks.check_fault(tasks, healthy).reason


@pytest.mark.parametrize(
    ("leave_out", "reason"),
    [
        (
            lambda topic, t: topic == "applied_effort" and 1.06 < t < 1.085,
            "states near the fault have no torque at their time",
        ),
        (lambda topic, t: 1.06 < t < 1.2, "no torque was recorded for 140 ms near the fault"),
        (lambda topic, t: round(100 * t) % 4 != 0, "only 25 torques a second"),
    ],
    ids=["torques alone", "a piece", "three of four"],
)
def test_a_recording_that_was_thinned_out_proves_nothing(
    tmp_path: Path, leave_out: Callable[[str, float], bool], reason: str
) -> None:
    tasks = replace(draw_tasks(1), fault="m_stop")
    events = [*ARMED, (1.0, "plant_mode", {"mode": "fault", "reason": "m_stop: pressed"})]
    bag = write_events_and_torque(tmp_path / "bag", "/hw", events, lambda t: 0.0, 2.0, leave_out=leave_out)
    found = checks.check_fault(tasks, bag)
    assert (found.right, reason in found.reason) == (False, True), found


@pytest.mark.parametrize(
    ("error", "answered"),
    [
        (PlantStoppedError("/hw", "fault", "position_limit: 400 deg"), True),
        (PlantStoppedError("/hw", "e_stop", "somebody's hand, in fear of a fault: none was there"), False),
        (FaultError("bridge ended with code 1; its last words: fault: no emulator"), False),
    ],
)
def test_a_controller_loses_by_a_fault_of_the_bridge_and_by_no_other_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: FaultError, answered: bool
) -> None:
    def record_run(*_: object, **__: object) -> Path:
        raise error

    monkeypatch.setattr(winner, "record_run", record_run)
    if answered:
        assert winner.spread_on_machine(tmp_path / "a", 0.1, 1) == math.inf
    else:
        with pytest.raises(FaultError) as caught:
            winner.spread_on_machine(tmp_path / "a", 0.1, 1)
        assert caught.value is error
