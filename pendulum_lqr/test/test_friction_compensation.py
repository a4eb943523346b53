"""LQR with dry friction fed forward: nearer to the set-point, and safe where friction is not what was thought."""

import numpy as np
import pytest

from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.linear.analysis import delayed_spectral_radius
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.linear.model import linearise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant

DFKI = load_plant("dfki")
X5_9 = load_plant("x5_9")
LATE = DFKI.with_values(transport_delay=0.01, angle_offset=0.02, torque_offset=0.05)


@pytest.mark.parametrize("plant", [DFKI, LATE], ids=["dfki", "dfki with offsets and delay"])
@pytest.mark.parametrize("set_point", [0.0, 0.3])
def test_it_rests_nearer_to_its_set_point_than_plain_lqr(plant, set_point, simulate):
    rest = {}
    for name in ("lqr", "lqr_friction"):
        controller = make_controller(name, plant, 0.005, {"set_point": set_point})
        run = simulate(plant, controller, theta=UPRIGHT + set_point + 0.04, duration=4.0, period=0.005)
        rest[name] = abs(run.angle[-1] - set_point)
    assert rest["lqr"] > 1e-3
    assert rest["lqr_friction"] < 0.35 * rest["lqr"]


@pytest.mark.parametrize("plant", [DFKI, LATE, X5_9], ids=["dfki", "dfki with offsets and delay", "x5_9"])
@pytest.mark.parametrize("share", [0.0, 0.5, 2.0])
def test_friction_that_is_not_what_was_identified_makes_no_limit_cycle(plant, share, simulate):
    controller = make_controller("lqr_friction", plant, 0.005, {"share": 0.95})
    friction = share * plant.coulomb_friction
    real = plant.with_values(coulomb_friction=friction, static_friction=friction)
    run = simulate(real, controller, theta=UPRIGHT + 0.03, duration=5.0, period=0.005)
    assert np.ptp(run.angle[-100:]) < 1e-4
    assert np.ptp(run.effort[-100:]) < 0.02


def test_the_loop_is_stable_with_every_spring_that_the_compensation_can_be():
    for plant, period in ((DFKI, 0.002), (DFKI, 0.02), (LATE, 0.01), (X5_9, 0.005)):
        controller = make_controller("lqr_friction", plant, period)
        k0, k1 = controller.gain.K
        steepest = controller.friction / controller.width
        assert steepest > 0.0
        for extra in np.linspace(0.0, 2.0 * (k0 + steepest) - k0, 50):
            assert delayed_spectral_radius(linearise(plant), (k0 + extra, k1), period) < 1.0


def test_it_never_gives_more_than_the_friction_beside_the_feedback_and_nothing_at_the_set_point():
    plain, paid = (make_controller(name, DFKI, 0.005, {"set_point": 0.1}) for name in ("lqr", "lqr_friction"))
    assert paid.command(0.0, (0.1, 0.0)) == plain.command(0.0, (0.1, 0.0))
    for angle in np.linspace(0.07, 0.13, 31):
        added = paid.command(0.0, (angle, 0.2)) - plain.command(0.0, (angle, 0.2))
        assert abs(added) <= 0.8 * DFKI.coulomb_friction + 1e-12
        assert added * (angle - 0.1) <= 1e-12


def test_without_friction_it_is_the_lqr():
    smooth = DFKI.with_values(coulomb_friction=0.0)
    plain, paid = (make_controller(name, smooth, 0.005) for name in ("lqr", "lqr_friction"))
    assert [paid.command(0.0, x) for x in ((0.02, 0.1), (-0.01, 0.3))] == [
        plain.command(0.0, x) for x in ((0.02, 0.1), (-0.01, 0.3))
    ]
    assert "no dry friction" in paid.describe()


def test_a_compensation_that_is_not_safe_is_refused():
    with pytest.raises(ParameterError, match=r"share is 1\.0"):
        make_controller("lqr_friction", DFKI, 0.005, {"share": 1.0})
    with pytest.raises(DesignError, match=r"width is 1e-05 rad: .*unstable with a period of 0\.01 s"):
        make_controller("lqr_friction", DFKI, 0.01, {"width": 1e-5})
    assert make_controller("lqr_friction", DFKI, 0.01, {"width": 0.01}).width == 0.01
    sticky = DFKI.with_values(coulomb_friction=1.2)
    with pytest.raises(DesignError, match=r"friction to compensate is 0\.96 N m, more than half of the effort_limit"):
        make_controller("lqr_friction", sticky, 0.005)
    with pytest.raises(DesignError, match=r"loop (bears no compensation|unstable)|makes the loop unstable"):
        make_controller("lqr_friction", DFKI.with_values(transport_delay=0.045), 0.005)
