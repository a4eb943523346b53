"""Learning: time to a solved Pendulum-v1; policies for ``dfki`` and the cart-pole; what the machine takes off a score.

The machine is the emulated X5-9 with its bridge, over DDS in lockstep; a score is the share of 10 s from hanging that
a design spends up.
"""

from __future__ import annotations

# isort: off
import pendulum_msgs_py.programs.one_thread  # noqa: F401  # as the nodes do, before numpy
# isort: on

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.experiments.joint_run import surrogate_for
from pendulum_bags.studies.leaderboard import evaluate
from pendulum_bags.studies.leaderboard_hardware import evaluate_hardware
from pendulum_learning.evaluation import Trial, is_up, measured_success, run_trial, trials_of
from pendulum_learning.task import VARIED, SwingUpTask
from pendulum_lqr.controllers.policy import START_TIME, LearnedPolicy
from pendulum_lqr.policies.policy import Policy
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, load_plant
from tests.benchmarks import Peer, Row, measured
from tests.benchmarks.emulated_trials import emulated_trials
from tests.benchmarks.prediction import judge_prediction

__all__ = ["rows"]

PUBLISHED_SAC = 480.0
"""Time of Stable-Baselines3's SAC to a solved Pendulum-v1, some 8 minutes on 8 cores; published, not measured [s]."""
HOLD, SETTLE = 60.0, 5.0
OTHER_SEED = 20_000
"""Trials that are not those with which the training ends."""
_BARE = ("share", "delay", "jitter", "angle-noise", "velocity-noise", "kick")
"""What a training without randomisation leaves out."""
_BARE_WORDS = [word for name in _BARE for word in (f"--{name}", "0")]
_OFF, _LATE = 0.05, 0.004
"""How far a surrogate of a machine is off, as a share, and its delay [s]: those of ``experiment joints``."""
_NEAR = 0.05
"""Share of a random start that remains of it around hanging."""
_FINISHED, _UNFINISHED = 60, ((12, 1), (6, 2))
"""Updates of a whole training for ``thesis``; updates and seeds of some that were broken off."""
_DESIGNS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "lqr": ("lqr", {}),
    "lqr of a dear torque": ("lqr", {"q": [10.0, 0.01], "r": 1.0}),
    "lqr of a dearer torque": ("lqr", {"q": [1.0, 0.01], "r": 1.0}),
    **{kind: (kind, {}) for kind in ("pid", "pd_gravity", "lqi", "energy_swing_up", "time_optimal", "sliding_mode")},
}
"""Designs of mixed quality, beside the policies."""


def rows() -> Iterator[Row]:
    """Yield the rows of this area."""
    with tempfile.TemporaryDirectory(prefix="pendulum_learn_") as folder:
        yield from _pendulum_v1(Path(folder) / "v1.npz")
        yield from _swing_up(Path(folder) / "dfki.npz")
        yield from _emulated(Path(folder) / "dfki.npz", Path(folder) / "emulated")
        yield from _cart_pole(Path(folder) / "cart.npz")
        for plant, name in ((load_plant("dfki"), "dfki"), (load_mechanism("cart_pole"), "cart")):
            yield from _stand_ins(plant, Path(folder) / f"{name}.npz", Path(folder) / f"{name}_bare.npz")
        yield from _machine(Path(folder))


def _pendulum_v1(out: Path) -> Iterator[Row]:
    told, wall, cpu = _train("--task", "pendulum_v1", out=out)
    yield measured(
        "Pendulum-v1: mean return over 100 episodes of Gymnasium's own",
        told["return_mean"],
        "",
        at_least=-160.0,
        note=f"standard deviation {told['return_std']:.1f}",
    )
    yield measured(
        "Pendulum-v1: training from start to file, wall time",
        wall,
        "s",
        at_most=60.0,
        peer=Peer("published SAC of SB3", PUBLISHED_SAC),
        note="peer: 8 cores",
    )
    yield measured("Pendulum-v1: training from start to file, CPU time", cpu, "s", at_most=60.0)


def _swing_up(out: Path) -> Iterator[Row]:
    told, wall, cpu = _train("--plant", "dfki", out=out)
    what = "dfki: upright at the end, any start, kicks, parameters off by 25 %, delay"
    yield measured(f"{what}; trials of the training", told["up"], f"of {told['trials']}", at_least=told["trials"])
    yield measured("dfki: training from start to file, wall time", wall, "s", at_most=300.0)
    yield measured("dfki: training from start to file, CPU time", cpu, "s", at_most=300.0)
    policy = load_policy(str(out))
    trials = trials_of(policy, SwingUpTask(), 60, OTHER_SEED)
    last = round(1.0 / policy.period)
    up = sum(bool(np.all(np.abs(run_trial(policy, trial)[0][0, -last:]) <= 0.3)) for trial in trials)
    yield measured(f"{what}; other trials", up, f"of {len(trials)}", at_least=len(trials))
    still = np.zeros((round((SETTLE + HOLD) / policy.period), 1))
    worst = max(
        float(np.abs(run_trial(policy, replace(trial, kicks=still))[0][0, round(SETTLE / policy.period) :]).max())
        for trial in trials[:12]
    )
    yield measured("dfki: largest deviation in 60 s upright, 12 plants off by up to 25 %", worst, "rad", at_most=0.3)
    controller = LearnedPolicy(policy, 1, policy.effort_limit)
    times = np.empty(5000)
    for k in range(times.size):
        x = (0.1 * np.sin(0.1 * k), 0.5 * np.cos(0.1 * k))
        began = time.perf_counter_ns()
        controller.command(k * policy.period, x)
        times[k] = (time.perf_counter_ns() - began) / 1e3
    assert controller.notice == ""
    median, p99 = np.percentile(times, [50, 99])
    yield measured(
        "policy of 64 x 64: time per answer, median", float(median), "us", at_most=20.0, note=f"p99 {p99:.3g} us"
    )


def _emulated(out: Path, folder: Path) -> Iterator[Row]:
    ends = list(emulated_trials(folder, out, "dfki", 20))
    yield measured(
        "dfki: upright at the end on an emulated drive, any start, kicks, parameters off by 25 %",
        sum(end <= 0.3 for end in ends),
        f"of {len(ends)}",
        at_least=len(ends),
        note=f"over DDS in lockstep; at most {max(ends):.3f} rad off in the last second",
    )


def _cart_pole(out: Path) -> Iterator[Row]:
    told, wall, cpu = _train("--plant", "cart_pole", out=out)
    what = "cart-pole: upright at the end and never beyond +-0.4 m, any start, kicks, parameters off by 25 %, delay"
    yield measured(f"{what}; trials of the training", told["up"], f"of {told['trials']}", at_least=told["trials"])
    policy = load_policy(str(out))
    trials = trials_of(policy, SwingUpTask(), 20, OTHER_SEED)
    for name, chosen in _cart_pole_trials(policy, trials).items():
        found = measured_success(policy, chosen)
        yield measured(
            f"cart-pole: upright at the end and never beyond +-0.4 m, {name}",
            found["up"],
            f"of {found['trials']}",
            at_least=found["trials"],
        )
    yield measured("cart-pole: training from start to file, wall time", wall, "s", at_most=600.0)
    yield measured("cart-pole: training from start to file, CPU time", cpu, "s", at_most=600.0)


def _cart_pole_trials(policy: Policy, trials: list[Trial]) -> dict[str, list[Trial]]:
    """Return trials by what they are, from the easiest to all that trials have at once."""

    def near(trial: Trial) -> Trial:
        position, velocity = (tuple(_NEAR * each for each in start) for start in (trial.position, trial.velocity))
        plant = trial.plant
        assert not plant.is_pendulum
        prompt = plant.with_values({f"{joint}.transport_delay": 0.0 for joint in plant.coordinates.driven_names})
        return replace(trial, position=position, velocity=velocity, plant=prompt)

    def calm(trial: Trial) -> Trial:
        return replace(trial, kicks=np.zeros_like(trial.kicks))

    def central(trial: Trial) -> Trial:
        return replace(trial, plant=policy.plant)

    return {
        "from around hanging, the plant at the centre": [central(calm(near(each))) for each in trials],
        "from around hanging, parameters off by 25 %": [calm(near(each)) for each in trials],
        "from around hanging, parameters off by 25 %, kicks": [near(each) for each in trials],
        "any start, the plant at the centre": [central(calm(each)) for each in trials],
        "any start, kicks, parameters off by 25 %, delay; other trials": trials,
    }


def _stand_ins(plant: PlantParameters, randomised: Path, bare: Path) -> Iterator[Row]:
    """Yield what machines take off the score of a policy: second simulations, drawn as ``experiment joints`` does."""
    _train("--plant", plant.name, *_BARE_WORDS, out=bare)
    machines = [_surrogate(plant, seed) for seed in range(1, 21)]
    for name, out, limit in (("randomised", randomised, 5.0), ("not randomised", bare, None)):
        policy = load_policy(str(out))
        sim, *others = (_time_up(policy, each) for each in (plant, *machines))
        hw = float(np.mean(others))
        yield measured(
            f"{plant.name}, policy {name}: score lost, simulator to {len(machines)} surrogates of machines",
            100.0 * (1.0 - hw / sim) if sim else float("nan"),
            "%",
            at_most=limit,
            note=f"{sim:.3f} to {hw:.3f}, worst {min(others):.3f}; off by up to {100.0 * _OFF:g} %, "
            f"{1e3 * _LATE:g} ms late",
        )


def _surrogate(plant: PlantParameters, seed: int) -> PlantParameters:
    """Return a second simulation in the place of a machine."""
    if not plant.is_pendulum:
        return surrogate_for(plant, share=_OFF, delay=_LATE, seed=seed)
    drawn = np.random.default_rng(seed)
    values = {name: plant.value(name) * (1.0 + float(drawn.uniform(-_OFF, _OFF))) for name in VARIED}
    if plant.coulomb_friction:
        # The ratio first: rounded, equal frictions must stay equal.
        values["static_friction"] = plant.static_friction / plant.coulomb_friction * values["coulomb_friction"]
    return plant.with_values(**values, transport_delay=_LATE)


def _time_up(policy: Policy, plant: PlantParameters) -> float:
    """Return the share of 10 s from hanging that a policy spends up, 0 where it leaves its travel."""
    n = len(policy.joints)
    trial = Trial(plant, (0.0,) * n, (0.0,) * n, np.zeros((round(10.0 / policy.period), n)), SwingUpTask().travel)
    return float(np.mean(is_up(policy, trial, run_trial(policy, trial)[0])))


def _machine(folder: Path) -> Iterator[Row]:
    """Yield what the emulated machine takes off the score of a policy, and how well scores are predicted."""
    trained: dict[str, tuple[int, int, list[str]]] = {
        f"policy, {updates} updates": (updates, seed, []) for updates, seed in _UNFINISHED
    }
    trained |= {"randomised": (_FINISHED, 1, []), "not randomised": (_FINISHED, 1, _BARE_WORDS)}
    designs = dict(_DESIGNS)
    for number, (name, (updates, seed, more)) in enumerate(trained.items()):
        out = folder / f"thesis_{number}.npz"
        _train("--plant", "thesis", "--updates", str(updates), "--seed", str(seed), *more, out=out)
        designs[name] = ("policy", {"policy": str(out)})
    scores = {}
    for name, (kind, parameters) in designs.items():
        # A bridge lets nobody begin with much torque; what is predicted begins as softly.
        given = {**parameters, "start_time": START_TIME}
        both = (
            evaluate("thesis", kind, parameters=given, robustness=False),
            evaluate_hardware(kind, parameters=given, robustness=False),
        )
        scores[name] = tuple(entry.scores.get("v3", 0.0) for entry in both)
    for name, limit in (("randomised", 0.05), ("not randomised", None)):
        sim, hw = scores[name]
        yield measured(
            f"thesis, policy {name}: score lost from simulator to emulated machine",
            100.0 * (1.0 - hw / sim) if sim else float("nan"),
            "%",
            at_most=None if limit is None else 100.0 * limit,
            note=f"{sim:.3f} to {hw:.3f}",
        )
    predicted, reached = ([pair[side] for pair in scores.values()] for side in (0, 1))
    found = judge_prediction(predicted, reached, np.random.default_rng(0))
    for what, value in (("Spearman's rank correlation", found.spearman), ("mean maximum rank violation", found.mmrv)):
        yield measured(
            f"prediction: {what} of predicted and measured scores, {found.designs} designs",
            value.value,
            "",
            note=f"95 %: {value.low:.3f} to {value.high:.3f}. {found.note}".strip(),
        )


def _train(*arguments: str, out: Path) -> tuple[dict[str, Any], float, float]:
    """Train by the command line; return what it says, wall time and CPU time [s]."""
    command = [sys.executable, "-m", "pendulum_learning", "train", *arguments, "--json", "--out", str(out)]
    before, began = os.times(), time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    wall, after = time.monotonic() - began, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return json.loads(done.stdout), wall, cpu
