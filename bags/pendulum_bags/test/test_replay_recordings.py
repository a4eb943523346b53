"""Input replay and controller replay."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.identify_cli import main as identify_main
from pendulum_bags.commands.replay_cli import main as replay_main
from pendulum_bags.identification.window_score import window_score
from pendulum_bags.replay.controller_replay import replay_controller
from pendulum_bags.replay.input_replay import replay_input, replay_recording
from pendulum_bags.replay.result import fit_percent
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_rosbag.storage import BagWriter
from pendulum_sim.stepping.plants import make_pendulum
from pendulum_testing.synthetic_runs import regulate, run_metadata, write_bag

DFKI = Path("dfki_torque_limited_simple_pendulum")


def swinging(plant_name: str = "dfki", *, duration: float = 4.0, period: float = 0.002) -> Recording:
    """Return a noiseless recording of a plant that is pushed by a sine."""
    plant = make_pendulum(load_plant(plant_name), period)
    plant.reset(0.3, 0.0)
    t = period * np.arange(round(duration / period))
    torque = 0.8 * np.sin(2.0 * np.pi * 0.7 * t)
    states = []
    for value in torque.tolist():
        states.append((plant.state.theta, plant.state.theta_dot))
        plant.step(value)
    position, velocity = np.array(states).T
    return Recording(t, position, velocity, torque, hold="zero", meta={"source": "swinging"})


def test_a_plant_follows_its_own_recording() -> None:
    result = replay_input(swinging(), load_plant("dfki"))
    assert result.rms < 1e-4
    assert result.free_run_rms < 2e-3
    assert result.fit > 99.0
    assert result.diverges_at is None
    assert "never" in result.sentence()


@pytest.mark.parametrize("effort", [[], [None, None]])
def test_a_bag_whose_torque_was_never_recorded_is_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], effort: list[None]
) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for topic in ("/sim/joint_states", "/sim/applied_effort", "/sim/effort_command"):
            writer.add_topic(topic, "sensor_msgs/msg/JointState")
        for index in range(100):
            stamp = index * 10_000_000
            writer.write("/sim/joint_states", stamp, encode_joint_state(stamp, position=0.1, velocity=0.0, effort=0.0))
        for stamp, value in enumerate(effort):
            writer.write("/sim/applied_effort", stamp, encode_joint_state(stamp, position=0.1, effort=value))
    held = "2 messages, none with an effort" if effort else "no message"
    for command in (replay_main, identify_main):
        assert command([str(tmp_path / "bag"), "--out", str(tmp_path / "out")]) == 2
        told = capsys.readouterr().err
        assert f"topic /sim/applied_effort of bag {tmp_path / 'bag'} has {held}; expected the torque" in told
    assert replay_main([str(tmp_path / "bag"), "--controller", "lqr", "--out", str(tmp_path / "out")]) == 2
    assert "topic /sim/effort_command of bag" in capsys.readouterr().err


def test_a_series_elastic_plant_can_be_replayed_too() -> None:
    recording = swinging("x5_9", duration=1.0)
    result = replay_input(recording, load_plant("x5_9"), window=0.5)
    assert result.by_window.size == 2
    assert result.rms < 0.02


def test_error_grows_with_the_horizon_under_wrong_parameters() -> None:
    result = replay_input(swinging(), load_plant("dfki").with_values(gravity=4.0))
    rms = [one.rms for one in result.horizons]
    assert result.horizons[0].steps == 1
    assert result.horizons[-1].time == pytest.approx(1.0)
    assert rms[-1] > 10.0 * rms[0]
    assert result.diverges_at is not None
    assert result.diverges_at < 4.0


def test_a_torque_beyond_the_models_limit_still_pushes() -> None:
    recording = swinging()
    weak = load_plant("dfki").with_values(effort_limit=0.1)
    assert replay_input(recording, weak).free_run_rms < 2e-3


def test_fit_is_100_for_equal_and_0_for_the_mean() -> None:
    values = np.sin(np.linspace(0.0, 9.0, 200))
    assert fit_percent(values, values) == 100.0
    assert fit_percent(values, np.full_like(values, values.mean())) == pytest.approx(0.0, abs=1e-12)


def test_other_inputs_than_torque_are_refused() -> None:
    t = np.linspace(0.0, 1.0, 50)
    recording = Recording(t, t, None, t, input_kind="voltage")
    with pytest.raises(DataError, match="has the input 'voltage'; expected 'effort'"):
        replay_input(recording, load_plant("dfki"))


def test_a_window_of_no_length_is_refused() -> None:
    with pytest.raises(DataError, match=r"window is 0\.0 s; expected > 0"):
        replay_input(swinging(duration=0.5), load_plant("dfki"), window=0.0)


def test_a_real_pendulum_is_followed_as_well_as_its_geometry_allows(shared_data: Path) -> None:
    result = replay_recording(shared_data / DFKI / "ddp_measured.csv", "dfki")
    assert result.rms == pytest.approx(0.038, rel=0.10)
    from pendulum_bags.runs.read_recording import read_recording

    recording = read_recording(shared_data / DFKI / "ddp_measured.csv")
    assert result.rms == window_score(load_plant("dfki"), recording).rms


def test_command_shows_a_real_pendulum_in_one_figure(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = str(shared_data / DFKI / "ddp_measured.csv")
    assert replay_main([recording, "--params", "dfki", "-o", str(tmp_path)]) == 0
    assert "windows of 1 s: rms 0.03" in capsys.readouterr().out
    assert (tmp_path / "replay.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "replay.json").read_text())["rms_rad"] == pytest.approx(0.038, rel=0.1)


def test_a_bag_given_as_the_folder_itself_has_its_name_and_no_file_is_written_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_bag(tmp_path / "monday", regulate(rate=100.0, seed=3, duration=2.0), "/sim", ramps=False)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(bag)
    assert replay_main([".", "--params", "thesis", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["recording"] == "monday"
    assert sorted(tmp_path.rglob("*")) == before


def test_the_plant_of_another_machine_is_said_to_be_and_ends_with_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = swinging(duration=8.0)
    table = np.column_stack((recording.time, recording.position, recording.input))
    path = tmp_path / "run.csv"
    np.savetxt(path, table, delimiter=",", header="time,position,torque", comments="")
    other = write_plant(tmp_path / "other.yaml", load_plant("dfki").with_values(gravity=0.4, inertia=0.4))
    assert replay_main([str(path), "--params", "dfki"]) == 0
    capsys.readouterr()
    assert replay_main([str(path), "--params", str(other)]) == 3
    assert "does not describe run.csv" in capsys.readouterr().out


def test_command_refuses_bad_files_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.csv"
    bad.write_text("time,position,velocity,torque\n0,0,0,0\n1,nan,0,0\n2,0,0,0\n")
    assert replay_main([str(bad), "--params", "dfki", "-o", str(tmp_path / "out")]) == 2
    assert "'position' is nan" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert replay_main([str(tmp_path / "missing.csv"), "--params", "dfki"]) == 2
    assert "does not exist" in capsys.readouterr().err
    assert replay_main([str(bad), "--params", "nothing"]) == 2


def test_command_takes_the_plant_of_a_bag_that_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "bag", regulate(rate=100.0, seed=3, duration=2.0), "/sim", ramps=False)
    arguments = [str(bag), "-o", str(tmp_path / "out")]
    assert replay_main([*arguments, "--prefix", "/sim"]) == 0
    assert "plant thesis (--params names another)" in capsys.readouterr().out
    assert replay_main([*arguments, "--prefix", "/hw"]) == 2
    assert "has no topic /hw/joint_states; it has" in capsys.readouterr().err


# -- controllers -------------------------------------------------------------------------------------------------


def test_the_recorded_controller_answers_as_it_did(tmp_path: Path) -> None:
    columns = regulate(rate=100.0, seed=3, duration=2.0)
    bag = write_bag(tmp_path / "bag", columns, "/sim", metadata=run_metadata(3), ramps=False)
    result = replay_controller(bag)
    assert result.controller == "lqr"
    assert "K = [33.345265, 0.158993]" in result.description
    # The recording was made with the gain of the table, rounded to six digits.
    assert np.abs(result.difference).max() < 1e-6
    assert result.t.size == 200
    assert result.unanswered == 0


@pytest.mark.parametrize("later", [0.0, 0.003])
def test_a_controller_is_replayed_from_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str], later: float) -> None:
    columns = regulate(rate=100.0, seed=3, duration=2.0)
    bag = write_bag(tmp_path / "bag", columns, "/sim", metadata=run_metadata(3), ramps=False)
    expected = replay_controller(bag, "lqr", values={"q": [1.0, 0.01]})
    path = tmp_path / "run.csv"
    lines = []
    for t, theta, rate, torque in zip(
        *(columns[name] for name in ("t", "position", "velocity", "command")), strict=True
    ):
        states = f"{t:.9f},{theta:.17g},{rate:.17g}"
        lines += [f"{states},{torque:.17g}"] if not later else [f"{states},", f"{t + later:.9f},,,{torque:.17g}"]
    path.write_text("\n".join(["time,theta,theta_dot,torque", *lines]) + "\n")
    assert replay_main([str(path), "--controller", "lqr", "--set", "q=[1.0, 0.01]", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["commands"], found["unanswered_states"]) == (200, 0)
    assert found["rms_difference_nm"] == pytest.approx(expected.as_dict()["rms_difference_nm"], rel=1e-6)
    assert replay_main([str(path), "--controller", "lqr", "--start", "1", "--stop", "1.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["commands"] == 50
    assert replay_main([str(path), "--controller", "recorded"]) == 2
    assert "the recording does not say which controller made it" in capsys.readouterr().err
    assert replay_main([str(path), "--controller", "lqr", "--start", "50"]) == 2
    assert "has 0 samples from 50 s after its start, and ends at 1.99 s; expected at least 4" in capsys.readouterr().err


def test_another_controller_answers_otherwise(tmp_path: Path) -> None:
    columns = regulate(rate=100.0, seed=3, duration=2.0)
    bag = write_bag(tmp_path / "bag", columns, "/sim", metadata=run_metadata(3), ramps=False)
    result = replay_controller(bag, "lqr", plant="thesis", values={"q": [1.0, 0.01]})
    assert np.abs(result.difference).max() > 0.01
    assert "differ by up to" in result.sentence()


def test_a_recording_that_does_not_name_its_controller_asks_for_one(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", regulate(rate=100.0, seed=3, duration=1.0), "/sim", ramps=False)
    with pytest.raises(DataError, match="does not say which controller made it"):
        replay_controller(bag)


def test_command_replays_a_controller(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = regulate(rate=100.0, seed=3, duration=2.0)
    bag = write_bag(tmp_path / "bag", columns, "/sim", metadata=run_metadata(3), ramps=False)
    arguments = [str(bag), "--controller", "lqr", "--set", "q=[1.0, 0.01]", "-o", str(tmp_path / "out"), "--json"]
    assert replay_main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["commands"] == 200
    assert (tmp_path / "out" / "controller_replay.png").exists()
