"""An environment of Gymnasium as a plant: Pendulum-v1, this package's, and any with an adapter file.

An adapter file, whose missing entries are those of a known environment::

    format: pendulum_simulation/1
    make: {g: 9.81}                        # arguments of gymnasium.make
    set: {dt: 0.002, max_torque: 13.0}     # attributes of the environment
    angle: {index: 0, unit: rad, sign: 1, zero: 3.14159}  # of the observation; or {cos: 0, sin: 1, ...}
    velocity: {index: 1, unit: rad/s}
    torque: {index: 0, scale: 1.0, sign: 1}  # entry of the action, and N m for 1 of it
    read: state                            # attribute with angle and velocity; by default the observation
    start: state       # attribute that is set to start; or {options: state} or {options: [theta, theta_dot]} of reset
    period: dt                             # attribute, or {value: 0.05, unit: s}
    effort_limit: max_torque               # attribute, or {value: 2.0, unit: N m}; by default the action's bounds
    equation: plant.yaml                   # plant file; by default it is identified from the environment
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.dynamics.runge_kutta import along_1, rk4_joints
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.parameters import load_yaml, reject_unknown, require_mapping
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant, pendulum_plant
from pendulum_msgs_py.programs.extras import how_to_install
from pendulum_sim.foreign.mujoco_mapping import FORMAT
from pendulum_sim.stepping.plant import PlantState, check_start, command_within

__all__ = ["KNOWN", "GymnasiumPlant", "load_adapter", "load_gymnasium_plant"]

Adapter = Mapping[str, Any]
Array = NDArray[np.float64]

KNOWN: dict[str, Adapter] = {
    "Pendulum-v1": {
        "angle": {"index": 0, "zero": math.pi},
        "velocity": {"index": 1},
        "torque": {"index": 0},
        "read": "state",
        "start": "state",
        "period": "dt",
        "effort_limit": "max_torque",
    },
    "PendulumX59-v0": {
        "make": {"episode_time": math.inf},
        "angle": {"index": 0, "zero": -math.pi},
        "velocity": {"index": 1},
        "torque": {"index": 0},
        "start": {"options": "state"},
        "period": "dt",
    },
}
"""Adapters of known environments."""
_KEYS = ("make", "set", "angle", "velocity", "torque", "read", "start", "period", "effort_limit", "equation")
_ENTRIES = {
    "angle": ("index", "cos", "sin", "unit", "sign", "zero"),
    "velocity": ("index", "unit", "sign"),
    "torque": ("index", "scale", "sign"),
}
_UNITS = {"angle": {"rad": 1.0, "deg": math.pi / 180.0}, "velocity": {"rad/s": 1.0, "deg/s": math.pi / 180.0}}
_QUANTITIES = {"period": "s", "effort_limit": "N m"}
_PROBES = 64
_DRAWN, _FEW, _AS_WELL = 300, 5, 4.0
_AS_GOOD = 0.1
"""Error of a step that still counts as a match, relative to a usual change."""
_LITTLE = 0.1
"""Share of the largest torque that no limit cuts."""
_SUBSTEPS, _ROUNDS = 20, 8
"""Integration steps of the equation in a period, and iterations of its fit."""
_BETTER = 0.5
"""The solved equation is used if its error is below this share of a first-order step's."""
_AHEAD = 0.5
"""Largest difference between an angle and its prediction from the velocities [rad]."""
_STEPS = 3
"""Fewest steps of a probe, of which the last counts."""
_LATEST = 50
"""Latest step in which a torque takes effect."""


def load_adapter(path: str | Path) -> Adapter:
    """Return the content of an adapter file; a ParameterError names file and entry."""
    document = load_yaml(path, "adapter file")
    reject_unknown(document, ("format", *_KEYS), where=str(path))
    if document.pop("format", None) != FORMAT:
        raise ParameterError(f"{path}: format is missing or another; expected {FORMAT!r}")
    for name, allowed in _ENTRIES.items():
        if name in document:
            reject_unknown(require_mapping(document[name], f"{path}: {name}"), allowed, where=f"{path}: {name}")
    for name in ("make", "set"):
        require_mapping(document.get(name, {}), f"{path}: {name}")
    if "equation" in document:
        equation = str(document["equation"])
        beside = Path(path).parent / equation
        document["equation"] = str(beside) if beside.is_file() else equation
    return document


def load_gymnasium_plant(
    env_id: str, adapter: Adapter | None = None, *, seed: int = 0, effort_limit: float = 0.0
) -> GymnasiumPlant:
    """Return an environment as a plant.

    ``env_id`` is that of ``gymnasium.make``; ``module:ID`` imports the module first. ``seed`` is used by every reset;
    ``effort_limit`` is the largest torque if nothing else sets one, 0 for none [N m].

    Raises:
        ParameterError: Gymnasium is missing, or environment and adapter do not fit.
    """
    # Imported late: only environments need Gymnasium.
    try:
        import gymnasium
    except ImportError as error:
        raise ParameterError(how_to_install(error) or f"Gymnasium cannot be imported: {error}") from error
    if env_id == "PendulumX59-v0":
        import pendulum_sim.environments  # noqa: F401  # registers it
    entries = {**KNOWN.get(env_id.rpartition(":")[2], {}), **(adapter or {})}
    try:
        env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **entries.get("make", {}))
    except (Exception, SystemExit) as error:
        raise ParameterError(f"Gymnasium refuses environment {env_id!r}: {' '.join(str(error).split())}") from error
    return GymnasiumPlant(env, env_id, entries, seed, effort_limit)


class GymnasiumPlant:
    """An environment as a plant; see :func:`load_gymnasium_plant`. A push adds to the action, its only input.

    ``parameters`` are the closest equation of a pendulum, ``remarks`` the automatic choices as text.
    """

    description = "gymnasium"

    def __init__(self, env: Any, env_id: str, adapter: Adapter, seed: int, effort_limit: float) -> None:
        self._env, self._id, self._adapter, self._seed = env, env_id, adapter, seed
        for name, value in adapter.get("set", {}).items():
            if not hasattr(env.unwrapped, name):
                raise self._error(f"set names {name!r}, which the environment has not")
            setattr(env.unwrapped, name, value)
        missing = [name for name in ("angle", "velocity", "torque") if name not in adapter]
        if missing:
            raise self._error(f"nothing says what is {' and '.join(missing)}; expected an adapter file")
        self._angle = self._reader("angle")
        self._velocity = self._reader("velocity")
        torque = adapter["torque"]
        self._per_torque = _sign(torque, self._error) / self._number(torque.get("scale", 1.0), "torque.scale")
        space = env.action_space
        if not hasattr(space, "low"):
            raise self._error(f"its actions are {space}; expected a continuous action")
        self._action = np.zeros(space.shape, dtype=space.dtype)
        self._index = self._whole(torque.get("index", 0), "torque.index")
        if not 0 <= self._index < self._action.size:
            raise self._error(f"torque.index is {self._index}, an action has {self._action.size} entries")
        self.dt = self._quantity("period", "dt")
        bound = min(abs(float(space.low.flat[self._index])), abs(float(space.high.flat[self._index])))
        self._limit = (
            self._quantity("effort_limit") if "effort_limit" in adapter else bound / abs(self._per_torque)
        ) or effort_limit
        if not math.isfinite(self._limit):
            self._limit = effort_limit
        if not self._limit > 0.0:
            raise self._error("nothing bounds its torque; expected effort_limit")
        self._steps, self._applied = 0, 0.0
        self._theta = self._theta_dot = 0.0
        self._read(self._reset_env({}), fresh=True)
        self.remarks: list[str] = [f"period {self.dt * 1e3:g} ms, at most {self._limit:g} N m"]
        self.parameters = self._find_equation()
        self.reset()

    @property
    def state(self) -> PlantState:
        """The present state; the effort is the command, as nothing is measured."""
        return PlantState(self._steps * self.dt, self._theta, self._theta_dot, self._applied)

    def reset(self, theta: float = 0.0, theta_dot: float = 0.0) -> PlantState:
        """Restart with the seed, at an angle [rad] and a velocity [rad/s]; a ParameterError if that is impossible."""
        check_start(theta, theta_dot)
        start = self._adapter.get("start")
        if start is None:
            raise self._error(
                "nothing says how it starts at an angle; expected start: an attribute, or options of reset"
            )
        wanted = [self._theirs("angle", theta), self._theirs("velocity", theta_dot)]
        if isinstance(start, Mapping):
            options = start.get("options")
            if isinstance(options, str):
                observation = self._reset_env({options: wanted})
            elif isinstance(options, list) and len(options) == 2:
                observation = self._reset_env(dict(zip(map(str, options), wanted, strict=True)))
            else:
                raise self._error(f"start is {dict(start)}; expected options: NAME, or options: [ANGLE, VELOCITY]")
        else:
            observation = self._reset_env({})
            held = np.array(getattr(self._env.unwrapped, str(start)), dtype=float)
            for name, value in zip(("angle", "velocity"), wanted, strict=True):
                held[self._whole(self._adapter[name].get("index"), f"{name}.index")] = value
            setattr(self._env.unwrapped, str(start), held)
        self._steps, self._applied = 0, 0.0
        if isinstance(start, str) and self._adapter.get("read") is None:
            # The observation is older than the start; the first step renews it.
            self._theta, self._theta_dot = float(theta), float(theta_dot)
        else:
            self._read(observation, fresh=True)
            # The environment does not count whole turns.
            self._theta += 2.0 * math.pi * round((theta - self._theta) / (2.0 * math.pi))
        return self.state

    def step(self, effort: float, push: float = 0.0) -> PlantState:
        """Advance by one period under a commanded torque and a push [N m].

        Raises:
            FaultError: The environment ended its episode.
            ParameterError: A torque is not finite (nothing moves then).
        """
        command = command_within(self._limit, effort, push)
        if self._advance(command, push):
            raise FaultError(
                f"the environment ended its episode at {self._theta:.4g} rad after {self._steps * self.dt:.3f} s"
            )
        return self.state

    def reseeded(self) -> GymnasiumPlant:
        """Return the same environment with another seed of its resets; run one at a time."""
        other = copy.copy(self)
        other._seed = self._seed + 1
        return other

    # --- entries of the adapter -----------------------------------------------------------------------------

    def _error(self, text: str) -> ParameterError:
        return ParameterError(f"environment {self._id}: {text}")

    def _number(self, value: object, name: str) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value == 0:
            raise self._error(f"{name} is {value!r}; expected a number, not 0")
        return float(value)

    def _whole(self, value: object, name: str) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._error(f"{name} is {value!r}; expected the number of an entry")
        return value

    def _quantity(self, name: str, attribute: str = "") -> float:
        entry = self._adapter.get(name, attribute)
        if isinstance(entry, str):
            value = getattr(self._env.unwrapped, entry, None)
            if value is None:
                raise self._error(
                    f"it has no attribute {entry!r}; expected {name}: {{value: ..., unit: {_QUANTITIES[name]}}}"
                )
        else:
            mapping = require_mapping(entry, f"environment {self._id}: {name}")
            if mapping.get("unit") != _QUANTITIES[name]:
                raise self._error(f"{name}: unit is {mapping.get('unit')!r}; expected {_QUANTITIES[name]!r}")
            value = mapping.get("value")
        number = self._number(value, name)
        if number < 0.0:
            raise self._error(f"{name} is {number} {_QUANTITIES[name]}; expected > 0")
        return number

    def _reader(self, name: str) -> Callable[[Any], float]:
        entry = self._adapter[name]
        unit = entry.get("unit", next(iter(_UNITS[name])))
        if unit not in _UNITS[name]:
            raise self._error(f"{name}: unit is {unit!r}; expected {' or '.join(_UNITS[name])}")
        scale, sign = _UNITS[name][unit], _sign(entry, self._error)
        zero = float(entry.get("zero", 0.0))
        if "cos" in entry or "sin" in entry:
            cos, sin = (self._whole(entry.get(part), f"{name}.{part}") for part in ("cos", "sin"))
            return lambda values: sign * (math.atan2(float(values[sin]), float(values[cos])) - zero)
        index = self._whole(entry.get("index"), f"{name}.index")
        return lambda values: sign * scale * (float(values[index]) - zero)

    def _theirs(self, name: str, value: float) -> float:
        entry = self._adapter[name]
        unit = _UNITS[name][entry.get("unit", next(iter(_UNITS[name])))]
        return _sign(entry, self._error) * value / unit + float(entry.get("zero", 0.0))

    # --- the environment -----------------------------------------------------------------------------------

    def _reset_env(self, options: dict[str, Any]) -> Any:
        answer = self._env.reset(seed=self._seed, options=options or None)
        if not (isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], Mapping)):
            raise self._error(
                f"reset returns {_count(answer)}; expected observation and info, as in Gymnasium 0.26 and later"
            )
        return answer[0]

    def _advance(self, command: float, push: float = 0.0) -> bool:
        self._action.flat[self._index] = (command + push) * self._per_torque
        answer = self._env.step(self._action)
        if not (isinstance(answer, tuple) and len(answer) == 5):
            raise self._error(
                f"step returns {_count(answer)}; expected 5 values (observation, reward, terminated, truncated, info), "
                "as in Gymnasium 0.26 and later"
            )
        self._steps += 1
        self._applied = command
        self._read(answer[0])
        return bool(answer[2])

    def _read(self, observation: Any, *, fresh: bool = False) -> None:
        source = self._adapter.get("read")
        values = observation if source is None else getattr(self._env.unwrapped, str(source))
        try:
            theta, theta_dot = self._angle(values), self._velocity(values)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            found = f"of shape {np.shape(values)}" if isinstance(values, np.ndarray) else f"a {type(values).__name__}"
            name = "observation" if source is None else f"attribute {source!r}"
            raise self._error(
                f"angle and velocity are not where the adapter says; its {name} is {found}, expected an array that "
                "holds both"
            ) from error
        if not fresh and math.isfinite(theta):
            # Observations are wrapped, the plant's angles are not. In a long period the joint may turn by more than
            # half a turn, which the velocities show.
            ahead = 0.5 * self.dt * (self._theta_dot + theta_dot)
            if not (abs(ahead) > math.pi and abs(wrap(theta - self._theta - ahead)) < _AHEAD):
                ahead = 0.0
            theta = self._theta + ahead + wrap(theta - self._theta - ahead)
        self._theta, self._theta_dot = theta, theta_dot

    def _speed(self, effort: float, steps: int) -> float:
        """Return the velocity some steps after a start at rest [rad/s]."""
        self.reset()
        for _ in range(steps):
            self._advance(effort)
        return self._theta_dot

    def _find_equation(self) -> PlantParameters:
        if "equation" in self._adapter:
            found = load_plant(self._adapter["equation"])
            return found.with_values(effort_limit=self._limit, name=self._id)
        # Single steps: v' = a v + c u - d sin(theta), where a and c give inertia and damping. The first steps are
        # skipped: neither a reset nor a short delay of the effort may bias the fit.
        generator = np.random.default_rng(0)
        rows, angles, after = np.empty((_PROBES, 3)), np.empty(_PROBES), np.empty(_PROBES)
        for i in range(_PROBES):
            self.reset(generator.uniform(-math.pi, math.pi), generator.uniform(-1.0, 1.0))
            effort = generator.uniform(-self._limit, self._limit)
            for _ in range(_STEPS + i % _STEPS):
                angles[i] = self._theta
                rows[i] = self._theta_dot, effort, -math.sin(self._theta)
                self._advance(effort)
            after[i] = self._theta_dot
        if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(after))):
            raise self._error(f"it is at {self._theta} rad, {self._theta_dot} rad/s; expected finite numbers")
        # Robust against stops and limits in most probes: of fits to few of them, the one that a third of all match
        # best, then a fit to those that match it.
        fits = []
        for _ in range(_DRAWN):
            few = generator.choice(_PROBES, _FEW, replace=False)
            fitted, *_ = np.linalg.lstsq(rows[few], after[few], rcond=None)
            left = np.abs(after - rows @ fitted)
            fits.append((_third(left), left))
        best, left = min(fits, key=lambda fit: fit[0])
        least = _AS_GOOD * float(np.median(np.abs(after - rows[:, 0])))
        kept = left <= max(_AS_WELL * best, least)
        (a, c, d), *_ = np.linalg.lstsq(rows[kept], after[kept], rcond=None)
        if not c > 0.0:
            answers = (self._speed(_LITTLE * self._limit, n) - self._speed(0.0, n) for n in range(_STEPS, _LATEST))
            steps, answer = next(((n, v) for n, v in enumerate(answers, _STEPS) if v), (0, 0.0))
            if answer < 0.0:
                why = "a positive torque speeds it up backwards; expected torque.sign or angle.sign the other way"
            elif answer == 0.0:
                why = "a torque does not move it; expected another torque.index"
            elif steps > _STEPS:
                why = f"a torque moves it only in step {steps} (a delay); expected equation: FILE"
            else:
                why = f"it moves as no pendulum does in single steps from {_PROBES} states; expected equation: FILE"
            raise self._error(why)
        slowing = 1.0 - float(a)
        if slowing > 1e-9:
            damping = slowing / float(c)
            inertia = -damping * self.dt / math.log(float(a)) if a > 0.0 else self.dt / float(c)
        else:
            damping, inertia = 0.0, self.dt / float(c)
        # For a long period a first-order step may be inaccurate: the solved equation is used if it matches better.
        rates = np.array([max(damping, 0.0), 1.0, max(0.0, float(d / c))]) / inertia
        for _ in range(2):
            rates = _fit_rates(rates, rows[kept], angles[kept], after[kept], self.dt)
            left = np.abs(after - _moved(rates, rows, angles, self.dt))
            kept = left <= max(_AS_WELL * _third(left), least)
        if rates[1] > 0.0 and _third(left) < _BETTER * best:
            inertia, damping, d = 1.0 / float(rates[1]), max(0.0, float(rates[0] / rates[1])), rates[2] / rates[1] * c
        return pendulum_plant(
            inertia=inertia, damping=damping, gravity=max(0.0, float(d / c)), effort_limit=self._limit, name=self._id
        )


def _third(left: Array) -> float:
    """Return the error that a third of all probes stay below."""
    return float(np.sort(left)[_PROBES // 3])


def _moved(rates: Array, rows: Array, angles: Array, dt: float) -> Array:
    """Return velocities after a period of v' = (v, u, -sin theta) . (-b/J, 1/J, G/J), by Runge-Kutta [rad/s]."""

    def forward(q: tuple[Array], v: tuple[Array], torque: tuple[Array], p: Array) -> tuple[Array]:
        return (p[1] * torque[0] - p[0] * v[0] - p[2] * np.sin(q[0]),)

    q, v, effort = (angles,), (rows[:, 0],), (rows[:, 1],)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_SUBSTEPS):
            q, v = rk4_joints(forward, along_1, q, v, effort, effort, effort, dt / _SUBSTEPS, rates)
    return v[0]


def _fit_rates(rates: Array, rows: Array, angles: Array, after: Array, dt: float) -> Array:
    """Return the rates that match the velocities after a period, by Gauss-Newton."""
    for _ in range(_ROUNDS):
        here = _moved(rates, rows, angles, dt)
        steps = 1e-6 * np.maximum(np.abs(rates), 1e-3 * float(np.max(rates)))
        slopes = [(_moved(rates + step, rows, angles, dt) - here) / step.sum() for step in np.diag(steps)]
        change = np.linalg.lstsq(np.stack(slopes, axis=1), after - here, rcond=None)[0]
        if not np.all(np.isfinite(change)):
            break
        rates = rates + change
    return rates


def _count(answer: object) -> str:
    return f"{len(answer)} values" if isinstance(answer, tuple) else f"a {type(answer).__name__}"


def _sign(entry: Mapping[str, Any], error: Callable[[str], ParameterError]) -> float:
    sign = entry.get("sign", 1)
    if isinstance(sign, bool) or sign not in {1, -1}:
        raise error(f"sign is {sign!r}; expected 1 or -1")
    return float(sign)
