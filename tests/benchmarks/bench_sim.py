"""The simulator beside its peers: steps per second of batch and environments, and the node's loop over DDS."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import from_upright
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant
from pendulum_sim.exports.model_files import mjcf
from tests.benchmarks import Peer, Row, measured, peer

if TYPE_CHECKING:
    from tests.benchmarks.sim_loop import LimitFigures

__all__ = ["rows"]

GAIN = (33.345265, 0.158993)
PENDULUMS = 10_240
_ACROBOT = "acrobot_frictionless"
_MOST_OF_LIMIT = {"cpu": 1.2, "p50": 1.1, "p99": 1.5}
"""What the loop may cost on two cores, in that of the same loop in C in the same run."""
_MOST_OF_LIMIT_ON_ONE_CORE = {"cpu": 1.3, "p50": 1.3}
_MISSED = 0.1
"""Share of deadlines that may be missed, where the loop in C misses fewer [%]."""
_LEAST_OF_LOCKSTEP = 0.7
SECONDS = float(os.environ.get("PENDULUM_BENCH_SECONDS", "60"))
"""Length of the longest realtime run [s]."""


def rows() -> Iterator[Row]:
    """Yield all rows; each figure only after a check that its numbers are right."""
    yield from _batch()
    yield from _environments()
    yield from _node()


# --- batch ---------------------------------------------------------------------------------------------------


def _batch() -> Iterator[Row]:
    _check_batch()
    speed = _batch_speed("euler")
    rollout = peer("mujoco.rollout", _mujoco_rollout)
    numpy_peer = peer("numpy", _numpy_speed)
    what = "batch, closed loop with noise, 10 240 pendulums, Euler 2 ms"
    yield measured(what, speed, "steps/s", at_least=4e8)
    yield measured(what, speed, "steps/s", peer=rollout, at_least_times_peer=200.0)
    yield measured(what, speed, "steps/s", peer=numpy_peer, at_least_times_peer=4.0)
    for method in ("etd2", "etd4"):
        yield measured(f"batch, the same with {method}", _batch_speed(method), "steps/s", peer=numpy_peer)
    acrobots = peer("mujoco.rollout", lambda: _mujoco_rollout(mjcf(load_mechanism(_ACROBOT)), 2))
    what = "batch, closed loop with noise, 10 240 acrobots, RK4 2 ms"
    yield measured(what, _acrobot_speed(), "steps/s", peer=acrobots, at_least_times_peer=50.0)


def _check_batch() -> None:
    """Compare the trajectory of one pendulum of a batch with plant, controller and noise apart."""
    from pendulum_sim.batches.batch import simulate_batch
    from pendulum_sim.stepping.plant import RigidPlant

    parameters = load_plant("thesis")
    result = simulate_batch(
        parameters, steps=500, method="euler", gain=GAIN, seeds=np.arange(300), amplitude=2.5, record=True
    )
    assert result.trajectories is not None
    plant = RigidPlant(parameters, 2e-3, method="euler")
    state = plant.reset(math.pi)
    worst = 0.0
    for k in range(500):
        worst = max(worst, abs(result.trajectories[k, 0, 299] - state.theta))
        control = -(GAIN[0] * from_upright(state.theta) + GAIN[1] * state.theta_dot)
        state = plant.step(control + noise.uniform(299, k, 2.5))
    if worst > 1e-12:
        raise AssertionError(f"batch and plant differ by {worst} rad; expected at most 1e-12")


def _batch_speed(method: str) -> float:
    from pendulum_sim.batches.batch import simulate_batch

    parameters, seeds = load_plant("thesis"), np.arange(PENDULUMS)

    def run(steps: int) -> None:
        simulate_batch(parameters, steps=steps, method=method, gain=GAIN, seeds=seeds, amplitude=2.5)

    return _best(lambda: run(2000), work=2000 * PENDULUMS, warm_up=lambda: run(2))


def _acrobot_speed() -> float:
    from pendulum_sim.batches.batch import simulate_batch
    from pendulum_sim.stepping.mechanism_plant import MechanismPlant

    plant, seeds = load_mechanism(_ACROBOT), np.arange(PENDULUMS)
    gain = np.array([[-295.0, -124.0, -63.0, -28.5]])

    def run(steps: int) -> None:
        simulate_batch(plant, steps=steps, gain=gain, seeds=seeds, amplitude=0.5)

    single = MechanismPlant(plant, 2e-3)
    state = single.reset(plant.coordinates.goal)
    for k in range(100):
        x = np.array([*plant.coordinates.deviation(state.position), *state.velocity])
        state = single.step((float((-gain @ x)[0]) + noise.uniform(PENDULUMS - 1, k, 0.5),))
    batch = simulate_batch(plant, steps=100, gain=gain, seeds=seeds, amplitude=0.5)
    worst = float(np.abs(batch.position[-1] - state.position).max())
    if not worst < 1e-8:
        raise AssertionError(f"batch and plant differ by {worst} rad; expected less than 1e-8")
    return _best(lambda: run(500), work=500 * PENDULUMS)


def _numpy_speed() -> float:
    generator = np.random.default_rng(0)
    x, v = np.full(PENDULUMS, math.pi), np.zeros(PENDULUMS)

    def run() -> None:
        nonlocal x, v
        for _ in range(100):
            u = -(GAIN[0] * (x - math.pi) + GAIN[1] * v) + generator.uniform(-2.5, 2.5, PENDULUMS)
            a = (np.clip(u, -13.0, 13.0) - 11.77 * v - 1.678 * np.sin(x)) / 0.055
            x = x + 2e-3 * v
            v = v + 2e-3 * a

    return _best(run, work=100 * PENDULUMS)


def _mujoco_rollout(file: str | None = None, joints: int = 1) -> float:
    """Return the steps a second of MuJoCo's own batch; of the thesis's pendulum, or of another file."""
    import mujoco
    from mujoco import rollout

    model = mujoco.MjModel.from_xml_string(file or mjcf(load_plant("thesis")))
    data = [mujoco.MjData(model) for _ in range(2)]
    count, steps = 1024, 200
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((count, size))
    initial[:, 1 : 1 + joints] = 0.5
    control = np.random.default_rng(0).uniform(-2.5, 2.5, (count, steps, 1))
    return _best(lambda: rollout.rollout(model, data, initial, control), work=count * steps)


# --- environments --------------------------------------------------------------------------------------------


def _environments() -> Iterator[Row]:
    import gymnasium

    import pendulum_sim.environments.environment as _  # noqa: F401  (registers the environment)

    ours = _env_speed("PendulumX59-v0")
    theirs = peer("Gymnasium Pendulum-v1", lambda: _env_speed("Pendulum-v1"))
    yield measured("env.step, as gymnasium.make returns it", ours, "steps/s", peer=theirs, at_least_times_peer=4.0)
    yield measured("env.step", ours, "steps/s", peer=peer("mujoco from Python", _mujoco_single))
    vector = _vector_speed(gymnasium.make_vec("PendulumX59-v0", num_envs=1024, vectorization_mode="vector_entry_point"))
    envpool = peer("envpool", _envpool_speed)
    if envpool.value is None:
        yield measured(
            "vectorised environment of 1024",
            vector,
            "steps/s",
            peer=Peer("envpool", None, envpool.note),
            at_least=1.6e7,
            note="target: 10 x the 1.6e6 that envpool reached on two such cores",
        )
    else:
        yield measured("vectorised environment of 1024", vector, "steps/s", peer=envpool, at_least_times_peer=10.0)
    sync = peer(
        "Gymnasium SyncVectorEnv",
        lambda: _vector_speed(gymnasium.make_vec("Pendulum-v1", num_envs=1024, vectorization_mode="sync"), 3),
    )
    yield measured("vectorised environment of 1024", vector, "steps/s", peer=sync)


def _env_speed(name: str) -> float:
    import gymnasium

    env = gymnasium.make(name, max_episode_steps=10**9)
    env.reset(seed=0)
    action = np.array([0.5], dtype=np.float32)

    def run() -> None:
        for _ in range(10_000):
            env.step(action)

    return _best(run, work=10_000)


def _vector_speed(env: object, steps: int = 200) -> float:
    env.reset(seed=0)  # type: ignore[attr-defined]
    actions = np.full((1024, 1), 0.5, dtype=np.float32)

    def run() -> None:
        for _ in range(steps):
            env.step(actions)  # type: ignore[attr-defined]

    return _best(run, work=steps * 1024)


def _envpool_speed() -> float:
    import envpool  # type: ignore[import-not-found, unused-ignore]  # an optional peer

    return _vector_speed(envpool.make_gymnasium("Pendulum-v1", num_envs=1024))


def _mujoco_single() -> float:
    import mujoco

    model = mujoco.MjModel.from_xml_string(mjcf(load_plant("thesis")))
    data = mujoco.MjData(model)

    def run() -> None:
        for _ in range(10_000):
            data.ctrl[0] = 0.5
            mujoco.mj_step(model, data)

    return _best(run, work=10_000)


# --- node ----------------------------------------------------------------------------------------------------


def _node() -> Iterator[Row]:
    from tests.benchmarks.sim_loop import (
        limit_lockstep_speed,
        lockstep_speed,
        peer_cpu,
        realtime_figures,
    )

    short = min(SECONDS, 20.0)
    plain = peer("SingleThreadedExecutor, typed", lambda: peer_cpu("plain_loop", short))
    bare = peer("two empty processes, best effort", lambda: peer_cpu("bare_loop", short))
    for label, cores, most, duration in (
        ("two cores", None, _MOST_OF_LIMIT, SECONDS),
        ("one core", [(os.cpu_count() or 1) - 1], _MOST_OF_LIMIT_ON_ONE_CORE, short),
    ):
        name = f"node, realtime 1 kHz, {label}, {duration:g} s"
        # At once before ours: what the machine does beside it changes by the minute.
        limit, why = _limit(duration, cores)
        if limit is None:
            yield Row(what=f"{name}: the same loop in C", note=why)
        else:
            note = f"p50 {limit.p50:.0f} us, p99 {limit.p99:.0f} us, {limit.missed:.2f} % of deadlines missed, "
            note += f"{limit.unanswered:.2f} % of states not answered within 0.9 of a period"
            yield measured(f"{name}: the same loop in C, CPU", limit.cpu, "% of a core", less_is_better=True, note=note)
        figures = realtime_figures(duration, cores=cores)
        for what, field, unit in (
            ("CPU, simulator + controller", "cpu", "% of a core"),
            ("round trip p50", "p50", "us"),
            ("round trip p99", "p99", "us"),
            # An answer that never came is in no percentile, of neither.
            ("states without an answer", "unanswered", "%"),
        ):
            in_c = Peer("the same loop in C", None if limit is None else getattr(limit, field), why)
            yield measured(
                f"{name}: {what}",
                getattr(figures, field),
                unit,
                peer=in_c,
                less_is_better=True,
                at_most_times_peer=most.get(field),
            )
        allowed = max(_MISSED, limit.missed if limit is not None else 0.0)
        yield measured(f"{name}: missed deadlines", figures.missed, "%", at_most=allowed)
        if cores is None:
            what = f"{name}: CPU, simulator + controller"
            yield measured(what, figures.cpu, "% of a core", peer=plain, less_is_better=True, at_least_times_peer=5.0)
            yield measured(
                what,
                figures.cpu,
                "% of a core",
                peer=bare,
                less_is_better=True,
                note="what rclpy and Fast DDS cost before anything is done",
            )
            yield measured(f"{name}: memory", figures.memory, "MB", at_most=100.0)
            yield measured(f"{name}: growth of memory", max(0.0, figures.growth), "MB", at_most=1.0)
    in_c = peer("the same in C", limit_lockstep_speed)
    what = "node, lockstep 2 ms, controller and disturbance as processes"
    yield measured(what, lockstep_speed(60.0), "x real time", peer=in_c, at_least_times_peer=_LEAST_OF_LOCKSTEP)
    yield from _under_load()


def _under_load() -> Iterator[Row]:
    from tests.benchmarks.loaded_plants import loaded_plants

    loaded = loaded_plants(60.0)
    what = "two plants at 500 Hz, controlled, under noise, recorded, on the console, two busy loops, 60 s"
    had = "real-time priority" if loaded.real_time else "no real-time priority (this user may have none)"
    note = "; ".join((*(f"{plant} {share:.2f} %" for plant, share in loaded.missed.items()), had))
    yield measured(f"{what}: missed deadlines", max(loaded.missed.values()), "%", at_most=0.5, note=note)
    yield measured(f"{what}: faults", len(loaded.faults), "", at_most=0.0, note="; ".join(loaded.faults))
    note = f"of {loaded.recorded + loaded.lost} messages"
    yield measured(f"{what}: lost in the bag", loaded.lost, "", at_most=0.0, note=note)


def _limit(duration: float, cores: Sequence[int] | None) -> tuple[LimitFigures | None, str]:
    """Measure the loop in C, or say why it cannot be measured here."""
    from tests.benchmarks.sim_loop import limit_figures

    try:
        return limit_figures(duration, cores=cores), ""
    # A machine without a compiler, or with other headers, still has the figures of ours.
    except (OSError, RuntimeError, AssertionError) as error:
        return None, f"the loop in C is not there: {error}"


def _best(work_function: Callable[[], None], *, work: float, warm_up: Callable[[], None] | None = None) -> float:
    """Return the best rate of five runs, after one that nobody counts: other load only ever slows down."""
    (warm_up or work_function)()
    best = 0.0
    for _ in range(5):
        start = time.perf_counter()
        work_function()
        best = max(best, work / (time.perf_counter() - start))
    return best
