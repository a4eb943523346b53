"""A plant of several joints, held upright under noise, and another plant as the surrogate of its machine."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.run_spec import lockstep_parameters
from pendulum_bags.runs.case import IDENTITY, plant_identity
from pendulum_bags.runs.run_folder import provenance
from pendulum_bags.runs.run_record import RUN_RECORD, STAND_IN
from pendulum_msgs_py.contract.names import JOINT_STATES
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import FaultError, ParameterError, PlantStoppedError
from pendulum_msgs_py.plants.mechanism_parameters import MechanismParameters, load_mechanism, write_mechanism
from pendulum_msgs_py.plants.plant_parameters import is_mechanism
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_rosbag.reader.bag import read_bag

__all__ = [
    "HOLDING",
    "LIMIT_PER_NOISE",
    "JointRun",
    "JointSettings",
    "design_file",
    "design_for",
    "fall_time",
    "identified_names",
    "load_stand_in",
    "record_joints",
    "stand_in_for",
]

Array = NDArray[Any]

_UNCHANGED = frozenset(
    {"gravity", "gear_ratio", "stribeck_velocity", "lower_stop", "upper_stop", "effort_limit", "time_constant"}
)
"""Values of a plant file that are not identified: constants, limits, and what belongs to a model of friction."""
_DELAY = "transport_delay"
HOLDING = ("lqr", "discrete_lqr", "lqi", "lqg", "mpc")
"""Controllers that hold a plant upright; ``tvlqr`` and ``ilqr`` begin at hanging, and ``nmpc`` is an LQR there."""
LIMIT_PER_NOISE = 10.0
"""Effort limit of the joint per amplitude of the noise [-]: the LQR holds every preset under it on both sides,
the acrobot and the pendubot with dry friction up to 0.16, and their joints slide in it instead of standing still."""
_SLIDING = 0.5
"""Velocity at which a design takes the dry friction of passive joints [rad/s or m/s]: that of the joints under this
noise. At 1 the pendubot falls; at 0.25 both plants stay, nearer to the end of what their LQR holds."""


@dataclass(frozen=True)
class JointSettings:
    """Noise on one joint of a plant that a controller holds upright.

    Attributes:
        plant: Preset or file of the simulated plant; the controller is designed on it on both sides.
        joint: Driven joint that has the noise; empty for the first.
        amplitude: Largest effort of the noise [N m or N]; None for a tenth of the joint's effort limit.
        hold_time: Time for which a sample is held [s].
        duration: Length [s].
        seed: Seed of the noise.
        period: Time between two states [s].
        storage: Storage of the bags.
        controller: What holds it, one of ``HOLDING``.
    """

    plant: str = "cart_pole"
    joint: str = ""
    amplitude: float | None = None
    hold_time: float = 0.01
    duration: float = 20.0
    seed: int = 1
    period: float = 0.002
    storage: str = "mcap"
    controller: str = "lqr"

    def __post_init__(self) -> None:
        """Refuse what cannot be run before anything starts; the joint defaults to the first driven one."""
        if not is_mechanism(self.plant):
            raise ParameterError(
                f"plant is {self.plant!r}, which has one joint; expected one of several, such as cart_pole "
                "(experiment thesis is for one joint)"
            )
        plant = load_mechanism(self.plant)
        driven = plant.coordinates.driven_names
        if not driven:
            raise ParameterError(f"plant {plant.name!r} has no driven joint; expected an actuator at one of its joints")
        if self.joint and self.joint not in driven:
            raise ParameterError(f"joint is {self.joint!r}; expected one that is driven: {', '.join(driven)}")
        object.__setattr__(self, "joint", self.joint or driven[0])
        if self.amplitude is None:
            limit = plant.effort_limits[driven.index(self.joint)]
            object.__setattr__(self, "amplitude", limit / LIMIT_PER_NOISE)
        if self.controller not in HOLDING:
            raise ParameterError(f"controller is {self.controller!r}; expected one of {', '.join(HOLDING)}")
        for name in ("amplitude", "hold_time", "duration", "period"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} is {value}; expected a finite number > 0")


@dataclass(frozen=True)
class JointRun:
    """One side of it, as :func:`pendulum_bags.experiments.lockstep.record_run` carries it out.

    Attributes:
        settings: The settings.
        side: ``sim``, or ``hw`` for the surrogate of the machine.
        plant: Preset or file of what runs on this side.
        design: Preset or file on which the controller is designed; empty for the simulated plant.
        excitation: Parameters of the disturbance that differ from those of the noise.
        tuning: Parameters of the controller that differ from those of the plant, ``q`` and ``r``.
    """

    settings: JointSettings
    side: str
    plant: str
    design: str = ""
    simulated_time: bool = True
    excitation: Mapping[str, Any] = field(default_factory=dict)
    tuning: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_bridge(self) -> bool:
        """Whether the plant is the bridge, on an emulated machine."""
        return self.side == "hw"

    @property
    def namespace(self) -> str:
        """Namespace of the plant."""
        return f"/{self.side}"

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.settings.duration

    @property
    def steps(self) -> int:
        """Number of steps of the plant."""
        return round(self.duration / self.settings.period)

    @property
    def storage(self) -> str:
        """Storage of the bag."""
        return self.settings.storage

    def plant_program(self, listeners: int) -> NodeProgram:
        """Return the simulator, paused, or the bridge; either waits for a number of subscriptions to its states."""
        rate = 1.0 / self.settings.period
        lockstep: dict[str, Any] = lockstep_parameters(listeners, self.duration)
        if self.has_bridge:
            goal = list(load_mechanism(self.plant).coordinates.goal)
            return graph.bridge(
                self.namespace,
                plant=self.plant,
                backend="emulator",
                initial_positions=goal,
                feedback_rate=rate,
                seed=self.settings.seed,
                **lockstep,
            )
        return graph.simulator(
            self.namespace, plant=self.plant, start="top", rate_hz=rate, armed_at_start=True, paused=True, **lockstep
        )

    def controller_program(self) -> NodeProgram:
        """Return the controller, designed on one plant on both sides."""
        return graph.controller(
            self.namespace,
            controller=self.settings.controller,
            plant=self.design or self.settings.plant,
            period=self.settings.period,
            use_sim_time=True,
            **self.tuning,
        )

    def disturbance_program(self) -> NodeProgram:
        """Return the disturbance."""
        return graph.disturbance(self.namespace, **self._noise(), autostart=True, use_sim_time=True)

    def metadata(self) -> dict[str, Any]:
        """Return the bag's metadata of its run."""
        return {
            RUN_RECORD: {
                "experiment": "joints",
                "clock": "lockstep",
                "namespace": self.namespace,
                "side": self.side,
                "plant": self.plant if self.side == "sim" else "another plant file",
                "design_plant": self.settings.plant,
                IDENTITY: plant_identity(load_mechanism(self.plant)),
                "seed": self.settings.seed,
                "disturbance": self._noise(),
                "controller": {
                    "kind": self.settings.controller,
                    **self.tuning,
                    **({"linearised": Path(self.design).name} if self.design else {}),
                },
                **({STAND_IN: "emulated machine"} if self.side == "hw" else {}),
                "duration": self.duration,
                "period": self.settings.period,
                **provenance(),
            }
        }

    def _noise(self) -> dict[str, Any]:
        own = self.settings
        return {
            "kind": "uniform",
            "joints": [own.joint],
            "amplitude": own.amplitude,
            "hold_time": own.hold_time,
            "duration": own.duration,
            "seed": own.seed,
            **self.excitation,
        }


def identified_names(plant: MechanismParameters) -> list[str]:
    """Return the names of the values that an identification finds: masses, lengths, inertias and friction."""
    return [name for name in plant.numbers if name.rpartition(".")[2] not in {*_UNCHANGED, _DELAY}]


def stand_in_for(plant: MechanismParameters, *, share: float, delay: float, seed: int) -> MechanismParameters:
    """Return another plant in place of a machine: values as far off as an identification may leave them.

    Args:
        plant: The plant that is simulated.
        share: Largest share by which a mass, length, inertia or friction is off, drawn uniformly.
        delay: Transport delay of each motor [s].
        seed: Of the draw.

    Raises:
        ParameterError: No plant has such values.
    """
    if not 0.0 <= share < 1.0:
        raise ParameterError(f"share is {share}; expected 0 to less than 1")
    drawn = np.random.default_rng(seed)
    changes = {name: delay for name in plant.numbers if name.rpartition(".")[2] == _DELAY}
    changes |= {
        name: plant.numbers[name] * (1.0 + float(drawn.uniform(-share, share))) for name in identified_names(plant)
    }
    return replace(plant.with_values(changes), name=f"{plant.name}_stand_in")


def design_for(plant: MechanismParameters) -> MechanismParameters:
    """Return the plant on which the LQR is designed: dry friction of passive joints as viscous friction.

    A linear model has no dry friction, and no motor can compensate that of a passive joint: an LQR without a model
    of it loses acrobot and pendubot as soon as they move. b = F / v has the same force at the velocity v.
    """
    driven = plant.coordinates.driven_names
    changes = {
        f"{joint.name}.damping": own.damping + own.coulomb_friction / _SLIDING
        for joint, own in zip(plant.mechanism.joints, plant.joints, strict=True)
        if joint.name not in driven and own.coulomb_friction > 0.0
    }
    return replace(plant.with_values(changes), name=f"{plant.name}_design") if changes else plant


def design_file(folder: Path, plant: MechanismParameters) -> str:
    """Return the file of the plant on which the LQR is designed, stored in a folder; empty where that is the plant."""
    designed = design_for(plant)
    if designed is plant:
        return ""
    meaning = f"{plant.name}, dry friction of its passive joints as viscous friction at {_SLIDING:g} rad/s or m/s"
    return str(write_mechanism(folder / "design.yaml", designed, provenance={"design_of": meaning}))


def load_stand_in(path: str | Path, plant: MechanismParameters) -> MechanismParameters:
    """Return the plant of a file that is to stand in for a machine.

    Args:
        path: The plant file, or a preset.
        plant: The plant that is simulated.

    Raises:
        ParameterError: It cannot be read, or has other equations or other joints than the simulated plant.
    """
    found = load_mechanism(path)
    for what, ours, others in (
        ("model", plant.mechanism.name, found.mechanism.name),
        ("driven joints", ", ".join(plant.coordinates.driven_names), ", ".join(found.coordinates.driven_names)),
    ):
        if ours != others:
            raise ParameterError(
                f"plant file {path} has {what} {others or 'none'}; expected {ours}, as the plant that is simulated, "
                f"{plant.name}: the controller on both sides is designed for it"
            )
    return found


def record_joints(
    folder: Path,
    settings: JointSettings,
    machine: Path,
    *,
    excitation: Mapping[str, Any] | None = None,
    hosts: HostPool | None = None,
    on_side: Callable[[str], None] = lambda side: None,
) -> None:
    """Record both sides over DDS, in lockstep, as the bags ``sim`` and ``hw`` of a run folder.

    Where the plant of the design is another than the simulated one, it is stored there as ``design.yaml``.

    Args:
        folder: The run folder.
        settings: What to run.
        machine: Plant file of the surrogate of the machine.
        excitation: Parameters of the disturbance that differ from those of the noise.
        hosts: As for :func:`pendulum_bags.experiments.lockstep.record_run`.
        on_side: Called with each side's name when it starts.

    Raises:
        BagError: A bag exists, or cannot be written.
        FaultError: A program ended or did not respond, or a plant fell or faulted; it reports both sides.
    """
    plant = load_mechanism(settings.plant)
    design = design_file(folder, plant)
    ends: dict[str, str] = {}
    for side, runs, words in (
        ("sim", settings.plant, "simulation"),
        ("hw", str(machine), "stand-in for the machine"),
    ):
        on_side(words)
        stopped = ""
        try:
            run = JointRun(settings, side, runs, design, excitation=excitation or {})
            record_run(folder / side, run, hosts=hosts)
        except PlantStoppedError as error:
            stopped = f"went to {error.mode} ({error.reason})"
        ends[words] = _end_of(folder / side, f"/{side}", plant, stopped)
    if any(ends.values()):
        raise FaultError(_told(ends, settings))


def fall_time(plant: MechanismParameters, stamps_ns: Array, position: Array) -> float | None:
    """Return when a plant fell, from the first state on [s], or None: half of its height of potential energy is lost.

    Args:
        plant: The plant.
        stamps_ns: Times of N states [ns].
        position: Their positions, shape (N, n).
    """
    potential, p = plant.mechanism.potential, plant.packed
    half = 0.5 * potential(plant.coordinates.goal, p)
    for stamp_ns, q in zip(stamps_ns, position, strict=True):
        if potential(tuple(q), p) < half:
            return float(stamp_ns - stamps_ns[0]) / NANOSECONDS
    return None


def _end_of(bag: Path, namespace: str, plant: MechanismParameters, stopped: str) -> str:
    """Return how a side failed, as text, or an empty string."""
    with read_bag(bag) as opened:
        states = opened.joints(f"{namespace}/{JOINT_STATES}")
    fell = fall_time(plant, states.stamp_ns, states.position) if len(states.stamp_ns) else None
    said = [] if fell is None else [f"fell after {fell:.2f} s"]
    return " and ".join([*said, stopped] if stopped else said)


def _told(ends: Mapping[str, str], settings: JointSettings) -> str:
    failed = [f"the {words} {end}" for words, end in ends.items() if end]
    held = [f"the {words} stayed upright" for words, end in ends.items() if not end]
    joint = next(joint for joint in load_mechanism(settings.plant).mechanism.joints if joint.name == settings.joint)
    return (
        f"{'both sides failed' if not held else 'the sides part'}: {'; '.join(failed + held)}, under noise of "
        f"{settings.amplitude:g} {joint.effort_unit} at {settings.joint}; expected both to stay upright: compare with "
        "a smaller --amplitude"
    )
