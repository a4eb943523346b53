"""A real machine moves only after its checklist and an operator's yes."""

import importlib.util
from pathlib import Path

import pytest

from pendulum_bags.commands import experiment_cli
from pendulum_bags.experiments.operator import ask_yes, real_machine
from pendulum_bags.experiments.run_spec import EMULATOR_LIFETIME, EMULATOR_WATCHDOG
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.experiments.trials import GRAVITY, INERTIA_DAMPING, TrialSettings
from pendulum_bags.studies.results import read_record
from pendulum_bags.studies.runner import default_workers, open_study_folder, run_study
from pendulum_bags.studies.study_file import StudyRun, load_study
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.programs.terminal import make_console

LAB = """format: pendulum_lab/1
module: {backend: emulator_process, emulator_address: '127.0.0.1:9', serial: X5-9-7}
joint: {sign: -1}
limits:
  effort: {value: 2.0, unit: N m}
drive: {effort_strategy: effort_loop}
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    path = tmp_path / "lab.yaml"
    path.write_text(LAB, encoding="utf-8")
    return path


def test_the_bridge_of_a_real_machine_gets_the_lab_file_and_nothing_that_contradicts_it(lab: Path) -> None:
    settings = RegulationSettings(hardware="hebi", lab=str(lab))
    assert settings.strategy == "effort_loop"
    program = settings.bridge_program()
    # A rehearsal on an emulator has the patience that a busy machine needs.
    assert program.parameters == {
        "lab_file": str(lab),
        "effort_strategy": "effort_loop",
        "feedback_watchdog": EMULATOR_WATCHDOG,
        "command_lifetime": EMULATOR_LIFETIME,
    }
    lab.write_text(LAB.replace("backend: emulator_process, ", ""), encoding="utf-8")
    # The vendor's own log is written beside the bag of a real one.
    assert settings.bridge_program(lab.parent / "run" / "hw").parameters["hebi_log"] == str(
        lab.parent / "run" / "hw.hebilog"
    )
    assert settings.bridge_program().parameters == {"lab_file": str(lab), "effort_strategy": "effort_loop"}
    assert RegulationSettings(hardware="hebi", lab=str(lab), effort_strategy="direct_pwm").strategy == "direct_pwm"
    run = settings.metadata("thesis")["pendulum.run"]
    assert run["strategy"] == "effort_loop"
    assert run["lab"]["joint_sign"] == -1
    for kind in (GRAVITY, INERTIA_DAMPING):
        assert TrialSettings(kind, 1, "hebi", lab=str(lab)).plant_program(1).parameters["lab_file"] == str(lab)


def test_a_ramp_that_the_machine_would_refuse_with_the_pendulum_upright_is_refused_before_it_moves(lab: Path) -> None:
    lab.write_text(LAB.replace("limits:", "limits:\n  velocity: {value: 0.3, unit: rad/s}"), encoding="utf-8")
    for speed in (0.2, 0.8):
        with pytest.raises(ParameterError, match=r"expected up to 0\.27 rad/s at a velocity limit of 0\.3 rad/s \(lab"):
            RegulationSettings(hardware="hebi", lab=str(lab), ramp_speed=speed)
    assert RegulationSettings(hardware="hebi", lab=str(lab), ramp_speed=0.18).ramp_time > 17.0


def test_emulators_on_the_network_of_hebi_are_a_rehearsal_with_the_limits_of_a_real_machine(lab: Path) -> None:
    lab.write_text(LAB.replace("emulator_process", "hebi, interface: 192.168.1.10"), encoding="utf-8")
    machine = real_machine("hebi", lab)
    assert machine is not None
    assert not machine.emulated
    assert machine.log_parameters(lab.parent / "hw")
    lab.write_text(LAB.replace("emulator_process", "hebi, interface: 'emulator:127.0.0.1:9'"), encoding="utf-8")
    machine = real_machine("hebi", lab)
    assert machine is not None
    assert machine.emulated
    assert not machine.patient
    # hebi-py logs what its own network brings.
    assert not machine.log_parameters(lab.parent / "hw")


def test_a_backend_that_nobody_knows_is_a_real_machine_whatever_its_name(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A rig of somebody's own that moves, behind a backend of its own.
    lab.write_text(LAB.replace("emulator_process", "emulator_rig"), encoding="utf-8")
    settings = RegulationSettings(hardware="hebi", lab=str(lab))
    machine = settings.machine
    assert machine is not None
    # A run on it is never started again by itself, its bag names a machine, and its watchdogs stay the strict ones.
    assert not machine.emulated
    assert settings.plant_name("hw") == "hebi"
    assert "feedback_watchdog" not in settings.bridge_program().parameters
    ask_yes(machine, "It moves.", make_console(), yes=True)
    assert "This moves a REAL machine" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["thesis", "gravity", "inertia_damping"])
def test_a_real_machine_needs_its_lab_file(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert experiment_cli.main([name, "--hardware", "hebi", "--out", str(tmp_path / "run")]) == 2
    assert "without a lab file; expected --lab FILE" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", ["gravity", "inertia_damping"])
def test_trials_that_could_not_be_evaluated_are_not_recorded(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None if module == "statsmodels" else found(module))
    assert experiment_cli.main([name, "--out", str(tmp_path / "run")]) == 2
    assert "statsmodels is not installed, which this needs; install it with make extras" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_lab_file_for_the_emulator_is_a_mistake(lab: Path) -> None:
    with pytest.raises(ParameterError, match="expected --hardware hebi"):
        real_machine("emulator", lab)


def test_nothing_is_started_where_the_checklist_is_not_passed(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab.write_text(LAB.replace("emulator_process", "emulator").replace("sign: -1", "zero: {value: 3.0, unit: rad}"))
    arguments = ["gravity", "--hardware", "hebi", "--lab", str(lab), "--yes", "--out", str(tmp_path / "run")]
    assert experiment_cli.main(arguments) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "the checklist is not passed: " in said
    assert "hanging is zero: 3.000 rad (expected 0 within" in said
    assert "nothing was started" in said
    assert "This moves" not in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("answer", ["", "no", "y", "yess"])
def test_any_answer_but_yes_ends_here(lab: Path, answer: str) -> None:
    machine = real_machine("hebi", lab)
    assert machine is not None
    with pytest.raises(FaultError, match="nothing was started"):
        ask_yes(machine, "It moves.", make_console(), yes=False, read=lambda: answer)


def test_the_question_says_which_machine_and_what_it_will_do(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = real_machine("hebi", lab)
    assert machine is not None
    ask_yes(machine, "It turns upright.", make_console(), yes=False, read=lambda: " Yes\n")
    said = " ".join(capsys.readouterr().out.split())
    for words in ("EMULATED", "X5-9-7", str(lab), "It turns upright.", "2 N m", "motion stop", "Type yes to arm"):
        assert words in said

    def nobody() -> str:
        raise EOFError

    with pytest.raises(FaultError, match="there is no terminal to confirm in; expected one, or --yes"):
        ask_yes(machine, "It moves.", make_console(), yes=False, read=nobody)
    ask_yes(machine, "It moves.", make_console(), yes=True, read=nobody)


STUDY = """format: pendulum_study/1
name: real
experiment: gravity
clock: realtime
plants:
  bench: {hardware: hebi, lab: lab.yaml}
trials: 1
seeds: {first: 1, count: 2}
"""


def test_a_study_asks_before_each_run_of_a_real_machine_and_goes_on_where_it_was_stopped(
    lab: Path, tmp_path: Path
) -> None:
    lab.write_text(LAB.replace("emulator_process", "replay"), encoding="utf-8")
    file = tmp_path / "study.yaml"
    file.write_text(STUDY, encoding="utf-8")
    study = load_study(file)
    assert [run.lab for run in study.runs] == [str(lab), str(lab)]
    assert default_workers(study) == 1
    folder = tmp_path / "out"
    open_study_folder(folder, study)
    asked: list[int] = []

    def answer(run: StudyRun) -> None:
        asked.append(run.number)
        if len(asked) == 2:
            raise FaultError("the answer is 'no'")

    with pytest.raises(FaultError, match="no"):
        run_study(folder, study, workers=1, before_machine=answer)
    assert asked == [1, 2]
    # The first was started, and refused by its checklist.
    record = read_record(folder, study.runs[0])
    assert record is not None
    assert "replay_file is empty" in record["reason"]
    assert "settings cannot be saved" in record["reason"]
    assert read_record(folder, study.runs[1]) is None


def test_a_study_of_a_real_machine_without_its_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "study.yaml"
    file.write_text(STUDY.replace(", lab: lab.yaml", ""), encoding="utf-8")
    with pytest.raises(ParameterError, match="hardware is 'hebi' without a lab file"):
        load_study(file)
