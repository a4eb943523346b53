"""The plant against physics: energy, periods, an independent simulator, and friction that holds."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from pendulum_msgs_py.dynamics import rigid_acceleration
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant, pendulum_plant
from pendulum_sim.stepping.dry_friction import acceleration_with_friction
from pendulum_sim.stepping.integrators import METHODS
from pendulum_sim.stepping.plant import RigidPlant, pack, period_segments
from pendulum_sim.stepping.plants import make_pendulum

_FREE = pendulum_plant(inertia=0.15, damping=0.0, gravity=3.0)
_DRY = pendulum_plant(
    inertia=0.15,
    damping=0.02,
    gravity=3.0,
    coulomb_friction=0.2,
    static_friction=0.35,
    stribeck_velocity=0.05,
)


def _period(theta_0: float, dt: float = 2e-3) -> float:
    """Return the time from rest at theta_0 through the other side and back [s]."""
    plant = RigidPlant(_FREE, dt, method="etd4")
    before = plant.reset(theta_0)
    crossings = []
    while len(crossings) < 3:
        state = plant.step(0.0)
        if before.theta * state.theta < 0.0:
            # Cubic Hermite interpolation of the crossing: the step's own accuracy is not lost on the way.
            low, high = 0.0, 1.0
            for _ in range(60):
                s = 0.5 * (low + high)
                theta = (
                    (1 + 2 * s) * (1 - s) ** 2 * before.theta
                    + s * (1 - s) ** 2 * dt * before.theta_dot
                    + s * s * (3 - 2 * s) * state.theta
                    + s * s * (s - 1) * dt * state.theta_dot
                )
                low, high = (s, high) if theta * before.theta > 0.0 else (low, s)
            crossings.append(before.time + low * dt)
        before = state
    return crossings[2] - crossings[0]


def test_small_swings_have_the_period_of_the_linear_pendulum() -> None:
    assert _period(1e-3) == pytest.approx(2.0 * math.pi * math.sqrt(0.15 / 3.0), rel=1e-6)


@pytest.mark.parametrize("theta_0", [0.5, 1.5, 2.5, 3.1])
def test_large_swings_have_the_exact_period_by_the_elliptic_integral(theta_0: float) -> None:
    exact = 4.0 * math.sqrt(0.15 / 3.0) * ellipk(math.sin(0.5 * theta_0) ** 2)
    assert _period(theta_0) == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize(("method", "bound"), [("rk4", 1e-6), ("etd4", 1e-6), ("semi_implicit", 2e-2)])
def test_energy_is_conserved_without_friction(method: str, bound: float) -> None:
    plant = RigidPlant(_FREE, 2e-3, method=method)
    plant.reset(2.0)
    start = plant.energy
    worst = 0.0
    for _ in range(5000):
        plant.step(0.0)
        worst = max(worst, abs(plant.energy - start) / start)
    assert worst < bound


@settings(max_examples=25, deadline=None)
@given(
    theta=st.floats(-3.1, 3.1),
    theta_dot=st.floats(-8.0, 8.0),
    coulomb=st.floats(0.0, 0.5),
    excess=st.floats(0.0, 0.3),
    damping=st.floats(0.0, 12.0),
    load=st.floats(0.0, 0.2),
)
def test_energy_never_grows_without_torque(
    theta: float, theta_dot: float, coulomb: float, excess: float, damping: float, load: float
) -> None:
    parameters = pendulum_plant(
        inertia=0.15,
        damping=damping,
        gravity=3.0,
        coulomb_friction=coulomb,
        static_friction=coulomb + excess,
        stribeck_velocity=0.05,
        load_friction=load,
    )
    plant = RigidPlant(parameters, 1e-3)
    plant.reset(theta, theta_dot)
    energy = plant.energy
    for _ in range(300):
        plant.step(0.0)
        assert plant.energy <= energy + 1e-9 * (1.0 + energy)
        energy = plant.energy


@pytest.mark.parametrize("method", [name for name in METHODS if name != "adaptive"])
def test_a_stuck_pendulum_does_not_creep_by_a_single_bit(method: str) -> None:
    plant = RigidPlant(_DRY, 2e-3, method=method)
    plant.reset(math.pi - 0.05)
    for step in range(2000):
        # Net torque up to 0.3 N m, below the 0.35 that friction holds.
        plant.step(0.15 * math.sin(0.01 * step))
        assert plant.theta == math.pi - 0.05
        assert plant.theta_dot == 0.0


def test_a_swing_ends_at_rest_where_friction_holds_and_stays_there() -> None:
    plant = RigidPlant(_DRY, 2e-3)
    plant.reset(1.2)
    for _ in range(5000):
        plant.step(0.0)
    resting = plant.theta
    assert plant.theta_dot == 0.0
    assert abs(3.0 * math.sin(resting)) <= 0.35
    for _ in range(1000):
        plant.step(0.0)
    assert plant.theta == resting


def test_slip_begins_when_the_torque_exceeds_static_friction() -> None:
    plant = RigidPlant(_DRY, 1e-3)
    plant.reset(0.0)
    plant.step(0.35)
    assert plant.theta_dot == 0.0
    plant.step(0.3501)
    assert plant.theta_dot > 0.0


def test_coulomb_friction_stops_a_flat_pendulum_where_mechanics_says() -> None:
    # Flat on a table: M v^2 / 2 = tau_C s.
    parameters = pendulum_plant(inertia=0.15, damping=0.0, gravity=0.0, coulomb_friction=0.2)
    for method in ("rk4", "etd4"):
        plant = RigidPlant(parameters, 0.013, method=method)
        plant.reset(0.0, 1.0)
        for _ in range(200):
            plant.step(0.0)
        assert plant.theta == pytest.approx(0.15 / (2.0 * 0.2), rel=1e-12)
        assert plant.theta_dot == 0.0


def test_friction_that_grows_with_load_holds_a_steeper_pendulum() -> None:
    loaded = _DRY.with_values(load_friction=0.5)
    # |sin| <= (0.35 + 0.5 * 3 |sin|) / 3  <=>  |sin| <= 0.2333
    for angle, holds in ((math.asin(0.233), True), (math.asin(0.234), False)):
        plant = RigidPlant(loaded, 1e-3)
        plant.reset(angle)
        plant.step(0.0)
        assert (plant.theta_dot == 0.0) is holds


def test_accelerations_equal_those_of_mujoco_at_100_random_states() -> None:
    mujoco = pytest.importorskip("mujoco")
    from pendulum_sim.exports.model_files import mjcf

    parameters = load_plant("dfki").with_values(coulomb_friction=0.0, static_friction=0.0)
    model = mujoco.MjModel.from_xml_string(mjcf(parameters))
    data = mujoco.MjData(model)
    generator = np.random.default_rng(3)
    for theta, theta_dot, effort in generator.uniform([-6.0, -10.0, -1.4], [6.0, 10.0, 1.4], (100, 3)):
        data.qpos[0], data.qvel[0], data.ctrl[0] = theta, theta_dot, effort
        mujoco.mj_forward(model, data)
        ours = acceleration_with_friction(theta, theta_dot, effort, 0.0, pack(parameters))
        assert ours == pytest.approx(data.qacc[0], abs=1e-8, rel=1e-8)


@pytest.mark.parametrize("name", ["thesis", "dfki"])
def test_the_linearisation_equals_finite_differences_of_the_plant(name: str) -> None:
    parameters = load_plant(name).with_values(coulomb_friction=0.0, static_friction=0.0)
    packed = pack(parameters)
    for theta in (0.0, 0.7, math.pi):
        a_21 = -parameters.gravity * math.cos(theta) / parameters.inertia
        a_22 = -parameters.damping / parameters.inertia
        steps = np.eye(3) * 1e-6
        derivative = [
            (
                acceleration_with_friction(theta + d[0], d[1], d[2], 0.0, packed)
                - acceleration_with_friction(theta - d[0], -d[1], -d[2], 0.0, packed)
            )
            / 2e-6
            for d in steps
        ]
        assert derivative == pytest.approx([a_21, a_22, 1.0 / parameters.inertia], rel=1e-8, abs=1e-8)


def test_one_step_equals_the_matrix_exponential_near_the_upright_state() -> None:
    from scipy.linalg import expm

    parameters = load_plant("thesis")
    A = np.array([[0.0, 1.0], [1.678 / 0.055, -11.77 / 0.055]])
    discrete = expm(np.block([[A, np.array([[0.0], [1 / 0.055]])], [np.zeros((1, 3))]]) * 2e-3)[:2]
    columns = []
    for x_0 in np.eye(3) * 1e-5:
        plant = RigidPlant(parameters, 2e-3)
        plant.reset(math.pi + x_0[0], x_0[1])
        state = plant.step(x_0[2])
        columns.append([(state.theta - math.pi) / 1e-5, state.theta_dot / 1e-5])
    assert pytest.approx(discrete, rel=1e-6, abs=1e-9) == np.array(columns).T


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.0033, 0.0071])
def test_a_delayed_command_acts_exactly_that_much_later(delay: float) -> None:
    # Flat and frictionless: theta_dot counts the torque that has arrived.
    parameters = pendulum_plant(inertia=1.0, damping=0.0, gravity=0.0, transport_delay=delay)
    plant = RigidPlant(parameters, 2e-3, method="rk4")
    plant.reset()
    for step in range(1, 11):
        state = plant.step(1.0)
        assert state.theta_dot == pytest.approx(max(0.0, step * 2e-3 - delay), abs=1e-15)


def test_the_actuator_lag_is_the_exact_exponential() -> None:
    parameters = pendulum_plant(inertia=1.0, damping=0.0, gravity=0.0, actuator_time_constant=0.01)
    plant = RigidPlant(parameters, 5e-3, method="etd4", substeps=4)
    plant.reset()
    for step in range(1, 9):
        state = plant.step(1.0)
        t = step * 5e-3
        assert state.effort == pytest.approx(1.0 - math.exp(-t / 0.01), rel=1e-12)
        assert state.theta_dot == pytest.approx(t - 0.01 * (1.0 - math.exp(-t / 0.01)), rel=1e-6)


def test_lag_delay_and_push_together_agree_with_an_independent_integration() -> None:
    parameters = _FREE.with_values(damping=0.3, actuator_time_constant=0.004, transport_delay=0.0033)
    plant = RigidPlant(parameters, 2e-3, method="etd4", substeps=4)
    plant.reset(0.4)
    commands = [math.sin(0.05 * k) for k in range(250)]
    for command in commands:
        plant.step(command, push=0.2)

    def command_at(t: float) -> float:
        index = math.floor((t - 0.0033) / 2e-3 + 1e-9)
        return commands[index] if index >= 0 else 0.0

    x = np.array([0.4, 0.0, 0.0])
    edges = sorted({*(k * 2e-3 for k in range(251)), *(k * 2e-3 + 0.0033 for k in range(249)), 0.5})
    edges = [t for t in edges if t <= 0.5 + 1e-12]
    for start, end in pairwise(edges):
        if end - start < 1e-12:
            continue
        u = command_at(0.5 * (start + end))
        x = solve_ivp(
            lambda t, x, u=u: [x[1], rigid_acceleration(x[0], x[1], x[2] + 0.2, 0.15, 0.3, 3.0), (u - x[2]) / 0.004],
            (start, end),
            x,
            method="DOP853",
            rtol=1e-12,
            atol=1e-13,
        ).y[:, -1]
    assert [plant.theta, plant.theta_dot, plant.effort] == pytest.approx(x.tolist(), abs=2e-9)


def test_commands_are_clamped_to_the_effort_limit_and_pushes_are_not() -> None:
    parameters = pendulum_plant(inertia=1.0, damping=0.0, gravity=0.0, effort_limit=2.0)
    plant = RigidPlant(parameters, 0.01)
    plant.reset()
    assert plant.step(50.0).effort == 2.0
    assert plant.step(0.0, push=50.0).theta_dot == pytest.approx(0.52)


def test_offsets_shift_angle_and_torque() -> None:
    parameters = _FREE.with_values(angle_offset=0.1, torque_offset=0.3)
    plant = RigidPlant(parameters, 1e-3)
    plant.reset(0.1 + math.asin(0.1))
    plant.step(0.0)
    assert abs(plant.theta_dot) < 1e-12


@settings(max_examples=50, deadline=None)
@given(fraction=st.just(0.0) | st.floats(1e-9, 0.999), substeps=st.integers(1, 20), dt=st.floats(1e-4, 0.1))
def test_segments_of_a_period_add_up_to_it(fraction: float, substeps: int, dt: float) -> None:
    segments = period_segments(dt, fraction, substeps)
    assert sum(h for _, h in segments) == pytest.approx(dt, rel=1e-12)
    assert sum(h for newer, h in segments if not newer) == pytest.approx(fraction * dt, abs=1e-12 * dt)
    assert all(0.0 < h <= dt / substeps * (1 + 1e-9) for _, h in segments)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"dt": 0.0}, "dt is 0.0 s; expected a finite number > 0"),
        ({"dt": math.nan}, "dt is nan s; expected a finite number > 0"),
        ({"dt": 1e-3, "substeps": 0}, "substeps is 0; expected an integer >= 1"),
        ({"dt": 1e-3, "method": "magic"}, "method is 'magic'; expected one of"),
    ],
)
def test_a_plant_that_cannot_be_stepped_is_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        make_pendulum(_FREE, **kwargs)


def test_a_start_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ParameterError, match="initial theta is nan rad; expected a finite number"):
        RigidPlant(_FREE, 1e-3).reset(math.nan)
