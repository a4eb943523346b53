"""Which designs carry over, as ``compare`` and ``report`` say it of a machine that was measured."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.commands.compare_cli import main as compare
from pendulum_bags.commands.report_cli import main as report
from pendulum_bags.frequency_response.analyse import MACHINE, NUMBERS, analyse_responses
from pendulum_bags.frequency_response.designs import design_rows
from pendulum_bags.report import FIGURES
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.verdict import write_layer
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_lqr.responses.gap_metric import Scaling
from pendulum_lqr.responses.measured_response import MeasuredResponse, read_response, write_response
from pendulum_lqr.responses.sampled_response import model_response
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_testing.policies import linear_policy
from pendulum_testing.synthetic_runs import regulate, run_metadata, write_bag, write_run_folder

GOOD, BAD = "q=100,0.01 r=0.1", "k=400,0.1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run_folder(tmp_path_factory.mktemp("carry") / "run", seed=1)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a measurement, without recordings: the thesis's plant with 60 ms more delay."""
    late = linearise(load_plant("thesis").with_values(transport_delay=0.06))
    frequency = np.geomspace(0.25, 47.5, 48)
    response = model_response(late, frequency, 0.01)
    n = frequency.size
    measured = MeasuredResponse(
        "hw", 0.01, frequency, response, 1e-3 * np.abs(response), np.ones((2, n)), np.ones(n, dtype=complex), 10.0
    )
    analysis = analyse_responses([measured], "thesis", [GOOD, BAD, "lqi"], scaling=Scaling(0.02, 2.0, 0.5))
    folder = tmp_path_factory.mktemp("measured")
    # What write_analysis keeps, but for its page and figures, which take seconds.
    write_response(folder / MACHINE, measured)
    write_json(folder / NUMBERS, analysis.to_json())
    write_layer(folder, analysis.layers[0])
    return folder


@pytest.mark.parametrize("option", ["--layers", "--machine"])
def test_compare_lists_the_designs_that_were_certified_when_the_machine_was_measured(
    option: str, folder: Path, machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare([str(folder), option, str(machine), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    kept = json.loads((machine / "frequency_response.json").read_text())["designs"]
    assert [(one["name"], one["certified"]) for one in found["designs"]] == [
        (one["name"], one["certified"]) for one in kept
    ]
    assert [one["certified"] for one in found["designs"]] == [True, False, True]
    # In the units in which it was judged then.
    assert [one["margin"] for one in found["designs"]] == pytest.approx([one["margin"] for one in kept])
    layers = {one["layer"]: one for one in found["answer"]["layers"]}
    assert layers["which_controllers"]["mark"] == "no"
    assert layers["same_choice"]["mark"] == "not measured"
    assert "K=(400, 0.1) not certified for the" in found["answer"]["sentence"]
    # A no about the motion beside a certificate: each says what it is about.
    assert found["answer"]["sentence"].endswith(
        "certified to be stable there, which does not show how closely it moves as simulated."
    )


def test_compare_certifies_the_designs_that_it_is_given(
    folder: Path, machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    response = str(machine / "hw_response.json")
    assert compare([str(folder), "--machine", response, "--design", BAD, "--design", GOOD]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(bool(re.match(r"│ 1 +│ K=\(400, 0.1\) .*│ no +│$", line)) for line in lines) == 1
    assert sum(bool(re.match(r"│ 2 +│ LQR q=\(100, 0.01\) r=0.1 .*│ yes, by", line)) for line in lines) == 1
    # Given designs stand for those that the folder keeps.
    assert compare([str(folder), "--layers", str(machine), "--design", GOOD, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["answer"]["layers"][2]
    assert (found["layer"], found["mark"]) == ("which_controllers", "yes")


def test_designs_without_a_measured_machine_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare([str(folder), "--design", GOOD]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --design needs the measured response of the machine")
    assert str(folder) in error
    assert compare([str(folder), "--machine", str(folder)]) == 2
    assert "hw_response.json cannot be read" in capsys.readouterr().err


def test_the_report_draws_the_certified_gains_of_a_measured_machine(
    folder: Path, machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The others are drawn by the tests of the report, and take seconds.
    titles = ("Gap per frequency", "Gains that carry over", "LQR weights that carry over")
    own = [(title, maker) for title, maker in FIGURES if title in titles]
    monkeypatch.setattr("pendulum_bags.report.figures.FIGURES", own)
    monkeypatch.setattr("pendulum_bags.frequency_response.figures._GRID", 9)
    assert report([str(folder), "--layers", str(machine), "-o", str(tmp_path), "--png-only"]) == 0
    assert "K=(400, 0.1) not certified" in capsys.readouterr().out
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<figure id="certified_gains">' in text
    assert "3 which controllers" in text
    assert "Evidence: which controllers" in text
    assert (tmp_path / "figures" / "certified_weights.png").exists()


@pytest.mark.parametrize("text", [GOOD, BAD, "q=0.5,1e-05 r=2", "lqi", "pid"])
def test_a_stored_design_says_how_to_ask_for_it_again(machine: Path, text: str) -> None:
    (design,) = analyse_responses([read_response(machine)], "thesis", [text]).designs
    stored = design.to_json()
    assert (stored["text"] or stored["name"]) == text


def policy_file(folder: Path, gains: tuple[float, float], **changes: Any) -> Path:
    policy = linear_policy(load_plant("thesis"), *gains, **changes)
    return write_policy(folder / "policy.npz", policy)


def test_a_policy_that_is_a_gain_near_upright_is_certified_as_that_gain(machine: Path, tmp_path: Path) -> None:
    policy = policy_file(tmp_path, (33.0, 1.0))
    gain, learned = analyse_responses([read_response(machine)], "thesis", ["k=33,1", str(policy)]).designs
    assert gain.certified
    assert (learned.name, learned.certified, learned.unknown) == ("policy policy.npz", True, "")
    for name in ("margin", "distance", "worst_modulus"):
        assert getattr(learned.certificate, name) == pytest.approx(getattr(gain.certificate, name), abs=2e-3)
    weak = analyse_responses([read_response(machine)], "thesis", [str(policy_file(tmp_path, (400.0, 0.1)))])
    assert [one.certified for one in weak.designs] == [False]
    assert weak.layers[0].mark.value in {"no", "undecided"}


@pytest.mark.parametrize(
    ("gains", "changes", "words"),
    [
        # Beyond 1 mrad it is at its limit: a switch, of which no linear certificate speaks.
        ((4e4, 40.0), {}, "is no linear law near upright|does not settle near upright"),
        ((1.0, 0.0), {}, "does not settle near upright"),
        ((33.0, 1.0), {"period": 0.05}, "commands every 0.05 s, and the hardware was measured every 0.01 s"),
    ],
)
def test_a_policy_without_a_linear_law_is_unknown_and_never_certified(
    machine: Path, tmp_path: Path, gains: tuple[float, float], changes: dict[str, float], words: str
) -> None:
    path = policy_file(tmp_path, gains, **changes)
    analysis = analyse_responses([read_response(machine)], "thesis", [GOOD, str(path)])
    good, learned = analysis.designs
    assert (good.certified, learned.certified, learned.undecided) == (True, False, True)
    assert re.search(words, learned.unknown)
    layer = analysis.layers[0]
    assert layer.mark.value == "undecided"
    assert [row.note for row in layer.evidence if "policy" in row.quantity] == [f"unknown: {learned.unknown}"]
    assert any("experiment thesis --controller" in step for step in layer.next_steps)
    assert design_rows(analysis.designs)[1][-1] == f"unknown: {learned.unknown}"


def test_compare_asks_about_the_policy_that_ran_even_after_its_file_is_gone(
    machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = policy_file(tmp_path, (33.0, 1.0))
    for side in ("sim", "hw"):
        metadata = run_metadata(1)
        metadata["pendulum.run"].update(controller={"kind": "policy", "policy": str(policy)})
        columns = regulate(rate=100.0, seed=1, hardware=side == "hw")
        write_bag(tmp_path / "run" / side, columns, f"/{side}", metadata=metadata, ramps=False)
    arguments = [str(tmp_path / "run"), "--machine", str(machine), "--json"]
    assert compare(arguments) == 0
    found = json.loads(capsys.readouterr().out)["designs"]
    assert [(one["name"], one["certified"]) for one in found][-1] == ("policy policy.npz", True)
    assert len(found) == 4
    policy.unlink()
    assert compare(arguments) == 0
    last = json.loads(capsys.readouterr().out)["designs"][-1]
    assert (last["certified"], last["unknown"]) == (False, f"policy file {policy} does not exist")
    # Who asks for it by name is told at once.
    assert compare([*arguments, "--design", str(policy)]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_a_response_of_another_machine_says_nothing_of_the_designs_of_a_comparison(
    tmp_path: Path, machine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for side in ("sim", "hw"):
        metadata = run_metadata(1)
        metadata["pendulum.run"]["identity"] = f"{side} (1)"
        columns = regulate(rate=100.0, seed=1, hardware=side == "hw")
        write_bag(tmp_path / "run" / side, columns, f"/{side}", metadata=metadata, ramps=False)
    for identity, code in (("hw (1)", 0), ("hw (2)", 2)):
        measured = read_response(machine / MACHINE)
        write_response(tmp_path / MACHINE, replace(measured, facts={**measured.facts, "identity": identity}))
        assert compare([str(tmp_path / "run"), "--machine", str(tmp_path / MACHINE), "--json"]) == code
    assert (
        f"{MACHINE} is of hardware hw (2); expected that of the compared recordings, hw (1)" in capsys.readouterr().err
    )
