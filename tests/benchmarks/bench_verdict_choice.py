"""How often the fourth layer says yes to a simulation whose pick is a tenth dearer than the best, on known plants."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits

from pendulum_bags.ranking.contender import Contender
from pendulum_bags.ranking.present import REGRET_MARGIN, same_choice
from pendulum_bags.ranking.ranking import rank
from pendulum_bags.verdict import Mark
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from pendulum_testing.plant_pairs import K
from tests.benchmarks import Row, counted

TRIALS = 300
"""Trials in which the simulation picks a gain on the margin, or beyond it."""
SEEDS = 3
"""Runs of each gain on each side, as ``experiment ranking`` has."""
STEPS = 500
PERIOD = 0.01
AMPLITUDE = 2.5
WEIGHTS = np.array([100.0, 0.01, 0.1])
GAINS = np.outer(np.geomspace(0.15, 8.0, 20), K)

Array = NDArray[np.float64]


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    # Matrices are small: threads of the linear algebra would only get into each other's way.
    with threadpool_limits(1):
        yield _at_margin()


def _at_margin() -> Row:
    sim, hw = load_plant("thesis"), machine_at_margin()
    sim_cost, hw_cost = expected_costs(sim), expected_costs(hw)
    truth = hw_cost / hw_cost.min() - 1.0
    pick = int(np.argmin(sim_cost))
    yes = on_margin = 0
    for trial in itertools.count():
        if on_margin == TRIALS:
            break
        seeds = range(SEEDS * trial, SEEDS * (trial + 1))
        parts = [simulated_parts(plant, seeds, sensors=side) for side, plant in enumerate((sim, hw))]
        contenders = [
            Contender(f"{i}", parts[0][i], parts[1][i], sim_seeds=tuple(seeds), hw_seeds=tuple(seeds))
            for i in range(len(GAINS))
            if np.isfinite(hw_cost[i]) and np.isfinite(sim_cost[i])
        ]
        found = rank(contenders, np.random.default_rng(trial))
        # The noise of few runs may make the simulation pick a neighbour, which is off the margin or beyond it.
        if truth[int(found.pick)] >= REGRET_MARGIN - 1e-6:
            on_margin += 1
            yes += same_choice(found).mark is Mark.YES
    return counted(
        f"layer 4 at its margin: a pick {100.0 * REGRET_MARGIN:g} % dearer than the best of {len(GAINS)} gains, "
        f"{SEEDS} runs of each, is called the same choice",
        yes,
        on_margin,
        at_most=5.0,
        note=f"gain {GAINS[pick, 0]:.1f} N m/rad picked, {GAINS[int(np.argmin(hw_cost)), 0]:.1f} is best, under "
        f"{1e3 * hw.transport_delay:.1f} ms more delay",
    )


def machine_at_margin() -> PlantParameters:
    """Return a machine on which the simulation's pick costs a tenth more than the best, by its delay alone."""
    base = load_plant("thesis")
    pick = int(np.argmin(expected_costs(base)))

    def beyond(delay: float) -> float:
        costs = expected_costs(base.with_values(transport_delay=delay))
        return float(costs[pick] / costs.min()) - 1.0 - REGRET_MARGIN

    delays = np.arange(0.0, 0.2, 0.002)
    at = next(i for i, delay in enumerate(delays) if beyond(delay) > 0.0)
    return base.with_values(transport_delay=float(brentq(beyond, delays[at - 1], delays[at], xtol=1e-9)))


def expected_costs(plant: PlantParameters) -> Array:
    """Return the mean cost of each gain under the noise, in the steady state; infinity where it does not stabilise."""
    model = discretise(linearise(plant), PERIOD)
    costs = np.full(len(GAINS), np.inf)
    for i, gain in enumerate(GAINS):
        closed = model.A - model.B @ _feedback(gain, model.A.shape[0])
        if np.abs(np.linalg.eigvals(closed)).max() < 1.0:
            spread = solve_discrete_lyapunov(closed, model.B @ model.B.T * AMPLITUDE**2 / 3.0)
            angle, velocity = spread[0, 0], spread[1, 1]
            costs[i] = WEIGHTS @ [angle, velocity, gain @ spread[:2, :2] @ gain]
    return costs


def simulated_parts(plant: PlantParameters, seeds: range, *, sensors: int) -> Array:
    """Return the parts of the cost of all gains under the noise of each seed, shape (gains, seeds, 3)."""
    model = discretise(linearise(plant), PERIOD)
    push = np.stack([np.random.default_rng(seed).uniform(-AMPLITUDE, AMPLITUDE, STEPS) for seed in seeds])
    noise = np.stack([np.random.default_rng([seed, sensors]).normal(0.0, 5e-4, STEPS) for seed in seeds])
    feedback = np.stack([_feedback(gain, model.A.shape[0])[0] for gain in GAINS])
    state = np.zeros((len(GAINS), len(seeds), model.A.shape[0]))
    sums = np.zeros((len(GAINS), len(seeds), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(STEPS):
            torque = -np.einsum("gn,gsn->gs", feedback, state) - GAINS[:, 1:2] * noise[:, k]
            sums += WEIGHTS * np.stack([state[..., 0] ** 2, state[..., 1] ** 2, torque**2], axis=-1)
            state = state @ model.A.T + (torque + push[:, k])[..., None] * model.B[:, 0]
    return sums / STEPS


def _feedback(gain: Array, states: int) -> Array:
    """Return the gain on angle and velocity as a row for all states of a sampled model."""
    row = np.zeros((1, states))
    row[0, :2] = gain
    return row
