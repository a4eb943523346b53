"""Plants driven in volts: against an independent simulation of the current, MuJoCo, batches and environments."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.joint_parameters import Actuator, Motor
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, pack_joints, pendulum_plant
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.environments.environment import PlantEnv, PlantVectorEnv
from pendulum_sim.exports.model_files import mjcf
from pendulum_sim.stepping.mechanism_plant import MechanismPlant, is_smooth
from pendulum_sim.stepping.plants import make_plant

QUBE = load_mechanism("qube_servo")
MOTOR = Motor(2.0, 0.05, 6.0, gear_ratio=14.0, inductance=1e-3)


def _in_volts(plant: PlantParameters, name: str, *motors: Motor | None) -> PlantParameters:
    joints = [
        replace(own, actuator=None if motor is None else Actuator(1.0, motor=motor))
        for own, motor in zip(plant.joints, motors, strict=True)
    ]
    return PlantParameters(plant.mechanism, plant.values, tuple(joints), name)


LINK = _in_volts(pendulum_plant(0.05, 0.02, 1.2), "link", MOTOR)
CART = _in_volts(load_mechanism("cart_pole"), "cart", Motor(2.6, 0.00767, 12.0, gear_ratio=600.0), None)
BOTH = _in_volts(load_mechanism("double_pendulum_frictionless"), "both", MOTOR, replace(MOTOR, gear_ratio=6.0))


def _truth(plant: PlantParameters, start: tuple[float, ...], volts: tuple[float, ...], time: float) -> np.ndarray:
    """Return the state after holding voltages: L i' = u - R i - k_e N v, effort = N k_t i, integrated as it stands."""
    n, driven = len(plant.joints), plant.coordinates.driven
    motors = [actuator.motor for actuator in plant.actuators]
    own = (*plant.values, *(joint.damping for joint in plant.joints))

    def rates(_: float, x: np.ndarray) -> list[float]:
        q, v, effort, change = tuple(x[:n]), tuple(x[n : 2 * n]), [0.0] * n, []
        for index, motor, lagging, u in zip(driven, motors, x[2 * n :], volts, strict=True):
            ratio, constant = motor.gear_ratio, motor.torque_constant
            beyond = np.sign(u) * max(0.0, abs(u) - motor.dead_band)
            drop = beyond - constant * ratio * v[index]
            current = drop / motor.resistance if motor.inductance == 0.0 else lagging
            effort[index] = ratio * constant * current
            change.append((drop - motor.resistance * current) / (motor.inductance or 1.0))
        return [*v, *plant.mechanism.forward(q, v, tuple(effort), own), *change]

    x = [*start, *(0.0,) * len(driven)]
    found: np.ndarray = solve_ivp(rates, (0.0, time), x, method="Radau", rtol=1e-9, atol=1e-12).y[:, -1]
    return found


@pytest.mark.parametrize(
    ("plant", "volts", "within"),
    [
        (QUBE, (3.0,), 1e-3),
        (QUBE, (-0.7,), 1e-3),
        (LINK, (4.0,), 2e-3),
        (CART, (5.0,), 1e-9),
        (BOTH, (3.0, -2.0), 5e-3),
    ],
)
def test_the_motion_is_that_of_windings_with_resistance_back_emf_and_inductance(
    plant: PlantParameters, volts: tuple[float, ...], within: float
) -> None:
    n = len(plant.joints)
    start = (*(0.3,) * n, *(0.5,) * n)
    stepped = make_plant(plant, 1e-3)
    stepped.reset(start[:n], start[n:])
    for _ in range(300):
        state = stepped.step(volts, (0.0,) * n)
    truth = _truth(plant, start, volts, 0.3)
    assert np.max(np.abs(np.array(state.position) - truth[:n])) < within
    motor, index = plant.actuators[0].motor, plant.coordinates.driven[0]
    assert motor is not None
    current = truth[2 * n]
    if motor.inductance == 0.0:
        current = (volts[0] - motor.torque_constant * motor.gear_ratio * truth[n + index]) / motor.resistance
    # The effort that is shown is that of the current, back EMF included.
    assert state.effort[index] == pytest.approx(motor.gear_ratio * motor.torque_constant * current, rel=0.02)


def test_a_voltage_within_the_dead_band_moves_nothing_and_the_rest_is_less_by_it() -> None:
    banded = QUBE.with_values({"arm.dead_band": 0.4})
    still = MechanismPlant(banded, 2e-3)
    still.reset()
    assert all(still.step((volts,)).position == (0.0, 0.0) for volts in (0.4, -0.4, 0.1))
    one, other = MechanismPlant(banded, 2e-3), MechanismPlant(QUBE, 2e-3)
    for plant in (one, other):
        plant.reset()
    for _ in range(20):
        ours, theirs = one.step((-1.4,)), other.step((-1.0,))
    for one_of, other_of in zip(ours[1:], theirs[1:], strict=True):
        assert one_of == pytest.approx(other_of)
    assert not is_smooth(banded.with_values({"arm.inductance": 0.0}))


def test_the_voltage_is_clamped_to_the_amplifiers() -> None:
    one, other = MechanismPlant(QUBE, 2e-3), MechanismPlant(QUBE, 2e-3)
    for plant in (one, other):
        plant.reset()
    assert one.step((10.0,)) == other.step((1e6,))


def test_steps_of_a_plant_that_knows_no_motor_refuse_it() -> None:
    with pytest.raises(ParameterError, match="plant 'qube_servo' is driven in volts; expected one that is driven by"):
        pack_joints(QUBE)


@pytest.mark.parametrize("plant", [QUBE, QUBE.with_values({"arm.inductance": 0.0}), BOTH, LINK], ids=lambda p: p.name)
def test_a_batch_moves_as_a_single_plant_in_volts(plant: PlantParameters) -> None:
    n, m = len(plant.joints), len(plant.coordinates.driven)
    gain = np.full((m, 2 * n), 0.3) + 0.1 * np.arange(m)[:, None]
    start, goal = np.full(n, 0.2), np.zeros(n)
    batch = simulate_batch(
        plant, steps=100, dt=1e-3, position=start, goal=goal, gain=gain, amplitude=0.4, seeds=3, record=True
    )
    single = make_plant(plant, 1e-3)
    state = single.reset(tuple(start.tolist()), (0.0,) * n)
    assert batch.trajectories is not None
    for row in batch.trajectories[:, :, 0]:
        np.testing.assert_allclose(row[:n], state.position, atol=1e-12)
        volts = tuple(row[2 * n + index] for index in plant.coordinates.driven)
        assert np.max(np.abs(np.array(volts) + gain @ [*state.position, *state.velocity])) <= 0.4 + 1e-12
        state = single.step(volts, (0.0,) * n)
    assert batch.max_effort[0] == pytest.approx(
        np.max(np.abs(gain @ batch.trajectories[:, : 2 * n, 0].T), axis=1), rel=0.2
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"arm.resistance": 12.0, "arm.torque_constant": 0.05},
        {"arm.damping": 1e-3},
        {"arm.inductance": 2e-3, "arm.gear_ratio": 2.0},
        {"arm.voltage_limit": 0.5},
    ],
)
def test_variations_of_a_batch_are_those_of_the_plant(changes: dict[str, float]) -> None:
    run = {"steps": 50, "position": [0.1, 0.1], "goal": [0.0, 0.0], "gain": [[5.0, 5.0, 0.1, 0.1]]}
    varied = simulate_batch(
        QUBE, variations={name: [QUBE.value(name), value] for name, value in changes.items()}, **run
    )
    for row, plant in enumerate((QUBE, QUBE.with_values(changes))):
        np.testing.assert_allclose(varied.position[row], simulate_batch(plant, **run).position[0], rtol=1e-12)


def test_a_batch_refuses_a_dead_band() -> None:
    with pytest.raises(ParameterError, match="the motor of arm has a dead band; expected none in a batch"):
        simulate_batch(QUBE.with_values({"arm.dead_band": 0.1}), steps=1)


def test_environments_take_volts_single_and_as_arrays() -> None:
    plant = QUBE.with_values({"arm.inductance": 0.0})
    single, vector = PlantEnv(plant, start="bottom"), PlantVectorEnv(2, plant=plant, start="bottom")
    assert single.action_space.high.tolist() == [10.0]
    single.reset(seed=1)
    vector.reset(seed=1)
    for _ in range(20):
        alone, reward, *_ = single.step(np.array([2.0]))
        both, rewards, *_ = vector.step(np.full((2, 1), 2.0))
        np.testing.assert_allclose(both, [alone, alone], atol=1e-12)
    assert reward == pytest.approx(rewards[0])
    assert alone[2] > 1.0


@pytest.mark.parametrize(
    ("plant", "within"),
    # MuJoCo's lag acts a step later.
    [(QUBE, 5e-4), (QUBE.with_values({"arm.inductance": 0.0}), 1e-9), (CART, 1e-9), (BOTH, 5e-4)],
)
def test_mujoco_moves_alike_from_the_exported_file(plant: PlantParameters, within: float) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(mjcf(plant))
    data = mujoco.MjData(model)
    single = make_plant(plant, model.opt.timestep)
    n = len(plant.joints)
    data.qpos[:] = 0.2
    state = single.reset((0.2,) * n, (0.0,) * n)
    volts = tuple(0.4 * limit for limit in plant.command_limits)
    data.ctrl[:] = volts
    for _ in range(100):
        mujoco.mj_step(model, data)
        state = single.step(volts, (0.0,) * n)
    np.testing.assert_allclose(data.qpos, state.position, rtol=0.0, atol=within)
    assert model.actuator_ctrlrange[:, 1].tolist() == list(plant.command_limits)
