"""A third-party simulation as one side of an experiment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.runs.case import identity_of
from pendulum_bags.runs.run_record import DIFFERENCE
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.names import Event
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, write_plant
from pendulum_msgs_py.programs.graph import NodeProgram, ParameterArgument
from pendulum_rosbag.reader import read_bag
from pendulum_sim.foreign.equation_check import TOLERANCE, EquationCheck, check_recording
from pendulum_sim.simulator.engines import find_engine, open_simulation
from pendulum_sim.stepping.plants import JointPlant, make_plant

__all__ = ["ForeignSimulation", "absolute_plant", "recorded_difference"]

EQUATION_FILE = "simulation.yaml"
_PIECES = 0.9
"""Share of the pieces of a recording that must agree: a late state spoils its piece."""


@dataclass(frozen=True)
class _Facts:
    parameters: PlantParameters
    period: float
    method: str
    remarks: tuple[str, ...]
    check: EquationCheck


@cache
def _facts(name: str, mapping: str, plant: str) -> _Facts:
    made = open_simulation(name, mapping, plant)
    assert made.check is not None  # of others
    return _Facts(made.plant.parameters, made.plant.dt, made.method, made.remarks, made.check())


@dataclass(frozen=True)
class ForeignSimulation:
    """A model file or ``gymnasium:ID`` in place of the simulator, with a mapping file or "".

    ``plant`` is the preset or plant file of several joints; empty for a pendulum, whose equation is found.
    """

    name: str
    mapping: str = ""
    plant: str = ""

    @property
    def _facts(self) -> _Facts:
        return _facts(self.name, self.mapping, self.plant)

    @property
    def label(self) -> str:
        """Name of the file or environment, without its folder."""
        return Path(self.name).name

    @property
    def parameters(self) -> PlantParameters:
        """The nearest equation; a ParameterError if the simulation is refused."""
        return self._facts.parameters

    @property
    def period(self) -> float:
        """Time between two states [s]."""
        return self._facts.period

    def check(self, hold_time: float) -> None:
        """Raise a ParameterError if it is too weak or slow to be held upright; noise is held ``hold_time`` [s]."""
        found = self.parameters
        if found.is_pendulum and found.gravity >= found.effort_limit:
            ways = {"gymnasium": "set, on the attribute that limits it,", "fmu": "effort_limit"}
            way = ways.get(find_engine(self.name)[0].program, "effort_limit with actuator: none")
            raise ParameterError(
                f"simulation {self.name} gives at most {found.effort_limit:g} N m, its weight takes up to "
                f"{found.gravity:.4g} N m: no ramp brings it upright; expected more torque, as {way} in a mapping file"
            )
        if self.period > hold_time * (1.0 + 1e-9):
            raise ParameterError(
                f"simulation {self.name} has a period of {self.period * 1e3:g} ms, the noise changes every "
                f"{hold_time * 1e3:g} ms; expected timestep in a mapping file, or --hold-time {self.period:g} and more"
            )

    def require_equation(self) -> None:
        """Raise a ParameterError if the simulation deviates from its equation: how much, where, and a tested cause."""
        if not (check := self._facts.check).agrees:
            raise ParameterError(
                f"simulation {self.name} {check}; expected one that does, --plant FILE to design on another equation, "
                "or --accept-differences to design on this one all the same"
            )

    def absolute(self) -> dict[str, str]:
        """Return the entries of a study that name it, with absolute paths."""
        given = {"simulation": self.name, "mapping": self.mapping}
        return {key: str(Path(text).resolve()) if Path(text).is_file() else text for key, text in given.items()}

    def open(self) -> JointPlant:
        """Return the simulation in this process."""
        return open_simulation(self.name, self.mapping, self.plant).plant

    def program(self, namespace: str, **parameters: ParameterArgument) -> NodeProgram:
        """Return its node, which has the simulator's name."""
        engine, named = find_engine(self.name)
        given = {"mapping": str(Path(self.mapping).expanduser().resolve())} if self.mapping else {}
        given |= {"plant": absolute_plant(self.plant)} if self.plant else {}
        return NodeProgram("pendulum_sim", engine.program, namespace, "simulator", {**named, **given, **parameters})

    def write_equation(self, folder: Path) -> Path:
        """Write the closest equation as a plant file, for a controller to be designed on; return the file."""
        facts = self._facts
        provenance = {
            "simulation": self.name,
            "engine": facts.method,
            "remarks": "; ".join(facts.remarks),
            "check": str(facts.check),
        }
        return write_plant(folder / EQUATION_FILE, facts.parameters, provenance=provenance)

    @property
    def identity(self) -> str:
        """Name, equation and files."""
        equation = describe_plants([self.parameters])
        return identity_of(self.label, equation, *map(Path, filter(None, (self.name, self.mapping))))

    def to_json(self) -> dict[str, Any]:
        """Return its entry in a bag's metadata."""
        facts = self._facts
        return {
            "name": self.label,
            "engine": facts.method,
            "mapping": Path(self.mapping).name,
            "period": facts.period,
            "equation": describe_plants([facts.parameters]),
            **({} if facts.check.agrees else {DIFFERENCE: str(facts.check)}),
        }


def absolute_plant(plant: str) -> str:
    """Return a preset unchanged, and a file's absolute path."""
    return plant if Path(plant).suffix == "" else str(Path(plant).resolve())


def recorded_difference(bag: Path, namespace: str, plant: str) -> str:
    """Return how far a running plant followed its equation, if it moved; a DataError without states.

    Of several joints, which are held by hand before the noise and fall after it, the noise alone counts.
    """
    parameters = load_mechanism(plant)
    with read_bag(bag) as opened:
        states = opened.joints(f"{namespace}/{names.JOINT_STATES}")
        efforts = opened.joints(f"{namespace}/{parameters.coordinates.topics.applied}")
        marks = {event["name"]: int(event["stamp_ns"]) for event in opened.events()}
    stamps = states.stamp_ns
    begin, end = int(stamps[0]), int(stamps[-1])
    if not parameters.is_pendulum:
        begin, end = marks.get(Event.NOISE_START, begin), marks.get(Event.NOISE_END, end)
    seconds = (stamps - begin) / NANOSECONDS
    period = float(np.median(np.diff(seconds)))
    times = np.arange(0.0, (end - begin) / NANOSECONDS, period)
    position, velocity = (
        np.stack([np.interp(times, seconds, column) for column in values.T], axis=1)
        for values in (states.position, states.velocity)
    )
    held = np.searchsorted((efforts.stamp_ns - begin) / NANOSECONDS, times + 1e-9, side="right") - 1
    effort = efforts.effort[np.maximum(held, 0)]
    substeps = None if parameters.drivetrain is not None else math.ceil(period / 1e-3)
    errors = check_recording(position, velocity, effort, make_plant(parameters, period, substeps=substeps))
    if not errors.size:
        return f"{namespace} ran already, and its recording is too short to check {plant} against it."
    error = float(np.quantile(errors.max(axis=1), _PIECES))
    verb = "agrees with" if error <= TOLERANCE else "DIFFERS FROM"
    spans = ", ".join(
        f"{f'{joint.name} ' if len(position.T) > 1 else ''}{np.min(q):.2f} to {np.max(q):.2f} {joint.unit}, up to "
        f"{np.max(np.abs(v)):.2g} {joint.velocity_unit}"
        for joint, q, v in zip(parameters.mechanism.joints, position.T, velocity.T, strict=True)
    )
    return (
        f"{namespace} ran already and could be put nowhere: only its recording was compared with {plant}. It {verb} "
        f"that equation within {100.0 * error:.2g} % of its motion (at most {100.0 * TOLERANCE:g} %) in nine of ten "
        f"pieces, at {spans} and {np.max(np.abs(effort)):.2g} {parameters.coordinates.drive_unit}; nothing beyond was "
        "checked."
    )
