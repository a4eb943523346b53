"""What stands in for the machine of several joints, and settings that cannot be run."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.comparison import Margins
from pendulum_bags.experiments.joint_run import (
    JointSettings,
    default_amplitude,
    design_file,
    design_for,
    fall_time,
    load_surrogate,
    require_upright,
    surrogate_for,
)
from pendulum_bags.experiments.repeats import record_simulation
from pendulum_bags.experiments.settings import NoiseSettings
from pendulum_bags.frequency_response.multisine import Multisine
from pendulum_bags.runs.run_record import RUN_RECORD, is_surrogate
from pendulum_bags.whole import carry_out
from pendulum_bags.whole.carry_out import Order
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

GIVEN = ("gravity", "gear_ratio", "elbow.effort_limit", "shoulder.stribeck_velocity")
"""What nobody has to identify."""


def test_a_stand_in_is_off_in_every_value_that_has_to_be_identified_and_in_no_other() -> None:
    plant = load_mechanism("acrobot")
    machine = surrogate_for(plant, share=0.1, delay=0.003, seed=4)
    assert machine.name == "acrobot_stand_in"
    off = {name: machine.numbers[name] / value - 1.0 for name, value in plant.numbers.items() if value}
    assert {name for name, share in off.items() if share == 0.0} == set(GIVEN) | {"elbow.stribeck_velocity"}
    assert max(map(abs, off.values())) <= 0.1
    assert machine.value("elbow.transport_delay") == 0.003
    assert surrogate_for(plant, share=0.1, delay=0.003, seed=4) == machine
    assert surrogate_for(plant, share=0.1, delay=0.003, seed=5) != machine
    assert surrogate_for(plant, share=0.0, delay=0.0, seed=4).numbers == plant.numbers


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"plant": "thesis"}, "plant is 'thesis', which has one joint; expected one of several, such as cart_pole"),
        ({"plant": "acrobot", "joint": "shoulder"}, "joint is 'shoulder'; expected one that is driven: elbow"),
        ({"controller": "mcp"}, r"controller is 'mcp'; expected one of lqr, discrete_lqr, lqi, lqg, mpc"),
        ({"controller": "nmpc"}, "controller is 'nmpc'; expected one of lqr,"),
    ],
)
def test_settings_that_cannot_be_run_are_refused_before_anything_starts(values: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        JointSettings(**values)


def test_one_controller_holds_both_sides_upright_and_frequencies_are_those_of_an_lqr() -> None:
    settings = JointSettings("cart_pole", controller="mpc")
    for side in ("sim", "hw"):
        run = replace(settings, machine="cart_pole").run(side)
        assert "controller:='mpc'" in run.controller_program().ros_arguments()
        record = run.metadata()[RUN_RECORD]
        assert record["controller"]["kind"] == "mpc"
        assert is_surrogate(record) is (side == "hw")
        started = run.plant_program(4).ros_arguments()
        assert any(("start:='top'" if side == "sim" else "initial_positions:=[0.0, 3.14159") in one for one in started)
        measured, _ = Multisine().specs(run, run)
        assert "controller:='lqr'" in measured.controller_program().ros_arguments()


def test_a_multisine_begins_at_the_inverse_of_its_period_and_lasts_for_those_averaged_and_one_more() -> None:
    run = JointSettings("cart_pole").run("sim")
    for multisine, lowest, duration in ((Multisine(), 0.25, 36.1), (Multisine(signal_period=1.0, periods=3), 1.0, 4.1)):
        for measured in multisine.specs(run, replace(run, side="hw")):
            assert measured.disturbance["frequency"] == lowest
            assert measured.disturbance["amplitude"] == run.disturbance["amplitude"]
            assert measured.duration == pytest.approx(duration)


@pytest.mark.parametrize("share", [-0.1, 1.0, float("nan")])
def test_a_share_that_makes_no_plant_is_refused(share: float) -> None:
    with pytest.raises(ParameterError, match=r"share is .*; expected 0 to less than 1"):
        surrogate_for(load_mechanism("cart_pole"), share=share, delay=0.0, seed=1)


def test_the_noise_is_on_the_first_driven_joint_unless_another_is_named() -> None:
    assert JointSettings("double_pendulum").joint == "shoulder"
    assert JointSettings("double_pendulum", joint="elbow").joint == "elbow"


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
        load_surrogate(other, load_mechanism(plant))


def test_a_machine_with_other_values_is_taken() -> None:
    assert load_surrogate("acrobot_frictionless", load_mechanism("acrobot")).name == "acrobot_frictionless"


def _longest_time_upright(plant: PlantParameters, design: PlantParameters, amplitude: float) -> float:
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
    plant, amplitude = load_mechanism(name), default_amplitude(name)
    assert amplitude == pytest.approx(0.6)
    assert _longest_time_upright(plant, design_for(plant), amplitude) == 3.0


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
    ("side", "stopped", "message"),
    [
        (
            "hw",
            "went to fault (velocity_limit: elbow)",
            r"the sides part: the emulated .* fell after \S+ s and went to",
        ),
        ("sim", "", r"the sides part: the simulation fell after \S+ s; the emulated hardware stayed upright"),
        ("", "", ""),
    ],
)
def test_sides_that_fell_are_reported_with_their_times(tmp_path: Path, side: str, stopped: str, message: str) -> None:
    design = design_file(tmp_path, "acrobot")
    settings = JointSettings("acrobot", design=design, noise=NoiseSettings(amplitude=0.6, duration=0.5))
    for one in ("sim", "hw"):
        # An LQR that knows nothing of the dry friction loses it.
        changes = {"design_plant": "acrobot", "duration": 1.5} if one == side else {}
        run = replace(settings.run(one), **changes, side="sim")
        record_simulation(tmp_path / one, run)
        if one == "hw":
            bag = read_bag(tmp_path / one)
            moved = bag.joints("/sim/joint_states")
            shutil.rmtree(tmp_path / one)
            with BagWriter(tmp_path / one, metadata={}) as writer:
                writer.add_topic("/hw/joint_states", "sensor_msgs/msg/JointState")
                for stamp, position in zip(moved.stamp_ns, moved.position, strict=True):
                    writer.write("/hw/joint_states", int(stamp), encode_joints(int(stamp), "", moved.names, position))
    if not message:
        require_upright(tmp_path, settings)
        return
    with pytest.raises(FaultError, match=message):
        require_upright(tmp_path, settings, stopped)


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
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from pendulum_bags.commands import experiment_cli, thesis_cli

    ordered: list[Order] = []
    monkeypatch.setattr(thesis_cli, "run_whole", lambda out, name, order_in, **_: ordered.append(order_in(out)))
    words = ["--plant", "acrobot", "--seed", "4", "--duration", "3", "--budget", "5", "--controller", "lqi"]
    assert experiment_cli.main(["thesis", *words, "--contenders", "4", "--out", str(tmp_path)]) == 0
    (order,) = ordered
    settings = order.settings
    assert isinstance(settings, JointSettings)
    # Its own defaults count where nothing was typed: 2.5 N m would be far too much for an acrobot.
    assert settings.noise == NoiseSettings(4, 0.6, 0.01, 3.0)
    assert (settings.controller, order.budget, order.contenders) == ("lqi", 5.0, 4)
    assert settings.design == str(tmp_path / "design.yaml")
    assert load_mechanism(settings.machine).value("elbow.transport_delay") == 0.004
    for option, value in (("--strategy", "effort_loop"), ("--ramp-speed", "0.3")):
        assert experiment_cli.main(["thesis", "--plant", "acrobot", option, value]) == 2
        assert f"error: {option} is for a plant of one joint, and acrobot has several" in capsys.readouterr().err
    assert experiment_cli.main(["joints", "--plant", "thesis", "--share", "0.1"]) == 2
    assert "error: --share is for a plant of several joints, and thesis has one" in capsys.readouterr().err
    assert experiment_cli.main(["joints", "--out", str(tmp_path)]) == 0
    assert ordered.pop().settings.plant == "cart_pole"
    assert len(ordered) == 1


def test_a_design_is_refused_where_no_frequency_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pendulum_bags.commands.experiment_cli import main

    words = ["--design", "q=1,1,1,1", "--plant", "double_pendulum", "--out", str(tmp_path / "run")]
    assert main(["joints", *words]) == 2
    assert "error: --design is for a plant with one driven joint; double_pendulum has 2" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_design_that_is_none_is_refused_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    assert main(["joints", "--plant", "acrobot", "--design", "q=1,1,1", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "with 4 numbers for q or k, for shoulder, elbow, shoulder_dot, elbow_dot" in said
    assert not (tmp_path / "run").exists()


def test_frequencies_are_measured_where_one_joint_is_driven() -> None:
    for plant, measured in (("cart_pole", True), ("double_pendulum", False)):
        order = Order(JointSettings(plant), Margins.parse(), 60.0, carry_out.STEPS)
        assert order.in_frequency is measured
        assert [one.layer.key for one in carry_out._undefined(order.settings)] == (
            [] if measured else ["same_plant", "which_controllers"]
        )


def test_a_run_of_several_joints_that_records_nothing_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pendulum_bags.commands.experiment_cli import main

    def ends(bag: Path, _: object) -> None:
        assert (bag.parent / "machine.yaml").is_file()
        raise FaultError("sim_plant ended with code 2")

    monkeypatch.setattr(carry_out, "record_simulation", ends)
    assert main(["joints", "--plant", "pendubot", "--budget", "0", "--out", str(tmp_path / "run")]) == 2
    assert "error: sim_plant ended with code 2" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
