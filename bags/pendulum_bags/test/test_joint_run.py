"""What stands in for the machine of several joints, and settings that cannot be run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_bags.experiments import joint_run
from pendulum_bags.experiments.joint_run import (
    JointRun,
    JointSettings,
    design_for,
    fall_time,
    load_stand_in,
    record_joints,
    stand_in_for,
)
from pendulum_bags.frequency_response.joint_experiment import JointMultisine
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.errors import FaultError, ParameterError, PlantStoppedError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

GIVEN = ("gravity", "gear_ratio", "elbow.effort_limit", "shoulder.stribeck_velocity")
"""What nobody has to identify."""


def test_a_stand_in_is_off_in_every_value_that_has_to_be_identified_and_in_no_other() -> None:
    plant = load_mechanism("acrobot")
    machine = stand_in_for(plant, share=0.1, delay=0.003, seed=4)
    assert machine.name == "acrobot_stand_in"
    off = {name: machine.numbers[name] / value - 1.0 for name, value in plant.numbers.items() if value}
    assert {name for name, share in off.items() if share == 0.0} == set(GIVEN) | {"elbow.stribeck_velocity"}
    assert max(map(abs, off.values())) <= 0.1
    assert machine.value("elbow.transport_delay") == 0.003
    assert stand_in_for(plant, share=0.1, delay=0.003, seed=4) == machine
    assert stand_in_for(plant, share=0.1, delay=0.003, seed=5) != machine
    assert stand_in_for(plant, share=0.0, delay=0.0, seed=4).numbers == plant.numbers


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plant": "thesis"}, "plant is 'thesis', which has one joint; expected one of several, such as cart_pole"),
        ({"plant": "acrobot", "joint": "shoulder"}, "joint is 'shoulder'; expected one that is driven: elbow"),
        ({"controller": "mcp"}, r"controller is 'mcp'; expected one of lqr, discrete_lqr, lqi, lqg, mpc"),
        ({"controller": "nmpc"}, "controller is 'nmpc'; expected one of lqr,"),
        ({"amplitude": 0.0}, "amplitude is 0.0; expected a finite number > 0"),
        ({"duration": float("nan")}, "duration is nan; expected a finite number > 0"),
        ({"hold_time": float("inf")}, "hold_time is inf; expected a finite number > 0"),
    ],
)
def test_settings_that_cannot_be_run_are_refused_before_anything_starts(values: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        JointSettings(**values)


@pytest.mark.parametrize("side", ["sim", "hw"])
def test_one_controller_is_run_and_told_of_on_both_sides_and_frequencies_are_those_of_an_lqr(side: str) -> None:
    settings = JointSettings("cart_pole", controller="mpc")
    run = JointRun(settings, side, "cart_pole")
    assert "controller:='mpc'" in run.controller_program().ros_arguments()
    assert run.metadata()[RUN_RECORD]["controller"]["kind"] == "mpc"
    multisine = JointRun(JointMultisine(settings).run, side, "cart_pole")
    assert "controller:='lqr'" in multisine.controller_program().ros_arguments()


def test_a_multisine_begins_at_the_inverse_of_its_period_and_lasts_for_those_averaged_and_one_more() -> None:
    settings = JointSettings("cart_pole")
    for multisine, lowest, duration in (
        (JointMultisine(settings), 0.25, 36.1),
        (JointMultisine(settings, 3, 1.0), 1.0, 4.1),
    ):
        assert multisine.excitation["frequency"] == 1.0 / multisine.excitation["signal_period"] == lowest
        assert multisine.run.duration == pytest.approx(duration)


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_a_share_that_makes_no_plant_is_refused(share: float) -> None:
    with pytest.raises(ParameterError, match=r"share is .*; expected 0 to less than 1"):
        stand_in_for(load_mechanism("cart_pole"), share=share, delay=0.0, seed=1)


def test_the_noise_is_on_the_first_driven_joint_unless_another_is_named() -> None:
    assert JointSettings("double_pendulum").joint == "shoulder"
    assert JointSettings("double_pendulum", "elbow").joint == "elbow"


@pytest.mark.parametrize(
    ("plant", "other", "message"),
    [
        ("cart_pole", "furuta", "has model furuta; expected cart_pole"),
        ("acrobot", "pendubot", "has driven joints shoulder; expected elbow"),
        ("cart_pole", "thesis", "has model pendulum; expected cart_pole"),
    ],
)
def test_a_machine_with_other_equations_or_other_motors_is_refused(plant: str, other: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        load_stand_in(other, load_mechanism(plant))


def test_a_machine_with_other_values_is_taken() -> None:
    assert load_stand_in("acrobot_frictionless", load_mechanism("acrobot")).name == "acrobot_frictionless"


def _longest_time_upright(plant: MechanismParameters, design: MechanismParameters, amplitude: float) -> float:
    """Return for how long an LQR holds a plant upright under seeded noise, at most 3 s."""
    mechanism, step = plant.mechanism, 4e-3
    gain = output_lqr(linearise(design), *mechanism.weights).rows
    simulated = MechanismPlant(plant, dt=step)
    goal = np.array(plant.coordinates.goal)
    simulated.reset(tuple(goal))
    noise, push = np.random.default_rng(1), 0.0
    stamps, positions, x = [], [], np.zeros(2 * len(goal))
    for k in range(750):
        push = noise.uniform(-amplitude, amplitude) if k % 3 == 0 else push
        limit = np.array(plant.effort_limits)
        state = simulated.step(tuple(np.clip(-gain @ x + push, -limit, limit)))
        x = np.concatenate([np.array(state.position) - goal, state.velocity])
        stamps.append(round(4e6 * k))
        positions.append(state.position)
    fell = fall_time(plant, np.array(stamps), np.array(positions))
    return 3.0 if fell is None else fell


@pytest.mark.parametrize("name", ["acrobot", "pendubot"])
def test_the_design_of_a_run_holds_a_plant_whose_passive_joint_has_dry_friction(name: str) -> None:
    settings, plant = JointSettings(name), load_mechanism(name)
    assert settings.amplitude == pytest.approx(0.6)
    assert _longest_time_upright(plant, design_for(plant), settings.amplitude) == 3.0


def test_the_acrobot_falls_under_an_lqr_that_knows_nothing_of_its_dry_friction() -> None:
    plant = load_mechanism("acrobot")
    assert _longest_time_upright(plant, plant, 0.6) < 1.0


def test_a_plant_whose_passive_joints_have_no_dry_friction_is_its_own_design() -> None:
    for name in ("cart_pole", "furuta", "double_pendulum", "acrobot_frictionless"):
        plant = load_mechanism(name)
        assert design_for(plant) is plant


def test_a_plant_has_fallen_when_half_of_its_height_is_lost() -> None:
    plant = load_mechanism("cart_pole")
    stamps = np.array([1_000_000_000, 1_500_000_000, 2_000_000_000])
    held = np.column_stack([np.zeros(3), np.full(3, np.pi)])
    assert fall_time(plant, stamps, held) is None
    assert fall_time(plant, stamps, held - [[0.0, 0.0], [0.0, 1.5], [0.0, 1.6]]) == 1.0


@pytest.mark.parametrize(
    ("failing", "message"),
    [
        (
            ("sim", "hw"),
            (
                r"both sides failed: the simulation fell after 0.20 s; the stand-in for the machine fell .* s .*"
                r"fault \(velocity_limit: elbow\), under noise of 0.6 N m at elbow; .* a smaller --amplitude"
            ),
        ),
        (
            ("hw",),
            r"the sides part: the stand-in for the machine fell .* \(velocity_limit: elbow\); the simulation stayed",
        ),
        (("sim",), "the sides part: the simulation fell after 0.20 s; the stand-in for the machine stayed upright"),
    ],
)
def test_the_sides_that_fell_are_told_with_their_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: tuple[str, ...], message: str
) -> None:
    recorded: list[str] = []
    closed: list[str] = []

    def record(bag: Path, run: Any, **_: Any) -> None:
        recorded.append(bag.name)
        assert run.design == str(tmp_path / "design.yaml")
        # The simulator has no limits and falls without a word; the bridge faults.
        if run.has_bridge and bag.name in failing:
            raise PlantStoppedError("/hw", "fault", "velocity_limit: elbow")

    @contextmanager
    def read(bag: Path) -> Iterator[Any]:
        goal = np.array(load_mechanism("acrobot").coordinates.goal)
        low = goal - [3.0, 0.0] if bag.name in failing else goal
        states = SimpleNamespace(stamp_ns=np.array([0, 200_000_000]), position=np.array([goal, low]))
        yield SimpleNamespace(joints=lambda topic: states)
        closed.append(bag.name)

    monkeypatch.setattr(joint_run, "record_run", record)
    monkeypatch.setattr(joint_run, "read_bag", read)
    with pytest.raises(FaultError, match=message):
        record_joints(tmp_path, JointSettings("acrobot"), tmp_path / "machine.yaml")
    assert recorded == closed == ["sim", "hw"]


@pytest.mark.parametrize(
    ("command", "instead"),
    [
        ("frequency_response", "experiment joints --plant cart_pole, which measures it, too"),
    ],
)
def test_an_experiment_for_one_joint_names_what_does_it_for_several(
    command: str, instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    assert main([command, "--plant", "cart_pole"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: plant is cart_pole, which has several joints; expected one of one joint, or ")
    assert instead in said
    assert said.count("\n") == 1


def test_the_main_experiment_of_a_plant_of_several_joints_is_that_of_joints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands import experiment_cli

    asked: list[tuple[tuple[object, ...], dict[str, object]]] = []
    monkeypatch.setattr(experiment_cli, "joints", lambda *args, **options: asked.append((args, options)))
    assert experiment_cli.main(["thesis", "--plant", "acrobot", "--seed", "4", "--duration", "3", "--out", "x"]) == 0
    ((args, options),) = asked
    assert args == (Path("x"), "acrobot")
    assert (options["seed"], options["duration"]) == (4, 3.0)
    # Its own defaults count where nothing was typed: 2.5 N m would be far too much for an acrobot.
    assert not {"amplitude", "hold_time"} & set(options)
    for option, value in (("--controller", "pid"), ("--hardware", "hebi"), ("--budget", "5")):
        assert experiment_cli.main(["thesis", "--plant", "acrobot", option, value]) == 2
        assert f"error: {option} is for a plant of one joint, and acrobot has several" in capsys.readouterr().err
    assert len(asked) == 1


@pytest.mark.parametrize("options", [["--no-frequencies"], ["--plant", "double_pendulum"]])
def test_a_design_is_refused_where_no_frequency_is_measured(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    assert main(["joints", "--design", "q=1,1,1,1", "--out", str(tmp_path / "run"), *options]) == 2
    assert "error: --design needs both plants measured" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_design_that_is_none_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    assert main(["joints", "--plant", "acrobot", "--design", "q=1,1,1", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "with 4 numbers for q or k, for shoulder, elbow, shoulder_dot, elbow_dot" in said
    assert not (tmp_path / "run").exists()


def test_a_plant_that_falls_under_the_multisine_alone_has_its_first_layer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands import compare_cli
    from pendulum_bags.commands.experiment_cli import main
    from pendulum_bags.frequency_response import joint_experiment

    def falls(*_: Any, **__: Any) -> None:
        raise FaultError("both sides failed: the simulation fell after 3.2 s")

    compared: list[list[Path]] = []
    monkeypatch.setattr(joint_run, "record_joints", lambda *_, **__: None)
    monkeypatch.setattr(joint_experiment, "measure_joints", falls)
    monkeypatch.setattr(compare_cli, "compare", lambda folders, **_: compared.append(folders))
    assert main(["joints", "--plant", "pendubot", "--out", str(tmp_path / "run")]) == 0
    assert compared == [[tmp_path / "run"]]
    said = " ".join(capsys.readouterr().out.split())
    assert "The frequencies were not measured: both sides failed: the simulation fell after 3.2 s" in said


def test_a_run_of_several_joints_that_records_nothing_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    def ends(folder: Path, *_: Any, **__: Any) -> None:
        assert (folder / "machine.yaml").is_file()
        raise FaultError("sim_plant ended with code 2")

    monkeypatch.setattr(joint_run, "record_joints", ends)
    assert main(["joints", "--plant", "pendubot", "--out", str(tmp_path / "run")]) == 2
    assert "error: sim_plant ended with code 2" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
