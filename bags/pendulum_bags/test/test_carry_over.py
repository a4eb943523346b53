"""Which designs carry over, as ``compare`` and ``report`` say it of a machine that was measured."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.comparison.compare_cli import main as compare
from pendulum_bags.frequency_response.analyse import MACHINE, NUMBERS, analyse_responses
from pendulum_bags.frequency_response.designs import design_text
from pendulum_bags.report.report_cli import main as report
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.verdict import write_layer
from pendulum_lqr.gap_metric import Scaling
from pendulum_lqr.measured_response import MeasuredResponse, read_response, write_response
from pendulum_lqr.model import linearise
from pendulum_lqr.sampled_response import model_response
from pendulum_msgs_py.plants.plant_parameters import load_plant
from tests.synthetic_runs import write_run_folder

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
        "certified to be stable there, which tells nothing of how closely it moves as simulated."
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
    folder: Path, machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report([str(folder), "--layers", str(machine), "-o", str(tmp_path), "--png-only"]) == 0
    assert "K=(400, 0.1) not certified" in capsys.readouterr().out
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<figure id="certified_gains">' in text
    assert "3 which controllers" in text
    assert "Evidence: which controllers" in text
    assert (tmp_path / "figures" / "certified_weights.png").exists()


@pytest.mark.parametrize("text", [GOOD, BAD, "q=0.5,1e-05 r=2", "lqi", "pid"])
def test_the_name_of_a_design_says_how_to_ask_for_it_again(machine: Path, text: str) -> None:
    (design,) = analyse_responses([read_response(machine)], "thesis", [text]).designs
    assert design_text(design.name) == text
