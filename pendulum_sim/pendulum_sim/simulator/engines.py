"""The simulations of the simulator node: the built-in one, and third-party ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import (
    MECHANISM_PRESETS,
    PLANT_SPECS,
    PRESET_NAMES,
    PlantParameters,
    is_mechanism,
    load_mechanism,
)
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run
from pendulum_sim.foreign.equation_check import EquationCheck, Switches, check_equation
from pendulum_sim.foreign.fmu_environment import load_fmu_mapping, load_fmu_plant
from pendulum_sim.foreign.guarded_plant import GuardedPlant, in_one_sentence
from pendulum_sim.foreign.gymnasium_plant import load_adapter, load_gymnasium_plant
from pendulum_sim.foreign.mujoco_mapping import MujocoMapping, load_mujoco_mapping
from pendulum_sim.foreign.mujoco_plant import load_mujoco_plant
from pendulum_sim.stepping.integrators import METHODS
from pendulum_sim.stepping.plants import JointPlant, OneJoint, make_plant

__all__ = [
    "FMU",
    "GYMNASIUM",
    "GYMNASIUM_PREFIX",
    "MUJOCO",
    "OWN",
    "Engine",
    "Simulation",
    "find_engine",
    "open_simulation",
]


class Simulation(NamedTuple):
    """A simulation, ready to run.

    Attributes:
        plant: Stepped once in a period.
        name: Requested preset, file or identifier.
        method: Integrator, as text.
        remarks: Automatic choices, one line each.
        sealed: Whether its parameters must not be shown.
        check: Checks a third-party simulation against its equation; reset the plant afterwards.
    """

    plant: JointPlant
    name: str
    method: str
    remarks: tuple[str, ...] = ()
    sealed: bool = False
    check: Callable[[], EquationCheck] | None = None


@dataclass(frozen=True)
class Engine:
    """One way to simulate a pendulum.

    Attributes:
        program: Name of the executable.
        description: What it does, one sentence.
        specs: Its own parameters.
        make: Makes the simulation from their values.
        foreign: Third-party: its states are checked and its steps timed.
        example: A command line.
    """

    program: str
    description: str
    specs: tuple[ParameterSpec, ...]
    make: Callable[[Mapping[str, Any]], Simulation]
    foreign: bool
    example: str


_RATE = ParameterSpec(
    "rate_hz", 500.0, "Hz", "Rate of states and commands.", minimum=50.0, maximum=2000.0, read_only=True
)
_OF_EQUATION = (
    *("inertia", "damping", "gravity", "coulomb_friction", "angle_offset"),
    *("effort_limit", "actuator_time_constant", "transport_delay"),
)
"""Parameters that an importer identifies."""
_EXACT_STEP = 1e-3
"""Longest step of the equation that a third-party simulation is checked against [s]."""
_FOREIGN_SPECS = (
    ParameterSpec(
        "step_timeout", 2.0, "s",
        "Time that one step of the simulation may take; one that takes longer ends the program.", minimum=0.1,
        read_only=True,
    ),
)  # fmt: skip


def _make_own(values: Mapping[str, Any]) -> Simulation:
    dt = round(NANOSECONDS / values["rate_hz"]) / NANOSECONDS
    parameters, sealed = load_plant_to_run(values["plant"])
    method: str = values["method"]
    remarks: tuple[str, ...] = ()
    plant = make_plant(parameters, dt, method=method, substeps=values["substeps"] or None)
    if not parameters.is_pendulum:
        coordinates = parameters.coordinates
        driven = ", ".join(coordinates.driven_names) or "none"
        method, remarks = "rk4", (f"joints {', '.join(coordinates.names)}; driven: {driven}",)
    return Simulation(plant, values["plant"], method, remarks, sealed=sealed)


def _make_mujoco(values: Mapping[str, Any]) -> Simulation:
    model, mapping = values["model"], values["mapping"]
    if not model:
        raise ParameterError("model is missing; expected -p model:=FILE, an MJCF or URDF file")
    equation = _equation(values)
    choices = MujocoMapping()
    if mapping:
        choices = load_mujoco_mapping(mapping, () if equation is None else equation.mechanism.joints)
    with in_one_sentence(f"model {model}", "loading", ParameterError):
        plant = load_mujoco_plant(
            model, choices, rate_hz=values["rate_hz"], effort_limit=values["effort_limit"], equation=equation
        )
    label = Path(model).name
    again = Switches(plant.switches, lambda causes: GuardedPlant(plant.without(causes), label))
    return _foreign(plant, model, label, plant.description, plant.remarks, switches=again)


def _equation(values: Mapping[str, Any]) -> PlantParameters | None:
    """Return the plant of a simulation of several joints, None for a pendulum."""
    if not values["plant"]:
        return None
    if not is_mechanism(values["plant"]):
        raise ParameterError(
            f"plant is {values['plant']}, of one joint, whose equation is found; expected one of several, or none"
        )
    plant = load_mechanism(values["plant"])
    if plant.coordinates.volts:
        raise ParameterError(f"plant is {values['plant']}, driven in volts; expected one driven by an effort")
    return plant


def _make_gymnasium(values: Mapping[str, Any]) -> Simulation:
    env, mapping = values["env"], values["mapping"]
    if not env:
        raise ParameterError("env is missing; expected -p env:=ID, such as Pendulum-v1")
    if values.get("plant"):
        raise ParameterError(
            f"environment {env} has one joint, and {values['plant']} several; expected a plant of one joint, or a "
            "model file"
        )
    adapter = load_adapter(mapping) if mapping else None
    with in_one_sentence(f"environment {env}", "loading", ParameterError):
        plant = load_gymnasium_plant(env, adapter, seed=values["seed"], effort_limit=values["effort_limit"])
    again = GuardedPlant(OneJoint(plant.reseeded()), env)
    return _foreign(OneJoint(plant), env, env, plant.description, plant.remarks, reseeded=again)


def _make_fmu(values: Mapping[str, Any]) -> Simulation:
    model, mapping = values["model"], values["mapping"]
    if not model:
        raise ParameterError("model is missing; expected -p model:=FILE, an FMU")
    if values.get("plant"):
        raise ParameterError(f"an FMU has one joint, and {values['plant']} several; expected a plant of one joint")
    entries = load_fmu_mapping(mapping) if mapping else None
    with in_one_sentence(f"model {model}", "loading", ParameterError):
        plant = load_fmu_plant(model, entries, effort_limit=values["effort_limit"])
    return _foreign(OneJoint(plant), model, Path(model).name, plant.description, plant.remarks)


def _foreign(
    plant: JointPlant, name: str, label: str, description: str, remarks: Sequence[str],
    *, switches: Switches | None = None, reseeded: JointPlant | None = None,
) -> Simulation:  # fmt: skip
    guarded, parameters = GuardedPlant(plant, label), plant.parameters

    def check() -> EquationCheck:
        equation = make_plant(parameters, plant.dt, substeps=math.ceil(plant.dt / _EXACT_STEP))
        try:
            coarse = make_plant(parameters, plant.dt, method="semi_implicit")
        except ParameterError:
            # It is unstable with that period, or has several joints.
            coarse = None
        return check_equation(guarded, equation, coarse=coarse, switches=switches, reseeded=reseeded)

    if parameters.is_pendulum:
        found = [(spec, getattr(parameters, spec.name)) for spec in PLANT_SPECS if spec.name in _OF_EQUATION]
        values = ", ".join(f"{spec.name} {value:.6g} {spec.unit}" for spec, value in found)
        remarks = (*remarks, f"closest equation: {values}")
    return Simulation(guarded, name, description, tuple(remarks), check=check)


OWN = Engine(
    program="simulator",
    description="Simulated pendulum behind the interface that simulator and hardware share.",
    specs=(
        ParameterSpec(
            "plant", "thesis", "",
            f"Preset ({PRESET_NAMES}; of several joints: {', '.join(MECHANISM_PRESETS)}) or path of a plant file.",
            read_only=True,
        ),
        ParameterSpec(
            "method",
            "auto",
            "",
            "Integrator; auto is etd4 for a rigid plant, semi_implicit for a series-elastic one, rk4 for several "
            "joints.",
            choices=("auto", *METHODS),
            read_only=True,
        ),
        _RATE,
        ParameterSpec(
            "substeps", 0, "-", "Integration steps in a period; 0 chooses by the plant.", minimum=0, read_only=True
        ),
    ),
    make=_make_own,
    foreign=False,
    example="python -m pendulum_sim simulator --ros-args -r __ns:=/sim -p plant:=x5_9",
)  # fmt: skip

MUJOCO = Engine(
    program="mujoco",
    description="A MuJoCo model (MJCF or URDF) behind the interface that simulator and hardware share.",
    specs=(
        ParameterSpec("model", "", "", "MJCF or URDF file.", read_only=True),
        ParameterSpec(
            "mapping", "", "", "Mapping file: joint, actuator, sign, zero, limit; empty for none.", read_only=True
        ),
        ParameterSpec(
            "plant", "", "", "Preset or plant file of a model of several joints; empty for a pendulum, whose equation "
            "is read off the file.", read_only=True,
        ),
        replace(
            _RATE, default=0.0, minimum=0.0,
            description="Rate of states and commands; 0 for 500, or one of the file's timestep where that is longer.",
        ),
        *_FOREIGN_SPECS,
    ),
    make=_make_mujoco,
    foreign=True,
    example="python -m pendulum_sim mujoco --ros-args -r __ns:=/sim -p model:=pendulum.xml",
)  # fmt: skip

GYMNASIUM = Engine(
    program="gymnasium",
    description="An environment of Gymnasium behind the interface that simulator and hardware share.",
    specs=(
        ParameterSpec("env", "", "", "Identifier, such as Pendulum-v1 or my_module:MyPendulum-v0.", read_only=True),
        ParameterSpec(
            "mapping", "", "", "Adapter file: what is angle, velocity, torque, start; empty for a known environment.",
            read_only=True,
        ),
        *_FOREIGN_SPECS,
    ),
    make=_make_gymnasium,
    foreign=True,
    example="python -m pendulum_sim gymnasium --ros-args -r __ns:=/sim -p env:=Pendulum-v1",
)  # fmt: skip

FMU = Engine(
    program="fmu",
    description="An FMU (FMI 2 or 3, co-simulation) behind the interface that simulator and hardware share.",
    specs=(
        ParameterSpec("model", "", "", "FMU.", read_only=True),
        ParameterSpec(
            "mapping", "", "", "Mapping file: angle, velocity, torque, start, start values; empty for none.",
            read_only=True,
        ),
        *_FOREIGN_SPECS,
    ),
    make=_make_fmu,
    foreign=True,
    example="python -m pendulum_sim fmu --ros-args -r __ns:=/sim -p model:=pendulum.fmu",
)  # fmt: skip
FMU_SUFFIX = ".fmu"
GYMNASIUM_PREFIX = "gymnasium:"


def find_engine(simulation: str) -> tuple[Engine, dict[str, str]]:
    """Return the engine of a model file or ``gymnasium:ID``, and the parameters that name it."""
    if simulation.startswith(GYMNASIUM_PREFIX):
        return GYMNASIUM, {"env": simulation.removeprefix(GYMNASIUM_PREFIX)}
    path = Path(simulation).expanduser().resolve()
    return FMU if path.suffix.lower() == FMU_SUFFIX else MUJOCO, {"model": str(path)}


def open_simulation(simulation: str, mapping: str = "", plant: str = "") -> Simulation:
    """Return a third-party simulation in this process; a ParameterError if refused.

    ``mapping`` is its mapping file, empty for none; ``plant`` preset or file of one of several joints, empty for one.
    """
    engine, named = find_engine(simulation)
    defaults = {spec.name: spec.default for spec in engine.specs}
    return engine.make({**defaults, "seed": 0, "effort_limit": 0.0, **named, "mapping": mapping, "plant": plant})
