"""Settings of an experiment's run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.graph_plant import PREFIX, running_namespace
from pendulum_bags.experiments.operator import RealMachine, real_machine
from pendulum_bags.experiments.run_spec import (
    EMULATOR_PATIENCE,
    THESIS_METHOD,
    RunSpec,
    absolute_plant,
    integrator_of,
    run_identity,
)
from pendulum_bags.experiments.simulation import ForeignSimulation
from pendulum_bags.runs.case import IDENTITY, identity_of
from pendulum_bags.runs.next_test import MUJOCO_FILES
from pendulum_bags.runs.run_folder import provenance
from pendulum_bags.runs.run_record import RUN_RECORD, SURROGATE
from pendulum_lqr.controller_interface.controller import controller_parameters
from pendulum_lqr.policies.policy_file import POLICY_SUFFIX, load_policy, policy_record
from pendulum_msgs_py.contract.angles import UPRIGHT
from pendulum_msgs_py.contract.trajectory import MAX_RAMP_VELOCITY, RAMP_INCREMENT, RAMP_PERIOD, Trajectory, thesis_ramp
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.lab_file import DRIVES
from pendulum_msgs_py.plants.plant_parameters import load_plant, require_one_joint
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_sim.simulator.engines import GYMNASIUM_PREFIX

__all__ = [
    "HARDWARE",
    "MODEL_FILES",
    "RAMP_SPEED",
    "RAMP_SPEEDS",
    "SETTLE_TIME",
    "TIME_WITHOUT_NOISE",
    "NoiseSettings",
    "RegulationSettings",
    "Sides",
    "is_named",
    "usual_of_drive",
]

HARDWARE = ("emulator", "hebi")
MODEL_FILES = (*MUJOCO_FILES, ".fmu")
DEFAULT_STRATEGY = "direct_pwm"
OF_DRIVES = "current_loop"
"""Reported in place of a strategy for drives with a current loop."""
_DRIVE_BANDWIDTH = 20.0
"""Natural frequency that the LQR of a drive's pendulum gets by default, a fifth of a usual rate's period [rad/s]."""
_NOISE_SHARE = 0.125
"""Default amplitude of the noise on a drive, as a share of its effort limit [-]."""
SETTLE_TIME = 1.0
"""Time under control before the noise starts [s]."""
TIME_WITHOUT_NOISE = 47.0
"""Wall time of the thesis's experiment without its noise, measured on two cores; 31 s are the ramps [s]."""
RAMP_SPEED = RAMP_INCREMENT / RAMP_PERIOD
"""Mean speed of the thesis's ramp [rad/s]."""
RAMP_SPEEDS = (0.05, 0.8)
"""Slowest and fastest ramps [rad/s]: as many points as a plant takes, and the most that a bridge limited to 1.5 rad/s
follows while it also closes the gap to the pendulum's position at up to 0.3 rad/s."""
_LARGEST_OF_LIMIT = 0.9
"""Largest speed of a ramp, as a share of the machine's limit: an upright pendulum is not where the ramp down begins,
and a refused ramp would release it there."""


def is_named(hardware: str) -> bool:
    """Return whether hardware is the emulator or an actuator, not a model file or a running plant."""
    return hardware in HARDWARE or hardware.partition(":")[0] in DRIVES


def usual_of_drive(plant: str, angle_weight: float) -> tuple[float, float]:
    """Return amplitude of the noise [N m] and LQR weight R that suit a pendulum on a small drive.

    The thesis's are those of a machine of 13 N m: with them a servo's steps of angle alone would swing its torque.
    """
    values = load_plant(plant)
    return _NOISE_SHARE * values.effort_limit, angle_weight / (values.inertia * _DRIVE_BANDWIDTH**2) ** 2


@dataclass(frozen=True)
class NoiseSettings:
    """Uniform noise on the torque.

    Attributes:
        amplitude: Largest torque [N m].
        hold_time: Time for which a sample is held [s].
        duration: Length [s].
    """

    seed: int = 1
    amplitude: float = 2.5
    hold_time: float = 0.01
    duration: float = 5.0

    def __post_init__(self) -> None:
        for name, value, unit in (
            ("noise amplitude", self.amplitude, "N m"),
            ("noise hold time", self.hold_time, "s"),
            ("noise duration", self.duration, "s"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} is {value} {unit}; expected a finite number > 0")
        if self.seed < 0:
            raise ParameterError(f"seed is {self.seed}; expected >= 0")


class Sides:
    """The two sides of an experiment: simulator, third-party simulations, emulated or real hardware, running plants.

    Attributes:
        simulation: A third-party simulation: a model file, ``gymnasium:ID``, or ``ros:/namespace`` for one that runs
            already; empty for the simulator.
        mapping: Its mapping file; empty for none.
        hardware: ``emulator``, ``hebi``, or a second simulation or running plant, named likewise.
        hardware_mapping: Mapping file of a simulation in the hardware's place; empty for none.
    """

    simulation: str
    mapping: str
    hardware: str
    hardware_mapping: str
    noise: NoiseSettings
    storage: str

    def _run(self, side: str, joints: Mapping[str, Any], **own: Any) -> RunSpec:
        noise, foreign = self.noise, self.foreign_of(side)
        return RunSpec(
            side=side,
            disturbance={
                "kind": "uniform",
                **joints,
                "amplitude": noise.amplitude,
                "hold_time": noise.hold_time,
                "duration": noise.duration,
            },
            duration=noise.duration,
            seed=noise.seed,
            storage=self.storage,
            simulation="" if foreign is None else foreign.name,
            mapping="" if foreign is None else foreign.mapping,
            **own,
        )

    def plant_of(self, side: str) -> str:
        """Return the preset or file of a side's simulation of several joints; empty for one."""
        return ""

    def _check_sides(self, hold_time: float) -> None:
        by_name = is_named(self.hardware) or self.hardware.startswith((PREFIX, GYMNASIUM_PREFIX))
        if not by_name and Path(self.hardware).suffix.lower() not in MODEL_FILES:
            raise ParameterError(
                f"hardware is {self.hardware!r}; expected one of {', '.join((*HARDWARE, *DRIVES))}, a model file "
                f"({', '.join(MODEL_FILES)}), gymnasium:ID or ros:/NAMESPACE"
            )
        for side, mapping, option in (("sim", self.mapping, "simulation"), ("hw", self.hardware_mapping, "hardware")):
            if (foreign := self.foreign_of(side)) is not None:
                foreign.check(hold_time)
            elif mapping:
                raise ParameterError(
                    f"mapping is {mapping} without a simulation; expected --{option} FILE or gymnasium:ID too"
                )
        if self.namespace("sim") == self.namespace("hw"):
            raise ParameterError(f"both plants are in {self.namespace('sim')}; expected two namespaces")

    @property
    def foreign(self) -> ForeignSimulation | None:
        """The third-party simulation of the side sim; None for the built-in one and for one that runs already."""
        return self.foreign_of("sim")

    def foreign_of(self, side: str) -> ForeignSimulation | None:
        """Return the third-party simulation of a side, ``sim`` or ``hw``, or None."""
        name, mapping = (self.simulation, self.mapping) if side == "sim" else (self.hardware, self.hardware_mapping)
        if not name or is_named(name) or name.startswith(PREFIX):
            return None
        return ForeignSimulation(name, mapping, self.plant_of(side))

    def running(self, side: str) -> str | None:
        """Return the namespace of a side's running plant; None if the experiment starts it."""
        return running_namespace(self.simulation if side == "sim" else self.hardware)

    def namespace(self, side: str) -> str:
        """Return the namespace of one side's plant."""
        return self.running(side) or f"/{side}"

    @property
    def can_repeat(self) -> bool:
        """Whether both sides can be recorded again with new noise, in lockstep and without an operator."""
        is_surrogate = self.hardware == "emulator" or self.foreign_of("hw") is not None
        return is_surrogate and self.running("sim") is None


@dataclass(frozen=True)
class RegulationSettings(Sides):
    """Regulation of the upright pendulum under noise, on simulator and hardware, as in the thesis.

    Attributes:
        design: Preset or file that the controller is designed on; empty for the simulated plant.
        hardware: ``emulator``, ``hebi`` for the machine of a lab file, ``dynamixel:PORT`` for a drive, a second
            third-party simulation (a model file or ``gymnasium:ID``), or ``ros:/namespace`` for a plant that runs.
        lab: The lab file, for ``hebi``.
        effort_strategy: The actuator's conversion of torque into PWM, which changes the plant. Empty for that of the
            lab file, else ``direct_pwm``; read it from :attr:`strategy`.
        method: Integrator of the simulator; Euler as in the thesis, but not for a plant with motor and spring.
        simulation: A third-party simulation: a model file, ``gymnasium:ID``, or ``ros:/namespace`` for one that runs
            already; empty for the simulator.
        mapping: Its mapping file; empty for none.
        hardware_mapping: Mapping file of a simulation in the hardware's place; empty for none.
        ramp_speed: Mean speed of the ramps up and down; the largest is half as much again [rad/s].
    """

    plant: str = "thesis"
    hardware: str = "emulator"
    effort_strategy: str = ""
    controller: str = "lqr"
    q: tuple[float, float] = (100.0, 0.01)
    r: float = 0.1
    noise: NoiseSettings = NoiseSettings()
    storage: str = "mcap"
    method: str = THESIS_METHOD
    lab: str = ""
    simulation: str = ""
    mapping: str = ""
    hardware_mapping: str = ""
    ramp_speed: float = RAMP_SPEED
    design: str = ""

    def __post_init__(self) -> None:
        """Validate plants, backends and policy before anything is started."""
        if self.controller == "policy":
            raise ParameterError("controller is 'policy' without a file; expected the path of a policy file (.npz)")
        if self.kind == "policy":
            load_policy(self.controller)
        require_one_joint(self.plant, f"python -m pendulum_bags experiment joints --plant {self.plant}")
        object.__setattr__(self, "method", integrator_of(self.plant, self.method))
        machine = real_machine(self.hardware, self.lab)
        slowest, fastest = RAMP_SPEEDS
        if not slowest <= self.ramp_speed <= fastest:
            raise ParameterError(f"ramp speed is {self.ramp_speed} rad/s; expected {slowest:g} to {fastest:g}")
        limit = 0.0 if machine is None else machine.lab.values.get("velocity_limit", 0.0)
        largest = self.ramp_speed / RAMP_SPEED * MAX_RAMP_VELOCITY
        if limit and largest > _LARGEST_OF_LIMIT * limit:
            raise ParameterError(
                f"ramp speed is {self.ramp_speed:g} rad/s, with up to {largest:g} rad/s; expected up to "
                f"{_LARGEST_OF_LIMIT * limit:g} rad/s at a velocity limit of {limit:g} rad/s (lab file)"
            )
        self._check_sides(self.noise.hold_time)
        if self.hardware not in HARDWARE and self.effort_strategy:
            raise ParameterError(
                f"strategy is {self.effort_strategy} for hardware {self.hardware}, which has none; expected it left out"
            )
        defaults = {item.name: item.default for item in fields(self)}
        for name in ("q", "r"):
            if getattr(self, name) != defaults[name] and name not in self.tuning:
                raise ParameterError(
                    f"{name} is {getattr(self, name)} for controller {self.controller!r}, which has no such parameter; "
                    "expected it left out"
                )

    @property
    def design_plant(self) -> str:
        """Preset or file that the controller is designed on."""
        return self.design or self.plant

    @property
    def kind(self) -> str:
        """Kind of controller: ``policy`` for a policy file."""
        return "policy" if self.controller.endswith(POLICY_SUFFIX) else self.controller

    @property
    def tuning(self) -> dict[str, list[float] | float | str]:
        """Weights Q and R or the policy file, as far as the controller has such parameters."""
        known = {spec.name for spec in controller_parameters(self.kind)}
        given: dict[str, list[float] | float | str] = {"q": [float(value) for value in self.q], "r": float(self.r)}
        if self.kind == "policy":
            given["policy"] = str(Path(self.controller).expanduser().resolve())
        return {name: value for name, value in given.items() if name in known}

    @property
    def is_emulated(self) -> bool:
        """Whether nothing real can move: the hardware is emulated or simulated, and the experiment starts both."""
        return self.can_repeat or (self.plant_name("hw") == "emulator" and self.running("sim") is None)

    @property
    def ramp_time(self) -> float:
        """Time of a ramp between hanging and upright [s]."""
        return UPRIGHT / self.ramp_speed

    @property
    def expected_wall_time(self) -> float:
        """Wall time of the thesis's experiment, measured on two cores [s]."""
        return TIME_WITHOUT_NOISE + self.noise.duration + 2.0 * (self.ramp_time - UPRIGHT / RAMP_SPEED)

    def run(self, side: str) -> RunSpec:
        """Return one side as a run in lockstep, for as long as the noise lasts."""
        return self._run(
            side,
            {},
            design_plant=self.design_plant,
            plant=self.plant if side == "sim" else "thesis",
            strategy=self.strategy,
            controller=self.kind,
            controller_parameters=self.tuning,
            method=self.method,
        )

    def ramp(self, start: float, goal: float) -> Trajectory:
        """Return the thesis's ramp between two positions [rad], at the speed of these settings."""
        faster = self.ramp_speed / RAMP_SPEED
        return thesis_ramp(start, goal, increment=RAMP_INCREMENT * faster, max_velocity=MAX_RAMP_VELOCITY * faster)

    @property
    def machine(self) -> RealMachine | None:
        """The machine of the lab file; None for the emulator."""
        return real_machine(self.hardware, self.lab)

    @property
    def strategy(self) -> str:
        """The actuator's conversion of torque into PWM: as given, as in the lab file, or ``direct_pwm``."""
        machine = self.machine
        if machine is not None and machine.is_drive:
            return OF_DRIVES
        of_lab = machine.lab.values.get("effort_strategy", "") if machine is not None else ""
        return self.effort_strategy or of_lab or DEFAULT_STRATEGY

    def plant_name(self, side: str) -> str:
        """Return a side's plant as a bag names it: ``emulator``, also for the emulated machine of a lab file."""
        if side == "sim":
            return self.plant if self.running(side) is None else self.simulation
        if (foreign := self.foreign_of("hw")) is not None:
            return foreign.label
        return "emulator" if self.machine is not None and self.machine.emulated else self.hardware

    def plant_program(self, side: str, bag: Path | None = None) -> NodeProgram | None:
        """Return a side's plant in real time, or None if it runs already; a real one's own log goes next to ``bag``."""
        if self.running(side) is not None:
            return None
        return self.simulator_program() if side == "sim" else self.bridge_program(bag)

    def simulator_program(self) -> NodeProgram:
        """Return the simulation, built-in or third-party, in real time."""
        if (foreign := self.foreign) is not None:
            return foreign.program("/sim", clock="realtime")
        return graph.simulator("/sim", plant=self.plant, method=self.method, clock="realtime")

    def bridge_program(self, bag: Path | None = None) -> NodeProgram:
        """Return the bridge to the actuator, whose own log goes next to ``bag``, or the simulation in its place."""
        if (foreign := self.foreign_of("hw")) is not None:
            return foreign.program("/hw", clock="realtime")
        if (machine := self.machine) is not None:
            return machine.bridge_program(self.strategy, bag)
        return graph.bridge("/hw", backend=self.hardware, effort_strategy=self.strategy, **EMULATOR_PATIENCE)

    def controller_program(self, namespace: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the controller of one of the plants."""
        parameters = {"controller": self.kind, "plant": absolute_plant(self.design_plant), **self.tuning}
        return graph.controller(namespace, **{**parameters, **changes})

    def disturbance_program(self, namespace: str, **changes: graph.ParameterArgument) -> NodeProgram:
        """Return the disturbance on one of the plants."""
        return graph.disturbance(namespace, **{"kind": "uniform", **asdict(self.noise), **changes})

    def identity(self, side: str) -> str:
        """Return a side's plant by name and values, or by its namespace if it runs already."""
        if (foreign := self.foreign_of(side)) is not None:
            return foreign.identity
        if side == "hw" and (machine := self.machine) is not None:
            return f"{identity_of(self.plant_name(side), dict(machine.lab.values))}, {self.strategy}"
        if (namespace := self.running(side)) is not None:
            return namespace
        return run_identity(self.plant) if side == "sim" else run_identity("thesis", self.strategy)

    def metadata(self, experiment: str, *, side: str = "sim", **more: Any) -> dict[str, Any]:
        """Return the metadata of one side's bag."""
        foreign = self.foreign_of(side) or self.foreign
        return {
            RUN_RECORD: {
                "experiment": experiment,
                "clock": "realtime",
                "strategy": self.strategy,
                "seed": self.noise.seed,
                IDENTITY: self.identity(side),
                "disturbance": {"kind": "uniform", **asdict(self.noise)},
                "controller": {"kind": self.kind, **self.tuning},
                **policy_record(self.tuning),
                **provenance(),
                **({} if foreign is None else {"simulation": foreign.to_json()}),
                **({SURROGATE: "simulation"} if side == "hw" and self.foreign_of("hw") is not None else {}),
                **({} if (machine := self.machine) is None else {"lab": dict(machine.lab.values)}),
                **more,
            }
        }
