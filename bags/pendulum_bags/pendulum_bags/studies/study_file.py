"""A study as a file: axes of plants, controllers, disturbances, set-points, starts and seeds, and their product."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from pendulum_bags.experiments.run_spec import CLOCKS, PERIODS, RunSpec
from pendulum_bags.experiments.settings import TIME_WITHOUT_NOISE
from pendulum_bags.studies.located import LocatedMapping
from pendulum_lqr.controller_interface.controller import controller_class
from pendulum_lqr.policies.policy_file import load_policy
from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import DataError, ParameterError

__all__ = ["ANALYSES", "AXES", "EXPERIMENTS", "Study", "StudyRun", "load_study", "shipped_studies"]

FORMAT = "pendulum_study/1"
EXPERIMENTS = ("run", "thesis", "inertia_damping", "gravity")
ANALYSES = ("metrics", "strategies", "pid_vs_lqr", "ranking", "none")
AXES = ("plant", "controller", "disturbance", "set_point", "start")
"""Axes of a study's matrix; seeds and repeats are two more."""
STARTS = {"upright": UPRIGHT, "bottom": 0.0}
_KEYS = (
    "format", "name", "description", "experiment", "analysis", "clock", "duration", "plants", "controllers",
    "disturbances", "set_points", "starts", "seeds", "repeats", "trials", "optional",
)  # fmt: skip
_PLANT_KEYS = (
    "side", "plant", "design_plant", "simulation", "mapping", "strategy", "method", "engine", "parameters", "hardware",
    "lab", "seed_offset",
)  # fmt: skip
_MAX_RUNS = 100_000
_LARGEST = 1e300  # whole numbers in YAML have no end

# Measured on two cores; an estimate for --dry-run, not a promise.
_NODE_START = 5.0
_SECONDS_PER_STEP = 1.5e-3
_BYTES_PER_STEP = {"sim": 600, "hw": 1300}
_BYTES_PER_RUN = 60_000
_THESIS_BYTES = 25_000_000
_TRIAL_SECONDS = {"inertia_damping": 7.0, "gravity": 17.0}
_TRIAL_BYTES = {"inertia_damping": 2_500_000, "gravity": 14_000_000}


@dataclass(frozen=True)
class StudyRun:
    """One cell of a study's matrix.

    Attributes:
        number: From 1, in the order of the file; added runs follow.
        labels: Name on each axis: plant, controller, disturbance, set_point, start, seed, repeat.
        spec: The run, for ``experiment: run``.
        engine: ``nodes`` over DDS, or ``process``: the same parts in one process.
        arguments: For other experiments: what follows ``python -m pendulum_bags experiment``, but ``--out``.
        seconds: Expected duration [s].
    """

    number: int
    labels: Mapping[str, Any]
    spec: RunSpec | None
    engine: str
    arguments: tuple[str, ...]
    seconds: float
    bytes: int

    @property
    def name(self) -> str:
        """Name of the run's folder: its number and what distinguishes it from others."""
        labels = [self.labels[axis] for axis in ("plant", "controller", "disturbance", "start")]
        parts = [f"{label:.4g}" if isinstance(label, float) else str(label) for label in labels]
        name = "_".join([f"{self.number:05}", *(p for p in parts if p), f"seed{self.labels['seed']}"])
        return name.replace("/", "-")

    @property
    def lab(self) -> str:
        """Lab file of the real machine that the run moves; empty where it moves none."""
        given = dict(itertools.pairwise(self.arguments))
        return str(given.get("--lab", "")) if given.get("--hardware") == "hebi" else ""

    def fingerprint(self) -> str:
        """Return a short hash of all that the run is made of, the content of the files that it names included."""
        spec = self.spec.to_json() if self.spec else None
        files = sorted({text for text in _texts([spec, self.arguments]) if Path(text).suffix})
        content = {
            "spec": spec,
            "arguments": self.arguments,
            "engine": self.engine,
            "files": {name: found for name in files if (found := _content(name))},
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Study:
    """A study.

    Attributes:
        experiment: ``run`` in lockstep, or the name of an experiment.
        clock: ``lockstep``, as fast as possible, or ``realtime``.
    """

    name: str
    description: str
    experiment: str
    analysis: str
    runs: tuple[StudyRun, ...]
    text: str = field(repr=False, default="")
    clock: str = "lockstep"
    left_out: tuple[str, ...] = ()

    @property
    def realtime(self) -> bool:
        """Whether runs keep the wall's time, so that no two of them may share the machine."""
        return self.clock == "realtime"


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _texts(item)


def _content(name: str) -> str:
    """Return a hash of a file's content, or nothing if a text is no file."""
    try:
        status = Path(name).stat()
    except (OSError, ValueError):
        return ""
    return _hash_of(name, status.st_mtime_ns, status.st_size) if Path(name).is_file() else ""


@lru_cache(maxsize=1024)
def _hash_of(name: str, _mtime_ns: int, _size: int) -> str:
    return hashlib.sha256(Path(name).read_bytes()).hexdigest()


def shipped_studies() -> dict[str, Path]:
    """Return the studies that come with the package, by name."""
    folder = resources.files("pendulum_bags.studies") / "files"
    paths = [Path(str(path)) for path in folder.iterdir() if path.name.endswith(".yaml")]
    return {path.stem: path for path in sorted(paths)}


def load_study(
    source: str | Path, *, seeds: Sequence[int] | None = None, plants: Mapping[str, Mapping[str, str]] | None = None
) -> Study:
    """Read a study file, or a shipped study by name; a ParameterError names file and line.

    Args:
        plants: By side, entries that replace those of its plants, such as ``{"sim": {"plant": "x5_9"}}``.
    """
    shipped = shipped_studies()
    path = Path(source)
    if str(source) in shipped and not path.exists():
        path = shipped[str(source)]
    elif not path.suffix and not path.exists():
        raise ParameterError(f"study is {str(source)!r}; expected a file, or one of {', '.join(sorted(shipped))}")
    file = LocatedMapping.load(path, "study file")
    file.reject_unknown(_KEYS)
    if file.get("format", str, None, repr(FORMAT)) != FORMAT:
        file.fail(f"format is {file.values['format']!r}; expected {FORMAT!r}", "format")
    text = path.read_text(encoding="utf-8")
    if plants:
        for entry in file.mapping("plants").values.values():
            entry.update(plants.get(entry.get("side", "sim"), {}))
        text = yaml.safe_dump(dict(file.values), sort_keys=False, allow_unicode=True)
    experiment = _choice(file, "experiment", EXPERIMENTS, "run")
    clock = _choice(file, "clock", CLOCKS, "realtime" if experiment == "thesis" else "lockstep")
    if experiment == "thesis" and clock != "realtime":
        file.fail("clock is 'lockstep'; expected realtime, the thesis's experiment knows no other", "clock")
    analysis = _choice(file, "analysis", ANALYSES, "metrics" if experiment == "run" else "none")
    values = list(seeds) if seeds is not None else _seeds(file)
    repeats = file.get("repeats", int, 1, "a whole number >= 1")
    if not 1 <= repeats <= _MAX_RUNS:
        file.fail(f"repeats is {repeats}; expected >= 1 and <= {_MAX_RUNS}", "repeats")
    left_out: dict[str, str] = {}
    if experiment == "run":
        left_out = _missing(file)
        runs = _plain_runs(file, clock, values, repeats, left_out)
    else:
        runs = _named_runs(file, experiment, clock, values, repeats)
    return Study(
        file.get("name", str, None, "a name"),
        file.get("description", str, "", "a sentence"),
        experiment,
        analysis,
        tuple(runs),
        text,
        clock,
        tuple(left_out.values()),
    )


def _law(file: LocatedMapping, name: str, entry: LocatedMapping) -> tuple[str, dict[str, Any]]:
    values = dict(entry.values)
    if (kind := values.pop("kind", name)) == "policy":
        path = file.path.resolve().parent / Path(str(values.get("policy", ""))).expanduser()
        try:
            load_policy(path)
        except DataError as error:
            file.fail(str(error), "controllers", name)
        values["policy"] = str(path)
    return kind, values


def _missing(file: LocatedMapping) -> dict[str, str]:
    """Return the optional controllers whose library is not installed, each with a sentence."""
    controllers = _axis(file, "controllers")
    found = {}
    for name in file.get("optional", list, [], "a list of controllers"):
        if name not in controllers:
            file.fail(f"optional has {name!r}; expected names of controllers", "optional")
        try:
            controller_class(controllers[name].values.get("kind", name))
        except ParameterError as error:
            if not isinstance(error.__cause__, ImportError):
                file.fail(str(error), "controllers", name)
            found[name] = str(error)
    return found


def _plain_runs(
    file: LocatedMapping, clock: str, seeds: Sequence[int], repeats: int, left_out: Collection[str]
) -> list[StudyRun]:
    duration = _duration(file)
    plants = _axis(file, "plants")
    controllers = {name: entry for name, entry in _axis(file, "controllers").items() if name not in left_out}
    disturbances = _axis(file, "disturbances", {"none": {}})
    set_points = file.get("set_points", list, [0.0], "a list of angles from upright [rad]")
    starts = file.get("starts", list, ["upright"], "a list of upright, bottom, random or angles [rad]")
    for index, start in enumerate(starts):
        if start not in (*STARTS, "random") and not _is_number(start):
            file.fail(f"start is {start!r}; expected upright, bottom, random or an angle [rad]", "starts", index)
    for index, value in enumerate(set_points):
        if not _is_number(value):
            file.fail(f"set-point is {value!r}; expected an angle from upright [rad]", "set_points", index)
    axes = (plants, controllers, disturbances, set_points, starts, seeds, range(1, repeats + 1))
    _limit_runs(file, axes)
    runs = []
    laws = {name: _law(file, name, entry) for name, entry in controllers.items()}
    for number, (plant, controller, disturbance, set_point, start, seed, repeat) in enumerate(
        itertools.product(*axes), start=1
    ):
        settings = plants[plant].values
        kind, parameters = laws[controller]
        offset = plants[plant].get("seed_offset", int, 0, "a whole number >= 0")
        if offset < 0:
            plants[plant].fail(f"seed_offset is {offset}; expected a whole number >= 0", "seed_offset")
        try:
            spec = RunSpec(
                side=settings.get("side", "sim"),
                plant=settings.get("plant", "thesis"),
                design_plant=settings.get("design_plant", "thesis"),
                simulation=settings.get("simulation", ""),
                mapping=settings.get("mapping", ""),
                strategy=settings.get("strategy", "direct_pwm"),
                method=settings.get("method", "euler"),
                plant_parameters=settings.get("parameters", {}),
                controller=kind,
                controller_parameters=parameters,
                disturbance=dict(disturbances[disturbance].values),
                theta=_start_angle(start, seed),
                set_point=float(set_point),
                duration=duration,
                seed=seed + offset,
                clock=clock,
            )
        except ParameterError as error:
            named = {"controller": controller, "disturbance": disturbance, "plant": plant}
            axis = next((axis for axis in named if str(error).startswith(axis)), "plant")
            file.fail(str(error), f"{axis}s", named[axis])
        engine = settings.get("engine", "nodes")
        if engine not in ("nodes", "process") or (engine == "process" and spec.side != "sim"):
            plants[plant].fail(f"engine is {engine!r}; expected nodes, or process for a plain simulator", "engine")
        if engine == "process" and (settings.get("parameters") or clock == "realtime"):
            plants[plant].fail(
                "engine is 'process'; expected nodes for a plant with parameters of its own, and in real time", "engine"
            )
        labels = _labels(plant, controller, disturbance, float(set_point), start, seed, repeat)
        steps = duration / PERIODS[spec.side]
        seconds = 0.05 + 8e-5 * steps if engine == "process" else _NODE_START + _SECONDS_PER_STEP * steps
        if clock == "realtime":
            seconds = _NODE_START + duration
        size = 56 * steps if engine == "process" else _BYTES_PER_RUN + _BYTES_PER_STEP[spec.side] * steps
        runs.append(StudyRun(number, labels, spec, engine, (), seconds, round(size)))
    return runs


def _labels(*names: Any) -> dict[str, Any]:
    return dict(zip((*AXES, "seed", "repeat"), names, strict=True))


def _limit_runs(file: LocatedMapping, axes: Sequence[Sized]) -> None:
    count = math.prod(len(axis) for axis in axes)
    if count > _MAX_RUNS:
        file.fail(f"the matrix has {count} runs; expected at most {_MAX_RUNS}")


def _named_runs(
    file: LocatedMapping, experiment: str, clock: str, seeds: Sequence[int], repeats: int
) -> list[StudyRun]:
    plants = _axis(file, "plants", {"thesis": {}})
    runs = []
    if experiment == "thesis":
        controllers = _axis(file, "controllers", {"lqr": {}})
        disturbances = _axis(file, "disturbances", {"uniform": {}})
    else:
        controllers = disturbances = {"": LocatedMapping({}, file.path, {})}
    trials = file.get("trials", int, 6 if experiment == "inertia_damping" else 3, "a whole number >= 1")
    axes = (plants, controllers, disturbances, seeds, range(1, repeats + 1))
    _limit_runs(file, axes)
    for number, (plant, controller, disturbance, seed, repeat) in enumerate(itertools.product(*axes), start=1):
        settings = plants[plant].values
        if settings.get("hardware") == "hebi" and not settings.get("lab"):
            plants[plant].fail("hardware is 'hebi' without a lab file; expected lab: FILE", "hardware")
        arguments = [experiment, "--seed", str(seed), "--hardware", str(settings.get("hardware", "emulator"))]
        if settings.get("lab"):
            # A file next to the study is found from any working folder.
            arguments += ["--lab", str((file.path.resolve().parent / str(settings["lab"])).resolve())]
        arguments += ["--plant", str(settings.get("plant", "thesis"))]
        if experiment == "thesis":
            if "strategy" in settings or not settings.get("lab"):
                arguments += ["--strategy", str(settings.get("strategy", "direct_pwm"))]
            arguments += ["--budget", "0"]
            arguments += _thesis_arguments(controllers[controller], controller, disturbances[disturbance])
            duration = _duration(file)
            arguments += ["--duration", repr(duration)]
            seconds, size = TIME_WITHOUT_NOISE + duration, _THESIS_BYTES
        else:
            arguments += ["--trials", str(trials), *(["--realtime"] if clock == "realtime" else [])]
            seconds, size = trials * _TRIAL_SECONDS[experiment], trials * _TRIAL_BYTES[experiment]
        labels = _labels(plant, controller, disturbance, 0.0, "", seed, repeat)
        runs.append(StudyRun(number, labels, None, "nodes", tuple(arguments), seconds, size))
    return runs


def _thesis_arguments(controller: LocatedMapping, name: str, disturbance: LocatedMapping) -> list[str]:
    controller.reject_unknown(("kind", "q", "r"))
    disturbance.reject_unknown(("kind", "amplitude", "hold_time"))
    kind = disturbance.values.get("kind", "uniform")
    if kind != "uniform":
        disturbance.fail(f"kind is {kind!r}; expected uniform, in the thesis's experiment", "kind")
    arguments = ["--controller", str(controller.values.get("kind", name))]
    if "q" in controller.values:
        q = controller.get("q", list, None, "two numbers")
        if len(q) != 2 or not all(_is_number(value) for value in q):
            controller.fail(f"q is {q!r}; expected two numbers", "q")
        arguments += ["--q", *(repr(float(value)) for value in q)]
    for key, source in (("r", controller), ("amplitude", disturbance), ("hold_time", disturbance)):
        if key in source.values:
            value = source.get(key, (int, float), None, "a number")
            if not _is_number(value):
                source.fail(f"{key} is {value!r}; expected a number", key)
            value = float(value)
            arguments += [f"--{key.replace('_', '-')}", repr(value)]
    return arguments


def _axis(file: LocatedMapping, key: str, default: Mapping[str, Any] | None = None) -> dict[str, LocatedMapping]:
    entries = file.mapping(key, default)
    if not entries.values:
        file.fail(f"{key} is empty; expected at least one name", key)
    found = {name: entries.mapping(name, {}) for name in entries.values}
    if key == "plants":
        for entry in found.values():
            entry.reject_unknown(_PLANT_KEYS)
    return found


def _seeds(file: LocatedMapping) -> list[int]:
    value = file.get("seeds", (list, dict), [1], "a list of whole numbers, or {first: 1, count: 20}")
    if isinstance(value, dict):
        entry = file.mapping("seeds")
        entry.reject_unknown(("first", "count"))
        first = entry.get("first", int, 1, "a whole number >= 0")
        count = entry.get("count", int, None, "a whole number >= 1")
        if not 1 <= count <= _MAX_RUNS:
            entry.fail(f"count is {count}; expected 1 to {_MAX_RUNS}", "count")
        value = list(range(first, first + count))
    if not value or not all(isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0 for seed in value):
        file.fail(f"seeds are {value!r}; expected at least one whole number >= 0", "seeds")
    if len(set(value)) != len(value):
        file.fail("a seed is given twice; use repeats to run one again", "seeds")
    return value


def _choice(file: LocatedMapping, key: str, choices: Sequence[str], default: str) -> str:
    value = file.get(key, str, default, f"one of {', '.join(choices)}")
    if value not in choices:
        file.fail(f"{key} is {value!r}; expected one of {', '.join(choices)}", key)
    return str(value)


def _start_angle(start: Any, seed: int) -> float:
    if start == "random":
        # A stream of its own: start and first noise sample must differ.
        return float(noise.uniform(seed, 2**40, math.pi))
    return STARTS[start] if isinstance(start, str) else float(start)


def _duration(file: LocatedMapping) -> float:
    value = file.get("duration", (int, float), 5.0, "a number of seconds")
    if not _is_number(value):
        file.fail(f"duration is {value!r}; expected a finite number of seconds", "duration")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < _LARGEST
