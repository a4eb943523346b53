"""One run as a value: plant, controller, disturbance, start, seed and clock. Studies consist of these."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.simulation import ForeignSimulation, absolute_plant
from pendulum_bags.runs.case import IDENTITY, plant_identity
from pendulum_bags.runs.run_folder import provenance
from pendulum_bags.runs.run_record import RUN_RECORD, SURROGATE
from pendulum_lqr.controller_interface.controller import controller_parameters
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS
from pendulum_lqr.policies.policy_file import policy_record
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import reject_unknown, validate
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, is_mechanism, load_mechanism
from pendulum_msgs_py.plants.sealed_plant import load_plant_to_run
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram

__all__ = [
    "BEGINS_ANYWHERE",
    "CLOCKS",
    "EMULATOR_LIFETIME",
    "EMULATOR_PATIENCE",
    "EMULATOR_WATCHDOG",
    "PERIODS",
    "SIDES",
    "THESIS_METHOD",
    "RunSpec",
    "absolute_plant",
    "integrator_of",
    "lockstep_parameters",
]

CLOCKS = ("lockstep", "realtime")
SIDES = ("sim", "hw")
EMULATOR_WATCHDOG = 50
"""Feedback periods that the bridge waits for an emulator, on a busy machine."""
EMULATOR_LIFETIME = 0.5
"""Command lifetime of an emulator on such a machine [s]."""
EMULATOR_PATIENCE: Mapping[str, graph.ParameterArgument] = {
    "feedback_watchdog": EMULATOR_WATCHDOG,
    "command_lifetime": EMULATOR_LIFETIME,
}
"""Parameters of the bridge to an emulator in real time, whose feedback may be late on a busy machine. A real actuator
keeps the default."""
_AT_REST = 1e-9
BEGINS_ANYWHERE = {"start_effort_limit": 0.0}
"""Of a simulated plant that starts at its own angle, with its controller's torque there."""
THESIS_METHOD = "euler"
"""Integrator of the thesis's simulation, for rigid plants."""
PERIODS = {"sim": 0.002, "hw": 0.01}
"""Period of the states of each plant, as in the thesis; of several joints, both have that of the simulator [s]."""
_OF_THE_NODE = {"duration", "file", "joints", "volts"}
"""Parameters of the disturbance that are the node's, not the signal's."""


@dataclass(frozen=True)
class RunSpec:
    """One run of one plant, of one joint or several, under one controller and one disturbance.

    Attributes:
        side: ``sim`` for the simulator, ``hw`` for the emulated hardware.
        strategy: The actuator's conversion of torque into PWM (``hw``).
        disturbance: Parameters of the disturbance; empty for none.
        theta: Initial angle; plants of several joints begin upright, or hanging at 0 [rad].
        set_point: Angle to hold, from upright [rad].
        duration: Length [s].
        method: Integrator of the simulator; Euler as in the thesis, but not for a plant with motor and spring.
        clock: ``lockstep`` for as fast as the nodes reply, ``realtime`` for wall time.
        simulation: A third-party simulation in place of ``plant``, a model file or ``gymnasium:ID``; empty for none.
        mapping: Its mapping file; empty for none.
    """

    side: str = "sim"
    plant: str = "thesis"
    design_plant: str = "thesis"
    strategy: str = "direct_pwm"
    controller: str = "lqr"
    controller_parameters: Mapping[str, Any] = field(default_factory=dict)
    disturbance: Mapping[str, Any] = field(default_factory=dict)
    theta: float = UPRIGHT
    set_point: float = 0.0
    duration: float = 5.0
    seed: int = 1
    method: str = THESIS_METHOD
    plant_parameters: Mapping[str, Any] = field(default_factory=dict)
    storage: str = "mcap"
    clock: str = "lockstep"
    simulation: str = ""
    mapping: str = ""

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise ParameterError(f"side is {self.side!r}; expected sim or hw")
        if self.clock not in CLOCKS:
            raise ParameterError(f"clock is {self.clock!r}; expected lockstep or realtime")
        off_rest = min(abs(self.theta), abs(self.theta - UPRIGHT))
        if self.clock == "realtime" and self.has_bridge and off_rest > _AT_REST:
            # Nothing holds it between its start and its arming.
            raise ParameterError(
                f"start angle is {self.theta} rad; expected upright or bottom, where a machine in real time is at rest"
            )
        for name, value, unit in (("start angle", self.theta, "rad"), ("duration", self.duration, "s")):
            if not math.isfinite(value):
                raise ParameterError(f"{name} is {value} {unit}; expected a finite number")
        if self.duration <= 0.0:
            raise ParameterError(f"duration is {self.duration} s; expected > 0")
        if (foreign := self.foreign) is not None:
            _ = foreign.parameters
        elif self.side == "sim":
            object.__setattr__(self, "method", integrator_of(self.plant, self.method))
        for name, given in self.plant_parameters.items():
            for value in given if isinstance(given, (list, tuple)) else (given,):
                # Checked before the run is stored; the node checks again.
                if isinstance(value, float) and not math.isfinite(value):
                    raise ParameterError(f"parameter {name} of the plant is {value}; expected a finite number")
        design = load_mechanism(self.design_plant)
        known = controller_parameters(self.controller, design)
        validate(known, self.law(design), where=f"controller {self.controller}")
        weights, joints = self.controller_parameters.get("q"), design.coordinates.with_units
        if isinstance(weights, (list, tuple)) and not design.is_pendulum and len(weights) < 2 * len(design.joints):
            raise ParameterError(f"q is {list(weights)} for {joints}; expected weights of each position and velocity")
        own = {spec.name for spec in DISTURBANCE_SPECS} | _OF_THE_NODE
        reject_unknown(self.disturbance, own, where="disturbance")
        signal = {k: v for k, v in self.disturbance.items() if k not in _OF_THE_NODE}
        validate(DISTURBANCE_SPECS, signal, where="disturbance")

    @property
    def namespace(self) -> str:
        """Namespace of the plant."""
        return f"/{self.side}"

    @property
    def mechanism(self) -> PlantParameters | None:
        """The plant, if it has several joints; else None."""
        return load_mechanism(self.plant) if is_mechanism(self.plant) else None

    @property
    def topics(self) -> names.DriveTopics:
        """Topics of the plant's commands."""
        return names.EFFORT_TOPICS if (plant := self.mechanism) is None else plant.coordinates.topics

    @property
    def hangs(self) -> bool:
        """Whether a plant of several joints begins hanging, at an angle of 0; else it begins upright."""
        return abs(self.theta) <= _AT_REST

    def start_position(self, mechanism: PlantParameters) -> tuple[float, ...]:
        """Return where the joints of a plant of several begin [rad or m]."""
        goal = mechanism.coordinates.goal
        return (0.0,) * len(goal) if self.hangs else goal

    def law(self, design: PlantParameters) -> dict[str, Any]:
        """Return the parameters of the controller, with the set point of one joint."""
        own = {"set_point": float(self.set_point)} if design.is_pendulum else {}
        return {**self.controller_parameters, **own}

    @property
    def period(self) -> float:
        """Time between two states [s]."""
        if (foreign := self.foreign) is not None:
            return foreign.period
        return PERIODS["sim" if is_mechanism(self.plant) else self.side]

    @property
    def foreign(self) -> ForeignSimulation | None:
        """The third-party simulation; None for the built-in one and the emulated hardware."""
        if not self.simulation:
            return None
        return ForeignSimulation(self.simulation, self.mapping, self.plant if is_mechanism(self.plant) else "")

    @property
    def identity(self) -> str:
        """The plant, by name and values."""
        if (foreign := self.foreign) is not None:
            return foreign.identity
        return run_identity(self.plant, self.strategy if self.has_bridge else "")

    @property
    def has_bridge(self) -> bool:
        """Whether the plant is the bridge, which no parameter arms; a simulator starts armed and paused."""
        return self.side == "hw" and not self.simulation

    @property
    def simulated_time(self) -> bool:
        """Whether time is the plant's rather than wall time."""
        return self.clock == "lockstep"

    @property
    def steps(self) -> int:
        """Number of steps of the plant."""
        return round(self.duration / self.period)

    def disturbance_parameters(self) -> dict[str, Any]:
        """Return the parameters of the disturbance, with the run's seed and, for several joints, its joint."""
        values: dict[str, Any] = {"kind": "uniform", "amplitude": 0.0, "hold_time": 0.01}
        if (mechanism := self.mechanism) is not None:
            values["joints"] = list(mechanism.coordinates.driven_names[:1])
            if mechanism.coordinates.volts:
                values["volts"] = True
        values.update(self.disturbance)
        return {**values, "seed": self.seed}

    def plant_program(self, listeners: int) -> NodeProgram:
        """Return the plant; it starts once armed or resumed, with ``listeners`` and the orchestrator subscribed."""
        if self.simulated_time:
            loop = lockstep_parameters(listeners, self.duration)
        else:
            loop = {"clock": self.clock, **(EMULATOR_PATIENCE if self.has_bridge else {})}
        loop.update(self.plant_parameters)
        foreign = self.foreign
        if foreign is None:
            loop.setdefault("plant", absolute_plant(self.plant))
        mechanism = self.mechanism
        if self.has_bridge:
            # No parameter arms hardware: the orchestrator does, before it becomes the last listener.
            loop["seed"] = self.seed
            if mechanism is not None:
                begin = list(self.start_position(mechanism))
                loop.setdefault("feedback_rate", 1.0 / self.period)
                return graph.bridge("/hw", backend="emulator", initial_positions=begin, **loop)
            loop["initial_position"] = float(self.theta)
            return graph.bridge("/hw", backend="emulator", effort_strategy=self.strategy, **loop)
        if mechanism is not None:
            loop.update(start="bottom" if self.hangs else "top", armed_at_start=True, paused=True)
        else:
            start = {"initial_theta": float(self.theta), "armed_at_start": True, "paused": True}
            loop = {**BEGINS_ANYWHERE, **loop, **start}
        if foreign is not None:
            return foreign.program(self.namespace, **loop)
        if mechanism is not None:
            return graph.simulator("/sim", rate_hz=1.0 / self.period, **loop)
        return graph.simulator("/sim", method=self.method, rate_hz=1.0 / self.period, **loop)

    def controller_program(self, subscribers: int = 0) -> NodeProgram:
        """Return the controller; in lockstep it replies to ``subscribers`` at least."""
        return graph.controller(
            self.namespace,
            **{
                **{
                    name: str(Path(value).resolve()) if name == "policy" and value else value
                    for name, value in self.law(load_mechanism(self.design_plant)).items()
                },
                "controller": self.controller,
                "plant": absolute_plant(self.design_plant),
                "period": self.period,
                "use_sim_time": self.simulated_time,
                "lockstep_subscribers": subscribers,
            },
        )

    def disturbance_program(self, subscribers: int = 0) -> NodeProgram:
        """Return the disturbance; in lockstep it replies to ``subscribers`` at least."""
        return graph.disturbance(
            self.namespace,
            **self.disturbance_parameters(),
            autostart=True,
            use_sim_time=self.simulated_time,
            lockstep_subscribers=subscribers,
        )

    def metadata(self) -> dict[str, Any]:
        """Return the bag's metadata of its run."""
        values = self.to_json()
        foreign = self.foreign
        del values["simulation"], values["mapping"]
        return {
            RUN_RECORD: {
                **values,
                "experiment": self.clock,
                "plant": self.plant if self.side == "sim" else "emulator" if foreign is None else foreign.label,
                "emulated_plant": self.plant if self.has_bridge else "",
                IDENTITY: self.identity,
                **({} if foreign is None else {"simulation": foreign.to_json()}),
                **({SURROGATE: "simulation"} if self.side == "hw" and foreign is not None else {}),
                "namespace": self.namespace,
                "disturbance": self.disturbance_parameters(),
                "controller": {"kind": self.controller, **self.controller_parameters},
                **policy_record(self.controller_parameters),
                **provenance(),
            }
        }

    def to_json(self) -> dict[str, Any]:
        """Return the run as JSON values; :meth:`from_json` reads them back."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RunSpec:
        """Return the run in JSON values; a ParameterError if a value is unknown or refused."""
        reject_unknown(values, cls.__dataclass_fields__, where="run")
        return cls(**values)


def lockstep_parameters(
    listeners: int, duration: float, inputs: Sequence[str] = (names.EFFORT_COMMAND, names.DISTURBANCE)
) -> dict[str, graph.ParameterArgument]:
    """Return parameters of a plant in lockstep: number of subscribers, duration [s], inputs that reply."""
    return {
        "clock": "lockstep",
        "lockstep_inputs": list(inputs),
        "lockstep_subscribers": listeners,
        "lockstep_duration": float(duration),
    }


def run_identity(plant: str, strategy: str = "") -> str:
    """Return a plant's identity in the simulator, or with a strategy in the emulator; or a ParameterError."""
    if is_mechanism(plant):
        return plant_identity(load_mechanism(plant))
    found = plant_identity(load_plant_to_run(plant)[0])
    return f"emulator of {found}, {strategy}" if strategy else found


def integrator_of(plant: str, method: str) -> str:
    """Return a plant's integrator: that of the thesis cannot step a motor on a spring; or a ParameterError."""
    if is_mechanism(plant):
        return "auto"
    elastic = load_plant_to_run(plant)[0].drivetrain is not None
    return "auto" if elastic and method == THESIS_METHOD else method
