"""A simulation that somebody else wrote, as one side of an experiment."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pendulum_bags.runs.run_record import DIFFERENCE
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, write_plant
from pendulum_msgs_py.programs.graph import NodeProgram, ParameterArgument
from pendulum_sim.foreign.equation_check import EquationCheck
from pendulum_sim.simulator.engines import find_engine, open_simulation
from pendulum_sim.stepping.plant import Plant

__all__ = ["ForeignSimulation"]

EQUATION_FILE = "simulation.yaml"


@dataclass(frozen=True)
class _Facts:
    parameters: PlantParameters
    period: float
    method: str
    remarks: tuple[str, ...]
    check: EquationCheck


@cache
def _facts(name: str, mapping: str) -> _Facts:
    made = open_simulation(name, mapping)
    assert made.check is not None  # of others
    return _Facts(made.pendulum.parameters, made.plant.dt, made.method, made.remarks, made.check())


@dataclass(frozen=True)
class ForeignSimulation:
    """A simulation in our simulator's place.

    Attributes:
        name: Path of a model file, or ``gymnasium:ID``.
        mapping: Path of its mapping file; empty for none.
    """

    name: str
    mapping: str = ""

    @property
    def label(self) -> str:
        """Name of the file or environment, without the place where it lies."""
        return Path(self.name).name

    @property
    def parameters(self) -> PlantParameters:
        """The equation that comes closest.

        Raises:
            ParameterError: The simulation is refused.
        """
        return _facts(self.name, self.mapping).parameters

    @property
    def period(self) -> float:
        """Time between two states [s]."""
        return _facts(self.name, self.mapping).period

    def check(self, hold_time: float) -> None:
        """Refuse a simulation that cannot take part in regulation upright.

        Args:
            hold_time: Time for which a sample of the noise is held [s].

        Raises:
            ParameterError: It is refused, is too weak or too slow.
        """
        found = self.parameters
        if found.gravity >= found.effort_limit:
            raise ParameterError(
                f"simulation {self.name} gives at most {found.effort_limit:g} N m, its weight takes up to "
                f"{found.gravity:.4g} N m: nobody brings it upright on a ramp; expected more torque, as effort_limit "
                "with actuator: none in a mapping file"
            )
        if self.period > hold_time * (1.0 + 1e-9):
            raise ParameterError(
                f"simulation {self.name} has a period of {self.period * 1e3:g} ms, the noise changes every "
                f"{hold_time * 1e3:g} ms; expected timestep in a mapping file, or --hold-time {self.period:g} and more"
            )

    def require_equation(self) -> None:
        """Refuse a simulation that does not move as the equation that a controller would be designed on.

        Raises:
            ParameterError: It does not; the message says by how much, where, and why where that could be tested.
        """
        if not (check := _facts(self.name, self.mapping).check).agrees:
            raise ParameterError(
                f"simulation {self.name} {check}; expected a model of which that holds, --plant FILE to design on "
                "another equation, or --accept-differences to design on this one all the same"
            )

    def open(self) -> Plant:
        """Return the simulation in this process."""
        return open_simulation(self.name, self.mapping).pendulum

    def program(self, namespace: str, **parameters: ParameterArgument) -> NodeProgram:
        """Return its node, which has the name of ours."""
        engine, named = find_engine(self.name)
        mapping = {"mapping": str(Path(self.mapping).expanduser().resolve())} if self.mapping else {}
        return NodeProgram("pendulum_sim", engine.program, namespace, "simulator", {**named, **mapping, **parameters})

    def write_equation(self, folder: Path) -> Path:
        """Write the closest equation as a plant file, for a controller to be designed on; return the file."""
        facts = _facts(self.name, self.mapping)
        provenance = {
            "simulation": self.name,
            "engine": facts.method,
            "remarks": "; ".join(facts.remarks),
            "check": str(facts.check),
        }
        return write_plant(folder / EQUATION_FILE, facts.parameters, provenance=provenance)

    def to_json(self) -> dict[str, Any]:
        """Return what a bag says about it."""
        facts = _facts(self.name, self.mapping)
        return {
            "name": self.label,
            "engine": facts.method,
            "mapping": Path(self.mapping).name,
            "period": facts.period,
            "equation": describe_plants([facts.parameters]),
            **({} if facts.check.agrees else {DIFFERENCE: str(facts.check)}),
        }
