"""Numbers of one course's exercises: drawn from a seed, stored in a file that students may read."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import dump_yaml, load_yaml, reject_unknown
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant

__all__ = ["CAUSES", "FAULTS", "FORMAT", "HOLD_STEP", "Tasks", "draw_plant", "draw_tasks", "read_tasks", "write_tasks"]

FORMAT = "pendulum_course/1"
FAULTS = {
    "m_stop": "m_stop",
    "voltage": "voltage_low",
    "locked_by_other": "locked_by_other",
    "module_restarted": "module_reboot",
    "motion_disagreement": "position_frozen",
}
"""Faults that the last exercise may require, with the emulator's fault that leads to each.  Frozen feedback is not
among them: a bridge without measurements publishes no torque, so no recording shows it."""
CAUSES = {
    "power": "noise that is held longer has more power at low frequencies, and the loop responds to those alone",
    "plant": "the machine is less damped than its model",
    "late": "the controller responds later on the machine",
    "samples": "fewer samples in a second make the estimate of a standard deviation smaller",
}
"""Explanations that the fourth exercise offers; the first is the right one."""
_LEAST_DIFFERENCE = 0.05
"""Least distance of the first exercise's time constant from the thesis's, which the documentation has [s]."""
_THESIS_TIME_CONSTANT = 0.372
_LIMITS = {
    "time_constant": (0.05, 5.0, "s"),
    "delay_weight": (0.001, 1.0, "1/(N m)^2"),
    "hold_time": (0.002, 0.1, "s"),
    "controller_a": (1e-5, 0.1, "1/(N m)^2"),
    "controller_b": (1e-5, 0.1, "1/(N m)^2"),
    "noise_seed": (1, 10**9, ""),
}
"""Range and unit of each number, wider than the draws: every exercise has a solution within it."""
HOLD_STEP = 0.002
"""A hold time is a multiple of the simulation's period [s]."""
_HARD = ((5e-5, 8e-5), (8e-4, 2e-3))
"""Ranges of R of the fifth exercise's controllers: one too quick for the machine, one not."""


@dataclass(frozen=True)
class Tasks:
    """The numbers of the exercises.

    Attributes:
        time_constant: To design for [s].
        delay_weight: R of the loop whose largest delay is to be found [1/(N m)^2].
        hold_time: Hold time of the noise that is compared with 2 ms [s].
        causes: Names in ``CAUSES``, in the order of a, b, c, d.
        controller_a: R of controller A [1/(N m)^2].
        controller_b: R of controller B [1/(N m)^2].
    """

    time_constant: float
    delay_weight: float
    hold_time: float
    causes: tuple[str, ...]
    controller_a: float
    controller_b: float
    noise_seed: int
    fault: str


def draw_tasks(seed: int) -> Tasks:
    """Return the tasks of a seed."""
    generator = np.random.default_rng([seed, 1])
    choices = np.round(np.arange(0.15, 0.81, 0.05), 2)
    choices = choices[abs(choices - _THESIS_TIME_CONSTANT) > _LEAST_DIFFERENCE]
    quick, calm = (_two_digits(low * (high / low) ** generator.uniform()) for low, high in _HARD)
    first = bool(generator.integers(2))
    return Tasks(
        time_constant=float(generator.choice(choices)),
        delay_weight=_two_digits(0.01 * 10.0 ** generator.uniform()),
        hold_time=float(generator.choice([0.004, 0.006, 0.008, 0.016, 0.02, 0.024])),
        causes=tuple(str(name) for name in generator.permutation(list(CAUSES))),
        controller_a=quick if first else calm,
        controller_b=calm if first else quick,
        noise_seed=int(generator.integers(1, 1000)),
        fault=str(generator.choice(list(FAULTS))),
    )


def draw_plant(seed: int) -> PlantParameters:
    """Return the hidden plant of a seed: the pendulum ``dfki``, as another workshop might have built it."""
    generator = np.random.default_rng([seed, 2])
    prior = load_plant("dfki")

    def far(factor: float) -> float:
        # Far enough from the published values.
        return float(factor ** (generator.uniform(0.4, 1.0) * generator.choice([-1.0, 1.0])))

    factors = {"inertia": far(1.25), "gravity": far(1.25), "damping": far(2.0)}
    friction = prior.coulomb_friction * far(1.6)
    changed = {name: getattr(prior, name) * factor for name, factor in factors.items()}
    return prior.with_values(**changed, coulomb_friction=friction, static_friction=friction, name="hidden")


def write_tasks(path: Path, tasks: Tasks) -> None:
    """Write the tasks as YAML."""
    content: dict[str, Any] = {"format": FORMAT, **asdict(tasks)}
    content["causes"] = list(tasks.causes)
    path.write_text(dump_yaml(content, "course file"), encoding="utf-8")


def read_tasks(path: Path) -> Tasks:
    """Return the tasks of a file of :func:`write_tasks`; a ParameterError if it is missing or another."""
    content = load_yaml(path, "course file")
    names = [field.name for field in fields(Tasks)]
    reject_unknown(content, ("format", *names), where=str(path))
    if content.get("format") != FORMAT:
        raise ParameterError(f"{path}: format is {content.get('format')!r}; expected {FORMAT!r}")
    missing = [name for name in names if name not in content]
    if missing:
        raise ParameterError(f"{path}: {missing[0]} is missing; expected the file as the course wrote it")
    values = {name: content[name] for name in names}
    for name, (low, high, unit) in _LIMITS.items():
        value = values[name]
        if type(value) not in {int, float} or not 0.0 < value < float("inf"):
            raise ParameterError(f"{path}: {name} is {value!r}; expected a number > 0")
        said = f"{path}: {name} is {value!r} {unit}".rstrip()
        if name == "hold_time":
            if not low <= value <= high or abs(value / HOLD_STEP - round(value / HOLD_STEP)) > 1e-6:
                raise ParameterError(f"{said}; expected a multiple of {HOLD_STEP:g} s up to {high:g} s")
        elif not low <= value <= high:
            raise ParameterError(f"{said}; expected {low:g} to {high:g}")
    if type(values["noise_seed"]) is not int:
        raise ParameterError(f"{path}: noise_seed is {values['noise_seed']!r}; expected a whole number")
    causes = values["causes"]
    if not isinstance(causes, list) or sorted(map(str, causes)) != sorted(CAUSES):
        raise ParameterError(f"{path}: causes is {causes!r}; expected {', '.join(sorted(CAUSES))} in some order")
    if values["fault"] not in FAULTS:
        raise ParameterError(f"{path}: fault is {values['fault']!r}; expected one of {', '.join(FAULTS)}")
    return Tasks(**{**values, "causes": tuple(causes)})


def _two_digits(value: float) -> float:
    return float(f"{value:.1e}")
