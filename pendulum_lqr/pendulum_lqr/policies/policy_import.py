"""Conversion of another library's actor into a policy, by a specification of its inputs and outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.policies.policy import SIGNALS, Network, Policy
from pendulum_lqr.policies.sb3_archive import Actor, Space
from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["ActorSpec", "policy_of_actor"]

_WORDS = (*SIGNALS, "-cos", "-sin")
_SAME = 1e-3
_BOX_MARGIN = 1.001
"""An environment that clips at a bound reaches it exactly."""


@dataclass(frozen=True)
class ActorSpec:
    """What an archive does not define of its actor.

    Attributes:
        plant: Plant of its training.
        period: Time between two commands [s].
        observation: Signals of a sample in order, with a minus for negatives (``-cos`` is the cosine of an angle from
            hanging); empty to infer them from the spaces.
        history: Number of samples, the oldest first.
        velocity_scale: Velocity that it sees as 1 [rad/s].
        velocity_box: Largest speed in training [rad/s]; 0 for the bound of its space.
        effort_limit: Torque of its largest action [N m]; 0 if that is the plant's limit in N m.
    """

    plant: PlantParameters
    period: float
    observation: str = ""
    history: int = 1
    velocity_scale: float = 1.0
    velocity_box: float = 0.0
    effort_limit: float = 0.0


class _Known(NamedTuple):
    """An environment that is identified by its spaces."""

    high: tuple[float, ...]
    action: float
    observation: str


_KNOWN = (
    _Known((1.0, 1.0, 8.0), 2.0, "cos,sin,velocity"),  # Gymnasium's Pendulum-v1
    _Known((math.pi, math.nan), math.nan, "angle,velocity"),  # this project's PendulumX59-v0
)
"""Upper bounds of observation and action; NaN for any."""


def policy_of_actor(actor: Actor, spec: ActorSpec, *, name: str, provenance: Mapping[str, Any]) -> Policy:
    """Return the policy with the outputs of an actor.

    Raises:
        ParameterError: The specification is incomplete, or contradicts the actor's spaces.
        DataError: The parts do not make a policy.
    """
    if actor.actions.high.size != 1:
        raise ParameterError(f"the actor answers with {actor.actions.high.size} values; expected 1, the torque")
    words = _words(actor, spec)
    network = actor.network
    first = network.weights[0][:, _columns(words, spec.history)] * np.float32(_signs(words, spec.history))
    box = _boxes(actor.observations, words, spec)
    limit = _effort_limit(float(actor.actions.high[0]), spec)
    return Policy(
        network=Network((np.ascontiguousarray(first), *network.weights[1:]), network.biases, network.activation,
                        network.output),
        name=name, task="imported", joints=(JOINT,), period=spec.period, plant=spec.plant, ranges={},
        effort_limit=(limit,), effort_rate=(math.inf,), velocity_scale=(spec.velocity_scale,), angle_box=(box[0],),
        velocity_box=(box[1],), signals=tuple(name for name in SIGNALS if name in _plain(words)),
        history=spec.history, provenance={**provenance, "observation": ",".join(words)},
    )  # fmt: skip


def _words(actor: Actor, spec: ActorSpec) -> list[str]:
    high = actor.observations.high
    text = spec.observation
    if not text:
        text = next((known.observation for known in _KNOWN if _is_known(known, actor)), "") if spec.history == 1 else ""
        if not text:
            raise ParameterError(
                f"the actor sees {high.size} values up to {', '.join(f'{value:g}' for value in high[:8])}, which is no "
                "environment that is known by its spaces; expected --observation, such as cos,sin,velocity"
            )
    words = [word.strip() for word in text.split(",")]
    unknown = [word for word in words if word not in _WORDS]
    if unknown or len(set(_plain(words))) != len(words):
        raise ParameterError(
            f"observation is {text!r}; expected some of {', '.join(_WORDS)}, separated by commas, each signal once"
        )
    if len(words) * spec.history != high.size:
        raise ParameterError(
            f"observation {text} in {spec.history} sample(s) has {len(words) * spec.history} values and the actor sees "
            f"{high.size}; expected as many"
        )
    return words


def _is_known(known: _Known, actor: Actor) -> bool:
    given = (*actor.observations.high, *actor.actions.high)
    wanted = (*known.high, known.action)
    if len(given) != len(wanted) or not actor.observations.is_symmetric:
        return False
    pairs = zip(wanted, given, strict=True)
    return all(math.isnan(value) or math.isclose(value, own, rel_tol=1e-6) for value, own in pairs)


def _plain(words: Sequence[str]) -> list[str]:
    return [word.removeprefix("-") for word in words]


def _columns(words: Sequence[str], history: int) -> NDArray[np.int64]:
    """Return the index in the actor's input of each input of a policy, shape (history * n,)."""
    own = sorted(range(len(words)), key=lambda k: SIGNALS.index(_plain(words)[k]))
    return np.array([len(words) * sample + k for sample in range(history) for k in own])


def _signs(words: Sequence[str], history: int) -> NDArray[np.float64]:
    signs = np.array([-1.0 if word.startswith("-") else 1.0 for word in words] * history)
    return signs[_columns(words, history)]


def _boxes(space: Space, words: Sequence[str], spec: ActorSpec) -> tuple[float, float]:
    """Return the largest angle [rad] and velocity [rad/s], after a check of all bounds."""
    angle, velocity = math.pi, spec.velocity_box
    # With stacked samples the bounds are in another order than the values (VecFrameStack repeats each bound).
    bounds = dict(zip(_plain(words), zip(space.low, space.high, strict=True), strict=True)) if spec.history == 1 else {}
    for word, (low, high) in bounds.items():
        expected = 1.0 if word in {"cos", "sin"} else high
        if low != -high or (math.isfinite(high) and not math.isclose(high, expected, rel_tol=1e-6)):
            raise ParameterError(
                f"observation says {word} and its value lies in {low:g} to {high:g}; expected "
                f"{'-1 to 1' if word in {'cos', 'sin'} else 'bounds with zero in their middle'}"
            )
        if word == "angle":
            angle = min(angle, float(high))
        if word == "velocity" and math.isfinite(high):
            largest = _BOX_MARGIN * float(high) * spec.velocity_scale
            if velocity > largest:
                raise ParameterError(
                    f"velocity_box is {velocity:g} rad/s and the actor's space ends at "
                    f"{largest / _BOX_MARGIN:g} rad/s; expected at most that"
                )
            velocity = velocity or largest
    if not velocity > 0.0:
        raise ParameterError(
            "the archive gives the velocity no bound; expected --velocity-box, the largest speed that training visited "
            "[rad/s]"
        )
    return angle, velocity


def _effort_limit(largest: float, spec: ActorSpec) -> float:
    limit = spec.plant.effort_limit
    if not spec.effort_limit:
        if abs(largest - limit) > _SAME * limit:
            raise ParameterError(
                f"the largest action is {largest:g} and plant {spec.plant.name!r} has {limit:g} N m; expected "
                "--effort-limit, the torque of the largest action [N m]"
            )
        return limit
    if spec.effort_limit > (1.0 + _SAME) * limit:
        raise ParameterError(
            f"effort_limit is {spec.effort_limit:g} N m and plant {spec.plant.name!r} has {limit:g} N m; expected at "
            "most that"
        )
    return spec.effort_limit
