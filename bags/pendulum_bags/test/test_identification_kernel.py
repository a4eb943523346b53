"""The compiled simulation against independent ones, and its sensitivities against finite differences."""

import numpy as np
import pytest

from pendulum_bags.identification.kernel import PARAMETER_NAMES
from pendulum_bags.identification.model import FitModel, from_plant, to_plant
from pendulum_bags.identification.problem import cut_windows, prepare, simulate
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.runs.datasets import Recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import pendulum_plant
from pendulum_testing.synthetic_recordings import multisine, synthetic_recording

PLANT = pendulum_plant(
    inertia=0.05,
    damping=0.03,
    gravity=1.5,
    coulomb_friction=0.05,
    static_friction=0.07,
    stribeck_velocity=0.3,
    load_friction=0.02,
    angle_offset=0.01,
    torque_offset=0.02,
    transport_delay=0.0125,
    quadratic_drag=0.02,
    torque_cos_2=0.05,
    torque_sin_2=-0.1,
    torque_cos_3=0.03,
    torque_sin_3=0.04,
)


def clean_run(plant=PLANT, seconds=6.0, seed=3):
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.005)
    return synthetic_recording(plant, multisine(time, 1.2, rng), 0.005, rng, noise=0.0)


def test_the_kernel_agrees_with_rk4_on_the_shared_equations_of_motion():
    recording = clean_run()
    assert window_score(from_plant(PLANT), recording, 6.0).rms < 3e-4
    assert np.ptp(recording.position) > 0.5


def test_a_linear_pendulum_follows_its_closed_form():
    # theta'' + 2 d theta' + w^2 theta = 0 from (0.01, 0): small enough that the sine is its argument to 2e-5.
    w, d = 5.0, 0.4
    time = np.linspace(0.0, 3.0, 601)
    damped = np.sqrt(w * w - d * d)
    exact = 0.01 * np.exp(-d * time) * (np.cos(damped * time) + d / damped * np.sin(damped * time))
    recording = Recording(time, exact, None, np.zeros_like(time), input_kind="effort")
    model = FitModel({"inertia": 0.2, "damping": 0.4 * d, "gravity": 0.2 * w * w})
    piece = prepare(recording, None)
    result = simulate(model, piece, np.array([[0.01, 0.0]]))
    np.testing.assert_allclose(result.theta, exact, atol=3e-6)


def test_the_integrator_is_of_second_order():
    recording = clean_run(pendulum_plant(inertia=0.05, damping=0.03, gravity=1.5))
    piece = prepare(recording, None)
    model = from_plant(pendulum_plant(inertia=0.05, damping=0.03, gravity=1.5))
    start = np.array([[0.0, 0.0]])
    fine = simulate(model, piece, start, step=1e-4).theta
    errors = [np.max(np.abs(simulate(model, piece, start, step=h).theta - fine)) for h in (5e-3, 2.5e-3, 1.25e-3)]
    slopes = np.diff(np.log2(errors))
    np.testing.assert_allclose(slopes, -2.0, atol=0.15)


def test_dry_friction_holds_at_rest_and_yields_at_its_level():
    time = np.arange(0.0, 2.0, 0.01)
    effort = 0.1 * time
    recording = Recording(time, np.zeros_like(time), None, effort, hold="linear")
    model = FitModel({"inertia": 0.05, "gravity": 0.0, "coulomb_friction": 0.1})
    result = simulate(model, prepare(recording, None), np.zeros((1, 2)))
    assert np.all(result.theta[time < 0.99] == 0.0)
    # From rest at 1 s: theta = 0.1 (t - 1)^3 / (6 J).
    np.testing.assert_allclose(result.theta[-1], 0.1 * 0.99**3 / 0.3, rtol=2e-3)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("kind", ["effort", "position_goal"])
def test_every_sensitivity_is_the_derivative_of_the_simulation(name, kind):
    recording = clean_run(seconds=3.0)
    values = {
        "inertia": 0.05,
        "damping": 0.03,
        "gravity": 1.5,
        "coulomb_friction": 0.03,
        "stribeck_excess": 0.02,
        "stribeck_velocity": 0.3,
        "load_friction": 0.03,
        "torque_offset": 0.02,
        "angle_offset": 0.01,
        "input_gain": 0.9,
        "transport_delay": 0.0031,
        "drive_damping": 0.02,
        "drive_load_friction": 0.02,
        "load_stribeck": 0.3,
        "quadratic_drag": 0.01,
        "torque_cos_2": 0.05,
        "torque_sin_2": -0.1,
        "torque_cos_3": 0.03,
        "torque_sin_3": 0.04,
    }
    gain = 0.0
    if kind == "position_goal":
        recording = Recording(
            recording.time,
            recording.position,
            None,
            1.5 * recording.input,
            kind,
            "zero",
            meta={"kp": 2.0, "vin": 3.0},
        )
        gain = 0.6
    model = FitModel(values, kind, "gear_load_stribeck", gain)
    piece = prepare(recording, 1.0)
    index = PARAMETER_NAMES.index(name)
    exact = simulate(model, piece, free=[index], step=1e-3).jacobian[:, 0]
    step = 1e-6 * max(values[name], 0.01)
    ends = []
    for sign in (1.0, -1.0):
        vector = np.array(model.vector)
        vector[index] += sign * step
        ends.append(simulate(model.with_vector(vector), piece, step=1e-3).theta)
    numeric = (ends[0] - ends[1]) / (2.0 * step)
    scale = max(np.max(np.abs(numeric)), 1e-3)
    # Single samples may straddle a kink of dry friction.
    assert np.quantile(np.abs(numeric - exact), 0.98) < 1e-4 * scale


@pytest.mark.parametrize("window", [0.5, 1.0, 2.0])
def test_windows_follow_one_another_and_a_short_rest_is_left_out(window):
    time = np.arange(0.0, 6.3, 0.002)
    windows = cut_windows(time, window)
    assert windows[0, 0] == 0
    np.testing.assert_array_equal(windows[1:, 0], windows[:-1, 1])
    rest = 6.3 % window
    assert (windows[-1, 1] == time.size) == (rest >= 0.5 * window or rest == 0.0)


def test_jitter_of_stamps_makes_no_extra_window():
    time = np.arange(3000) * 0.002 + np.random.default_rng(0).uniform(-2e-4, 2e-4, 3000)
    assert len(cut_windows(time, 1.0)) == 6


def test_a_window_that_is_not_positive_or_too_short_is_refused():
    time = np.arange(0.0, 1.0, 0.1)
    with pytest.raises(DataError, match=r"window is 0\.0 s; expected > 0"):
        cut_windows(time, 0.0)
    with pytest.raises(DataError, match="fewer than 4 samples"):
        cut_windows(time, 0.2)


def test_the_window_score_fits_initial_states_only():
    recording = clean_run()
    score = window_score(from_plant(PLANT), recording)
    assert len(score.by_window) == 6
    assert score.rms == pytest.approx(np.sqrt(np.mean((score.simulated - score.measured) ** 2)))
    worse = window_score(from_plant(PLANT.with_values(gravity=1.8)), recording).rms
    assert worse > 20.0 * score.rms
    assert free_run(from_plant(PLANT), recording).rms < 1e-3


def test_plant_and_fit_model_are_two_ways_to_write_the_same():
    back = to_plant(from_plant(PLANT), name=PLANT.name, effort_limit=PLANT.effort_limit)
    for field in ("inertia", "damping", "gravity", "static_friction", "load_friction", "angle_offset"):
        assert getattr(back, field) == pytest.approx(getattr(PLANT, field))


def test_the_score_of_the_geometry_on_the_real_swing_up_is_the_published_one(shared_data):
    from pendulum_bags.runs.read_recording import read_recording

    recording = read_recording(shared_data / "dfki_torque_limited_simple_pendulum" / "ddp_measured.csv")
    plant = pendulum_plant(inertia=0.1495, damping=0.1, gravity=0.3055 * 9.81, coulomb_friction=0.093)
    assert window_score(plant, recording).rms == pytest.approx(0.038, rel=0.1)
