"""The public double-pendulum benchmark: scores and simulation beside numbers of the public implementation.

The numbers come from github.com/dfki-ric-underactuated-lab/double_pendulum (1e8544e), run on the same motions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from typer.testing import CliRunner

from pendulum_bags.commands.experiment_cli import app
from pendulum_bags.studies import mechanism_benchmark_runs as runs
from pendulum_bags.studies.benchmark_controllers import DifferencedVelocity, make_contender
from pendulum_bags.studies.mechanism_benchmark import (
    PUBLISHED,
    benchmark_plant,
    criteria_of,
    score_v1,
    score_v2,
    time_above_line,
)
from pendulum_bags.studies.mechanism_benchmark_runs import Disturbances, Trial, robustness_of, robustness_trials
from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.dynamics.runge_kutta import along_2, rk4_joints
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.joint_plants import delayed_plant
from pendulum_testing.policies import random_policy

T = 0.002 * np.arange(5000)
ENDS = {
    "acrobot": {
        "coulomb": (-1.007986815, -3.543630219, -13.597052429, 2.286715182),
        "damping": (-0.12390988, -4.943382878, -13.338686002, 4.39461492),
        "rotor": (-0.90437882, -4.253895224, -7.576318668, -0.295401535),
        "centre": (-1.327925671, -3.938398807, -8.57104643, 0.407045685),
        "response": (-1.031618113, -4.337293214, -6.512968304, -0.540935566),
        "delay": (-1.260493321, -4.214006192, -5.893718084, -0.307533862),
        "kicks": (-1.162872033, -0.614114225, -6.841995244, 16.867439957),
        "knock": (1.7623366826, -6.0852685755, 8.1259195664, -8.9718017509),
    },
    "pendubot": {
        "coulomb": (-1.607225513, -3.562179802, 8.68603116, -19.293326927),
        "damping": (-10.277537931, 20.525870167, -10.638386902, 44.159827296),
        "rotor": (-1.680169041, -2.33398443, 8.669391881, -15.676880674),
        "centre": (-4.659861848, 1.019817455, 1.649652777, -9.730011559),
        "response": (-1.43789128, -2.834309727, 9.632354501, -16.646017051),
        "delay": (-1.335881169, -2.937135082, 10.737900068, -16.877501256),
        "kicks": (-0.01478298, -2.619494896, 13.162387298, -11.26954794),
        "knock": (-0.0138940728, -39.8531803658, -12.321415817, 1.7402417471),
    },
}


def answer(driven: int) -> Callable[[float, Vector], Vector]:
    """Return the controller that the numbers were made with."""

    def respond(t: float, x: Vector) -> Vector:
        effort = 4.0 * math.cos(5.0 * t) - 0.2 * x[2 + driven] + 0.1 * x[0]
        return (effort, 0.0) if driven == 0 else (0.0, effort)

    return respond


def motion() -> tuple[np.ndarray, np.ndarray]:
    rise = 1.0 - np.exp(-2.0 * T) * np.cos(3.0 * T)
    elbow = 0.5 * np.sin(4.0 * T) * np.exp(-T)
    states = np.column_stack([math.pi * rise, elbow, np.gradient(math.pi * rise, T), np.gradient(elbow, T)])
    return states, np.column_stack([0.0 * T, 2.0 * np.cos(5.0 * T) * np.exp(-T)])


def test_criteria_and_scores_are_those_of_the_public_implementation() -> None:
    plant = benchmark_plant("acrobot")
    states, efforts = motion()
    criteria = criteria_of(plant, T, states, efforts)
    assert criteria == pytest.approx(
        {
            "swingup_time": 0.834,
            "max_torque": 2.0,
            "energy": 0.9611022146845036,
            "torque_integral": 1.2832219609830104,
            "torque_cost": 1.0424642028009294,
            "torque_smoothness": 0.0032622124584485,
            "velocity_cost": 22.01641374319899,
        },
        rel=1e-12,
    )
    assert score_v1(criteria, T[-1]) == pytest.approx(0.9421396348377297, rel=1e-12)
    assert score_v2(criteria, T[-1]) == pytest.approx(0.8767631498765713, rel=1e-12)
    assert time_above_line(plant, T, states) == pytest.approx(9.506, rel=1e-12)
    # One that falls and comes back counts from when it is back.
    states[4000:4100, 0] = 0.0
    criteria = criteria_of(plant, T, states, efforts)
    assert score_v2(criteria, T[-1]) == pytest.approx(0.7310920148033291, rel=1e-12)
    assert time_above_line(plant, T, states) == pytest.approx(9.306, rel=1e-12)
    # One that is down at its end scores nothing.
    states[-5:, 0] = 0.0
    assert score_v2(criteria_of(plant, T, states, efforts), T[-1]) == 0.0


@pytest.mark.parametrize("name", ["acrobot", "pendubot"])
def test_each_disturbance_moves_the_plant_as_the_public_simulation_does(name: str) -> None:
    plant = benchmark_plant(name)
    driven = plant.coordinates.driven[0]
    stepper = runs.make_stepper(plant, compiled=False)
    height, moment = ((3.0, 0.5), (2.0, 0.8))[driven]
    bell = tuple(height * np.exp(-((T - moment) ** 2) / 0.01))
    cases = {
        "coulomb": Disturbances(coulomb=(-0.14, 0.0)),
        "damping": Disturbances(damping=(0.0, -0.07)),
        "rotor": Disturbances(values={"rotor_inertia": 5e-5}),
        "centre": Disturbances(values={"centre_2": 0.8 * plant.value("centre_2")}),
        "response": Disturbances(response=1.7),
        "delay": Disturbances(delay=0.022),
        "kicks": Disturbances(kicks=bell),
    }
    for case, disturbances in cases.items():
        end = runs.simulate(plant, stepper, answer(driven), 600, disturbances).states[-1]
        assert end == pytest.approx(ENDS[name][case], abs=2e-8), case


class Waving(Controller):
    """The same controller, as controllers are."""

    def __init__(self, driven: int) -> None:
        super().__init__((6.0,))
        self.driven = driven

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        return (answer(self.driven)(t, position + velocity)[self.driven],)


@pytest.mark.parametrize("name", ["acrobot", "pendubot"])
def test_a_knock_down_moves_the_plant_as_the_public_tester_does(name: str) -> None:
    plant = benchmark_plant(name)
    knocks = runs._KnockDowns(plant, Waving(plant.coordinates.driven[0]), np.random.default_rng(0))
    knocks._goals[:2] = [[-1.746768422704538, 2.3293797790704955], [-0.07281464829200779, 0.7021073975573935]]
    knocks._moments[:2] = [3.34577025367686, 7.5815541571127945]
    stepper = runs.make_stepper(plant, compiled=False)
    run = runs.simulate(plant, stepper, knocks.answer, 2100, limits=(6.0, 6.0))
    assert run.states[-1] == pytest.approx(ENDS[name]["knock"], abs=2e-8)


def test_the_trials_are_the_benchmark_s() -> None:
    plant = benchmark_plant("pendubot")
    trials = robustness_trials(plant)
    counts = {kind: sum(trial.kind == kind for trial in trials) for kind in runs.KINDS}
    assert counts == {
        "model": 210,
        "velocity_noise": 210,
        "torque_noise": 210,
        "torque_response": 21,
        "delay": 21,
        "kicks": 50,
    }
    of_mass = [trial.disturbances.values["mass_2"] for trial in trials if "mass_2" in trial.disturbances.values]
    assert (of_mass[0], of_mass[-1]) == pytest.approx((0.75 * plant.value("mass_2"), 1.25 * plant.value("mass_2")))
    # The start is the same for the same seed, and each noisy run has noise of its own.
    assert trials == robustness_trials(plant) != robustness_trials(plant, seed=2)
    assert len({trial.seed for trial in trials}) == len(trials)
    peaks = [max(abs(value) for value in trial.disturbances.kicks) for trial in trials if trial.kind == "kicks"]
    assert min(peaks) >= 0.5
    assert 3.0 < max(peaks) <= 5.01


def test_a_noisy_level_holds_where_more_than_half_of_its_runs_do() -> None:
    trials = [Trial("delay", "0", Disturbances(), 0)]
    trials += [Trial("velocity_noise", level, Disturbances(), 0) for level in "ab" for _ in range(4)]
    result = robustness_of(trials, [True, True, True, True, False, True, True, False, False])
    assert result["velocity_noise"] == 0.5
    assert result["delay"] == 1.0


def test_another_plant_is_not_in_the_benchmark() -> None:
    with pytest.raises(ParameterError, match="'cart_pole' is not in the benchmark; expected acrobot or pendubot"):
        benchmark_plant("cart_pole")


@pytest.mark.parametrize("name", ["acrobot", "pendubot"])
def test_the_stored_swing_up_scores_better_than_every_published_method(name: str, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Takes some seconds: the whole command, design, run of 10 s and figure."""
    arguments = ["benchmark", "--plant", name, "--controller", "tvlqr", "--no-robustness", "--uptime-seeds", "0",
                 "--out", str(tmp_path), "--json"]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert [row["method"] for row in document["published"]] == [row.method for row in PUBLISHED if row.plant == name]
    best = max(row["score_v2"] or 0.0 for row in document["published"])
    assert document["rows"][0]["score_v2"] > best + 0.01
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def test_a_policy_file_is_scored_with_an_lqr_near_upright_and_without(tmp_path) -> None:  # type: ignore[no-untyped-def]
    plant = benchmark_plant("pendubot")
    file = write_policy(tmp_path / "weak.npz", random_policy(plant, velocity_box=(50.0, 50.0)))
    names = f"{file},{file}+lqr"
    arguments = ["benchmark", "--plant", "pendubot", "--controller", names, "--no-robustness", "--uptime-seeds", "0"]
    result = CliRunner().invoke(app, [*arguments, "--workers", "1", "--out", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "pendubot.json").read_text())["rows"]
    assert [row["controller"] for row in rows] == names.split(",")
    assert rows[0]["criteria"]["torque_cost"] > 0.0
    # It never comes near upright: nothing is caught, both do the same.
    assert rows[0]["criteria"] == rows[1]["criteria"]
    answers = make_contender(f"{file}+lqr", plant, 0.002), make_contender(str(file), plant, 0.002)
    near = (math.pi + 0.02, -0.01, 0.0, 0.05)
    caught, bare = (controller.efforts(0.0, near[:2], near[2:]) for controller in answers)
    assert caught != bare
    with pytest.raises(ParameterError, match="trained on a double_pendulum driven at shoulder, and this one is"):
        make_contender(str(file), benchmark_plant("acrobot"), 0.002)
    with pytest.raises(DesignError, match=r"trained for a period of 0\.01 s and states come every 0\.003 s"):
        make_contender(str(file), plant, 0.003)


def test_velocities_from_positions_are_the_true_ones_whatever_was_measured() -> None:
    plant, period = benchmark_plant("acrobot"), 0.002

    class Listener(Controller):
        def __init__(self) -> None:
            super().__init__(plant.effort_limits)
            self.heard: list[Vector] = []

        def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
            self.heard.append(position + velocity)
            return (2.0 * math.sin(9.0 * t),)

    listener = Listener()
    controller = DifferencedVelocity(plant, listener)
    x: Vector = (0.1, 0.4, 0.0, 0.0)
    for k in range(500):
        noise = 0.5 * (-1) ** k if k else 0.0
        effort = controller.efforts(k * period, x[:2], (x[2] + noise, x[3] - noise))
        assert listener.heard[-1] == pytest.approx(x, rel=1e-3, abs=2e-3)
        torque = plant.coordinates.spread(effort)
        q, v = rk4_joints(plant.mechanism.forward, along_2, x[:2], x[2:], torque, torque, torque, period, plant.packed)
        x = (*q, *v)


def test_a_contender_that_does_not_settle_or_that_nobody_knows_is_refused_and_old_names_are_known() -> None:
    plant = benchmark_plant("acrobot")
    late = delayed_plant("acrobot_frictionless", 0.3)
    with pytest.raises(ParameterError, match=r"tvlqr asked every 0\.002 s does not settle on plant 'acrobot_frict"):
        make_contender("tvlqr", late, 0.002)
    with pytest.raises(ParameterError, match="controller 'lqr' is unknown; expected one of tvlqr"):
        make_contender("lqr", plant, 0.002)
    old, new = (make_contender(name, plant, 0.002) for name in ("tvlqr_mpc", "tvlqr_nmpc"))
    assert type(old) is type(new)
