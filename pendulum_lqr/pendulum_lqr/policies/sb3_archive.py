"""Actors of Stable-Baselines3 (PPO, A2C, SAC, TQC), read without that library and without torch.

The archive is a zip file with ``data`` (JSON, whose pickled parts are ignored) and ``policy.pth`` (weights). The output
is that of ``model.predict(observation, deterministic=True)``::

    PPO, A2C  u = clip(network(o), low, high), tanh between the layers by default
    SAC, TQC  u = high tanh(network(o)), relu between the layers by default

Source: Stable-Baselines3, "On saving and loading"; sb3-contrib, ``TQC``.
"""

from __future__ import annotations

import hashlib
import json
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_lqr.policies.bounded_files import read_bounded, read_parts, sentence_of, shown
from pendulum_lqr.policies.policy import Network
from pendulum_lqr.policies.torch_state import LARGEST_STATE, read_state
from pendulum_msgs_py.errors import DataError, PendulumError

__all__ = ["LARGEST_ARCHIVE", "Actor", "Space", "load_actor"]

LARGEST_ARCHIVE = 40_000_000
"""Largest archive [bytes], including optimisers of all networks."""
_LARGEST_DATA = 20_000_000
_PARTS = ("data", "policy.pth")
_VERSION = "_stable_baselines3_version"


@dataclass(frozen=True)
class _Kind:
    """Location of the actor of a class of policies among its weights."""

    algorithm: str
    activation: str
    output: str
    hidden: str
    last: str
    others: tuple[str, ...]


_SAC = _Kind("SAC", "relu", "tanh", "actor.latent_pi", "actor.mu", ("actor.log_std.", "critic.", "critic_target."))
_KINDS = {
    "stable_baselines3.common.policies": _Kind(
        "PPO or A2C",
        "tanh",
        "clip",
        "mlp_extractor.policy_net",
        "action_net",
        ("log_std", "mlp_extractor.value_net.", "value_net."),
    ),
    "stable_baselines3.sac.policies": _SAC,
    "sb3_contrib.tqc.policies": replace(_SAC, algorithm="TQC"),
}
"""Module of the class of policies -> its actor."""
_ACTIVATIONS = {
    "<class 'torch.nn.modules.activation.Tanh'>": "tanh",
    "<class 'torch.nn.modules.activation.ReLU'>": "relu",
}
_BOXES = ("<class 'gymnasium.spaces.box.Box'>", "<class 'gym.spaces.box.Box'>")
_SETTINGS = (
    "net_arch", "activation_fn", "squash_output", "use_sde", "n_quantiles", "n_critics", "ortho_init", "log_std_init",
    "optimizer_class", "optimizer_kwargs", "share_features_extractor", "normalize_images", "full_std",
    "use_expln", "clip_mean",
)  # fmt: skip
"""Settings of a policy that do not change its network, or are handled here."""


@dataclass(frozen=True)
class Space:
    """A box of vectors: its bounds in the archive's precision, shape (n,)."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def is_symmetric(self) -> bool:
        """Whether it is centred at zero."""
        return bool(np.array_equal(self.low, -self.high))


@dataclass(frozen=True)
class Actor:
    """Contents of an actor's archive.

    Attributes:
        network: From observations to actions within [-1, 1], in units of the largest action.
        observations: Space of its inputs.
        actions: Space of its outputs, in the units of its environment.
        steps: Training steps; None if unknown.
        sha256: Of the archive.
    """

    network: Network
    observations: Space
    actions: Space
    algorithm: str
    version: str
    steps: int | None
    sha256: str


def load_actor(path: str | Path) -> Actor:
    """Return the actor of an archive.

    Raises:
        DataError: The archive is missing, too large, damaged, foreign, or not a plain network with tanh or relu from a
            box of vectors to a symmetric box.
    """
    path = Path(path).expanduser()
    where = f"archive {path}"
    content = read_bounded(path, where, LARGEST_ARCHIVE)
    try:
        return _read(content)
    except PendulumError as error:
        raise DataError(f"{where} is refused: {error}") from error


def _read(content: bytes) -> Actor:
    def check(entries: list[zipfile.ZipInfo]) -> list[zipfile.ZipInfo]:
        names = [entry.filename for entry in entries]
        if any(names.count(part) != 1 for part in _PARTS):
            raise DataError(f"it holds {shown(sorted(names)[:8])}; expected data and policy.pth, each once")
        by_name = {entry.filename: entry for entry in entries}
        wanted = [by_name[name] for name in (*_PARTS, _VERSION) if name in by_name]
        for entry, largest in zip(wanted, (_LARGEST_DATA, LARGEST_STATE, 100), strict=False):
            if entry.file_size > largest:
                raise DataError(f"its {entry.filename} has {entry.file_size} bytes; expected at most {largest}")
        return wanted

    data, weights, *rest = read_parts(content, "Stable-Baselines3", check)
    saved = _json(data)
    kind = _kind(saved)
    settings = saved.get("policy_kwargs", {})
    if not isinstance(settings, dict):
        raise DataError(f"policy_kwargs is {shown(settings)}; expected a mapping")
    activation, output = _settings(kind, settings, sde=saved.get("use_sde") is True)
    observations, actions = (_space(saved, name) for name in ("observation_space", "action_space"))
    if not actions.is_symmetric or not np.all(np.isfinite(actions.high) & (actions.high > 0.0)):
        raise DataError(
            f"its actions go from {shown(actions.low.tolist())} to {shown(actions.high.tolist())}; expected a finite "
            "range with zero in its middle"
        )
    pairs = _layers(kind, read_state(weights))
    if output == "clip":
        # In units of the largest action, as a policy's output is.
        scale = actions.high.astype(np.float32)
        pairs[-1] = pairs[-1][0] / scale[:, None], pairs[-1][1] / scale
    network = Network(tuple(w for w, _ in pairs), tuple(b for _, b in pairs), activation, output)
    if (network.sizes[0], network.sizes[-1]) != (observations.low.size, actions.low.size):
        raise DataError(
            f"its network takes {network.sizes[0]} values and gives {network.sizes[-1]}, its spaces have "
            f"{observations.low.size} and {actions.low.size}; expected the same"
        )
    version = rest[0].decode("ascii", "replace").strip() if rest else ""
    steps = saved.get("num_timesteps")
    return Actor(
        network,
        observations,
        actions,
        kind.algorithm,
        version if version.isprintable() else "",
        steps if type(steps) is int else None,
        hashlib.sha256(content).hexdigest(),
    )


def _json(data: bytes) -> dict[str, Any]:
    try:
        content = json.loads(data.decode())
    except (ValueError, RecursionError) as error:
        raise DataError(f"its data is no JSON ({sentence_of(error)})") from error
    if not isinstance(content, dict):
        raise DataError(f"its data is a {type(content).__name__}; expected a mapping")
    return content


def _kind(content: Mapping[str, Any]) -> _Kind:
    policy = content.get("policy_class")
    module = policy.get("__module__") if isinstance(policy, dict) else None
    kind = _KINDS.get(module) if isinstance(module, str) else None
    if kind is None:
        raise DataError(
            f"its policy is of {shown(module)}; expected an MlpPolicy of PPO, A2C, SAC or TQC ({', '.join(_KINDS)})"
        )
    return kind


def _settings(kind: _Kind, settings: Mapping[str, Any], *, sde: bool) -> tuple[str, str]:
    """Return activation and output of the network."""
    for name, value in settings.items():
        if name not in _SETTINGS and not name.startswith(":"):
            raise DataError(f"its policy has the setting {shown(name)} ({shown(value)}); expected a plain MlpPolicy")
    activation = kind.activation
    if "activation_fn" in settings:
        given = settings["activation_fn"]
        if not isinstance(given, str) or given not in _ACTIVATIONS:
            raise DataError(f"its activation is {shown(given)}; expected Tanh or ReLU")
        activation = _ACTIVATIONS[given]
    if sde and kind.output == "tanh":
        raise DataError(
            f"its {kind.algorithm} explores by a state-dependent noise (use_sde); expected it trained without"
        )
    squashed = str(settings.get("squash_output", False)) == "True"
    return activation, "tanh" if squashed else kind.output


def _space(content: Mapping[str, Any], name: str) -> Space:
    given = content.get(name)
    kind = given.get(":type:") if isinstance(given, dict) else None
    if not isinstance(given, dict) or kind not in _BOXES:
        raise DataError(f"its {name} is {shown(kind)}; expected a Box of Gymnasium")
    shape = given.get("_shape")
    if isinstance(shape, str) and re.fullmatch(r"[(\[]\d{1,6},?[)\]]", shape):
        shape = [int(shape.strip("()[],"))]
    low, high = (_vector(given.get(end)) for end in ("low", "high"))
    if low is None or high is None or not (shape == [low.size] == [high.size]) or not np.all(low < high):
        raise DataError(
            f"its {name} has the shape {shown(shape)} from {shown(given.get('low'))} to {shown(given.get('high'))}; "
            "expected a vector and its bounds"
        )
    return Space(low, high)


def _vector(text: object) -> NDArray[np.float64] | None:
    """Parse a vector printed by numpy, such as ``[-1. -1. -8.]``, or return None."""
    if not isinstance(text, str) or len(text) > 10_000 or not re.fullmatch(r"\[[-+.0-9einf\s]+\]", text):
        return None
    try:
        return np.array([float(part) for part in text[1:-1].split()])
    except ValueError:
        return None


def _layers(
    kind: _Kind, state: Mapping[str, NDArray[np.float32]]
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Return weight and bias of each layer of the actor."""
    stems: list[str] = []
    while f"{kind.hidden}.{2 * len(stems)}.weight" in state:  # an activation lies between two of them
        stems.append(f"{kind.hidden}.{2 * len(stems)}")
    stems.append(kind.last)
    used = {f"{stem}.{part}" for stem in stems for part in ("weight", "bias")}
    unknown = [name for name in state if name not in used and not name.startswith(kind.others)]
    lacking = sorted(used - set(state))
    if unknown or lacking:
        problem = f"lacks {shown(lacking[0])}" if lacking else f"has {shown(unknown[0])} too"
        raise DataError(f"its policy.pth {problem}; expected the layers of a plain MlpPolicy of {kind.algorithm}")
    return [(state[f"{stem}.weight"], state[f"{stem}.bias"]) for stem in stems]
