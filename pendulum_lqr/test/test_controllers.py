"""Every controller behind the one interface."""

import math
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.controller_interface import controller as registry
from pendulum_lqr.controller_interface.controller import (
    COMMON_PARAMETERS,
    BaseController,
    controller_class,
    controller_names,
    controller_parameters,
    make_controller,
)
from pendulum_lqr.controller_interface.interface import unwrapped
from pendulum_lqr.controllers.nmpc import NonlinearMpc
from pendulum_lqr.controllers.playback import Playback
from pendulum_lqr.disturbances.disturbance import make_disturbance
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_testing.policies import random_policy

THESIS = load_plant("thesis")
DFKI = load_plant("dfki")
BALANCING = ("lqr", "lqi", "lqg", "lqr_friction", "discrete_lqr", "pid", "pd_gravity", "mpc", "sliding_mode")
SWINGING = ("energy_swing_up", "time_optimal", "tvlqr", "nmpc")


@pytest.fixture(scope="module")
def playback_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("playback") / "torque.csv"
    path.write_text("time,effort\n0.0,0.5\n0.1,-0.5\n0.2,99.0\n")
    return path


def design(name, plant, playback_file, period=0.01, **values):
    if name == "playback":
        values["file"] = str(playback_file)
    if name == "policy":
        values["policy"] = str(write_policy(playback_file.with_name("policy.npz"), random_policy(plant)))
    return make_controller(name, plant, period, values)


def test_playback_refuses_an_angle_to_hold(playback_file):
    with pytest.raises(DataError, match=r"set_point is 0\.3 rad; expected 0: a recorded torque aims at no angle"):
        design("playback", load_plant("dfki"), playback_file, set_point=0.3)


@pytest.mark.parametrize("name", controller_names())
def test_every_controller_answers_within_its_limit_and_repeats_itself_after_a_reset(name, playback_file):
    controller = design(name, DFKI, playback_file, effort_limit=1.2)
    assert controller.effort_limits == (1.2,)
    rng = np.random.default_rng(3)
    states = rng.uniform([-math.pi, -8.0], [math.pi, 8.0], (6, 2))
    states[0] = (-math.pi, 0.0)
    answers = []
    for _ in range(2):
        controller.reset()
        answers.append([controller.command(0.01 * k, tuple(x)) for k, x in enumerate(states)])
    assert answers[0] == answers[1]
    assert all(isinstance(u, float) and abs(u) <= 1.2 for u in answers[0])
    assert controller.describe()


@pytest.mark.parametrize("name", controller_names())
def test_every_controller_has_a_summary_and_documented_parameters(name):
    kind = controller_class(name)
    assert kind.SUMMARY
    names = [spec.name for spec in controller_parameters(name)]
    assert len(names) == len(set(names))
    assert all(spec.description.endswith(".") for spec in controller_parameters(name))


@pytest.mark.parametrize("name", BALANCING)
def test_every_balancing_controller_returns_the_thesis_plant_to_upright(name, simulate, playback_file):
    run = simulate(THESIS, design(name, THESIS, playback_file), theta=math.pi + 0.2, duration=8.0)
    assert abs(run.angle[-1]) < 5e-3
    assert abs(run.velocity[-1]) < 5e-3


@pytest.mark.parametrize("name", BALANCING)
def test_every_balancing_controller_reaches_a_set_point_beside_upright(name, simulate, playback_file):
    controller = design(name, THESIS, playback_file, set_point=0.2)
    run = simulate(THESIS, controller, theta=math.pi, duration=8.0)
    assert run.angle[-1] == pytest.approx(0.2, abs=6e-3)


@pytest.mark.parametrize("name", ["lqi", "pid"])
def test_integral_action_removes_the_offset_of_a_constant_torque(name, simulate, playback_file):
    load = make_disturbance({"kind": "step", "amplitude": 1.0})
    offset = {}
    for kind in ("lqr", name):
        run = simulate(
            THESIS,
            design(kind, THESIS, playback_file),
            theta=math.pi,
            duration=25.0,
            period=0.02,
            disturbance=load,
        )
        offset[kind] = abs(run.angle[-1])
    # LQR alone gives way by d / (K1 - G).
    assert offset["lqr"] == pytest.approx(1.0 / (33.345 - 1.678), rel=1e-2)
    assert offset[name] < 1e-3


def test_the_response_to_the_thesis_noise_held_for_10_ms_is_that_of_the_thesis_at_100_hz(simulate):
    peaks, angles, velocities = [], [], []
    for seed in range(20):
        noise = make_disturbance({"seed": seed, "amplitude": 2.5, "hold_time": 0.01})
        run = simulate(THESIS, make_controller("lqr", THESIS, 0.01), theta=math.pi, disturbance=noise)
        peaks.append(np.abs(run.effort).max())
        angles.append(run.angle.std())
        velocities.append(run.velocity.std())
    # Reference over 200 seeds: 0.460 (0.344 to 0.605) N m, 0.00479 rad, 0.100 rad/s.
    assert np.median(peaks) == pytest.approx(0.460, abs=0.06)
    assert np.mean(angles) == pytest.approx(0.00479, rel=0.15)
    assert np.mean(velocities) == pytest.approx(0.100, rel=0.1)


def test_lqr_is_the_law_of_the_thesis():
    controller = make_controller("lqr", THESIS, 0.01)
    assert controller.command(0.0, (0.1, 0.2)) == pytest.approx(-(33.345265 * 0.1 + 0.158993 * 0.2), abs=1e-6)


def test_lqr_takes_the_short_way_round():
    controller = make_controller("lqr", THESIS, 0.01, {"set_point": 3.0})
    # From -3.0 rad the set-point lies 0.28 rad further backwards, across the wrap.
    deviation = controller.command(0.0, (-3.0, 0.0)) - THESIS.gravity * math.sin(math.pi + 3.0)
    gain = -deviation / (2 * math.pi - 6.0)
    assert 0.0 < gain < 100.0


@given(st.floats(-math.pi, math.pi), st.floats(-50.0, 50.0))
@settings(deadline=None, max_examples=50)
def test_simple_controllers_answer_any_state_within_the_limit(angle, velocity):
    for name in ("lqr", "lqi", "lqg", "discrete_lqr", "pd_gravity", "sliding_mode", "energy_swing_up"):
        controller = _cached(name)
        controller.reset()
        assert abs(controller.command(0.0, (angle, velocity))) <= DFKI.effort_limit


_CACHE: dict[str, BaseController] = {}


def _cached(name):
    return _CACHE.setdefault(name, make_controller(name, DFKI, 0.01))


def test_unlimited_mpc_is_the_discrete_lqr_and_limited_mpc_keeps_the_limit():
    lqr = make_controller("discrete_lqr", THESIS, 0.01)
    mpc = make_controller("mpc", THESIS, 0.01)
    for x in ((0.01, 0.1), (0.1, -1.0), (-0.2, 0.5)):
        assert mpc.command(0.0, x) == pytest.approx(lqr.command(0.0, x), abs=1e-4)
    # Over a horizon in which the plant alone would have grown by 10^5, and the more so at a slow rate.
    dfki = load_plant("dfki")
    for period in (0.01, 0.05):
        far, near = (make_controller("mpc", dfki, period, {"horizon": horizon}) for horizon in (200, 5))
        assert far.command(0.0, (0.01, 0.02)) == pytest.approx(near.command(0.0, (0.01, 0.02)), abs=1e-6)
        strong = (0.3, 0.5)
        assert abs(far.command(0.0, strong)) <= dfki.effort_limit
    tight = make_controller("mpc", THESIS, 0.01, {"effort_limit": 2.0})
    assert tight.command(0.0, (0.3, 0.0)) == pytest.approx(-2.0, abs=1e-4)


@pytest.mark.parametrize(("name", "answered"), [("mpc", "the LQR"), ("nmpc", "the last plan")])
def test_where_a_solver_finds_no_plan_the_user_is_informed(
    name: str, answered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = make_controller(name, DFKI, 0.01)
    controller = unwrapped(told)
    assert told.notice == ""
    if isinstance(controller, NonlinearMpc):
        monkeypatch.setattr(controller, "_solver", lambda **given: {"x": np.full_like(given["x0"], np.nan)})
    else:
        monkeypatch.setattr(controller._program, "first", lambda *_: None)
    for _ in range(2):
        assert abs(told.command(0.0, (0.3, 0.0))) <= DFKI.effort_limit
    assert told.notice == f"no plan for 2 states: {answered} answered"


def test_mpc_keeps_the_angle_within_its_soft_limit_where_lqr_does_not(simulate):
    strong = DFKI.with_values(effort_limit=10.0)
    values = {"q": [1.0, 0.01], "r": 1.0}
    start = {"theta": math.pi + 0.15, "theta_dot": 1.5, "duration": 3.0}
    lqr = simulate(strong, make_controller("lqr", strong, 0.01, values), **start)
    limited = make_controller("mpc", strong, 0.01, {**values, "horizon": 40, "angle_limit": 0.2})
    mpc = simulate(strong, limited, **start)
    assert lqr.angle.max() > 0.23
    assert mpc.angle.max() < 0.21


def test_delay_compensation_beats_plain_lqr_on_a_delayed_plant(simulate):
    delayed = DFKI.with_values(transport_delay=0.06, effort_limit=10.0)
    weights = {"q": [100.0, 0.01], "r": 0.1}
    told = r"lqr makes the loop unstable with a period of 0\.01 s, a delay of 0\.06 s"
    with pytest.raises(ParameterError, match=told):
        make_controller("lqr", delayed, 0.01, weights)
    believed = delayed.with_values(transport_delay=0.0)
    plain = simulate(delayed, make_controller("lqr", believed, 0.01, weights), theta=math.pi + 0.1)
    aware = simulate(delayed, make_controller("discrete_lqr", delayed, 0.01, weights), theta=math.pi + 0.1)
    assert not abs(plain.angle[-100:]).max() < 0.05
    assert abs(aware.angle[-100:]).max() < 0.01


def test_pid_does_not_wind_up(simulate):
    controller = make_controller("pid", THESIS, 0.01, {"effort_limit": 3.0})
    run = simulate(THESIS.with_values(effort_limit=3.0), controller, theta=math.pi + 1.2, duration=10.0)
    assert np.abs(run.effort).max() == 3.0
    assert run.angle.min() > -0.2


@pytest.mark.parametrize("plant", [THESIS, DFKI], ids=lambda plant: plant.name)
def test_numerical_tuning_finds_a_minimum_of_the_cost(plant):
    from pendulum_lqr.linear.model import linearise
    from pendulum_lqr.linear.tuning import PidGains, pid_cost, tune_numerically

    model = linearise(plant)
    arguments = (0.01, 0.02, (100.0, 0.01), 0.1)
    best = tune_numerically(model, *arguments)
    least = pid_cost(model, best, *arguments)
    for factors in (
        (1.1, 1.0, 1.0),
        (0.9, 1.0, 1.0),
        (1.0, 1.2, 1.0),
        (1.0, 0.8, 1.0),
        (1.0, 1.0, 1.1),
        (1.0, 1.0, 0.9),
    ):
        other = PidGains(best.kp * factors[0], best.ki * factors[1], best.kd * factors[2])
        assert pid_cost(model, other, *arguments) >= least * (1.0 - 1e-6)


def test_ziegler_nichols_starts_from_the_gain_at_which_the_sampled_loop_oscillates():
    from pendulum_lqr.linear.model import linearise
    from pendulum_lqr.linear.tuning import ultimate_gain, ziegler_nichols

    gain, oscillation = ultimate_gain(linearise(DFKI), 0.01)
    gains = ziegler_nichols(linearise(DFKI), 0.01)
    assert gains.kp == pytest.approx(0.6 * gain)
    assert gains.kp / gains.ki == pytest.approx(0.5 * oscillation)
    with pytest.raises(ParameterError, match="make the loop unstable"):
        make_controller("pid", THESIS, 0.01, {"tuning": "ziegler_nichols"})


@pytest.mark.parametrize("name", ["lqi", "pid", "lqg", "discrete_lqr"])
def test_a_change_while_running_does_not_forget_what_was_learnt(name, simulate):
    load = make_disturbance({"kind": "step", "amplitude": 1.0})
    first = make_controller(name, THESIS, 0.01)
    simulate(THESIS, first, theta=math.pi, duration=20.0, disturbance=load)
    second = make_controller(name, THESIS, 0.01)
    second.carry_over(first)
    x = (0.01, 0.0)
    assert second.command(20.0, x) == pytest.approx(first.command(20.0, x), rel=1e-9)


def test_estimated_velocity_is_carried_over():
    first = make_controller("lqr", THESIS, 0.01, {"velocity": "filtered_difference"})
    for k in range(50):
        first.command(0.01 * k, (0.001 * k, 99.0))
    second = make_controller("lqr", THESIS, 0.01, {"velocity": "filtered_difference"})
    second.carry_over(first)
    assert second.command(0.5, (0.05, 99.0)) == pytest.approx(-(33.345265 * 0.05 + 0.158993 * 0.1), abs=1e-3)


def test_playback_holds_each_torque_until_the_next_and_is_silent_after_the_end(playback_file):
    controller = design("playback", DFKI, playback_file)
    times = (-0.01, 0.0, 0.05, 0.1, 0.1999, 0.2, 0.29, 0.31)
    assert [controller.command(t, (0.0, 0.0)) for t in times] == [0.0, 0.5, 0.5, -0.5, -0.5, 1.5, 1.5, 0.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,effort\n0,1\n", "has 1 samples; expected at least 2"),
        ("time,effort\n0,1\nx,2\n", r"torque.csv:3: 'x,2'; expected time"),
        ("time,effort\n0,1\n0,2\n", r"playback time 0\.0 s follows 0\.0 s; expected increasing times"),
        ("time,effort\n0,1\n1,nan\n", "not finite"),
    ],
)
def test_a_bad_playback_file_is_refused_with_its_line(tmp_path, text, message):
    path = tmp_path / "torque.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        make_controller("playback", DFKI, 0.01, {"file": str(path)})


def test_playback_without_a_file_is_refused():
    with pytest.raises(DataError, match="file is empty; expected the path of a CSV"):
        make_controller("playback", DFKI, 0.01)
    with pytest.raises(DataError, match=r"expected equal \(n,\)"):
        Playback([0.0, 1.0], [0.0], 1.0)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("lrq", {}, "controller is 'lrq'; did you mean 'lqr'"),
        (
            "ilqr",
            {},
            "ilqr is for plants of several joints, and .* pendulum_joint; expected one of lqr, lqi",
        ),
        ("lqr", {"qq": [1.0, 1.0]}, "unknown parameter 'qq'"),
        ("lqr", {"r": 0.0}, r"r is 0\.0 1/\(N m\)\^2; expected > 0"),
        ("lqr", {"set_point": 9.0}, r"set_point is 9\.0 rad"),
        ("lqr", {"velocity": "guess"}, "velocity is 'guess'; expected one of measured"),
        ("discrete_lqr", {"delay": 0.5, "q": [1.0, 1.0, 1.0]}, "q has the shape"),
        (
            "mpc",
            {"set_point": 1.5, "effort_limit": 1.0},
            r"holding set_point 1\.5 takes .* N m at pendulum_joint; expected less",
        ),
    ],
)
def test_a_bad_parameter_is_refused_with_its_reason(name, values, message):
    with pytest.raises(ParameterError, match=message):
        make_controller(name, THESIS, 0.01, values)


def test_a_bad_period_is_refused():
    with pytest.raises(ParameterError, match=r"period is 0\.0 s; expected a finite value > 0"):
        make_controller("lqr", THESIS, 0.0)


def test_a_new_controller_is_one_class_and_one_line(monkeypatch, simulate):
    from pendulum_msgs_py.parameters import ParameterSpec

    module = types.ModuleType("my_controllers")

    class Proportional(BaseController):
        SUMMARY = "proportional feedback"
        PARAMETERS = (ParameterSpec("kp", 30.0, "N m/rad", "Proportional gain."),)

        def __init__(self, kp: float, effort_limit: float) -> None:
            super().__init__(effort_limit)
            self.kp = kp

        @classmethod
        def design(cls, plant: PlantParameters, period: float, p):
            return cls(p["kp"], p["effort_limit"])

        def command(self, t, x):
            return self.clamp(-self.kp * x[0])

    module.Proportional = Proportional
    monkeypatch.setitem(sys.modules, "my_controllers", module)
    monkeypatch.setitem(registry.CONTROLLERS, "proportional", registry.Row("my_controllers:Proportional"))
    controller = make_controller("proportional", THESIS, 0.01, {"kp": 20.0})
    run = simulate(THESIS, controller, theta=math.pi + 0.1)
    assert abs(run.angle[-1]) < 1e-3
    names = [spec.name for spec in controller_parameters("proportional")]
    assert names == [*(spec.name for spec in COMMON_PARAMETERS), "kp"]
