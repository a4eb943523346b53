"""A model file of others as the simulation of an experiment: what is refused, what it runs, what its bags say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_bags.commands import experiment_cli
from pendulum_bags.comparison import Outcome, compare_runs
from pendulum_bags.comparison.independence import check_pairs
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.joint_run import JointSettings
from pendulum_bags.experiments.repeats import record_repeat, record_simulation, repeat_folder
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings
from pendulum_bags.experiments.simulation import ForeignSimulation, recorded_difference
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_differences import plant_differences
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant, write_plant
from pendulum_rosbag.reader import read_bag
from pendulum_sim.exports.model_files import mjcf

pytest.importorskip("mujoco")

SHORT = NoiseSettings(duration=1.0)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "own.xml"
    path.write_text(mjcf(load_plant("thesis")), encoding="utf-8")
    return path


def test_the_controller_is_designed_on_what_the_model_says(model: Path, tmp_path: Path) -> None:
    foreign = RegulationSettings(simulation=str(model)).foreign
    assert foreign is not None
    assert plant_differences(load_plant(foreign.write_equation(tmp_path)), load_plant("thesis")) == ()


def test_a_model_with_our_parameters_moves_like_our_simulation(model: Path) -> None:
    ours = simulate(RegulationSettings(noise=SHORT, method="etd4").run("sim"))
    theirs = simulate(RegulationSettings(noise=SHORT, simulation=str(model)).run("sim"))
    assert np.array_equal(theirs.disturbance, ours.disturbance)
    assert np.max(np.abs(theirs.position - ours.position)) < 0.1 * np.std(ours.position)


@pytest.mark.parametrize("kind", ["mujoco", "gymnasium"])
def test_two_simulations_of_one_plant_are_equivalent_and_of_two_plants_are_not(
    model: Path, tmp_path: Path, kind: str
) -> None:
    noise = NoiseSettings(duration=5.0)
    theirs = RegulationSettings(noise=noise, simulation=str(model) if kind == "mujoco" else "gymnasium:PendulumX59-v0")
    record_simulation(tmp_path / "theirs", theirs.run("sim"))
    for damping, outcome in ((11.77, Outcome.EQUIVALENT), (6.0, Outcome.DIFFERENT)):
        plant = write_plant(tmp_path / f"{damping}.yaml", load_plant("thesis").with_values(damping=damping))
        spec = replace(RegulationSettings(noise=noise, method="etd4").run("sim"), plant=str(plant))
        ours = record_simulation(tmp_path / f"ours_{damping}", spec)
        assert compare_runs(tmp_path / "theirs", ours).verdict.outcome is outcome


def test_the_node_has_our_simulators_name_and_absolute_paths(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(model.parent)
    settings = RegulationSettings(noise=SHORT, simulation=model.name)
    program = settings.simulator_program()
    assert (program.full_name, program.executable) == ("/sim/simulator", "mujoco")
    assert program.parameters == {"model": str(model), "clock": "realtime"}
    in_lockstep = settings.run("sim").plant_program(4)
    assert in_lockstep.full_name == "/sim/simulator"
    assert "plant" not in in_lockstep.parameters
    assert settings.run("hw").foreign is None


@pytest.mark.parametrize(
    ("model_text", "sentence"),
    [
        (("-13.0 13.0", "-1.0 1.0"), r"gives at most 1 N m, its weight takes up to 1.678 N m: .* actuator: none"),
        (
            ('timestep="0.002"', 'timestep="0.02"'),
            r"has a period of 20 ms, the noise changes every 10 ms; expected timestep",
        ),
    ],
)
def test_a_model_that_cannot_take_part_is_refused_before_anything_starts(
    model: Path, model_text: tuple[str, str], sentence: str
) -> None:
    text = model.read_text(encoding="utf-8")
    assert model_text[0] in text
    model.write_text(text.replace(*model_text), encoding="utf-8")
    with pytest.raises(ParameterError, match=sentence):
        RegulationSettings(simulation=str(model))


def test_a_weak_environment_is_reported_with_what_its_adapter_file_takes() -> None:
    pytest.importorskip("gymnasium")
    with pytest.raises(
        ParameterError, match=r"expected more torque, as set, on the attribute that limits it, in a map"
    ):
        ForeignSimulation("gymnasium:Pendulum-v1").check(0.05)


@pytest.fixture
def stopped(model: Path) -> Path:
    """Return a model with an end stop at 170 degrees."""
    text = model.read_text(encoding="utf-8")
    path = model.with_name("stopped.xml")
    path.write_text(text.replace('type="hinge"', 'type="hinge" range="-2.967 2.967"'), encoding="utf-8")
    return path


@pytest.mark.parametrize("command", ["lockstep", "thesis"])
def test_no_controller_is_designed_on_an_equation_that_the_model_does_not_keep(
    stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    out = ["--bag" if command == "lockstep" else "--out", str(tmp_path / "run")]
    assert experiment_cli.main([command, *out, "--simulation", str(stopped)]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert f"simulation {stopped} does not move as its equation: joint pendulum_joint differs by" in told
    assert "cause: the range of a joint (without:" in told
    assert "--accept-differences to design on this one all the same" in told
    assert not (tmp_path / "run").exists()


def test_a_difference_that_was_accepted_stands_beside_the_figures(model: Path, stopped: Path, tmp_path: Path) -> None:
    bags = []
    for path in (stopped, model):
        settings = RegulationSettings(noise=SHORT, simulation=str(path))
        bags.append(record_simulation(tmp_path / path.stem, settings.run("sim")))
    (note,) = compare_runs(*bags).notes
    assert note.startswith("The simulation, stopped.xml, does not move as its equation")
    assert compare_runs(bags[1], bags[0]).notes == []


@pytest.mark.parametrize(("damping", "verb"), [(11.77, "It agrees with"), (6.0, "It DIFFERS FROM")])
def test_a_plant_that_cannot_be_reset_is_checked_by_its_recording(tmp_path: Path, damping: float, verb: str) -> None:
    bag = record_simulation(tmp_path / "bag", RegulationSettings(noise=SHORT, method="etd4").run("sim"))
    plant = write_plant(tmp_path / "believed.yaml", load_plant("thesis").with_values(damping=damping))
    told = recorded_difference(bag, "/sim", str(plant))
    assert verb in told
    assert "nothing beyond was checked" in told


def test_a_mapping_without_a_simulation_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"mapping is lab\.yaml without a simulation"):
        RegulationSettings(mapping="lab.yaml")


def _recording(name: str, metadata: dict[str, Any]) -> SimpleNamespace:
    """Return of a recording what pooling looks at."""
    window = SimpleNamespace(t=np.arange(5.0), position=np.random.default_rng(list(name.encode())).random(5))
    return SimpleNamespace(source=name, metadata=metadata, window=window)


def test_runs_with_one_plant_file_in_two_places_are_pooled_and_other_simulations_are_not(
    model: Path, tmp_path: Path
) -> None:
    settings = RegulationSettings(simulation=str(model))
    foreign = settings.foreign
    assert foreign is not None
    pairs = []
    for seed in (1, 2):
        plant = foreign.write_equation(tmp_path / str(seed))
        told = replace(settings, plant=str(plant), noise=NoiseSettings(seed=seed)).metadata("thesis", plant=str(plant))
        pairs.append([_recording(f"{side}_{seed}", told) for side in ("sim", "hw")])
    check_pairs(pairs)  # type: ignore[arg-type]
    pairs[1][0].metadata["pendulum.run"]["simulation"]["name"] = "other.xml"
    with pytest.raises(DataError, match="runs with different simulations cannot be pooled"):
        check_pairs(pairs)  # type: ignore[arg-type]


def test_two_simulations_of_others_are_compared_without_a_process(model: Path, tmp_path: Path) -> None:
    noise = NoiseSettings(duration=5.0)
    settings = RegulationSettings(noise=noise, simulation="gymnasium:PendulumX59-v0", hardware=str(model))
    assert (settings.can_repeat, settings.is_emulated) == (True, True)
    record_repeat(tmp_path, settings, 1)
    place = repeat_folder(tmp_path, 1)
    result = compare_runs(place / "sim", place / "hw")
    assert result.verdict.outcome is Outcome.EQUIVALENT
    # Nothing real moved, and the words say so.
    assert result.is_emulated
    told = read_bag(place / "hw").metadata["pendulum.run"]
    assert (told["plant"], told["namespace"], told["stand_in"]) == ("own.xml", "/hw", "simulation")
    assert told["simulation"]["name"] == "own.xml"
    in_real_time = settings.metadata("thesis", side="hw", plant=settings.plant_name("hw"), namespace="/hw")
    assert in_real_time["pendulum.run"]["simulation"] == told["simulation"]
    assert settings.plant_program("hw").full_name == "/hw/simulator"  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"hardware": "hebii"}, "hardware is 'hebii'; expected one of emulator, hebi, dynamixel, a model file"),
        ({"hardware": "ros:lab"}, "plant is 'ros:lab'; expected ros:/NAMESPACE"),
        ({"simulation": "ros:/"}, "plant is 'ros:/'; expected ros:/NAMESPACE"),
        ({"simulation": "ros:/hw"}, "both plants are in /hw; expected two namespaces"),
        ({"simulation": "ros:/a", "hardware": "ros:/a"}, "both plants are in /a; expected two namespaces"),
        ({"hardware": "ros:/a", "effort_strategy": "effort_loop"}, "strategy is effort_loop for hardware ros:/a"),
        ({"hardware": "ros:/a", "hardware_mapping": "m.yaml"}, "mapping is m.yaml without a simulation"),
        ({"hardware": "ros:/a", "lab": "lab.yaml"}, "expected --hardware hebi"),
        ({"hardware": "none.xml"}, "none.xml does not exist"),
    ],
)
def test_sides_that_cannot_be_are_refused(changes: dict[str, str], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        RegulationSettings(**changes)  # type: ignore[arg-type]


def test_a_plant_that_runs_already_is_started_by_nobody_and_measured_once() -> None:
    settings = RegulationSettings(simulation="ros:/a", hardware="ros:/lab/b")
    assert [settings.plant_program(side) for side in ("sim", "hw")] == [None, None]
    assert [settings.namespace(side) for side in ("sim", "hw")] == ["/a", "/lab/b"]
    assert (settings.can_repeat, settings.is_emulated) == (False, False)
    # An emulator beside it is repeated by nobody either: the other side cannot be asked for a new run.
    assert not RegulationSettings(simulation="ros:/a").can_repeat


def test_nobody_keeps_a_running_plant_in_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert experiment_cli.main(["lockstep", "--bag", str(tmp_path / "bag"), "--simulation", "ros:/lab"]) == 2
    assert "simulation is ros:/lab, which runs already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--hardware", "ros:/lab"], "plant /lab runs on a ROS domain; expected --domain N, or ROS_DOMAIN_ID"),
        (["--simulation", "ros:/lab", "--domain", "3"], "ros:/lab does not state its equation; expected --plant FILE"),
    ],
)
def test_a_running_plant_needs_its_domain_and_a_simulation_its_equation(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert experiment_cli.main(["thesis", *arguments, "--yes", "--out", str(tmp_path / "run")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


# --- several joints ----------------------------------------------------------------------------------------------


@pytest.fixture
def acrobot(tmp_path: Path) -> tuple[Path, Path]:
    """Return a model file of an acrobot, and its plant file."""
    plant = load_mechanism("acrobot_frictionless")
    path = tmp_path / "acrobot.xml"
    path.write_text(mjcf(plant), encoding="utf-8")
    return path, write_plant(tmp_path / "acrobot.yaml", plant)


def test_a_model_of_two_joints_moves_like_our_simulation_of_its_plant_on_either_side(
    acrobot: tuple[Path, Path],
) -> None:
    model, plant = map(str, acrobot)
    noise = NoiseSettings(amplitude=0.1, duration=1.0)
    ours = simulate(JointSettings(plant, noise=noise).run("sim"))
    for settings, side in (
        (JointSettings(plant, noise=noise, simulation=model), "sim"),
        (JointSettings(plant, noise=noise, hardware=model), "hw"),
    ):
        theirs = simulate(settings.run(side))
        assert np.array_equal(theirs.disturbance, ours.disturbance)
        assert np.max(np.abs(theirs.position - ours.position)) < 0.1 * np.min(np.std(ours.position, axis=0))
    with pytest.raises(ParameterError, match=r"hardware is hebi; .* give ros:/hw"):
        JointSettings(plant, hardware="hebi")


def test_a_model_of_two_joints_that_does_not_move_as_its_plant_file_is_refused(
    acrobot: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, plant = map(str, acrobot)
    heavier = str(write_plant(tmp_path / "heavier.yaml", load_mechanism(plant).with_values({"mass_2": 0.9})))
    out = ["--out", str(tmp_path / "no"), "--plant", heavier, "--simulation", model]
    assert experiment_cli.main(["thesis", *out]) == 2
    assert "does not move as its equation: joint" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
