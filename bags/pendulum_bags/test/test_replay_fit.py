"""A voltage or a free swing is replayed through the fit that identification left beside its plant file."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pendulum_bags.commands.identify_cli import main as identify_main
from pendulum_bags.commands.replay_cli import main as replay_main
from pendulum_bags.replay.input_replay import replay_recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant, write_plant
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

TRUTH = pendulum_plant(inertia=0.05, damping=0.05, gravity=1.5, coulomb_friction=0.02)
VOLTAGE = """format: pendulum_columns/1
time: {column: time, unit: s}
position: {column: position, unit: rad}
input: {column: u, unit: V, hold: zero}
"""


def save(path, seed, *, driven):
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 5.0, 0.01)
    effort = multisine(time, 1.0, rng) if driven else np.zeros_like(time)
    start = (0.0, 0.0) if driven else (1.0 + 0.2 * seed, 0.0)
    found = synthetic_recording(TRUTH, effort, 0.01, rng, start=start)
    columns = [found.time, found.position, *([found.input / 0.4] if driven else [])]
    np.savetxt(
        path,
        np.stack(columns, axis=1),
        delimiter=",",
        header="time,position,u"[: 15 if driven else 13],
        comments="",
    )
    return str(path)


@pytest.mark.parametrize("driven", [True, False])
def test_an_identified_plant_is_replayed_on_a_recording_that_it_has_not_seen(tmp_path, capsys, driven):
    mapping = "free_swing"
    if driven:
        mapping = str(tmp_path / "map.yaml")
        (tmp_path / "map.yaml").write_text(VOLTAGE)
    first, second = (save(tmp_path / f"{seed}.csv", seed, driven=driven) for seed in (1, 2))
    plant = str(tmp_path / "mine.yaml")
    quick = ["--friction", "coulomb", "--no-page"]
    assert identify_main([first, "--mapping", mapping, "--out", plant, *quick]) == 0
    capsys.readouterr()
    arguments = [second, "--params", plant, "--mapping", mapping, "--out", str(tmp_path / "out"), "--json"]
    assert replay_main(arguments) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["plant"] == "mine"
    assert content["free_run_rms_rad"] < 0.02
    assert content["free_run_fit_percent"] > 95.0
    assert content["horizons"][0]["rms_rad"] < 5e-3
    assert list((tmp_path / "out").glob("replay*"))


def test_a_voltage_without_its_identification_is_refused_with_what_is_missing(tmp_path):
    (tmp_path / "map.yaml").write_text(VOLTAGE)
    path = save(tmp_path / "run.csv", 1, driven=True)
    write_plant(tmp_path / "mine.yaml", replace(load_plant("thesis"), name="mine"))
    with pytest.raises(DataError, match=r"expected .*mine\.json, as `identify --out` writes it"):
        replay_recording(path, tmp_path / "mine.yaml", mapping=tmp_path / "map.yaml")


def test_a_free_swing_replays_on_any_rigid_plant(tmp_path):
    path = save(tmp_path / "swing.csv", 1, driven=False)
    result = replay_recording(path, TRUTH, mapping="free_swing")
    assert result.free_run_rms < 5e-3
    assert "Driven by nothing but the start of swing.csv" in result.sentence()
