"""The nu-gap, margins and certificates against closed forms, an optimal controller, and loops known to fail."""

import json
import math

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.design_command.design_cli import main as design
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_lqr.responses.certificate import Certifier, is_stable
from pendulum_lqr.responses.gap_metric import (
    Scaling,
    chordal_distance,
    loop_distance,
    nu_gap,
    pointwise_margin,
    winding_number,
)
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import MeasuredResponse, read_response, write_response
from pendulum_lqr.responses.sampled_response import brought_to, model_response
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant

OMEGA = np.concatenate([[0.0], np.logspace(-4, 5, 4000)])
S = 1j * OMEGA


@pytest.mark.parametrize(
    ("first", "second", "unstable", "expected"),
    [
        # Constants: |a - b| / sqrt((1 + a^2)(1 + b^2)).
        (2.0 + 0.0 * S, 0.5 + 0.0 * S, (0, 0), 1.5 / (math.sqrt(5.0) * math.sqrt(1.25))),
        # Largest at zero frequency: e / sqrt(1 + e^2) with 1/s seen from infinity.
        (1.0 / (S + 1e-9), 1.0 / (S + 0.3), (0, 0), 0.3 / math.sqrt(1.09)),
        # Zhou and Doyle, Essentials of Robust Control, 1998, section 17.2: an unstable plant close to a stable one.
        (100.0 / (2.0 * S + 1.0), 100.0 / (2.0 * S - 1.0), (0, 1), 200.0 / 10001.0),
        (100.0 / (2.0 * S - 1.0), 100.0 / (2.0 * S + 1.0), (1, 0), 200.0 / 10001.0),
        # kappa is small everywhere, but the winding number condition fails: counted as poles that they have not.
        (100.0 / (2.0 * S + 1.0), 100.0 / (2.0 * S - 1.0), (0, 0), 1.0),
        ((S - 1.0) / (S + 1.0), (2.0 * S - 1.0) / (S + 1.0), (0, 0), 1.0 / math.sqrt(10.0)),
        (1.0 / (S - 1.0), 1.0 / (S - 1.5), (1, 1), 0.5 / (math.sqrt(2.0) * math.sqrt(3.25))),
    ],
)
def test_the_nu_gap_has_its_closed_form(first, second, unstable, expected):
    assert nu_gap(first, second, unstable=unstable).value == pytest.approx(expected, abs=1e-6)


def test_the_winding_number_counts_turns_of_the_whole_curve():
    # (s - 1)/(s + 1) goes once round 0 as frequency runs from -infinity to infinity, clockwise.
    assert winding_number((S - 1.0) / (S + 1.0)) == -1
    assert winding_number((S + 2.0) / (S + 1.0)) == 0
    assert winding_number(((S + 1.0) / (S - 1.0)) ** 2) == 2


@given(st.lists(st.complex_numbers(max_magnitude=1e3, allow_nan=False), min_size=6, max_size=6))
@settings(deadline=None)
def test_the_chordal_distance_is_a_metric_and_never_exceeds_one(values):
    a, b, c = (np.array(values[i : i + 2])[:, None] for i in (0, 2, 4))
    ab, bc, ac = (float(chordal_distance(x, y)[0]) for x, y in ((a, b), (b, c), (a, c)))
    assert 0.0 <= ab <= 1.0
    assert ab == pytest.approx(float(chordal_distance(b, a)[0]), abs=1e-12)
    assert ac <= ab + bc + 1e-9
    # The angle between the two graphs, by an independent route.
    graphs = [np.vstack([[[1.0]], x]) for x in (a, b)]
    angle = scipy.linalg.subspace_angles(*graphs)[0]
    assert ab == pytest.approx(math.sin(angle), abs=1e-6)


def test_the_optimal_controller_has_the_optimal_margin_and_no_other_has_more():
    # b_opt = 1/sqrt(1 + rho(X Z)) of Glover and McFarlane, 1989, from two Riccati equations.
    scaling = Scaling(0.03, 1e9, 1.0)
    model = linearise(load_plant("dfki"))
    A, B, C = model.A, model.B * scaling.torque, np.array([[1.0 / scaling.angle, 0.0]])
    X = scipy.linalg.solve_continuous_are(A, B, C.T @ C, np.eye(1))
    Z = scipy.linalg.solve_continuous_are(A.T, C.T, B @ B.T, np.eye(1))
    best = 1.0 / math.sqrt(1.0 + float(np.max(np.linalg.eigvals(X @ Z).real)))
    # The controller that reaches it, for u = K y: Skogestad and Postlethwaite, 2nd ed., 2005, eq. 9.75.
    gamma = 1.0005 / best
    L = (1.0 - gamma**2) * np.eye(2) + X @ Z
    Bk = gamma**2 * np.linalg.solve(L.T, Z @ C.T)
    Ak = A - B @ B.T @ X + Bk @ C
    omega = OMEGA[:3600]
    optimal = np.array([(B.T @ X @ np.linalg.solve(1j * w * np.eye(2) - Ak, Bk))[0, 0] for w in omega])
    plant = scaling.plant(model_response(linearise(load_plant("dfki")), omega / (2.0 * np.pi)))
    margin = pointwise_margin(plant, np.vstack([-optimal, 0.0 * optimal]))
    assert float(margin.min()) == pytest.approx(best, rel=2e-3)
    # Such a controller makes rho nearly flat; other ones have less somewhere.
    for k0, lead in ((15.0, 0.5), (30.0, 0.3), (60.0, 0.1)):
        filtered = k0 * (1.0 + lead * 1j * omega) / (1.0 + 0.005j * omega)
        assert pointwise_margin(plant, scaling.controller(np.vstack([filtered, 0.0 * filtered]))).min() < best


def test_the_loop_distance_is_the_best_of_all_weights():
    generator = np.random.default_rng(0)
    one = generator.normal(size=200) + 1j * generator.normal(size=200)
    two = generator.normal(size=200) + 1j * generator.normal(size=200)
    best = np.full(200, np.inf)
    for weight in np.logspace(-4, 4, 400):
        ratio = chordal_distance(weight * one, weight * two) / pointwise_margin(
            weight * one, np.full(200, 1.0 / weight)
        )
        best = np.minimum(best, ratio)
    safe = loop_distance(one, two) < 1.0
    np.testing.assert_array_equal(safe, best < 1.0)
    assert 0.2 < safe.mean() < 0.8
    # A disc counts with its worst loop.
    radius = 0.2
    worst = np.max([loop_distance(one, two + radius * np.exp(1j * a)) for a in np.linspace(0, 2 * np.pi, 400)], axis=0)
    assert np.all(loop_distance(one, two, radius) >= worst - 1e-3)


def exact(plant: PlantParameters, period: float = 0.01, lines: int = 60, error: float = 1e-3) -> MeasuredResponse:
    """Return a measurement of a plant whose errors are as good as none."""
    frequency = np.geomspace(0.25, 0.475 / period, lines)
    response = model_response(linearise(plant), frequency, period)
    n = frequency.size
    return MeasuredResponse(
        "hw",
        period,
        frequency,
        response,
        error * np.abs(response),
        np.ones((2, n)),
        np.ones(n, dtype=complex),
        10.0,
    )


def test_the_sampled_response_is_that_of_a_simulation_sample_by_sample():
    plant = linearise(load_plant("dfki").with_values(transport_delay=0.004, actuator_time_constant=0.003))
    period, size = 0.01, 500
    # A periodic torque, its steady response by brute force: fine steps of the continuous equations under the hold.
    frequency = np.array([3.0, 17.0, 44.0])
    P = model_response(plant, frequency, period)
    fine, A, B = 200, plant.A, plant.B[:, 0]
    step = period / fine
    phi = scipy.linalg.expm(A * step)
    gamma = np.linalg.solve(A, (phi - np.eye(3)) @ B)
    late = round(plant.delay / step)
    for f, expected in zip(frequency, P.T, strict=True):
        u = np.cos(2.0 * np.pi * f * period * np.arange(size))
        held = np.concatenate([np.zeros(late), np.repeat(u, fine)])[: fine * size]
        # Upright is unstable: the bounded solution is that whose growing part is traced back from the end.
        values, vectors = np.linalg.eig(phi)
        modal = np.linalg.solve(vectors, gamma)
        z = np.zeros((3, fine * size + 1), dtype=complex)
        for mode in range(3):
            if abs(values[mode]) < 1.0:
                for k in range(fine * size):
                    z[mode, k + 1] = values[mode] * z[mode, k] + modal[mode] * held[k]
            else:
                for k in range(fine * size - 1, -1, -1):
                    z[mode, k] = (z[mode, k + 1] - modal[mode] * held[k]) / values[mode]
        x = (vectors @ z)[:2, ::fine].real
        middle = slice(200, 300)
        basis = np.exp(2j * np.pi * f * period * np.arange(200, 300))
        got = 2.0 * np.mean(x[:, middle] * np.conj(basis), axis=1)
        np.testing.assert_allclose(got, expected, rtol=0.02)


def test_a_response_can_be_brought_to_another_rate():
    plant, wrong = load_plant("dfki"), load_plant("dfki").with_values(inertia=0.16, damping=0.12)
    frequency = np.geomspace(0.25, 40.0, 30)
    fast = model_response(linearise(plant), frequency, 0.002)
    slow = model_response(linearise(plant), frequency, 0.01)
    # A model that is 7 % off serves: the change of hold and folding is nearly that of any such plant.
    moved = brought_to(fast, linearise(wrong), frequency, measured=0.002, period=0.01)
    np.testing.assert_allclose(moved, slow, rtol=2e-3)
    assert np.max(np.abs(fast / slow - 1.0)) > 0.5


def test_a_design_is_certified_for_a_close_machine_and_not_for_one_that_it_does_not_stabilise():
    base = load_plant("dfki")
    near, far = base.with_values(transport_delay=0.004), base.with_values(transport_delay=0.06)
    K = np.array([20.0, 3.0])
    assert is_stable(discretise(linearise(base), 0.01), K)
    assert not is_stable(discretise(linearise(far), 0.01), K)
    certificates = [Certifier(linearise(base), Machine.of(exact(plant))).gain(K) for plant in (base, near, far)]
    assert [c.certified for c in certificates] == [True, True, False]
    assert certificates[0].distance < certificates[1].distance < 1.0 < certificates[2].distance
    # A gain that does not even hold the pendulum on the model is certified for nothing.
    weak = Certifier(linearise(base), Machine.of(exact(base))).gain([2.0, 3.0])
    assert not weak.stable_on_model
    assert not weak.certified


def test_a_gain_that_fails_below_the_lowest_line_is_not_certified():
    # The machine is heavier than the gain can hold; on every measured line its loop looks fine.
    base, heavy = load_plant("dfki"), load_plant("dfki").with_values(gravity=3.5)
    K = np.array([3.3, 8.0])
    assert is_stable(discretise(linearise(base), 0.01), K)
    assert not is_stable(discretise(linearise(heavy), 0.01), K)
    found = Certifier(linearise(base), Machine.of(exact(heavy))).gain(K)
    assert not found.certified
    assert not found.undecided


def test_a_measurement_that_tells_little_certifies_little():
    base = load_plant("dfki")
    K = np.array([20.0, 3.0])
    rough, fine = (Certifier(linearise(base), Machine.of(exact(base, error=error))).gain(K) for error in (0.3, 1e-3))
    assert not rough.certified
    # It is the measurement that is to blame, and says so; a design that fails on the machine is another matter.
    assert rough.undecided
    assert not fine.undecided
    far = Certifier(linearise(base), Machine.of(exact(base.with_values(transport_delay=0.06)))).gain(K)
    assert not far.certified
    assert not far.undecided


def test_no_certified_gain_fails_on_any_of_many_machines():
    generator = np.random.default_rng(7)
    base = load_plant("dfki")
    counts = {"certified": 0, "failed": 0, "stable": 0}
    for _ in range(10):
        gain, damping, delay = (
            generator.uniform(0.8, 1.25),
            generator.uniform(0.5, 2.0),
            generator.uniform(0.0, 0.012),
        )
        plant = base.with_values(
            inertia=base.inertia / gain,
            damping=damping * base.damping,
            gravity=base.gravity / gain,
            transport_delay=delay,
        )
        certifier = Certifier(linearise(base), Machine.of(exact(plant, lines=28)))
        for _ in range(30):
            K = np.exp([generator.uniform(0.9, 5.0), generator.uniform(-2.0, 2.0)])
            stable = is_stable(discretise(linearise(plant), 0.01), K)
            certified = certifier.gain(K).certified
            counts["certified"] += certified
            counts["stable"] += stable
            counts["failed"] += certified and not stable
    assert counts["failed"] == 0
    assert counts["certified"] > 0.7 * counts["stable"] > 50


def test_a_response_survives_its_file(tmp_path):
    measured = exact(load_plant("thesis"))
    write_response(tmp_path / "hw_response.json", measured)
    again = read_response(tmp_path)
    np.testing.assert_array_equal(again.response, measured.response)
    np.testing.assert_array_equal(again.radius(), measured.radius())
    (tmp_path / "other.json").write_text('{"format": "pendulum_plant/1"}')
    with pytest.raises(DataError, match=r"other.json: format is 'pendulum_plant/1'; expected"):
        read_response(tmp_path / "other.json")
    with pytest.raises(DataError, match="cannot be read"):
        read_response(tmp_path / "none.json")


def test_design_says_which_rows_are_certified_for_a_machine(tmp_path, capsys):
    write_response(tmp_path / "hw_response.json", exact(load_plant("dfki").with_values(transport_delay=0.03)))
    asked = ["--preset", "dfki", "--q", "10,1", "--q", "100000,1", "--r", "1", "--machine", str(tmp_path)]
    assert design([*asked, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["machine"]["rows"]
    assert [row["certified"] for row in rows] == [True, False]
    assert design(asked) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Certified for this machine" in text
    assert "dry friction at rest are outside the certificate" in text
    assert design([*asked, "--theta", "0"]) == 2
    assert "was measured upright" in " ".join(capsys.readouterr().err.split())


def test_scales_of_zero_are_refused():
    with pytest.raises(ParameterError, match=r"scale of angle is 0.0 rad; expected a finite value > 0"):
        Scaling(angle=0.0)
