"""Options for the plants of an experiment, with the same names in each command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pendulum_bags.experiments.simulation import ForeignSimulation

__all__ = [
    "AcceptDifferences",
    "AnySimulation",
    "HardwareMapping",
    "MappingFile",
    "SimulatedPlant",
    "Simulation",
    "Strategy",
    "equation_file",
]

SimulatedPlant = Annotated[
    str | None,
    typer.Option(
        help="Preset or plant file of the simulated plant, and of the controller's design; default thesis, or with "
        "--simulation the equation read off it."
    ),
]
Simulation = Annotated[
    str, typer.Option(help="In the simulator's place: a model file (MJCF or URDF, run by MuJoCo), or gymnasium:ID.")
]
AnySimulation = Annotated[
    str,
    typer.Option(
        help="In the simulator's place: a model file (MJCF or URDF, run by MuJoCo), gymnasium:ID, or ros:/NAMESPACE "
        "for a plant that runs already on --domain; that one needs --plant, too."
    ),
]
HardwareMapping = Annotated[Path | None, typer.Option(help="Mapping file of a simulation that --hardware names.")]
MappingFile = Annotated[
    Path | None, typer.Option(help="Mapping file of that simulation: joint, actuator, sign, zero, limit.")
]
AcceptDifferences = Annotated[
    bool,
    typer.Option(
        "--accept-differences",
        help="Design on the equation of --simulation even if the simulation does not move as it; the report says so.",
    ),
]
Strategy = Annotated[str, typer.Option(help="How the actuator turns wanted torque into PWM.")]


def equation_file(foreign: ForeignSimulation | None, target: Path, *, accept_differences: bool) -> str:
    """Write the equation of a foreign simulation, for a controller's design, and return its plant file, or "".

    The file goes into ``logs`` next to ``target``, the recording's folder, which may have to be new. A ParameterError
    if the simulation is refused, or deviates without ``accept_differences``.
    """
    if foreign is None:
        return ""
    if not accept_differences:
        foreign.require_equation()
    return str(foreign.write_equation(target.parent / "logs" / target.name))
