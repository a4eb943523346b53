"""What all environments take: the checks of their arguments, the length of an episode, and the frame of a vector."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "STARTS",
    "Array",
    "PlantVectorEnv",
    "check_disturbance",
    "check_reset_options",
    "check_start_name",
    "check_weights",
    "episode_steps",
]

STARTS = ("bottom", "top", "random")
Array = NDArray[np.float64]


def check_start_name(start: object) -> None:
    """Refuse a start that is none of ``STARTS``."""
    if start not in STARTS:
        raise ParameterError(f"start is {start!r}; expected one of {', '.join(STARTS)}")


def check_disturbance(disturbance: float, unit: str) -> None:
    """Refuse a half width of the noise that is none."""
    if not (math.isfinite(disturbance) and disturbance >= 0.0):
        raise ParameterError(f"disturbance is {disturbance} {unit}; expected a finite number >= 0")


def check_weights(q: object, r: float, count: int, expected: str) -> None:
    """Refuse weights of the reward that are none.

    Args:
        q: Weights of the state.
        r: Weight of the efforts.
        count: How many the state has.
        expected: That as text.
    """
    weights = np.asarray(q, dtype=np.float64)
    # Below zero they would pay for what they are to keep small.
    if weights.shape != (count,) or not (np.isfinite(weights) & (weights >= 0.0)).all():
        raise ParameterError(f"q is {q}; expected {expected}")
    if not (math.isfinite(r) and r >= 0.0):
        raise ParameterError(f"r is {r}; expected a finite number >= 0")


def check_reset_options(options: Mapping[str, Any], known: Sequence[str] = ("state", "start")) -> None:
    """Refuse unknown options."""
    unknown = set(options) - set(known)
    if unknown:
        expected = f"{', '.join(known[:-1])} or {known[-1]}"
        raise ParameterError(f"reset option {min(unknown)!r} is unknown; expected {expected}")


def episode_steps(episode_time: float, dt: float) -> float:
    """Return after how many steps an episode is over; inf for never."""
    if not episode_time > 0.0:
        raise ParameterError(f"episode_time is {episode_time} s; expected > 0")
    return math.inf if math.isinf(episode_time) else max(1, math.ceil(episode_time / dt - 1e-9))


class PlantVectorEnv(VectorEnv[Array, Array, NDArray[Any]]):
    """The frame of an environment of many equal plants: spaces, length of an episode, generators.

    Args:
        num_envs: Plants, >= 1.
        observation: Space of one plant's observations.
        action: Space of its actions.
        last: Steps of an episode.
        max_episode_steps: Another number of them, if not None.
        render_mode: None.
        single: The environment of one plant, which can be drawn.

    Raises:
        ParameterError: There is no plant or no step, or a picture is requested.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}

    def __init__(
        self,
        num_envs: int,
        observation: spaces.Box,
        action: spaces.Box,
        last: float,
        max_episode_steps: int | None,
        render_mode: str | None,
        single: str,
    ) -> None:
        self._last = last if max_episode_steps is None else max_episode_steps
        if num_envs < 1 or self._last < 1:
            raise ParameterError(
                f"num_envs is {num_envs} and max_episode_steps {max_episode_steps}; expected both >= 1"
            )
        if render_mode is not None:
            raise ParameterError(f"render_mode is {render_mode!r}; expected None: draw one {single} instead")
        self.num_envs = num_envs
        self.single_observation_space = observation
        self.single_action_space = action
        self.observation_space = batch_space(observation, num_envs)
        self.action_space = batch_space(action, num_envs)
        self._done = np.zeros(num_envs, dtype=np.bool_)
        self._generators: list[np.random.Generator] | None = None

    def _take_seeds(self, seed: int | list[int | None] | None) -> None:
        """Set the generators: one for all plants, or one for each; None in a list leaves that generator as it is."""
        if isinstance(seed, (list, tuple, np.ndarray)):
            if len(seed) != self.num_envs:
                raise ParameterError(f"seed has {len(seed)} entries; expected one for each of {self.num_envs} plants")
            before = self._generators
            self._generators = [
                before[index]
                if given is None and before is not None
                else seeding.np_random(None if given is None else int(given))[0]
                for index, given in enumerate(seed)
            ]
        elif seed is not None:
            super().reset(seed=seed)
            self._generators = None
