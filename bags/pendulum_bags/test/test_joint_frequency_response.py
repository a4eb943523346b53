"""The frequency response of plants of several joints: estimate, gap, and which designs carry over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pendulum_bags.experiments.joint_run import JointSettings, surrogate_for
from pendulum_bags.experiments.settings import NoiseSettings
from pendulum_bags.frequency_response.analyse import analyse_responses
from pendulum_bags.frequency_response.designs import certify_designs
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.figures import response_figures
from pendulum_bags.frequency_response.multisine import Multisine
from pendulum_bags.frequency_response.record import INPUT_UNIT, Record
from pendulum_bags.verdict import Mark
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS, make_disturbance
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_lqr.responses.certificate import Certifier, is_stable
from pendulum_lqr.responses.gap_metric import JointScaling
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import MeasuredResponse, read_response, write_response
from pendulum_lqr.responses.sampled_response import model_response
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

PERIOD = 0.002
DRIVEN_ALONE = ("cart_pole", "acrobot_frictionless", "furuta")


@cache
def _model(name: str) -> LinearModel:
    return linearise(load_mechanism(name))


@cache
def _record(name: str, *, periods: int = 3, noise: float = 0.0, label: str = "sim") -> Record:
    """Return a plant under its LQR and a multisine, by the plant's own equations."""
    plant = load_mechanism(name)
    run = JointSettings(name, noise=NoiseSettings(3, 0.02 * plant.effort_limits[0])).run("sim")
    run, _ = Multisine(periods=periods).specs(run, run)
    parameters = run.disturbance_parameters()
    wave = make_disturbance(validate(DISTURBANCE_SPECS, {k: v for k, v in parameters.items() if k != "joints"}))
    gain = output_lqr(_model(name), *plant.mechanism.weights).K
    simulated, coordinates = MechanismPlant(plant, PERIOD), plant.coordinates
    state = simulated.reset(coordinates.goal)
    generator = np.random.default_rng(1)
    n = len(coordinates.joints)
    count = run.steps
    r, u, y = np.zeros(count), np.zeros(count), np.zeros((2 * n, count))
    for k in range(count):
        x = np.array([*coordinates.deviation(state.position), *state.velocity])
        y[:, k] = x + noise * generator.standard_normal(2 * n)
        r[k] = wave(round(k * PERIOD * NANOSECONDS))
        u[k] = float(-gain @ y[:, k]) + r[k]
        state = simulated.step((u[k],))
    return Record(label, PERIOD, r, u, y, parameters, joints=coordinates.names, driven=coordinates.driven[0])


def _exact(model: LinearModel, plant: PlantParameters, label: str, lowest: float = 0.25) -> MeasuredResponse:
    """Return what a faultless measurement of a linear plant would tell."""
    lines = np.unique(2 * np.round((np.geomspace(1, 100 / lowest, 48) - 1) / 2) + 1) * lowest
    response = model_response(model, lines, PERIOD)
    small = 1e-6 * np.abs(response)
    coordinates = plant.coordinates
    return MeasuredResponse(
        label,
        PERIOD,
        lines,
        response,
        small,
        np.ones_like(small),
        np.ones(lines.size, dtype=complex),
        8.0,
        joints=coordinates.names,
        driven=coordinates.driven[0],
    )


def _scaling(plant: PlantParameters, model: LinearModel) -> JointScaling:
    q, r = plant.mechanism.weights
    return JointScaling.of_weights(model.states, ["-"] * len(q), q, r, "-")


@pytest.mark.parametrize("name", DRIVEN_ALONE)
def test_a_simulated_plant_answers_as_its_linear_model_at_every_joint_and_line(name: str) -> None:
    measured = estimate(_record(name))
    assert measured.joints == load_mechanism(name).coordinates.names
    expected = model_response(_model(name), measured.frequency, PERIOD)
    assert measured.response.shape == expected.shape == (4, measured.frequency.size)
    # What is left is the end of the transient, which the discs count, and the part of the motion that is not linear.
    error = np.abs(measured.response - expected)
    assert np.all(error < np.maximum(0.02 * np.abs(expected), measured.radius()))
    low = measured.frequency < 10.0
    assert np.all(error[:, low] < 0.02 * np.abs(expected[:, low]))


def test_discs_hold_the_true_response_of_noisy_sensors() -> None:
    measured = estimate(_record("cart_pole", periods=6, noise=1e-4, label="hw"))
    true = model_response(_model("cart_pole"), measured.frequency, PERIOD)
    error = np.abs(measured.response - true)
    assert np.mean(error < measured.radius()) > 0.98
    # Not by being wide: single discs of 95 % leave out about one in twenty.
    assert 0.005 < np.mean(error > measured.radius(joint=False)) < 0.15


def test_a_response_of_several_joints_survives_its_file(tmp_path: Any) -> None:
    measured = estimate(_record("furuta"))
    again = read_response(write_response(tmp_path / "hw_response.json", measured))
    assert (again.joints, again.driven, again.driven_velocity) == (("arm", "pendulum"), 0, 2)
    assert np.array_equal(again.response, measured.response)


def test_a_response_in_volts_is_none_of_a_plant_driven_by_a_torque_and_the_reverse() -> None:
    torque = estimate(_record("furuta"))
    volts = replace(torque, facts={**torque.facts, INPUT_UNIT: "V"})
    with pytest.raises(ParameterError, match="plant furuta is driven in N m; expected one driven in V, as the input"):
        analyse_responses([volts], "furuta")
    with pytest.raises(ParameterError, match="plant qube_servo is driven in V; expected one driven by an effort, as"):
        analyse_responses([torque], "qube_servo")


def test_the_driven_joint_tells_delay_and_gain() -> None:
    plant, model = load_mechanism("acrobot_frictionless"), _model("acrobot_frictionless")
    later = replace(model, delay=0.008)
    analysis = analyse_responses([_exact(model, plant, "sim"), _exact(later, plant, "hw")], "acrobot_frictionless")
    assert analysis.difference is not None
    assert abs(analysis.difference.delay.value - 0.008) < 1e-6
    assert abs(analysis.difference.gain.value - 1.0) < 1e-6


def test_delay_and_gain_are_those_of_the_driven_joint() -> None:
    plant, model = load_mechanism("acrobot_frictionless"), _model("acrobot_frictionless")
    measured = _exact(model, plant, "hw")
    response = measured.response.copy()
    response[3] *= 0.8 * np.exp(-2j * np.pi * measured.frequency * 0.004)
    analysis = analyse_responses(
        [replace(measured, label="sim"), replace(measured, response=response)], "acrobot_frictionless"
    )
    assert analysis.difference is not None
    assert abs(analysis.difference.delay.value - 0.004) < 1e-6
    assert abs(analysis.difference.gain.value - 0.8) < 1e-6


@pytest.mark.parametrize("name", DRIVEN_ALONE)
def test_between_and_below_the_lines_the_machine_is_what_it_is(name: str) -> None:
    plant, model = load_mechanism(name), _model(name)
    other = replace(linearise(surrogate_for(plant, share=0.1, delay=0.0, seed=2)), delay=0.005)
    measured = _exact(other, plant, "hw")
    machine = Machine.relative_to(measured, model)
    true = model_response(other, machine.frequency, PERIOD)
    error = np.abs(machine.response - true)
    measured_there = machine.frequency >= measured.frequency[0]
    assert np.all(error[:, measured_there] <= machine.radius[:, measured_there])
    share = error / np.abs(true)
    assert np.max(share[:, measured_there]) < 0.02
    # Below the lowest line nobody saw where a cart's friction begins to count.
    assert (~measured_there).sum() > 5
    assert np.max(share[:, ~measured_there]) < 0.2


def test_below_the_lowest_line_a_delay_goes_on_through_zero_without_a_kink() -> None:
    plant, model = load_mechanism("acrobot_frictionless"), _model("acrobot_frictionless")
    late = replace(model, delay=0.02)
    measured = _exact(late, plant, "hw")
    machine = Machine.relative_to(measured, model)
    below = machine.frequency < measured.frequency[0]
    true = model_response(late, machine.frequency, PERIOD)
    assert np.max(np.abs(machine.response / true - 1.0)[:, below]) < 1e-4


def test_what_noise_makes_of_the_lines_counts_between_them_too() -> None:
    plant, model = load_mechanism("furuta"), _model("furuta")
    exact = _exact(model, plant, "hw")
    machine = Machine.relative_to(replace(exact, deviation=0.05 * np.abs(exact.response)), model)
    share = machine.radius / np.abs(machine.response)
    on_line = np.isin(machine.frequency, exact.frequency)
    assert share[:, ~on_line].min() > 0.9 * share[:, on_line].min()


@pytest.mark.parametrize("name", DRIVEN_ALONE)
def test_the_same_plant_is_yes_and_all_that_stabilises_it_is_certified(name: str) -> None:
    plant, model = load_mechanism(name), _model(name)
    # A cart that rolls away has to be measured from below its loop's slowest mode.
    both = [_exact(model, plant, side, 0.1) for side in ("sim", "hw")]
    analysis = analyse_responses(both, name)
    assert [layer.mark for layer in analysis.layers] == [Mark.YES, Mark.YES]
    assert len(analysis.designs) == 4
    assert all(design.certified for design in analysis.designs)


def _gains(model: LinearModel, weights: Sequence[float], generator: np.random.Generator) -> NDArray[np.float64]:
    scale = 10.0 ** generator.uniform(-2.0, 2.0, len(weights))
    cost = 10.0 ** generator.uniform(-3.0, 2.0)
    return np.asarray(output_lqr(model, np.array(weights) * scale, cost).K, dtype=np.float64)


@pytest.mark.parametrize("name", DRIVEN_ALONE)
def test_no_certified_gain_fails_on_the_machine_that_was_measured(name: str) -> None:
    plant, model = load_mechanism(name), _model(name)
    generator = np.random.default_rng(7)
    certified = sound = 0
    for seed in range(6):
        machine = surrogate_for(plant, share=0.1, delay=0.0, seed=seed)
        other = replace(linearise(machine), delay=float(generator.uniform(0.0, 0.01)))
        measured = _exact(other, plant, "hw", 0.05)
        certifier = Certifier(model, Machine.relative_to(measured, model), _scaling(plant, model))
        sampled = discretise(other, PERIOD)
        for _ in range(40):
            K = _gains(model, plant.mechanism.weights[0], generator)
            found, stable = certifier.gain(K), is_stable(sampled, K)
            assert stable or not found.certified, (seed, K, found)
            certified += found.certified
            # Modulus margin of the machine itself: of what keeps 0.5 from -1 most should be certified.
            sound += stable and found.worst_modulus > 0.5
    assert sound >= 10
    assert certified > 0.5 * sound


@pytest.mark.parametrize("stiffness", [-1.0, -0.45, 0.2, 0.45, 0.6, 0.8])
def test_no_loop_that_an_unseen_stiffness_of_the_cart_may_tip_is_certified(stiffness: float) -> None:
    """The model's cart has poles at 0: no line shows how many unstable poles the machine has below the lowest one."""
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    A, drive = model.A.copy(), model.B[:, 0]
    A[:, 0] -= drive * stiffness / drive[2]
    other = replace(model, A=A)
    certifier = Certifier(model, Machine.relative_to(_exact(other, plant, "hw"), model), _scaling(plant, model))
    sampled, generator = discretise(other, PERIOD), np.random.default_rng(11)
    refused = fell = certified = 0
    for _ in range(80):
        K = _gains(model, plant.mechanism.weights[0], generator)
        found, stable = certifier.gain(K), is_stable(sampled, K)
        assert stable or not found.certified, K
        certified += found.certified
        refused += bool(found.unseen) and (found.by_gap or found.by_frequency)
        fell += bool(found.unseen) and (found.by_gap or found.by_frequency) and not stable
        assert not found.unseen or found.unseen < certifier.machine.lowest
    assert refused
    # Without the refusal some of these would be certified and fall.
    assert fell or stiffness < 0.2 or stiffness > 0.7
    assert certified or abs(stiffness) > 0.5


def test_a_loop_slower_than_the_lowest_line_is_measured_again_from_below_it() -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    both = [_exact(model, plant, side) for side in ("sim", "hw")]
    layer = analyse_responses(both, "cart_pole").layers[1]
    assert layer.mark is Mark.UNDECIDED
    # The slowest mode of the default designs is at 0.148 Hz.
    assert [step.rpartition(" --")[2] for step in layer.next_steps] == ["signal-period 7"]
    assert "as many unstable poles as the model has, 1, and no resonance" in layer.sentence


def test_a_machine_that_falls_under_the_design_is_not_certified() -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    late = replace(model, delay=0.15)
    certifier = Certifier(model, Machine.relative_to(_exact(late, plant, "hw"), model), _scaling(plant, model))
    K = output_lqr(model, *plant.mechanism.weights).K
    assert is_stable(discretise(model, PERIOD), K)
    assert not is_stable(discretise(late, PERIOD), K)
    assert not certifier.gain(K).certified
    analysis = analyse_responses([_exact(model, plant, "sim"), _exact(late, plant, "hw")], "cart_pole")
    assert [layer.mark for layer in analysis.layers] == [Mark.NO, Mark.NO]
    assert any("experiment joints" in step or "identify" in step for step in analysis.layers[0].next_steps)


@pytest.mark.parametrize(
    ("design", "words"),
    [
        ("q=1,2 r=1", "with 4 numbers for q or k"),
        ("k=1,2,3", "with 4 numbers for q or k"),
        ("q=1,1,1,1 r=1,2", "one for r"),
        ("pid", "expected 'q=... r=...' or 'k=...'"),
        ("q=1,1,1,e r=1", "with 4 numbers for q or k"),
        ("q=1,1,1,-1 r=1", "weight"),
    ],
)
def test_what_is_no_design_of_the_plant_is_refused(design: str, words: str) -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    certifier = Certifier(model, Machine.relative_to(_exact(model, plant, "hw"), model), _scaling(plant, model))
    with pytest.raises(ParameterError, match=words):
        certify_designs([design], plant, certifier)


def test_a_gain_is_certified_as_it_is_written() -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    certifier = Certifier(model, Machine.relative_to(_exact(model, plant, "hw"), model), _scaling(plant, model))
    K = output_lqr(model, *plant.mechanism.weights).K
    own, same, wrong = certify_designs(
        ["q=10,100,1,1 r=0.1", "k=" + ",".join(map(repr, map(float, K))), "k=0,0,0,0"], plant, certifier
    )
    assert own.certificate == same.certificate
    assert not wrong.certified


@pytest.mark.parametrize(("plant", "driven"), [("acrobot", "elbow"), ("double_pendulum", "shoulder, elbow")])
def test_a_plant_of_other_joints_or_two_motors_is_refused(plant: str, driven: str) -> None:
    measured = _exact(_model("cart_pole"), load_mechanism("cart_pole"), "hw")
    with pytest.raises(ParameterError, match=f"driven: {driven}; expected cart, pole, driven: cart alone"):
        analyse_responses([measured], plant)


def test_figures_have_a_row_for_each_joint_with_its_units() -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    analysis = analyse_responses([_exact(model, plant, "sim"), _exact(model, plant, "hw")], "cart_pole")
    figures = {figure.name: figure for figure in response_figures(analysis)}
    assert list(figures) == ["bode", "response_quality", "gap", "nyquist"]
    labels = [panel.y_label for panel in figures["bode"].panels]
    assert labels == ["cart per effort\n[m/N]", "pole per effort\n[rad/N]", "phase of cart\n[deg]"]
    assert "0.316 m of cart" in figures["gap"].sentence


def test_an_error_far_too_large_is_not_answered_by_measuring_longer() -> None:
    plant, model = load_mechanism("cart_pole"), _model("cart_pole")
    exact = _exact(model, plant, "hw", 0.1)
    layer = analyse_responses([replace(exact, deviation=20.0 * np.abs(exact.response))], "cart_pole").layers[0]
    assert layer.mark is Mark.UNDECIDED
    assert [step.partition(" about")[0] for step in layer.next_steps] == ["measuring longer decides nothing"]
