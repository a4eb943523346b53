"""The proven part of the region of attraction against simulation, and its limits."""

import math

import numpy as np
import pytest

from pendulum_lqr.design_command.figures import phase_portrait_figure, region_to_show
from pendulum_lqr.linear.design import DesignError, continuous_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.roa import proven_level, region_of_attraction, rigid_rollout, sublevel_ellipse
from pendulum_msgs_py.plants.plant_parameters import load_plant

THESIS = load_plant("thesis")
DFKI = load_plant("dfki")
CASES = [
    (DFKI, (10.0, 1.0), 1.0, 1.5),
    (DFKI, (1.0, 1.0), 10.0, 1.5),
    (DFKI, (100.0, 1.0), 0.1, 1.5),
    (THESIS, (100.0, 0.01), 0.1, 13.0),
]


@pytest.mark.parametrize(("plant", "q", "r", "limit"), CASES)
def test_every_sample_of_the_proven_set_is_attracted(plant, q, r, limit):
    gain = continuous_lqr(linearise(plant), q, r)
    level = proven_level(plant, gain, limit)
    assert level > 0.0
    rng = np.random.default_rng(0)
    ellipse = sublevel_ellipse(gain.S, level, 201)
    starts = np.vstack([0.999 * ellipse, ellipse * np.sqrt(rng.uniform(0.0, 1.0, (201, 1)))])
    duration = min(20.0, 14.0 / -gain.poles[0].real)
    angle, velocity = rigid_rollout(plant, gain, limit, duration)(starts[:, 0], starts[:, 1])
    assert np.max(np.abs(angle)) < 0.02
    assert np.max(np.abs(velocity)) < 0.1


@pytest.mark.parametrize(("plant", "q", "r", "limit"), CASES)
def test_the_lyapunov_function_falls_everywhere_in_the_proven_set_and_not_far_beyond(plant, q, r, limit):
    gain = continuous_lqr(linearise(plant), q, r)
    level = proven_level(plant, gain, limit)

    def largest_rate(scale):
        x, v = math.sqrt(scale) * sublevel_ellipse(gain.S, level, 20001).T
        u = np.clip(-gain.K[0] * x - gain.K[1] * v, -limit, limit)
        acceleration = (u - plant.damping * v + plant.gravity * np.sin(x)) / plant.inertia
        slope = 2.0 * (gain.S @ np.vstack([x, v]))
        return float(np.max(slope[0] * v + slope[1] * acceleration))

    assert all(largest_rate(scale) < 0.0 for scale in (0.01, 0.1, 0.5, 0.9, 1.0))
    if plant is DFKI:
        # The bound is not wasteful: 2 % further out the function rises somewhere.
        assert largest_rate(1.02) > 0.0


def test_a_larger_limit_proves_a_larger_set():
    gain = continuous_lqr(linearise(DFKI), (10.0, 1.0), 1.0)
    levels = [proven_level(DFKI, gain, limit) for limit in (0.5, 1.5, 3.0)]
    assert levels == sorted(levels)
    assert levels[0] < levels[-1]


def test_offsets_of_angle_and_torque_count_in_what_is_proven():
    def level(plant, theta):
        return proven_level(plant, continuous_lqr(linearise(plant, theta), (10.0, 1.0), 1.0), 1.5, theta)

    straight = level(DFKI, math.pi)
    turned = DFKI.with_values(angle_offset=0.1)
    assert level(turned, math.pi + 0.1) == pytest.approx(straight, rel=1e-6)
    assert level(turned, math.pi) < 0.99 * straight
    # Torque that stands against an offset is torque that is not there to catch with.
    assert level(DFKI.with_values(torque_offset=0.5), math.pi) < 0.99 * straight


def test_the_proven_set_never_reaches_around_the_circle():
    gain = continuous_lqr(linearise(DFKI), (10.0, 1.0), 1.0)
    level = proven_level(DFKI, gain, 1e6)
    assert np.max(np.abs(sublevel_ellipse(gain.S, level)[:, 0])) <= math.pi + 1e-9


def test_a_limit_of_zero_is_refused():
    gain = continuous_lqr(linearise(DFKI), (10.0, 1.0), 1.0)
    with pytest.raises(DesignError, match=r"effort_limit is 0\.0 N m; expected > 0"):
        proven_level(DFKI, gain, 0.0)


def test_a_weak_motor_on_the_overdamped_plant_reaches_as_far_as_its_torque_holds_the_weight():
    # Without speed worth the name, 1 N m wins wherever it exceeds G sin(theta): up to asin(1 / 1.678) = 0.638 rad.
    gain = continuous_lqr(linearise(THESIS), (100.0, 0.01), 0.1)
    region = region_to_show(THESIS, linearise(THESIS), gain, 1.0, points=11)
    edge = math.asin(1.0 / THESIS.gravity)
    # At a velocity of zero, in the middle; what lies at the edge itself falls too slowly to tell.
    clear = np.abs(np.abs(region.angles) - edge) > 0.01
    assert region.velocities[5] == pytest.approx(0.0)
    assert region.attracted[5][clear].tolist() == (np.abs(region.angles[clear]) < edge).tolist()
    assert region.attracted[5].sum() > 2
    figure = phase_portrait_figure(THESIS, gain, 1.0, region)
    assert "torque limit 1 N m" in " ".join(label.get_text() for label in figure.axes[0].get_legend().get_texts())
    angles = np.array([0.5 * edge, edge - 0.01, edge + 0.01, 2.0 * edge])
    end, _ = rigid_rollout(THESIS, gain, 1.0, 70.0)(angles, np.zeros(4))
    assert (np.abs(end) < 0.05).tolist() == [True, True, False, False]


def test_sampling_through_the_batch_engine_of_the_simulator_contains_the_proven_set():
    from pendulum_sim.batches.batch import simulate_batch

    smooth = DFKI.with_values(coulomb_friction=0.0, static_friction=0.0)
    gain = continuous_lqr(linearise(smooth), (10.0, 1.0), 1.0)

    def rollout(angle, velocity):
        end = simulate_batch(
            smooth,
            steps=3000,
            dt=2e-3,
            position=angle + math.pi,
            velocity=velocity,
            gain=gain.K,
        )
        return end.position[:, 0] - math.pi, end.velocity[:, 0]

    region = region_of_attraction(smooth, gain, 1.5, rollout, velocity_span=10.0, points=41)
    assert region.counterexamples() == 0
    proven = math.pi * region.level / math.sqrt(np.linalg.det(region.S))
    assert 0.0 < proven < region.area
    assert region.attracted[20, 20]
    assert not region.attracted[20, 0]
    own = region_of_attraction(smooth, gain, 1.5, rigid_rollout(smooth, gain, 1.5, 6.0), velocity_span=10.0, points=41)
    # Two integrators, one region: only cells on its rim may differ.
    assert np.mean(own.attracted != region.attracted) < 0.01
