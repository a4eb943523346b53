"""A resumable training from its settings to a policy file: one seed, one file."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import threadpoolctl
from numpy.typing import NDArray

from pendulum_bags.runs.run_folder import provenance
from pendulum_learning.body import travel_of, velocity_scales
from pendulum_learning.environment import SwingUp
from pendulum_learning.evaluation import gymnasium_return, measured_success, trials_of
from pendulum_learning.imitation import Imitation
from pendulum_learning.pendulum_v1 import PLANT, STEP, PendulumV1
from pendulum_learning.ppo import Ppo, PpoSettings
from pendulum_learning.task import SwingUpTask, ranges_of
from pendulum_learning.teacher import Teacher
from pendulum_lqr.policies.policy import Network, Policy, default_signals
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.atomic_write import write_atomically
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["EPISODES", "TASKS", "TEACHERS", "TRIALS", "Training", "checkpoint_path", "train"]

TASKS = ("swing_up", "pendulum_v1")
TEACHERS = ("none", "tvlqr")
"""What a policy imitates: nothing (it learns from its reward), or the stored swing-up of its plant."""
_CHECKPOINT_EVERY = 10
_LARGEST_CHECKPOINT = 500_000_000
TRIALS, EPISODES = 60, 100
"""Number of runs that judge a finished policy."""
_EVALUATION_SEED = 10_000
_SPEED_MARGIN = 1.1
"""Ratio of the policy's box of velocities to what training visited."""


@dataclass(frozen=True)
class Training:
    """Settings of a training of a number of ``environments``.

    ``intervals`` of the plant's parameters are as in a plant file; ``swing_up`` has the variations between episodes.
    """

    task: str = "swing_up"
    plant: PlantParameters = PLANT
    intervals: Mapping[str, Any] = field(default_factory=dict)
    swing_up: SwingUpTask = field(default_factory=SwingUpTask)
    ppo: PpoSettings = field(default_factory=PpoSettings)
    environments: int = 512
    updates: int = 240
    seed: int = 1
    teacher: str = "none"

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise ParameterError(f"task is {self.task!r}; expected one of {', '.join(TASKS)}")
        if self.teacher not in TEACHERS:
            raise ParameterError(f"teacher is {self.teacher!r}; expected one of {', '.join(TEACHERS)}")
        if self.teacher != "none" and self.plant.is_pendulum:
            raise ParameterError(
                f"teacher is {self.teacher!r}, and plant {self.plant.name!r} has one joint; expected one of several "
                "joints with a stored swing-up, or none"
            )
        for name in ("environments", "updates"):
            if getattr(self, name) < 1:
                raise ParameterError(f"{name} is {getattr(self, name)}; expected >= 1")
        if self.seed < 0:
            raise ParameterError(f"seed is {self.seed}; expected >= 0")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each varied parameter."""
        return ranges_of(self.plant, self.swing_up.share, self.intervals) if self.task == "swing_up" else {}

    @property
    def steps(self) -> int:
        """Total number of environment steps."""
        return self.environments * self.ppo.horizon * self.updates

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
        swing_up = asdict(self.swing_up) if self.task == "swing_up" else {}
        if all(joint.turns for joint in self.plant.coordinates.joints):
            swing_up.pop("travel", None)
        return {
            "task": self.task, "plant": json.loads(describe_plants([self.plant]))[0], "ranges": self.ranges,
            "swing_up": swing_up, "ppo": asdict(self.ppo), "environments": self.environments,
            "updates": self.updates, "seed": self.seed,
            **({} if self.teacher == "none" else {"teacher": self.teacher}),
        }  # fmt: skip


def _settings_text(settings: Training) -> str:
    return json.dumps(settings.to_json(), sort_keys=True)


def checkpoint_path(out: Path) -> Path:
    """Return the path of a training's checkpoint."""
    return out.with_name(f"{out.stem}.checkpoint.npz")


def train(
    settings: Training,
    out: Path,
    *,
    on_update: Callable[[int, Mapping[str, float]], None] | None = None,
    on_trial: Callable[[int, int], None] | None = None,
) -> tuple[Policy, NDArray[np.float64]]:
    """Train, or resume from a checkpoint, and write the policy file.

    Returns:
        The policy, and its curves: steps, mean reward, divergence and spread per update, shape (n, 4).

    Raises:
        ParameterError: There is a checkpoint of other settings.
        DataError: The file or the checkpoint cannot be written or read.
        FaultError: The training diverged; the last checkpoint remains.
    """
    # One thread, so that sums are added in one order on any number of cores.
    with threadpoolctl.threadpool_limits(1):
        generator = np.random.default_rng(settings.seed)
        environment = _environment(settings, generator)
        learner = _learner(settings, environment, generator)
        curves: list[list[float]] = []
        checkpoint = checkpoint_path(out)
        fastest = np.zeros(len(settings.plant.coordinates.joints))
        if checkpoint.exists():
            curves, fastest = _restore(checkpoint, settings, learner, generator)
            if on_update is not None:
                on_update(len(curves), {"reward": curves[-1][1]})
        for number in range(len(curves), settings.updates):
            if isinstance(environment, SwingUp):
                environment.progress = number / settings.updates
            measured = learner.update(1.0 - number / settings.updates)
            if isinstance(environment, SwingUp):
                speeds = np.abs(environment.motion[:, fastest.size : 2 * fastest.size])
                fastest = np.maximum(fastest, speeds.max(axis=0))
            steps = float((number + 1) * settings.environments * settings.ppo.horizon)
            curves.append([steps, measured["reward"], measured["divergence"], measured["spread"]])
            if on_update is not None:
                on_update(number + 1, measured)
            if (number + 1) % _CHECKPOINT_EVERY == 0 or number + 1 == settings.updates:
                _keep(checkpoint, settings, learner, generator, curves, fastest)
        policy = _policy(settings, learner, fastest, {})
        policy = _policy(settings, learner, fastest, _evaluate(settings, policy, on_trial))
        write_policy(out, policy)
    with suppress(OSError):
        checkpoint.unlink()
    return policy, np.array(curves)


def _environment(settings: Training, generator: np.random.Generator) -> SwingUp | PendulumV1:
    if settings.task == "pendulum_v1":
        return PendulumV1(settings.environments, generator)
    return SwingUp(settings.environments, settings.plant, settings.ranges, settings.swing_up, generator)


def _learner(settings: Training, environment: SwingUp | PendulumV1, generator: np.random.Generator) -> Ppo | Imitation:
    plant = settings.plant
    if settings.teacher == "none" or not (isinstance(environment, SwingUp) and not plant.is_pendulum):
        return Ppo(environment, settings.ppo, generator)
    return Imitation(environment, settings.ppo, generator, Teacher(plant, settings.swing_up.period))


def _evaluate(settings: Training, policy: Policy, on_trial: Callable[[int, int], None] | None) -> dict[str, Any]:
    if settings.task == "pendulum_v1":
        mean, spread = gymnasium_return(policy, EPISODES, _EVALUATION_SEED)
        return {"episodes": EPISODES, "return_mean": mean, "return_std": spread}
    hanging = settings.teacher != "none"
    trials = trials_of(policy, settings.swing_up, TRIALS, _EVALUATION_SEED, hanging=hanging)
    return {**measured_success(policy, trials, on_trial), **({"start": "hanging"} if hanging else {})}


def _policy(
    settings: Training, learner: Ppo | Imitation, fastest: NDArray[np.float64], evaluation: Mapping[str, Any]
) -> Policy:
    parameters = learner.actor.parameters
    network = Network(
        tuple(np.ascontiguousarray(each.T) for each in parameters[::2]), tuple(each.copy() for each in parameters[1::2])
    )
    origin = {
        "training": settings.to_json(), "steps": settings.steps, "evaluation": dict(evaluation),
        **provenance(),
    }  # fmt: skip
    plant, task = settings.plant, settings.swing_up
    coordinates = plant.coordinates
    common: dict[str, Any] = {
        "network": network, "task": settings.task, "joints": coordinates.names, "plant": plant,
        "ranges": settings.ranges, "effort_limit": plant.effort_limits, "provenance": origin,
        "angle_box": travel_of(plant, task.travel), "name": f"{plant.name} {settings.task} seed {settings.seed}",
    }  # fmt: skip
    if settings.task == "pendulum_v1":
        return Policy(
            **common, period=STEP, effort_rate=(math.inf,), velocity_scale=(8.0,), velocity_box=(8.001,),
            signals=("cos", "sin", "velocity"),
        )  # fmt: skip
    return Policy(
        **common, period=task.period, effort_rate=tuple(2.0 * limit / task.rate_time for limit in plant.effort_limits),
        velocity_scale=velocity_scales(plant, task.travel), history=task.history, signals=default_signals(coordinates),
        velocity_box=tuple(float(_SPEED_MARGIN * speed) for speed in fastest),
    )  # fmt: skip


def _keep(
    path: Path,
    settings: Training,
    learner: Ppo | Imitation,
    generator: np.random.Generator,
    curves: list[list[float]],
    fastest: NDArray[np.float64],
) -> None:
    arrays: dict[str, Any] = {f"learner/{name}": each for name, each in learner.state().items()}
    arrays |= {f"environment/{name}": each for name, each in learner.environment.state().items()}
    words = {"settings": _settings_text(settings), "generator": json.dumps(generator.bit_generator.state)}
    arrays |= {name: np.frombuffer(text.encode(), dtype=np.uint8) for name, text in words.items()}
    buffer = io.BytesIO()
    np.savez(buffer, curves=np.array(curves), fastest=fastest, **arrays)
    try:
        write_atomically(path, buffer.getvalue())
    except OSError as error:
        left = "the one before it stays" if path.exists() else "nothing was written"
        raise DataError(f"checkpoint {path} cannot be written: {error.strerror}; {left}") from error


def _check_arrays(
    path: Path, stored: Mapping[str, NDArray[Any]], learner: Ppo | Imitation, joints: int, updates: int
) -> None:
    """Refuse arrays that do not match the settings: numpy would broadcast or cast them silently."""
    expected = {f"learner/{name}": np.asarray(each) for name, each in learner.state().items()}
    expected |= {f"environment/{name}": each for name, each in learner.environment.state().items()}
    for name in (*expected, "curves", "fastest"):
        if name not in stored:
            raise DataError(f"checkpoint {path} lacks {name}; expected a whole one, another --out, or it removed")
    expected |= {"fastest": np.zeros(joints), "curves": np.zeros((len(stored["curves"]), 4))}
    for name, own in expected.items():
        found = stored[name]
        if found.shape != own.shape or found.dtype != own.dtype:
            problem = (
                f"has shape {found.shape} of {found.dtype}; expected {own.shape} of {own.dtype}, as the settings say"
            )
        elif not np.isfinite(found).all():
            problem = "holds a number that is not finite; expected finite ones"
        else:
            continue
        raise DataError(f"checkpoint {path}: {name} {problem}: another --out, or the checkpoint removed")
    if not 1 <= len(stored["curves"]) <= updates:
        raise DataError(
            f"checkpoint {path} has done {len(stored['curves'])} updates; expected 1 to {updates}: another --out, or "
            "the checkpoint removed"
        )


def _restore(
    path: Path, settings: Training, learner: Ppo | Imitation, generator: np.random.Generator
) -> tuple[list[list[float]], NDArray[np.float64]]:
    try:
        if path.stat().st_size > _LARGEST_CHECKPOINT:
            raise DataError(f"checkpoint {path} has more than {_LARGEST_CHECKPOINT} bytes; expected one of ours")
        with np.load(path, allow_pickle=False) as stored:
            if stored["settings"].tobytes().decode() != _settings_text(settings):
                raise ParameterError(
                    f"checkpoint {path} is of a training with other settings; expected the same ones, another --out, "
                    "or the checkpoint removed"
                )
            joints = len(settings.plant.coordinates.joints)
            _check_arrays(path, stored, learner, joints, settings.updates)
            learner.restore({key[8:]: stored[key] for key in stored.files if key.startswith("learner/")})
            learner.environment.restore(
                {key[12:]: stored[key] for key in stored.files if key.startswith("environment/")}
            )
            generator.bit_generator.state = json.loads(stored["generator"].tobytes().decode())
            curves: list[list[float]] = stored["curves"].tolist()
            return curves, stored["fastest"]
    except (ParameterError, DataError):
        raise
    except Exception as error:
        raise DataError(
            f"checkpoint {path} cannot be read ({type(error).__name__}); expected one of ours, or none"
        ) from error
