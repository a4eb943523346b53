"""The whole answer: contenders that differ, recordings made once, a budget that holds, and one sentence."""

from __future__ import annotations

import json
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.comparison import Margins
from pendulum_bags.experiments.deadline import BudgetSpentError, Deadline
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.machine import Machine, MachineRun, record_listed
from pendulum_bags.experiments.progress import PhaseProgress
from pendulum_bags.experiments.repeats import record_simulation, record_spec
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings
from pendulum_bags.runs.run_data import read_run
from pendulum_bags.verdict import Answer, Layer, LayerResult, Mark
from pendulum_bags.whole import carry_out, words
from pendulum_bags.whole.carry_out import Findings, Simulated
from pendulum_bags.whole.contenders import contender_specs, place_of, simulate_contenders
from pendulum_bags.whole.page import leave_files_out
from pendulum_msgs_py.errors import BagError, DataError, FaultError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_sim.exports.model_files import mjcf
from pendulum_testing.fixtures import wait_for

NOISE = {"kind": "uniform", "amplitude": 2.5, "hold_time": 0.01}


def test_contenders_differ_in_what_they_command_and_are_picked_under_other_noise_than_judged() -> None:
    sim, hw = (RunSpec(side=side) for side in ("sim", "hw"))
    found = contender_specs(sim, hw, 32, 5)
    assert next(iter(found)) == "lqr"
    # The file lists the thesis's LQR a second time, under the name of its weights.
    assert "lqr_q100_0.01_r0.1" not in found
    commands = [simulate(replace(both[0][0], duration=0.5)).command for both in found.values()]
    for i, own in enumerate(commands):
        assert not any(np.allclose(own, other, rtol=1e-6, equal_nan=True) for other in commands[:i])
    for both in found.values():
        assert [b.seed for _, b in both] == [5, 6, 7]
        assert not {a.seed for a, _ in both} & {b.seed for _, b in both}
        assert all(a.controller == b.controller and a.disturbance == b.disturbance for a, b in both)
    assert list(contender_specs(sim, hw, 6, 5)) == list(found)[:6]


def test_a_controller_that_refuses_the_plant_leaves_its_place_to_the_next() -> None:
    # Sliding mode is for rigid plants alone, and x5_9 has a spring.
    sim, hw = (RunSpec(side=side, plant="x5_9", design_plant="x5_9") for side in ("sim", "hw"))
    found = contender_specs(sim, hw, 6, 1)
    assert len(found) == 6
    assert "sliding_mode" not in found


def test_a_simulated_run_of_a_ranking_is_read_back_as_a_run_of_a_study(tmp_path: Path) -> None:
    from pendulum_bags.ranking.collect import collect_contenders

    specs = {
        name: [RunSpec(side=side, disturbance=NOISE, duration=1.0, controller=name) for side in ("sim", "hw")]
        for name in ("lqr", "pid")
    }
    simulate_contenders(tmp_path, {name: [both[0]] for name, both in specs.items()})
    assert (place_of(tmp_path, "lqr", specs["lqr"][0]) / "run.npz").is_file()
    # Nothing ran on the other side.
    assert collect_contenders([tmp_path])[0] == []


def test_recordings_are_made_one_after_the_other_and_a_failure_is_reported_by_its_own_bag_alone(tmp_path: Path) -> None:
    first, second, third = (RunSpec(disturbance=NOISE, duration=0.2, seed=seed) for seed in (1, 2, 3))
    runs = [MachineRun(tmp_path / name, spec) for name, spec in (("a", first), ("b", second), ("c", third))]
    record_simulation(tmp_path / "b", first)
    with Machine(tmp_path, runs) as machine:
        with pytest.raises(FaultError, match="was not recorded"):
            machine.wait(tmp_path / "a")
        machine.start()
        machine.wait(tmp_path / "a")
        with pytest.raises((FaultError, BagError), match=r"exists|not recorded"):
            machine.wait(tmp_path / "b")
        machine.discard()
    assert not (tmp_path / "a").exists()


def test_two_simulations_are_not_repeated_in_advance_since_they_may_be_one(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    model = tmp_path / "own.xml"
    model.write_text(mjcf(load_plant("thesis")), encoding="utf-8")
    repeats = []
    for hardware in ("emulator", str(model)):
        settings = RegulationSettings(simulation=str(model), hardware=hardware)
        order = carry_out.Order(settings, Margins.parse(), 60.0, carry_out.STEPS, 6)
        with PhaseProgress(1.0, make_console()) as progress:
            run = carry_out._Run(tmp_path, order, progress, lambda _: None)
        bags = [str(one.bag.relative_to(tmp_path)) for one in run.machine.runs]
        assert {"identified/hw", "frequency_response/hw", "ranking/lqr_seed1/hw/bag"} <= set(bags)
        repeats.append("repeats/1/hw" in bags)

    def fails() -> None:
        raise DataError("they hold one and the same recording")

    run.now = "undecided"
    with pytest.raises(DataError):
        run.carry_out(fails)
    run.found.given.comparisons = {"": object()}  # type: ignore[dict-item]
    # There is an answer, which must not be lost.
    run.carry_out(fails)
    assert run.found.notes == ["Undecided failed: they hold one and the same recording."]
    assert repeats == [True, False]
    # The identified plant runs as a simulator of ours, under the controller of the given one and under other noise.
    file = write_plant(tmp_path / "plant.yaml", load_plant("thesis").with_values(inertia=0.2))
    spec, given = (one.run("sim") for one in (carry_out._with_plant(run.tested, file), settings))
    assert (spec.plant, spec.simulation) == (str(file), "")
    assert spec.design_plant == given.design_plant == "thesis"
    assert spec.seed != given.seed


def test_an_identified_plant_runs_under_the_controller_of_the_given_one(tmp_path: Path) -> None:
    file = write_plant(tmp_path / "plant.yaml", load_plant("thesis").with_values(inertia=0.2))
    noise = NoiseSettings(duration=0.5)
    settings = RegulationSettings(plant=str(file), design="thesis", noise=noise)
    spec = settings.run("sim")
    assert (spec.plant, spec.design_plant) == (str(file), "thesis")
    assert settings.controller_program("/sim").parameters["plant"] == "thesis"
    run = read_run(record_simulation(tmp_path / "sim", spec))
    own = replace(spec, design_plant=str(file))
    # Another gain: the one that was designed on the plant itself commands otherwise.
    assert not np.allclose(run.window.effort, simulate(own).command[:-1], atol=1e-3)


def test_waiting_for_a_recording_ends_with_the_budget(tmp_path: Path) -> None:
    runs = [MachineRun(tmp_path / "a", RunSpec(disturbance=NOISE, duration=600.0))]
    with Machine(tmp_path, runs) as machine:
        machine.start()
        with pytest.raises(BudgetSpentError, match=r"budget of 0.1 s is spent"):
            machine.wait(tmp_path / "a", Deadline(0.1))


def test_a_program_that_starts_late_records_nothing_yet_and_begins_when_it_may(tmp_path: Path) -> None:
    with Machine(tmp_path, [MachineRun(tmp_path / "a", RunSpec(disturbance=NOISE, duration=0.2))]) as machine:
        assert machine.rests()
        machine.start()
        assert machine._child is not None
        # As beside a busy computer, on which it takes minutes.
        machine._child.process.send_signal(signal.SIGSTOP)
        assert machine.rests()
        machine._child.process.send_signal(signal.SIGCONT)
        machine.resume()
        machine.wait(tmp_path / "a", Deadline(60.0))


def test_recordings_pause_between_two_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hold, busy, listed = (tmp_path / name for name in ("hold", "busy", "runs.json"))
    spec = RunSpec(disturbance=NOISE, duration=0.2)
    listed.write_text(json.dumps([{"bag": str(tmp_path / name), "spec": spec.to_json()} for name in "ab"]))
    seen = []

    def record(bag: Path, spec: RunSpec, **more: Any) -> None:
        seen.append((bag.name, hold.exists(), busy.exists()))
        record_spec(bag, spec, **more)
        hold.touch()

    monkeypatch.setattr("pendulum_bags.experiments.machine.record_spec", record)
    program = threading.Thread(target=record_listed, args=[listed])
    program.start()
    wait_for(lambda: hold.exists() and not busy.exists(), 60.0, "the pause behind the first")
    hold.unlink()
    program.join(60.0)
    assert seen == [("a", False, True), ("b", False, True)]
    assert not busy.exists()


def _answer(mark: Mark, choice: Mark) -> Answer:
    layers = [LayerResult(layer, mark, "A sentence.", reason="a reason") for layer in list(Layer)[:3]]
    missing = ("same choice",) if (mark, choice) == (Mark.YES, Mark.NOT_MEASURED) else ()
    last = LayerResult(Layer.SAME_CHOICE, choice, "Another.")
    holds = "" if mark is Mark.YES else "it stands"
    return Answer(mark, "a reason", [*layers, last], ("the next step",), "Test 3 decides.", holds, missing)


@pytest.mark.parametrize(
    ("marks", "choices", "expected"),
    [
        (
            (Mark.NO, Mark.YES),
            (Mark.YES, Mark.YES),
            (
                "No with thesis, the plant that you had; yes with plant.yaml, which this run found. Of these 6 "
                "controllers the simulation picks the right one with both. With thesis: a reason. Test 3 decides."
            ),
        ),
        (
            (Mark.NO, Mark.UNDECIDED),
            (Mark.NO, Mark.YES),
            (
                "No with thesis, the plant that you had; undecided with plant.yaml, which this run found. Of these 6 "
                "controllers the simulation picks a wrong one with thesis and picks the right one with plant.yaml. "
                "With thesis: a reason. With plant.yaml: a reason. Test 3 decides. What holds with plant.yaml: it "
                "stands."
            ),
        ),
        (
            (Mark.NO, Mark.YES),
            (Mark.NOT_MEASURED, Mark.NOT_MEASURED),
            (
                "No with thesis, the plant that you had; yes with plant.yaml, which this run found. With thesis: a "
                "reason. Test 3 decides. Not measured: “same choice”."
            ),
        ),
    ],
)
def test_one_sentence_names_both_plants_and_the_choice(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    marks: tuple[Mark, Mark],
    choices: tuple[Mark, Mark],
    expected: str,
) -> None:
    class Ranked:
        names = tuple("abcdef")

    answers = iter([_answer(*both) for both in zip(marks, choices, strict=True)])
    monkeypatch.setattr(Simulated, "answer", lambda _: next(answers))
    settings = RegulationSettings()
    given, identified = (
        Simulated(name, settings, tmp_path, comparisons={"": object()}, ranking=Ranked())  # type: ignore[dict-item,arg-type]
        for name in ("thesis", "plant.yaml")
    )
    answer, own = words.whole_answer(Findings(given, identified))
    assert answer.sentence == expected
    assert answer.mark is marks[0]
    assert [one.mark for one in own] == list(marks)
    assert ("design on it" in answer.next_steps[0]) is (marks[1] is Mark.YES)


def test_files_that_the_budget_has_no_time_for_are_named(tmp_path: Path) -> None:
    settings = RegulationSettings()
    early, late = (
        Findings(Simulated("thesis", settings, tmp_path, 0.0), deadline=Deadline(budget)) for budget in (1.0, 3600.0)
    )
    for found in (early, late):
        leave_files_out(found)
    assert early.spent
    assert any("report.html alone" in note for note in early.notes)
    assert not late.spent
    assert late.notes == []
