"""Identification of the numbers in a MuJoCo file: which a recording shows, their values, and the same file back."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.figures.table import Table
from pendulum_bags.identification.covariance import without
from pendulum_bags.identification.explained import REFUSED
from pendulum_bags.identification.identify import identify_motions
from pendulum_bags.identification.joint_fit import (
    JointFit,
    first_weights,
    fit,
    noise_of,
    prepare_windows,
)
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.joint_search import default_window
from pendulum_bags.identification.motion_model import DELAY
from pendulum_bags.identification.result import IdentificationResult
from pendulum_bags.identification.simulation_model import (
    LEAST,
    MujocoMotion,
    SimulationModel,
    check_alone,
    check_efforts,
)
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.determined import SPAN
from pendulum_sim.foreign.model_source import WRITTEN, ModelParameter

__all__ = [
    "Identifiability",
    "SimulationResult",
    "identifiability",
    "identify_simulation",
    "undetermined_numbers",
]

_ORDER = ("damping", "frictionloss", "inertia", "ipos", "mass", "armature")
"""Which of two numbers that the motion cannot tell apart is fitted: that which comes first here."""

_SAME = 0.02
"""Share of a number's effect that must be left after others have explained what they can, or they are one."""

_NOTHING = 1e-3
"""Effect of twice a number, in standard deviations of the noise over all samples, that is rounding."""

_TELLS = 0.05
"""Largest relative standard error, by the sensors' noise alone, of a number that is proposed."""


@dataclass(frozen=True)
class Identifiability:
    """What recordings show of the numbers of a file, before a fit.

    Attributes:
        parameters: The numbers.
        alone: Standard error of each if all others were known, in its unit; inf where it has no effect.
        together: The same with the chosen ones, offsets and delay unknown too; of one not chosen, as if it were.
        chosen: Whether each is to be fitted.
        same: By name of one that is not, why.
        singular: Singular values of the effects of the chosen ones, each scaled to 1, largest first.
        weakest: The combination of them that is seen least, shape (k,).
    """

    parameters: tuple[ModelParameter, ...]
    alone: Array
    together: Array
    chosen: tuple[bool, ...]
    same: Mapping[str, str]
    singular: Array
    weakest: Array

    @property
    def fitted(self) -> tuple[ModelParameter, ...]:
        """The numbers to fit."""
        return tuple(one for one, use in zip(self.parameters, self.chosen, strict=True) if use)

    @property
    def sentences(self) -> list[str]:
        """Return which combination of the fitted numbers is known least."""
        if len(self.singular) < 2:
            return []
        order = np.argsort(-np.abs(self.weakest))[:3]
        parts = ", ".join(f"{self.weakest[i]:+.2f} {self.fitted[i].name}" for i in order)
        values = ", ".join(f"{one:.3g}" for one in self.singular)
        return [f"Singular values of the effects, each scaled to 1: {values}. Seen least is {parts}."]

    @property
    def table(self) -> Table:
        """The numbers, for terminal and page."""
        rows = []
        for one, alone, together, use in zip(self.parameters, self.alone, self.together, self.chosen, strict=True):
            cells = [_relative(error, one) for error in (alone, together)]
            rows.append((one.name, f"{one.value:.5g}", one.unit, *cells, "fitted" if use else self.same[one.name]))
        head = ("number", "in the file", "unit", "error alone", "with the others", "")
        return Table("What the recordings show, at the numbers of the file", "\n".join(self.sentences), head, rows)


def _relative(error: float, one: ModelParameter) -> str:
    if not math.isfinite(error):
        return "no effect"
    return f"{100.0 * error / abs(one.value):.2g} %" if one.value else f"{error:.2g} {one.unit}"


def identifiability(
    model: SimulationModel, recordings: Sequence[JointRecording], window: float | None, *, propose: bool
) -> Identifiability:
    """Return what recordings show of the numbers of a model; ``propose`` chooses those that they show well.

    Sensitivities at the file's numbers, without what window starts, offsets and a delay take over, over the noise of
    the sensors: standard errors if the model lacks nothing.

    Raises:
        DataError: The recordings are too short.
    """
    length = window or default_window(model, recordings)[0]
    data = [prepare_windows(recording, length) for recording in recordings]
    still = fit(model, data, (), first_weights(data), most=8, tolerance=1e-3)
    noise = np.sqrt(np.mean([noise_of(r.position) ** 2 for r in recordings], axis=0))
    weights = np.concatenate((1.0 / np.maximum(noise, 1e-6), np.zeros(noise.size)))
    names = [one.name for one in model.parameters]
    nuisance = [name for name in model.fitted(offsets=True, delay=True) if name not in names]
    seen = replace(still, free=(*names, *nuisance), weights=weights).information
    columns = np.concatenate([effects for effects, _ in seen.windows])
    columns *= np.array([model.size(name) for name in (*names, *nuisance)])
    effects, rest = columns[:, : len(names)], columns[:, len(names) :]
    size = np.array([model.size(name) for name in names])
    norm = np.linalg.norm(effects, axis=0)
    basis = rest[:, np.linalg.norm(rest, axis=0) > 0.0]
    chosen, same = [False] * len(names), dict[str, str]()
    order = sorted(range(len(names)), key=lambda i: (_rank(names[i]), i)) if propose else range(len(names))
    for i in order:
        left = float(np.linalg.norm(without(basis, effects[:, i]))) if basis.size else norm[i]
        if not norm[i] > _NOTHING:
            same[names[i]] = "no effect on what was recorded: held"
        elif left < _SAME * norm[i]:
            same[names[i]] = f"held: {_likeness(names, effects, i, chosen)}"
        elif propose and size[i] / left > _TELLS * _usual(model, model.parameters[i], recordings):
            same[names[i]] = f"held: known to no better than {_relative(size[i] / left, model.parameters[i])}"
        else:
            chosen[i] = True
            basis = np.column_stack((basis, effects[:, i]))
    if not any(chosen):
        listing = "; ".join(f"{name}: {why}" for name, why in same.items())
        raise DataError(f"the recordings show none of the numbers ({listing}); expected a motion that does")
    together = np.array([_error(effects, rest, i, chosen) for i in range(len(names))])
    use = without(rest, effects[:, chosen]) if rest.size else effects[:, chosen]
    _, singular, right = np.linalg.svd(use / np.maximum(np.linalg.norm(use, axis=0), 1e-300), full_matrices=False)
    with np.errstate(divide="ignore"):
        alone = size / np.where(norm > _NOTHING, norm, 0.0)
    return Identifiability(model.parameters, alone, size * together, tuple(chosen), same, singular, right[-1])


def _usual(model: SimulationModel, one: ModelParameter, recordings: Sequence[JointRecording]) -> float:
    """Return a size of a number, in its unit: its own, or of a friction that is 0 what would brake like the effort."""
    at = [i for i, joint in enumerate(model.motion.joints) if model.motion.model.dof_jntid[joint.dof] == one.joint]
    if one.value or not at or not one.name.endswith(("damping", "frictionloss")):
        return model.size(one.name)
    effort = float(np.sqrt(np.mean([np.mean(each.effort[:, at[0]] ** 2) for each in recordings])))
    speed = np.mean([np.mean(np.gradient(each.position[:, at[0]], each.time) ** 2) for each in recordings])
    return effort if one.name.endswith("frictionloss") else effort / float(np.sqrt(speed))


def _rank(name: str) -> int:
    return next((i for i, one in enumerate(_ORDER) if f"/{one}" in name), len(_ORDER))


def _error(effects: Array, rest: Array, i: int, chosen: Sequence[bool]) -> float:
    """Return the relative standard error of a number next to the chosen ones."""
    others = effects[:, [use and j != i for j, use in enumerate(chosen)]]
    left = without(np.column_stack((rest, others)), effects[:, i]) if rest.size or others.size else effects[:, i]
    size = float(np.linalg.norm(left))
    return 1.0 / size if size > 1e-9 else math.inf


def _likeness(names: Sequence[str], effects: Array, i: int, chosen: Sequence[bool]) -> str:
    """Return which chosen numbers do what a number does, in words."""
    others = [j for j, use in enumerate(chosen) if use]
    shares = np.linalg.lstsq(effects[:, others], effects[:, i], rcond=None)[0] if others else np.zeros(0)
    size = np.abs(shares) * np.linalg.norm(effects[:, others], axis=0)
    most = [others[j] for j in np.argsort(-size) if size[j] > 0.1 * size.max()][:3]
    return f"does the same as {' and '.join(names[j] for j in most)}" if most else "does the same as an offset or delay"


@dataclass(frozen=True)
class SimulationResult(IdentificationResult):
    """The numbers of a model file.

    Args:
        shown: What the recordings show of them.
        simulation: Options of the command that runs the file: a mapping, a plant.
    """

    shown: Identifiability | None = field(default=None, kw_only=True)
    simulation: Mapping[str, str] = field(default_factory=dict, kw_only=True)

    @property
    def model(self) -> SimulationModel:
        """The fitted model."""
        assert isinstance(self.fit.model, SimulationModel)
        return self.fit.model

    def tables(self) -> list[Table]:
        """Return what the recordings show, before the tables of the fit."""
        return [*([self.shown.table] if self.shown is not None else ()), *super().tables()]

    def _remarks(self) -> list[str]:
        model, said = self.model, list[str]()
        if DELAY in self.fit.free:
            said.append(
                f"The effort acts {1e3 * model[DELAY]:.3g} ms after its stamp; the file does not get that: the loop "
                "around the simulation delays it, or its actuator does."
            )
        for one in self._written:
            value, (low, high) = model[one.name], model.bounds(one.name)
            if value <= low == 0.0:
                said.append(f"{one.name} is 0: the recordings want none of it.")
            elif not low < value < high:
                said.append(
                    f"{one.name} ended at the edge of its domain, {value:.4g} {one.unit}: the motion wants "
                    f"{'less' if value <= low else 'more'}."
                )
        said += [f"{one.name} is put into {one.place}." for one in self._written if one.place]
        for one in self._written:
            owner = one.name.split("/")
            if owner[0] == "actuator" and owner[2] == "gear":
                said.append(
                    f"Behind the contract commands are efforts at the joint, which {one.name} leaves as they are: give "
                    f"--mapping a file with control_per_torque: {{value: {1.0 / one.value:.9g}, unit: 1/(N m)}}."
                )
        return said

    @property
    def _written(self) -> list[ModelParameter]:
        return [one for one in self.model.parameters if one.name in self.fit.free]

    def next_step(self, plant: str) -> tuple[str, str]:
        """Return what the file, written, is to be tested by, in words and as a command."""
        way = "joints" if len(self.model.coordinates.joints) > 1 else "thesis"
        options = "".join(f" --{name} {shlex.quote(text)}" for name, text in self.simulation.items())
        which = ""
        if way == "joints" and "plant" not in self.simulation:
            options += " --plant PLANT"
            which = " (PLANT is a preset or plant file whose joints these are)"
        sentence = (
            f"It misses {100.0 * self.explained.share:.2g} % of what straight lines through the windows miss; whether "
            f"that is good enough to design a controller on, no fit can say. Test it under noise that is new{which}:"
        )
        return sentence, f"python -m pendulum_bags experiment {way} --simulation {shlex.quote(plant)}{options}"

    def _own_values(self) -> dict[str, Any]:
        assert isinstance(self.fit, JointFit)
        own = dict(zip(self.fit.own, self.fit.offsets.T.tolist(), strict=True))
        shown = self.shown
        table = {} if shown is None else {
            one.name: {"in_the_file": one.value, "alone": alone, "together": together, "fitted": use}
            for one, alone, together, use in zip(
                shown.parameters, shown.alone.tolist(), shown.together.tolist(), shown.chosen, strict=True
            )
        }  # fmt: skip
        return {"model": str(self.model.motion.source.path), "own_offsets": own, "identifiability": table}

    def write(self, path: str | Path, *, name: str = "") -> Path:
        """Write the model file with the identified numbers, and all the rest as JSON of the same name.

        Raises:
            DataError: The fit is refused.
            ParameterError: A file may not have this name, or MuJoCo does not read back what was written.
        """
        source, target = self.model.motion.source, Path(path)
        if self.refused:
            raise DataError(f"{self.refusal} No file is written.")
        listing = []
        for one in self._written:
            found = self.intervals.get(one.name)
            ends = f", 95 % interval {found.text}" if found is not None else ""
            listing.append(f"{one.name}: {self.model[one.name]:.6g} {one.unit} (was {one.value:.6g}{ends})")
        data = ", ".join(f"{Path(one['source']).name} (sha256 {one['sha256']})" for one in self.data)
        head = f"{WRITTEN} from {data}, {self.created}, in {source.path.name}:"
        values = [self.model[one.name] for one in self._written]
        source.write(target, self._written, values, [head, *listing, f"{self.verdict}"])
        write_json(target.with_suffix(".json"), self.to_dict())
        return target


def undetermined_numbers(found: JointFit, uncertainty: Uncertainty) -> str | None:
    """Return which numbers the recordings leave open, in a sentence; an inertia may be a small part of what moves."""
    model = found.model
    assert isinstance(model, SimulationModel)
    for name in model.sizes:
        value, low = model[name], model.bounds(name)[0]
        if name in found.free and name not in model.limits and value <= low:
            return (
                f"{REFUSED}: the motion wants {name} below {value:.4g} {model.unit(name)}, {LEAST:g} of what "
                f"{model.label} has; expected a bound of yours (--parameter {name}=LOW:HIGH) or, if another number is "
                "wrong, that one in its place (--parameter, once for each number to fit)"
            )
    lost = [
        f"{name} ({one.text} {model.unit(name)})"
        for name, one in uncertainty.intervals.items()
        if name in model.near and not (one.low > 0.0 and one.high < SPAN * one.low)
    ]
    return f"{REFUSED}: the recordings do not determine {', '.join(lost)}" if lost else None


def identify_simulation(
    motion: MujocoMotion,
    recordings: Sequence[JointRecording],
    wanted: Mapping[str, tuple[float, float] | None],
    *,
    held_out: Sequence[JointRecording] = (),
    window: float | None = None,
    extras: str | None = None,
    simulation: Mapping[str, str] | None = None,
) -> SimulationResult:
    """Identify numbers of a model file by output error and judge the result.

    ``wanted`` are their paths, with domains or None; without any, those that the recordings show are proposed.
    ``simulation`` are options of the command that runs the file. The others are those of
    :func:`~pendulum_bags.identification.identify.identify_joints`.

    Raises:
        DataError: A recording is too short, of other joints, or one joint of it does not move.
        ParameterError: The file has no such number.
    """
    source = motion.source
    for recording in (*recordings, *held_out):
        recording.check(motion.coordinates)
    if wanted:
        parameters = tuple(source.parameter(name) for name in wanted)
        check_alone(motion, parameters)
    else:
        joints = [int(motion.model.dof_jntid[joint.dof]) for joint in motion.joints]
        parameters = tuple(source.candidates(joints))
    domains = {name: one for name, one in wanted.items() if one is not None}
    shown = identifiability(SimulationModel.of(motion, parameters, domains), recordings, window, propose=not wanted)
    found = identify_motions(
        SimulationModel.of(motion, shown.fitted, domains), recordings, SimulationResult, undetermined_numbers,
        held_out=held_out, window=window, extras=extras,
    )  # fmt: skip
    notes = [said for one in recordings if (said := check_efforts(motion, one.name, one.effort)) is not None]
    return replace(found, shown=shown, simulation=dict(simulation or {}), notes=(*found.notes, *notes))
