"""Published controllers of the public contests, in the contests' plant and in identified ones.

Files of policies hold pickles. They are read without importing or running any code that they name: only arrays are
built. Sources: github.com/dfki-ric-underactuated-lab/double_pendulum (1e8544e), folders data/policies and leaderboard.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.recordings.delimited import read_delimited
from pendulum_bags.studies.real_ai_gym import CONTESTS, Trial, published_score, score_of_rows, trajectory_rows
from pendulum_lqr.policies.bounded_files import read_bounded
from pendulum_lqr.policies.policy import Network
from pendulum_lqr.policies.torch_state import read_state
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_sim.stepping.plants import make_plant

__all__ = [
    "BOARD_PLANT",
    "BOARD_TOLERANCE",
    "BoardRow",
    "Policy",
    "PredictionRow",
    "board_jobs",
    "closed_loop",
    "prediction_jobs",
    "refuse_other_plants",
]

BOARD_TOLERANCE = 0.02
"""Largest difference of a simulated score from the published one that counts as reproduced."""
BOARD_PLANT = "double_pendulum_frictionless"
"""The contests' plant."""
_LARGEST = 8_000_000
_STEP = 0.002
_BOARD = CONTESTS[3]
_MACHINE = {
    "acrobot": ((0.5, 6.0), (0.0, 6.0)),
    "pendubot": ((6.0, 0.5), (6.0, 0.0)),
}
"""Largest torques of both joints on the machine, where 0.5 N m compensates friction, and on the board [N m]."""

Policy = Callable[[Array], Array]
"""Torques of both joints [N m] at a state [shoulder, elbow, their velocities]."""


class BoardRow(NamedTuple):
    """A controller of the simulation's board: its published score, that here, and those in further plants by name."""

    robot: str
    controller: str
    published: float
    computed: float
    elsewhere: dict[str, float]


class PredictionRow(NamedTuple):
    """MC-PILCO of a machine in one plant.

    Attributes:
        difference: Rms difference of its torques at the logged states from the logged ones [N m].
        machine: Scores of the trials.
        predicted: Scores under the perturbations of the same trials, by (friction, the machine's loop).
    """

    robot: str
    plant: str
    difference: float
    machine: tuple[float, ...]
    predicted: dict[tuple[bool, bool], tuple[float, ...]]


def refuse_other_plants(plants: Sequence[str]) -> None:
    """Refuse files or presets that are no double pendulum with torques at both joints, or have one name.

    Raises:
        ParameterError: They are.
    """
    for plant in plants:
        found = load_mechanism(plant)
        model, driven = found.mechanism.model, found.coordinates.driven_names
        if model != "double_pendulum" or len(driven) < len(found.joints) or found.coordinates.volts:
            volts = " in volts" if found.coordinates.volts else ""
            raise ParameterError(
                f"--plant {plant} is a {model}, driven{volts} at {', '.join(driven) or 'no joint'}; expected a "
                "double_pendulum with torques at both joints"
            )
    if len(names := {Path(plant).stem for plant in plants}) < len(plants) or BOARD_PLANT in names:
        raise ParameterError(f"--plant is {', '.join(plants)}; expected files of different names, none {BOARD_PLANT}")


def board_jobs(data: Path, policies: Path, plants: Sequence[str]) -> list[Callable[[], BoardRow]]:
    """Return jobs, a row each: controllers of the simulation's second board that are published as arrays.

    Args:
        data: Clone of real_ai_gym_leaderboard.
        policies: Clone of double_pendulum.
        plants: Files or presets of further plants; there by the machine's norms, without perturbations
            and the machine's loop.
    """
    return [partial(_board_row, data, policies, robot, name, plants) for robot in _MACHINE for name in _BOARD_POLICIES]


def prediction_jobs(
    data: Path, policies: Path, trials: Sequence[Trial], plants: Sequence[str]
) -> list[Callable[[], PredictionRow]]:
    """Return jobs, a row each: what a plant predicts of MC-PILCO at IROS 2024.

    It is the controller whose file gives its logged torques. Each trial is simulated with the perturbations of that
    number, as logged at 500 Hz with AR-EAPO's. Arguments as of :func:`board_jobs`.
    """
    mine = [one for one in trials if one.contest == _BOARD and one.controller == "mcpilco"]
    return [
        partial(_prediction_row, data, policies, robot, [one for one in mine if one.robot == robot], plant)
        for robot in dict.fromkeys(one.robot for one in mine)
        for plant in (BOARD_PLANT, *plants)
    ]


def _board_row(data: Path, policies: Path, robot: str, name: str, plants: Sequence[str]) -> BoardRow:
    policy = _BOARD_POLICIES[name](policies / "data/policies/design_C.1", robot)
    folder, limits = data / "data" / robot / _BOARD.simulation / name, _MACHINE[robot][1]
    files = sorted(folder.glob("scores*.csv"))
    if not files:
        raise DataError(f"{folder} has no scores*.csv; expected the published score of the simulation's board")
    runs = (closed_loop(load_mechanism(of), policy, _STEP, limits, as_machine=False) for of in (BOARD_PLANT, *plants))
    own, *others = runs
    computed = score_of_rows(_BOARD, robot, own, simulated=True)[0]
    elsewhere = {Path(of).stem: _score(robot, run) for of, run in zip(plants, others, strict=True)}
    return BoardRow(robot, name, published_score(files[0]), computed, elsewhere)


def _prediction_row(data: Path, policies: Path, robot: str, trials: Sequence[Trial], plant: str) -> PredictionRow:
    limits, folder, true = _MACHINE[robot][0], data / "data" / robot / _BOARD.folder, load_mechanism(plant)
    file = policies / f"data/policies/design_C.1/model_1.0/{robot}/MC-PILCO/policy_hardware_2024.np"
    policy = _gaussians(file, limits)
    runs = [f"experiment{one.number:02}/trajectory.csv" for one in trials]
    logs = [trajectory_rows(folder / "mcpilco" / run) for run in runs]
    differences = np.concatenate([np.array([policy(row[1:5]) for row in log]) - log[:, 5:] for log in logs])
    period = float(np.median(np.diff(logs[0][:, 0])))
    pushes = [_pushes(folder / "ar_eapo" / run) for run in runs]
    predicted = {}
    for friction in (True, False) if _has_friction(true) else (False,):
        there = true if friction else _without_friction(true)
        for as_machine in (True, False):
            predicted[friction, as_machine] = tuple(
                _score(robot, closed_loop(there, policy, period, limits, as_machine=as_machine, pushes=each))
                for each in pushes
            )
    difference = float(np.sqrt(np.mean(differences**2)))
    return PredictionRow(robot, Path(plant).stem, difference, tuple(one.score for one in trials), predicted)


def closed_loop(
    plant: PlantParameters,
    policy: Policy,
    period: float,
    limits: tuple[float, float],
    *,
    as_machine: bool,
    pushes: Array | None = None,
    duration: float = _BOARD.duration,
) -> Array:
    """Return rows of time, measured state and commands of a run from hanging at rest, one for each control period.

    Args:
        plant: A double pendulum with both joints driven.
        period: Control period, over which a command is held [s].
        limits: Of the torque of both joints [N m].
        as_machine: The loop of the machine: a command acts from the next control period on, and velocities are the
            change of position over the last one, as those of all logs are. Else at once, with the plant's velocities.
        pushes: Torques on both joints by steps of 2 ms, shape (N, 2) [N m]; the last stays. None for none.
    """
    inner = max(1, math.ceil(period / _STEP - 1e-9))
    stepped = make_plant(plant, period / inner)
    stepped.reset((0.0, 0.0), (0.0, 0.0))
    acting = (0.0, 0.0)
    rows: list[tuple[float, ...]] = []
    for k in range(math.ceil(duration / period - 1e-9)):
        position, velocity = np.array(stepped.state.position), np.array(stepped.state.velocity)
        if as_machine:
            velocity = (position - rows[-1][1:3]) / period if rows else np.zeros(2)
        state = np.concatenate([position, velocity])
        command = np.clip(policy(state), np.negative(limits), limits)
        rows.append((k * period, *state, *command))
        now, acting = (acting if as_machine else tuple(command)), tuple(command)
        for i in range(inner):
            at = round((k + i / inner) * period / _STEP)
            push = (0.0, 0.0) if pushes is None else tuple(pushes[min(at, len(pushes) - 1)])
            stepped.step(now, push)
    return np.array(rows)


def _score(robot: str, rows: Array) -> float:
    return score_of_rows(_BOARD, robot, rows)[0]


def _has_friction(plant: PlantParameters) -> bool:
    return any(joint.damping or joint.coulomb_friction for joint in plant.joints)


def _without_friction(plant: PlantParameters) -> PlantParameters:
    return replace(plant, joints=tuple(replace(one, damping=0.0, coulomb_friction=0.0) for one in plant.joints))


def _pushes(trajectory: Path) -> Array:
    table = read_delimited(trajectory)
    times = table.values("time")
    at = np.clip(np.searchsorted(times, np.arange(0.0, times[-1], _STEP)), 0, len(times) - 1)
    return np.stack([table.values(name)[at] for name in ("tau_pert1", "tau_pert2")], axis=1)


# --- policies ----------------------------------------------------------------------------------------------------


def _ar_eapo(folder: Path, robot: str) -> Policy:
    own = folder / f"model_1.1/{robot}/AR_EAPO"
    normalisation = _normalisation(own / "vec_normalize_env.pkl")
    return _network(own / "model.zip", ("mlp_extractor.policy_net", "action_net"), robot, 6.0, 20.0, normalisation)


def _evolsac(folder: Path, robot: str) -> Policy:
    own = folder / f"model_1.0/{robot}/evolsac"
    return _network(own / "model.zip", ("actor.latent_pi", "actor.mu"), robot, 3.0, 50.0)


_BOARD_POLICIES = {"ar_eapo": _ar_eapo, "evolsac": _evolsac}
"""Readers of the simulation board's controllers by their folder there; torque and velocity scales are its own."""


def _network(
    file: Path,
    names: tuple[str, str],
    robot: str,
    torque: float,
    speed: float,
    normalisation: tuple[Array | float, Array | float] = (0.0, 1.0),
) -> Policy:
    """Return the policy of an archive of Stable-Baselines3: two layers of ReLU, squashed, one torque."""
    try:
        with zipfile.ZipFile(io.BytesIO(read_bounded(file, str(file), _LARGEST))) as archive:
            state = read_state(archive.read("policy.pth"))
        layers = (f"{names[0]}.0", f"{names[0]}.2", names[1])
        weights, biases = (tuple(state[f"{layer}.{part}"] for layer in layers) for part in ("weight", "bias"))
    except (KeyError, zipfile.BadZipFile) as error:
        raise DataError(f"{file} is no archive of a policy with two hidden layers ({error})") from error
    network = Network(weights, biases, "relu", "tanh")
    mean, variance = normalisation
    where = np.array([torque, 0.0] if robot == "pendubot" else [0.0, torque])

    def policy(state: Array) -> Array:
        angles = (state[:2] % (2.0 * math.pi) - math.pi) / math.pi
        seen = np.concatenate([angles, np.clip(state[2:], -speed, speed) / speed])
        scaled = np.clip((seen - mean) / np.sqrt(variance + 1e-8), -10.0, 10.0).astype(np.float32)
        return where * float(network.forward(scaled)[0])

    return policy


def _gaussians(file: Path, limits: tuple[float, float]) -> Policy:
    """Return a policy of sums of Gaussians over velocities, cosines and sines, one for each joint, saturated."""
    parts = _arrays(file)
    try:
        scales = [np.exp(part["log_lengthscales"]) for part in parts]
        centres = [part["centers"] / scale for part, scale in zip(parts, scales, strict=True)]
        weights = [part["linear_weights"] for part in parts]
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{file} holds no two sums of Gaussians ({error})") from error

    def policy(state: Array) -> Array:
        seen = np.concatenate([state[2:], np.cos(state[:2]), np.sin(state[:2])])
        sums = (
            float(np.sum(weight * np.exp(-np.sum((centre - seen / scale) ** 2, axis=-1))))
            for weight, centre, scale in zip(weights, centres, scales, strict=True)
        )
        return np.array([limit * math.tanh(each / limit) for each, limit in zip(sums, limits, strict=True)])

    return policy


def _normalisation(file: Path) -> tuple[Array, Array]:
    try:
        rms = vars(vars(_arrays(file))["obs_rms"])
        return rms["mean"], rms["var"]
    except (KeyError, TypeError) as error:
        raise DataError(f"{file} holds no normalisation of observations ({error})") from error


class _Inert:
    """What a pickle names besides arrays: an object without code of its own that only holds its state."""

    def __new__(cls, *_: Any) -> _Inert:
        return object.__new__(cls)

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, dict):
            self.__dict__.update(state)


class _Arrays(pickle.Unpickler):
    """Builds arrays; every other name of a pickle is an inert class."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what builds an array, or an inert class; nothing is imported."""
        if module in {"numpy", "numpy.core.multiarray", "numpy._core.multiarray"} and name in _BUILDERS:
            return _BUILDERS[name]
        return _array_of if (module, name) == ("dill._dill", "_create_array") else type(name, (_Inert,), {})


def _array_of(build: Any, arguments: Any, state: Any, *_: Any) -> Any:
    array = build(*arguments)
    array.__setstate__(state)
    return array


_BUILDERS = {
    "ndarray": np.ndarray,
    "dtype": np.dtype,
    "_reconstruct": np.empty(0).__reduce__()[0],
    "scalar": np.float64(0.0).__reduce__()[0],
}


def _arrays(file: Path) -> Any:
    content = read_bounded(file, str(file), _LARGEST)
    try:
        return _Arrays(io.BytesIO(content)).load()
    except (
        pickle.UnpicklingError,
        EOFError,
        MemoryError,
        TypeError,
        ValueError,
        AttributeError,
        IndexError,
        KeyError,
    ) as error:
        raise DataError(f"{file} is no whole file of a policy ({error})") from error
