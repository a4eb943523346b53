"""The batch engine: the same numbers as the single plant, the thesis's statistics, flat memory."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import from_upright, wrap
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant, pendulum_plant
from pendulum_sim.batches import vector_math
from pendulum_sim.batches.batch import simulate_batch
from pendulum_sim.batches.compiling import compile_tree
from pendulum_sim.stepping.plant import RigidPlant

THESIS_GAIN = (33.345265, 0.158993)
_PLAIN = load_plant("dfki").with_values(coulomb_friction=0.0, static_friction=0.0, effort_limit=20.0)
_FULL = load_plant("dfki").with_values(
    static_friction=0.12,
    load_friction=0.02,
    actuator_time_constant=0.003,
    transport_delay=0.0033,
    angle_offset=0.02,
    torque_offset=-0.05,
    effort_limit=20.0,
)


def _single(
    parameters: PlantParameters, method: str, steps: int, seed: int, hold: int, gain: tuple[float, float]
) -> np.ndarray:
    """Run one pendulum step by step, as the nodes do: plant, controller and disturbance apart."""
    plant = RigidPlant(parameters, 2e-3, method=method)
    state = plant.reset(math.pi + 0.3)
    rows = []
    for k in range(steps):
        control = -(gain[0] * from_upright(state.theta) + gain[1] * state.theta_dot)
        rows.append((state.theta, state.theta_dot))
        state = plant.step(control + noise.uniform(seed, k // hold, 2.5))
    return np.array(rows)


@pytest.mark.parametrize(
    ("parameters", "method", "gain"),
    [
        (load_plant("thesis"), "euler", THESIS_GAIN),
        (load_plant("thesis"), "etd4", THESIS_GAIN),
        (load_plant("thesis"), "etd2", (0.0, 0.0)),
        (_PLAIN, "semi_implicit", (6.0, 0.6)),
        (_PLAIN, "rk4", (6.0, 0.6)),
        (_FULL, "etd2", (6.0, 0.6)),
    ],
)
def test_each_pendulum_of_a_batch_equals_the_single_plant_to_1e_12(
    parameters: PlantParameters, method: str, gain: tuple[float, float]
) -> None:
    seeds = [5, 2**64 - 1]
    result = simulate_batch(
        parameters,
        steps=800,
        method=method,
        position=math.pi + 0.3,
        gain=gain,
        seeds=seeds,
        amplitude=2.5,
        hold=5,
        record=True,
    )
    assert result.trajectories is not None
    for column, seed in enumerate(seeds):
        single = _single(parameters, method, 800, seed, 5, gain)
        assert np.abs(result.trajectories[:, :2, column] - single).max() < 1e-12


@pytest.mark.parametrize(
    ("hold", "median", "low", "high", "std_theta", "std_theta_dot"),
    [(1, 0.205, 0.152, 0.286, 0.00213, 0.0637), (5, 0.460, 0.344, 0.605, 0.00479, 0.100)],
)
def test_200_seeds_reproduce_the_statistics_of_the_thesis(
    hold: int, median: float, low: float, high: float, std_theta: float, std_theta_dot: float
) -> None:
    # Thesis: Euler at 2 ms, 5 s, uniform noise of 2.5 N m, held for 2 ms (simulation) or 10 ms (hardware loop).
    result = simulate_batch(
        load_plant("thesis"),
        steps=2500,
        method="euler",
        gain=THESIS_GAIN,
        seeds=np.arange(200),
        amplitude=2.5,
        hold=hold,
    )
    assert np.percentile(result.max_effort, [50, 5, 95]) == pytest.approx([median, low, high], rel=0.08)
    assert np.median(result.std_deviation) == pytest.approx(std_theta, rel=0.04)
    assert np.median(result.std_velocity) == pytest.approx(std_theta_dot, rel=0.04)


def test_each_pendulum_has_its_own_parameters_gain_start_seed_and_amplitude() -> None:
    plants = [load_plant("thesis").with_values(inertia=m) for m in (0.05, 0.055, 0.06)]
    together = simulate_batch(
        plants,
        steps=300,
        position=[3.0, 3.1, 3.2],
        velocity=[0.0, 0.1, 0.2],
        seeds=[1, 2, 3],
        gain=[(30.0, 0.1), (33.0, 0.15), (36.0, 0.2)],
        amplitude=[1.0, 2.0, 2.5],
    )
    for i in range(3):
        alone = simulate_batch(
            plants[i],
            steps=300,
            position=3.0 + 0.1 * i,
            velocity=0.1 * i,
            seeds=i + 1,
            gain=[(30.0, 0.1), (33.0, 0.15), (36.0, 0.2)][i],
            amplitude=[1.0, 2.0, 2.5][i],
        )
        assert alone.position[0, 0] == together.position[i, 0]
        assert alone.max_effort[0] == together.max_effort[i]


@pytest.mark.parametrize("static", [None, [0.05, 0.3, 0.4]])
def test_a_batch_over_dry_friction_moves_like_plants_of_their_own(static: list[float] | None) -> None:
    # Where static friction is not said, it is the Coulomb friction, as in a plant file.
    plain = pendulum_plant(inertia=0.055, damping=0.02, gravity=1.678, effort_limit=13.0)
    coulomb = [0.0, 0.1, 0.3]
    variations = {"coulomb_friction": coulomb} | ({"static_friction": static} if static else {})
    together = simulate_batch(plain, variations=variations, steps=500, method="etd2", position=1.0, hold=1, substeps=1)
    for i, tau in enumerate(coulomb):
        single = RigidPlant(
            pendulum_plant(
                inertia=0.055,
                damping=0.02,
                gravity=1.678,
                effort_limit=13.0,
                coulomb_friction=tau,
                static_friction=static[i] if static else None,  # type: ignore[arg-type]
            ),
            2e-3,
            method="etd2",
        )
        single.reset(1.0)
        for _ in range(500):
            single.step(0.0)
        assert together.position[i, 0] == pytest.approx(single.theta, abs=1e-12)
    assert len(set(np.round(together.position[:, 0], 6))) == 3


def test_results_do_not_depend_on_the_size_of_the_batch_or_the_threads() -> None:
    def run(size: int, threads: int | None) -> np.ndarray:
        return simulate_batch(
            load_plant("thesis"),
            steps=200,
            gain=THESIS_GAIN,
            seeds=np.arange(size),
            amplitude=2.5,
            threads=threads,
        ).position

    large = run(600, None)
    assert np.array_equal(run(600, 1), large)
    assert np.array_equal(run(7, 1), large[:7])


def test_memory_does_not_grow_with_the_number_of_steps() -> None:
    def peak(steps: int) -> int:
        tracemalloc.start()
        simulate_batch(load_plant("thesis"), steps=steps, gain=THESIS_GAIN, seeds=np.arange(512), amplitude=2.5)
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return highest

    peak(10)
    # A record of the long run would take 245 MB.
    assert peak(20_000) - peak(100) < 1_000_000


def test_the_polynomial_sine_is_within_4e_16_of_the_true_one() -> None:
    from decimal import Decimal, getcontext

    dense = np.concatenate([np.linspace(-7.0, 7.0, 400_001), np.random.default_rng(1).uniform(-1e4, 1e4, 200_000)])
    # The library's own error of half a unit in the last place is part of the difference.
    assert np.abs(vector_math.sin(dense) - np.sin(dense)).max() < 4e-16
    getcontext().prec = 60
    for x in np.random.default_rng(2).uniform(-1.5707, 1.5707, 200):
        exact_x = Decimal(float(x))
        term = total = exact_x
        for n in range(1, 25):
            term *= -exact_x * exact_x / (2 * n * (2 * n + 1))
            total += term
        assert abs(Decimal(float(vector_math.sin(float(x)))) - total) < Decimal("4e-16")


def test_the_branchless_wrap_equals_that_of_the_vocabulary_to_the_last_bit_of_its_ends() -> None:
    angles = np.random.default_rng(4).uniform(-40.0, 40.0, 10_000)
    compiled = compile_tree(vector_math.wrap)
    edges = [
        math.nextafter(turns * math.pi + sign * ulps * math.ulp(turns * math.pi or 1e-300), toward)
        for turns in (-3.0, -1.0, 0.0, 1.0, 3.0, 1001.0)
        for sign in (-1.0, 1.0)
        for ulps in (0, 1, 2)
        for toward in (-math.inf, math.inf, turns * math.pi)
    ]
    for angle in edges:
        for turned in (compiled(angle), float(vector_math.wrap(angle))):
            assert -math.pi <= turned < math.pi
            if -math.pi <= angle < math.pi - math.ulp(math.pi):
                assert turned == angle
            # To an ulp of where it came from, and the same turn but for that ulp.
            assert abs(math.remainder(turned - angle, 2.0 * math.pi)) <= 2.0 * math.ulp(max(abs(angle), math.pi))
    assert np.abs(vector_math.wrap(angles) - wrap(angles)).max() < 1e-13
    inside = angles[np.abs(angles) < math.pi]
    assert np.array_equal(vector_math.wrap(inside), inside)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"steps": 0}, "steps is 0; expected a whole number >= 1"),
        ({"steps": 5, "hold": 1.5}, "hold is 1.5; expected a whole number >= 1"),
        ({"steps": 5, "seeds": 1.5}, "seeds has 1.5; expected whole numbers from 0 to"),
        ({"steps": 5, "seeds": [1, -2]}, "seeds has -2; expected whole numbers from 0 to"),
        ({"steps": 5, "seeds": True}, "seeds has True; expected whole numbers from 0 to"),
        ({"steps": 5, "threads": -3}, "threads is -3; expected a whole number >= 1"),
        ({"steps": 5, "gain": (math.nan, 0.0)}, "gain has a value that is not finite"),
        ({"steps": 5, "gain": (math.inf, 0.0)}, "gain has a value that is not finite"),
        ({"steps": 5, "goal": math.nan}, r"goal is \[nan\]; expected 1 finite numbers"),
        ({"steps": 5, "amplitude": [1.0, -1.0]}, "amplitude has a value of -1.0; expected >= 0"),
        (
            {"steps": 5, "variations": {"coulomb_friction": [0.1, 0.3], "static_friction": [0.2]}},
            "static_friction of pendulum_joint of plant 1 is 0.2; expected >= coulomb_friction = 0.3",
        ),
        ({"steps": 5, "position": [0.0, 1.0], "seeds": [1, 2, 3]}, "position has 2 entries; expected 1 or 3"),
        ({"steps": 5, "gain": (1.0, 2.0, 3.0)}, r"gain has shape \(3,\); expected \(1, 2\) or \(B, 1, 2\)"),
        ({"steps": 5, "method": "adaptive"}, "method is 'adaptive' in a batch; expected a compiled one"),
        ({"steps": 5, "position": math.nan}, "position has a value that is not finite"),
    ],
)
def test_what_makes_no_batch_is_refused(kwargs: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        simulate_batch(load_plant("thesis"), **kwargs)


def test_series_elastic_plants_are_refused() -> None:
    with pytest.raises(ParameterError, match="a batch takes rigid plants"):
        simulate_batch(load_plant("x5_9"), steps=5)
