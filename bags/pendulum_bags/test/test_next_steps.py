"""What a program tells its user to do next leads on: commands that exist, with the recordings and options they need."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer.main
from typer.testing import CliRunner

from pendulum_bags.commands.experiment_cli import app as experiment_app
from pendulum_bags.commands.identify_cli import main
from pendulum_bags.comparison import compare
from pendulum_bags.identification.identify import identify
from pendulum_bags.identification.options import Options
from pendulum_bags.identification.residual_tests import _outlier_sentence, _stretches
from pendulum_bags.pages.terms import Terms
from pendulum_bags.runs.datasets import Recording
from pendulum_bags.runs.next_test import measurement_of, next_test_of, question_of, with_budget
from pendulum_bags.verdict.same_run import same_run_layer
from pendulum_msgs_py.plants.plant_parameters import pendulum_plant
from pendulum_testing.plant_pairs import SIMULATED, pair
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

THESIS = "python -m pendulum_bags experiment thesis"
QUICK = Options(friction="viscous", folds=2, multi_start=False)


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (THESIS, f"{THESIS} --plant my.yaml --seed 2"),
        (f"{THESIS} --out /tmp/a --seed 7", f"{THESIS} --plant my.yaml --seed 8"),
        (f"{THESIS} --seed 7 --out 12 --plant 3", f"{THESIS} --plant my.yaml --seed 8"),
        (f"{THESIS} -o /tmp/a --plant=x.yaml --seed=7", f"{THESIS} --plant my.yaml --seed 8"),
        (
            f"{THESIS} --hardware hebi --lab 'my lab.yaml' --yes --q 100 0.01 --plant x --margin delay=8ms",
            f"{THESIS} --hardware hebi --lab 'my lab.yaml' --q 100 0.01 --margin delay=8ms --plant my.yaml --seed 2",
        ),
        (
            "python -m pendulum_bags experiment joints --plant acrobot --seed x",
            "python -m pendulum_bags experiment joints --plant my.yaml --seed 2",
        ),
        (f"{THESIS} --seed", f"{THESIS} --plant my.yaml --seed 2"),
        (f"{THESIS} --seed 3 -o/tmp/a --seed 5", f"{THESIS} --plant my.yaml --seed 6"),
        (
            f"{THESIS} --simulation my.xml --mapping my.map --design-plant x",
            f"{THESIS} --design-plant x --plant my.yaml --seed 2",
        ),
        ("python /lab/.venv/bin/pendulum experiment thesis --seed 7", f"{THESIS} --plant my.yaml --seed 8"),
        ("python -m pendulum_bags experiment lockstep --side hw --seed 7", ""),
        ("python -m pendulum_bags experiment", ""),
        ("python -m pendulum_sim experiment thesis", ""),
        (f"{THESIS} --lab 'no end", ""),
        ("", ""),
    ],
)
def test_a_plant_file_is_tested_by_the_recorded_experiment_under_other_noise(command: str, expected: str) -> None:
    assert next_test_of([{"command": command}], "my.yaml") == expected


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (THESIS, ""),
        (
            f"{THESIS} --plant=my.yaml --seed 7 --strategy effort_loop -o /tmp/a",
            "--plant my.yaml --strategy effort_loop",
        ),
        (f"{THESIS} --simulation 'my robot.xml' --mapping m.yaml", "--simulation 'my robot.xml' --mapping m.yaml"),
        (f"{THESIS} --hardware emulator --q 1 1", ""),
        ("python '/my lab/.venv/bin/pendulum' experiment thesis --plant my.yaml", "--plant my.yaml"),
    ],
)
@pytest.mark.parametrize("experiment", ["frequency_response", "ranking"])
def test_other_layers_are_measured_of_the_plants_that_were_compared(
    command: str, options: str, experiment: str
) -> None:
    told = measurement_of([{}, {"command": command}], experiment)
    assert told == f"python -m pendulum_bags experiment {experiment} {options}".rstrip()
    known = typer.main.get_command(experiment_app).commands[experiment]  # type: ignore[attr-defined]
    names = {name for parameter in known.params for name in parameter.opts}
    assert {word for word in shlex.split(told) if word.startswith("--")} <= names


@pytest.mark.parametrize(
    "command", [f"{THESIS} --hardware hebi", f"{THESIS} --simulation ros:/lab --plant x", "by hand"]
)
def test_no_experiment_on_the_emulator_is_advised_to_measure_another_machine(command: str) -> None:
    assert measurement_of([{"command": command}], "ranking") == ""


@pytest.mark.parametrize(
    ("command", "options"),
    [
        (f"{THESIS} --only same_run --seed 7 --budget=30 -o /tmp/a", "--seed 7"),
        (f"{THESIS} --plant my.yaml --q 1 1 --only=same_run --only identified", "--plant my.yaml --q 1 1"),
    ],
)
def test_an_experiment_whose_budget_was_spent_is_carried_out_again_with_all_its_other_options(
    command: str, options: str
) -> None:
    assert with_budget([{}, {"command": command}], 480.0) == f"{THESIS} {options} --budget 480"
    assert with_budget([{"command": "by hand"}], 480.0) == ""
    assert with_budget([{"command": f"{command} --json"}]) == f"{THESIS} {options}"


def test_the_emulated_machine_of_several_joints_is_kept_for_the_next_test(tmp_path: Path) -> None:
    joints = "python -m pendulum_bags experiment joints"
    bag, machine = str(tmp_path / "hw"), tmp_path / "machine.yaml"
    assert next_test_of([{"command": joints}], "my.yaml", [bag]) == f"{joints} --plant my.yaml --seed 2"
    machine.touch()
    kept = f"{joints} --plant my.yaml --seed 2 --hardware {machine}"
    assert next_test_of([{"command": joints}], "my.yaml", [bag]) == kept
    given = next_test_of([{"command": f"{joints} --hardware other.yaml"}], "my.yaml", [bag])
    assert given == f"{joints} --hardware other.yaml --plant my.yaml --seed 2"


def test_a_record_without_a_command_tells_no_experiment() -> None:
    assert next_test_of([{}], "my.yaml") == ""
    assert next_test_of([], "my.yaml") == ""


def test_the_experiment_takes_the_options_of_the_command_that_is_reported() -> None:
    told = shlex.split(next_test_of([{"command": f"{THESIS} --hardware hebi"}], "my file.yaml"))
    assert told[-4:] == ["--plant", "my file.yaml", "--seed", "2"]
    command = typer.main.get_command(experiment_app).commands["thesis"]  # type: ignore[attr-defined]
    known = {name for parameter in command.params for name in parameter.opts}
    assert {word for word in told if word.startswith("--")} <= known
    assert CliRunner().invoke(experiment_app, ["thesis", "--help"]).exit_code == 0


def test_noise_of_no_recording_that_is_fitted_to_is_the_test() -> None:
    records = [{"command": f"{THESIS} --seed {seed}", "seed": seed} for seed in (2, 1, 3)]
    assert next_test_of(records, "my.yaml") == f"{THESIS} --plant my.yaml --seed 4"
    assert next_test_of([{}, {"seed": 2}, *records[1:2]], "my.yaml") == f"{THESIS} --plant my.yaml --seed 3"


@pytest.mark.parametrize("told", ["", "--hardware emulator", "--hardware=emulator", "--q 1 1"])
def test_an_emulator_is_moved_without_a_question(told: str) -> None:
    assert question_of(f"{THESIS} {told}") == ""


@pytest.mark.parametrize("told", ["--hardware hebi", "--hardware=hebi", "--hardware ros:/lab"])
def test_of_a_command_that_may_move_a_machine_it_is_said_that_it_asks(told: str) -> None:
    assert "it asks first" in question_of(f"{THESIS} {told}")


# -- after a comparison that says no ------------------------------------------------------------------------------


def slack(sources: list[str], command: str) -> str:
    """Return the first step that is told after runs whose hardware has twice the damping."""
    return slack_steps(sources, command)[0]


def slack_steps(sources: list[str], command: str) -> Sequence[str]:
    runs = []
    for number, source in enumerate(sources):
        simulation, hardware = pair(5 + number, plant=SIMULATED.with_values(damping=2 * 11.77))
        record = {"pendulum.run": {"command": command, "seed": 5 + number}}
        runs.append((simulation, replace(hardware, source=source, metadata=record)))
    return same_run_layer(compare(runs)).next_steps


def test_after_a_no_the_plant_is_identified_from_all_runs_and_tested_under_other_noise(tmp_path: Path) -> None:
    run = tmp_path / "my run"
    (run / "hw").mkdir(parents=True)
    first, repeat = run / "hw", run / "repeats" / "1" / "hw"
    both = f"python -m pendulum_bags identify '{first}' '{repeat}' --out plant.yaml"
    test = f"{THESIS} --plant plant.yaml --seed 2"
    step = slack([str(first), str(repeat)], f"{THESIS} --out x")
    assert f"({both})" in step
    assert f"({test})" in step
    assert "MODEL INCOMPLETE" in step
    marked = Terms().mark(step)
    assert marked.count("<code>") == 2
    assert f"<code>{test}</code>" in marked
    # A repeat stands upright all the while, where gravity hardly shows: the fit has the run, which the test has not.
    assert f"({both})" in slack([str(repeat)], THESIS)
    # Of a repeat the simulation's side tells the experiment: the hardware's was recorded by a command of its own.
    simulation, hardware = pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))
    told = [{"pendulum.run": {"command": command}} for command in (f"{THESIS} --seed 4", "experiment lockstep")]
    sides = replace(simulation, metadata=told[0]), replace(hardware, metadata=told[1])
    assert f"({THESIS} --plant plant.yaml --seed 5)" in same_run_layer(compare([sides])).next_steps[0]
    (run / "hw").rmdir()
    assert f"identify '{repeat}' --out" in slack([str(repeat)], THESIS)


def test_after_a_no_of_other_recordings_the_step_names_no_experiment_and_few_recordings() -> None:
    step = slack([f"/lab/{number}/hw" for number in range(6)], "by hand")
    assert "identify /lab/0/hw /lab/1/hw /lab/2/hw /lab/3/hw --out plant.yaml" in step
    assert step.endswith("simulate and design with --plant plant.yaml, and compare again under noise of another seed.")
    assert "identify RUN/hw --out" in slack([""], "")


@pytest.mark.parametrize(
    ("simulated", "following"),
    [("plant.yaml", "plant_2.yaml"), ("a b/plant_2.yml", "'a b/plant_3.yml'"), ("_7.yaml", "_7_2.yaml")],
)
def test_a_file_that_was_fitted_is_left_alone_by_the_next_fit_and_no_third_is_promised_to_do(
    simulated: str, following: str
) -> None:
    again, otherwise = slack_steps(["/lab/run/hw"], f"{THESIS} --plant {shlex.quote(simulated)} --seed 2")
    assert again.startswith(f"The simulation had {simulated} already. Identify once more")
    assert f"identify /lab/run/hw --out {following})" in again
    assert f"({THESIS} --plant {following} --seed 3)" in again
    assert f"experiment frequency_response --plant {shlex.quote(simulated)})" in otherwise
    assert slack_steps(["/lab/run/hw"], f"{THESIS} --plant={shlex.quote(simulated)}")[0] == again.replace(
        "seed 3", "seed 2"
    )
    # Of a preset nobody has fitted anything.
    (step,) = slack_steps(["/lab/run/hw"], f"{THESIS} --plant thesis --seed 2")
    assert step.startswith("Identify the plant from what the hardware did")
    assert "--out plant.yaml)" in step


def test_no_identification_is_recommended_from_recordings_that_one_has_refused() -> None:
    pairs = pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))
    steps = same_run_layer(compare([pairs]), refused="the windows are too short").next_steps
    assert steps[0] == "No plant could be identified from these recordings: the windows are too short."
    assert not any("pendulum_bags identify" in step for step in steps)


# -- after an identification ---------------------------------------------------------------------------------------


def swing() -> Recording:
    rng = np.random.default_rng(1)
    effort = multisine(np.arange(0.0, 6.0, 0.01), 1.2, rng)
    return synthetic_recording(pendulum_plant(inertia=0.05, damping=0.03, gravity=1.5), effort, 0.01, rng)


def test_identify_ends_with_the_test_of_the_file_that_it_wrote(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = swing()
    content = np.column_stack([recording.time, recording.position, recording.input])
    np.savetxt(tmp_path / "run.csv", content, delimiter=",", header="time,position,torque", comments="")
    out = tmp_path / "a plant.yaml"
    arguments = [str(tmp_path / "run.csv"), "--hold", "zero", "--friction", "viscous", "--no-page"]
    assert main([*arguments, "--out", str(out)]) == 0
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert last == f"  python -m pendulum_bags replay RECORDING --params '{out}'"
    assert main(arguments) == 0
    assert "replay" not in capsys.readouterr().out


def test_identify_tells_the_experiment_that_recorded_its_data() -> None:
    recording = swing()
    result = identify([recording], QUICK, profiles=0)

    def next_step(*records: Mapping[str, object]) -> tuple[str, str]:
        pieces = [
            replace(result.fit.pieces[0], recording=replace(recording, meta={"pendulum.run": one})) for one in records
        ]
        return replace(result, fit=replace(result.fit, pieces=pieces)).next_step("my.yaml")

    repeat = {"command": "python -m pendulum_bags experiment lockstep --side hw", "plant": "emulator"}
    told, command = next_step(repeat, {"command": f"{THESIS} --seed 7", "plant": "hebi"})
    assert command == f"{THESIS} --plant my.yaml --seed 8"
    assert told.endswith("Test it under noise that it was not fitted to:")
    assert "it asks first" not in told
    assert next_step(repeat)[1] == f"{THESIS} --plant my.yaml --seed 2"
    assert next_step({**repeat, "seed": 2})[1] == f"{THESIS} --plant my.yaml --seed 3"
    told, command = next_step({"command": f"{THESIS} --hardware hebi --lab my.yaml", "plant": "hebi"})
    assert "--hardware hebi" in command
    assert told.endswith("not fitted to. Where that moves a machine, it asks first:")
    told, command = next_step({"plant": "hebi"})
    assert command == "python -m pendulum_bags replay RECORDING --params my.yaml"
    assert told.endswith("Test it on a recording that it was not fitted to:")


def test_the_next_step_says_what_is_missing_and_how_much() -> None:
    recording = swing()
    result = identify([recording], QUICK, profiles=0)
    explained = replace(result.explained, share=0.0432, incomplete=None)
    whole = replace(result, explained=explained, tests=replace(result.tests, incomplete=False, outliers=()))
    assert whole.next_step("my.yaml")[0].startswith("It misses 4.3 % of what straight lines through the windows miss; ")
    assert not whole.incomplete
    outlier = ("run", 1.0, 2.0, 0.1)
    lacking = replace(whole, tests=replace(whole.tests, incomplete=True, outliers=(outlier,)))
    assert lacking.next_step("my.yaml")[0].startswith(
        "The model is incomplete. Apart from the windows named above, it misses 4.3 % of what"
    )
    assert replace(whole, explained=replace(explained, incomplete="A part is not explained.")).incomplete


def test_windows_that_stand_out_one_after_the_other_are_one_stretch_and_all_stretches_one_sentence() -> None:
    outliers = [
        ("hw", 5.0, 5.99, 0.6),
        ("hw", 21.0, 21.99, 0.9),
        ("hw", 22.0, 22.99, 1.2),
        ("hw", 23.0, 23.99, 1.1),
        ("hw", 26.0, 26.99, 0.7),
        ("other", 27.0, 27.99, 0.7),
    ]
    stretches = _stretches(outliers)
    assert [len(one) for one in stretches] == [1, 3, 1, 1]
    assert _stretches([]) == []
    said = _outlier_sentence(stretches, 0.1)
    assert said.startswith(
        "hw, 5.00 to 5.99 s after its start, 21.00 to 23.99 s after its start, 26.00 to 26.99 s after its start; "
        "other, 27.00 to 27.99 s after its start: the fit is 6 to 12 times worse there than in the median window"
    )
    assert "hand" not in said
    assert "the fit is 6 times worse" in _outlier_sentence(stretches[:1], 0.1)
