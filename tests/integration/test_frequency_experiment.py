"""The frequency response of both plants, measured by nodes over DDS."""

import json
from pathlib import Path

import pytest

from pendulum_bags.verdict import Layer, read_layers
from pendulum_lqr.measured_response import read_response
from tests.processes import ProcessGroup


def test_both_plants_are_measured_in_lockstep_and_designs_certified(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    program = processes.start(
        "pendulum_bags", "experiment", "frequency_response", "--out", str(folder), "--signal-period", "1",
        "--lowest", "1", "--periods", "3", "--lines", "12", "--design", "q=100,0.01 r=0.1",
    )  # fmt: skip
    assert program.wait(170) == 0, program.output
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
