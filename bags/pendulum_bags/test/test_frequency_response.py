"""Frequency responses: estimates against known plants, what tells two plants apart, and what is said of designs."""

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.experiment_cli import main as experiment_main
from pendulum_bags.commands.frequency_response_cli import main
from pendulum_bags.experiments.in_process import simulate_plant
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.frequency_response.analyse import analyse_responses
from pendulum_bags.frequency_response.compare import compare_responses, continuous
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.record import Record, record_of_arrays, record_of_run
from pendulum_bags.frequency_response.write import write_analysis
from pendulum_bags.runs.run_data import RunData
from pendulum_bags.runs.series import Series, Signal
from pendulum_bags.verdict import Layer, Mark
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.responses.controller_response import controller_response
from pendulum_lqr.responses.measured_response import MeasuredResponse
from pendulum_lqr.responses.sampled_response import model_response
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_sim.stepping.sensors import Sensors

THESIS = load_plant("thesis")
MULTISINE = {
    "kind": "multisine",
    "signal_period": 4.0,
    "frequency": 0.25,
    "frequency_end": 47.5,
    "lines": 40,
    "hold_time": 0.01,
    "amplitude": 2.5,
}
NOISE = {"position_noise": 1e-4, "velocity_noise": 2e-3}


def record(
    plant: PlantParameters,
    side: str = "hw",
    seed: int = 1,
    periods: int = 6,
    noise: dict | None = None,
    **disturbance,
) -> Record:
    """Return a record of a plant under the thesis's LQR and a multisine."""
    spec = RunSpec(
        side=side,
        disturbance={**MULTISINE, **disturbance},
        duration=4.0 * (periods + 1),
        seed=3,
        method="etd4",
    )
    sensors = Sensors(np.random.default_rng(seed), **(NOISE if noise is None else noise))
    return record_of_arrays(simulate_plant(spec, plant, sensors), side, spec.disturbance_parameters())


@pytest.fixture(scope="module")
def measured() -> dict[str, MeasuredResponse]:
    """Two measurements of one plant at two rates, with noises of their own, and one of a later and weaker plant."""
    weaker = {name: getattr(THESIS, name) / 1.2 for name in ("inertia", "damping", "gravity")}
    other = THESIS.with_values(transport_delay=0.01, **weaker)
    return {
        "sim": estimate(record(THESIS, "sim", 11)),
        "hw": estimate(record(THESIS, "hw", 12)),
        "other": estimate(record(other, "hw", 13)),
    }


def test_the_discs_hold_the_true_response_and_are_no_larger_than_they_need_be():
    trials = [estimate(record(THESIS, "hw", seed)) for seed in range(100, 108)]
    true = model_response(linearise(THESIS), trials[0].frequency, trials[0].period)
    errors = np.array([np.abs(trial.response - true) for trial in trials])
    held = [bool(np.all(error <= trial.radius())) for error, trial in zip(errors, trials, strict=True)]
    # All discs of a measurement together fail in 5 % of measurements at most.
    assert sum(held) >= 7
    # |error|^2 / deviation^2 has the mean of F(2, 10), which is 1.25.
    shares = np.array([(error / trial.deviation) ** 2 for error, trial in zip(errors, trials, strict=True)])
    assert np.mean(shares) == pytest.approx(1.25, abs=0.15)
    assert np.max(errors[:, 1] / np.abs(true[1])) < 0.03


def test_output_over_torque_is_biased_by_feedback_and_the_joint_estimate_is_not():
    # Noise as large as the motion: the controller answers it, and the torque knows it.
    periods = 60
    noisy = record(THESIS, noise={"position_noise": 8e-3, "velocity_noise": 0.0}, periods=periods, amplitude=0.5)
    joint = estimate(noisy)
    true = model_response(linearise(THESIS), joint.frequency, joint.period)
    u, y = noisy.torque[400:], noisy.outputs[0, 400:]
    spectra = [np.fft.rfft((x - x.mean()).reshape(periods, 400), axis=1) for x in (u, y)]
    lines = np.round(joint.frequency * 4.0).astype(int)
    naive = (np.sum(spectra[1] * np.conj(spectra[0]), axis=0) / np.sum(np.abs(spectra[0]) ** 2, axis=0))[lines]
    high = joint.frequency > 10.0
    biased, unbiased = (abs(np.mean((found - true[0])[high])) for found in (naive, joint.response[0]))
    assert biased > 3.0 * unbiased
    assert np.all(np.abs(joint.response - true) <= joint.radius())


def test_any_rich_disturbance_serves_by_windowed_segments():
    uniform = record(THESIS, periods=9, kind="uniform")
    found = estimate(uniform)
    true = model_response(linearise(THESIS), found.frequency, found.period)
    inside = (found.frequency > 0.7) & (found.frequency < 40.0)
    assert np.count_nonzero(inside) > 20
    relative = np.abs(found.response[1] / true[1] - 1.0)[inside]
    assert np.median(relative) < 0.05
    assert np.mean(np.abs(found.response - true)[:, inside] <= found.radius()[:, inside]) > 0.97


def test_the_same_plant_at_two_rates_shows_no_difference(measured):
    difference = compare_responses(measured["sim"], measured["hw"], linearise(THESIS))
    assert not difference.found
    assert difference.nu_gap.low == 0.0
    assert difference.nu_gap.high < 0.02
    assert difference.delay.low < 0.0 < difference.delay.high
    # Freed from hold and folding both are the continuous plant.
    for side in ("sim", "hw"):
        true = model_response(linearise(THESIS), measured[side].frequency)
        np.testing.assert_allclose(continuous(measured[side], linearise(THESIS))[1], true[1], rtol=0.03)


def test_a_delay_and_a_gain_are_found_and_distinguished(measured):
    difference = compare_responses(measured["sim"], measured["other"], linearise(THESIS))
    assert difference.found
    assert difference.delay.value == pytest.approx(0.01, abs=2e-4)
    assert difference.gain.value == pytest.approx(1.2, rel=0.01)
    assert difference.lines_that_differ > 0.9 * difference.frequency.size


def test_dry_friction_shows_on_lines_that_were_not_excited():
    stiff = THESIS.with_values(coulomb_friction=0.3, static_friction=0.3)
    smooth, rough = (estimate(record(p, noise={}, periods=3)).distortion[1] for p in (THESIS, stiff))
    assert smooth < 2e-3
    assert rough > 10.0 * smooth


def test_layers_say_yes_for_the_same_plant_and_name_the_designs_that_do_not_carry_over(measured, tmp_path, monkeypatch):
    # Gains on its maps are looked at one by one, over a thousand.
    monkeypatch.setattr("pendulum_bags.frequency_response.figures._GRID", 9)
    same = analyse_responses([measured["sim"], measured["hw"]], "thesis")
    assert [layer.layer for layer in same.layers] == [Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS]
    assert [layer.mark for layer in same.layers] == [Mark.YES, Mark.YES]
    late = estimate(record(THESIS.with_values(transport_delay=0.08), periods=4))
    other = analyse_responses(
        [measured["sim"], replace(late, label="hw")], "thesis", ["q=100,0.01 r=0.1", "k=400,0.1", "lqi"]
    )
    assert other.layers[0].mark is Mark.NO
    assert [design.certificate.certified for design in other.designs] == [True, False, True]
    assert "not row 2" in other.layers[1].sentence
    # A design that the simulation itself rejects carries nothing over, wrong or right.
    for designs, mark in ((["q=100,0.01 r=0.1", "k=-1,0"], Mark.YES), (["k=-1,0"], Mark.UNDECIDED)):
        layer = analyse_responses([measured["sim"], measured["hw"]], "thesis", designs).layers[1]
        assert layer.mark is mark
        assert f"unstable on the model already: row {len(designs)};" in layer.sentence
        assert any("--design" in step for step in layer.next_steps) is (mark is Mark.UNDECIDED)
    # A simulation at 500 Hz shows nothing of a design that is unstable on hardware at 100 Hz.
    quick = replace(measured["sim"], period=0.002)
    layer = analyse_responses([quick, measured["hw"]], "thesis", ["q=100,0.01 r=0.1", "k=33,15"]).layers[1]
    assert layer.mark is Mark.NO
    assert "not row 2" in layer.sentence
    page = write_analysis(tmp_path, same, formats=("png",))
    text = page.read_text(encoding="utf-8")
    assert "Which designs carry over" in text
    assert "emulated" not in text
    assert "nu-gap" in same.layers[0].sentence
    assert "0.2 allowed" in same.layers[0].sentence
    assert "Certified for the hardware: all 4 designs;" in same.layers[1].sentence
    # Headings follow each other without a gap in their levels.
    levels = [int(level) for level in re.findall(r"<h(\d)", text)]
    assert all(later - level <= 1 for level, later in itertools.pairwise(levels))
    assert "half a period of hold" in text
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert drawn == {"bode", "response_quality", "gap", "nyquist", "certified_weights", "certified_gains"}
    assert (tmp_path / "layers" / "which_controllers.json").is_file()


def test_a_page_about_emulated_hardware_says_so_in_its_title_and_in_each_text(measured, tmp_path, monkeypatch):
    monkeypatch.setattr("pendulum_bags.frequency_response.figures._GRID", 3)
    emulated = replace(measured["hw"], facts={**measured["hw"].facts, "emulated": True})
    found = analyse_responses([measured["sim"], emulated], "thesis")
    text = write_analysis(tmp_path, found, formats=()).read_text(encoding="utf-8")
    assert "<h1>Frequency response of emulated hardware</h1>" in text
    assert "no machine was measured" in text
    assert "Certified for the emulated hardware" in text
    shown = re.sub(r"(?s)<(script|style).*?</\1>", "", text.split('id="terms-title"')[0]).replace(
        "place of the hardware", ""
    )
    assert re.findall(r"(?i)(?<!emulated )\bhardware\b.{40}", shown) == []


def test_the_command_reads_bags_of_any_noise(capsys):
    examples = next(path for path in Path(__file__).parents if (path / "examples").is_dir()) / "examples"
    bags = [str(examples / f"regulation_{side}") for side in ("sim", "hw")]
    assert main([*bags, "--json", "--design", "q=100,0.01 r=0.1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["designs"][0]["K"] == pytest.approx([33.345265, 0.158993], abs=1e-5)
    assert {layer["layer"] for layer in result["layers"]} == {"same_plant", "which_controllers"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("q=100", "expected 'q=... r=...' or 'k=...' with 2 numbers for q or k, for theta, theta_dot"),
        ("lqx", "controller is 'lqx'; did you mean 'lq"),
    ],
)
def test_a_design_that_is_none_is_refused(measured, text, message):
    with pytest.raises(ParameterError, match=message):
        analyse_responses([measured["hw"]], "thesis", [text])


def test_stamps_that_jitter_and_skip_are_brought_to_the_nominal_raster():
    generator = np.random.default_rng(4)
    t = np.delete(0.01 * np.arange(2000) + generator.normal(0.0, 7e-4, 2000), [500, 501, 900])
    angle = np.pi + 0.01 * np.sin(2.0 * np.pi * 3.0 * t)
    torque = np.where(t < 10.0, 1.0, -1.0)
    series = Series(t, angle, 0.0 * t, torque)
    run = RunData(
        "hw",
        series,
        series,
        Signal(t, torque),
        Signal(t, torque),
        None,
        np.diff(t),
        100.0,
        3,
        metadata={"pendulum.run": {"disturbance": MULTISINE}},
    )
    found = record_of_run(run)
    assert found.period == 0.01
    raster = t[0] + 0.01 * np.arange(found.torque.size)
    np.testing.assert_allclose(found.outputs[0], np.pi + 0.01 * np.sin(2.0 * np.pi * 3.0 * raster), atol=2e-4)
    # A held torque keeps its mean: the one step that holds the edge shares it.
    assert np.mean(found.torque) == pytest.approx(np.mean(np.where(raster < 10.0, 1.0, -1.0)), abs=2e-3)
    assert np.count_nonzero(np.abs(found.torque) < 0.999) <= 1


def test_what_cannot_be_measured_is_refused(measured):
    one = record(THESIS, periods=1, noise={})
    with pytest.raises(DataError, match=r"8.0 s, 2.0 periods of 4 s; expected at least 4"):
        estimate(one)
    with pytest.raises(DataError, match="was not excited"):
        estimate(replace(one, excitation=np.zeros_like(one.excitation)))
    with pytest.raises(DataError, match=r"a signal period of 4.003 s is 400.300 sampling periods"):
        estimate(replace(one, disturbance={**MULTISINE, "signal_period": 4.003}))


def test_a_controller_that_answers_by_the_time_has_no_frequency_response(capsys):
    assert experiment_main(["frequency_response", "--controller", "lqr_tracking"]) == 2
    assert "controller 'lqr_tracking' answers by the time, and so has no frequency response" in capsys.readouterr().err
    with pytest.raises(ParameterError, match="expected one that holds a set-point"):
        controller_response("lqr_tracking", load_plant("thesis"), [1.0], 0.01)


@pytest.mark.parametrize("controller", ["lqr", "pd_gravity", "lqi", "lqg"])
def test_the_linear_part_of_a_controller_is_that_of_its_equations(controller):
    frequency = np.array([0.5, 3.0, 20.0])
    K, stable = controller_response(controller, THESIS, frequency, 0.01)
    assert stable
    if controller == "lqr":
        np.testing.assert_allclose(K, np.array([[33.345265], [0.158993]]) * np.ones(3), atol=1e-5)
    elif controller == "pd_gravity":
        # -G_c sin(x) - kp x - kd x'
        np.testing.assert_allclose(K[0].imag, 0.0, atol=1e-6)
        np.testing.assert_allclose(K[0].real, K[0, 0].real)
    elif controller == "lqi":
        # The integral turns the angle's part by up to -90 degrees, the less the faster.
        phase = np.degrees(np.angle(K[0]))
        assert phase[0] < phase[1] < phase[2] < 0.0
    else:
        np.testing.assert_allclose(K[1], 0.0, atol=1e-6)
