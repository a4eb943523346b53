"""A plant of several joints, held upright under noise, and another plant as the surrogate of its machine."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import NoiseSettings, Sides, is_named
from pendulum_bags.runs.case import IDENTITY
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_msgs_py.contract.names import JOINT_STATES
from pendulum_msgs_py.contract.values import NANOSECONDS, Vector
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, is_mechanism, load_mechanism, write_plant
from pendulum_rosbag.reader.bag import read_bag

__all__ = [
    "HOLDING",
    "LIMIT_PER_NOISE",
    "JointSettings",
    "default_amplitude",
    "design_file",
    "design_for",
    "driven_joint",
    "fall_time",
    "has_fallen",
    "identified_names",
    "load_surrogate",
    "require_upright",
    "surrogate_for",
]

Array = NDArray[Any]

_UNCHANGED = frozenset(
    {
        *("gravity", "gear_ratio", "stribeck_velocity", "lower_stop", "upper_stop", "time_constant"),
        *("effort_limit", "voltage_limit"),
    }
)
"""Values of a plant file that are not identified: constants, limits, and those of a friction model."""
_DELAY = "transport_delay"
DURATION = 20.0
"""Default length of the noise [s]."""
HOLDING = ("lqr", "discrete_lqr", "lqi", "lqg", "mpc")
"""Controllers that hold a plant upright; ``tvlqr`` and ``ilqr`` start hanging, and ``nmpc`` is an LQR there."""
LIMIT_PER_NOISE = 10.0
"""Effort limit of the joint per amplitude of the noise [-]: the LQR holds every preset under it on both sides, acrobot
and pendubot with dry friction up to 0.16, and their joints slide instead of standing still."""
_SLIDING = 0.5
"""Velocity at which a design linearises the dry friction of passive joints [rad/s or m/s]: that of the joints under
this noise. At 1 the pendubot falls; at 0.25 both plants stay, nearer to the limit of their LQR."""


@dataclass(frozen=True)
class JointSettings(Sides):
    """Noise on one joint of a plant that a controller holds upright, in simulation and on a machine.

    Attributes:
        machine: Plant file of the emulated machine, or of a simulation in its place; empty for ``plant``.
        design: Preset or file that the controller is designed on; empty for the simulated plant.
        joint: Driven joint that has the noise; empty for the first.
        noise: The disturbance, such as one of :func:`default_amplitude`.
        controller: One of ``HOLDING``.
    """

    plant: str = "cart_pole"
    machine: str = ""
    design: str = ""
    joint: str = ""
    noise: NoiseSettings = field(default_factory=lambda: NoiseSettings(duration=DURATION))
    storage: str = "mcap"
    controller: str = "lqr"
    simulation: str = ""
    mapping: str = ""
    hardware: str = "emulator"
    hardware_mapping: str = ""
    strategy: ClassVar[str] = ""
    method: ClassVar[str] = "auto"

    def __post_init__(self) -> None:
        """Validate the settings; the joint defaults to the first driven one."""
        if not is_mechanism(self.plant):
            raise ParameterError(
                f"plant is {self.plant!r}, which has one joint; expected one of several, such as cart_pole "
                "(experiment thesis is for one joint)"
            )
        object.__setattr__(self, "joint", driven_joint(self.plant, self.joint))
        if self.controller not in HOLDING:
            raise ParameterError(f"controller is {self.controller!r}; expected one of {', '.join(HOLDING)}")
        if is_named(self.hardware) and self.hardware != "emulator":
            raise ParameterError(
                f"hardware is {self.hardware}; with several joints start the bridge (python -m pendulum_hw_bridge "
                "bridge) and give ros:/hw: a person has to hold the plant upright"
            )
        self._check_sides(self.noise.hold_time)

    @property
    def design_plant(self) -> str:
        """Preset or file that the controller is designed on."""
        return self.design or self.plant

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the plant's joints."""
        return load_mechanism(self.plant).coordinates.names

    @property
    def expected_wall_time(self) -> float:
        """Wall time of the first recordings, measured on two cores [s]."""
        return 6.0 + 0.25 * self.noise.duration

    def plant_of(self, side: str) -> str:
        """Return the preset or file of a side's plant."""
        return self.plant if side == "sim" else self.machine or self.plant

    def run(self, side: str) -> RunSpec:
        """Return one side as a run in lockstep, for as long as the noise lasts."""
        own = {"plant": self.plant_of(side), "design_plant": self.design_plant, "controller": self.controller}
        return self._run(side, {"joints": [self.joint]}, **own)

    def metadata(self, side: str) -> dict[str, Any]:
        """Return the metadata of the bag of a side that runs already."""
        name, space = (self.simulation if side == "sim" else self.hardware), self.namespace(side)
        own = {"clock": "realtime", "plant": name, "emulated_plant": "", IDENTITY: space, "namespace": space}
        return {RUN_RECORD: {**self.run(side).metadata()[RUN_RECORD], **own, "experiment": "joints"}}


def driven_joint(plant: str, joint: str = "") -> str:
    """Return the joint that has the noise: the named or the first driven one; a ParameterError if there is none."""
    loaded = load_mechanism(plant)
    driven = loaded.coordinates.driven_names
    if not driven:
        raise ParameterError(f"plant {loaded.name!r} has no driven joint; expected an actuator at one of its joints")
    if joint and joint not in driven:
        raise ParameterError(f"joint is {joint!r}; expected one that is driven: {', '.join(driven)}")
    return joint or driven[0]


def default_amplitude(plant: str, joint: str = "") -> float:
    """Return the largest command of the noise, a share of its joint's limit [N m or N, or V]."""
    loaded = load_mechanism(plant)
    index = loaded.coordinates.driven_names.index(driven_joint(plant, joint))
    return loaded.command_limits[index] / LIMIT_PER_NOISE


def identified_names(plant: PlantParameters) -> list[str]:
    """Return the names of identifiable values: masses, lengths, inertias and friction."""
    return [name for name in plant.numbers if name.rpartition(".")[2] not in {*_UNCHANGED, _DELAY}]


def surrogate_for(plant: PlantParameters, *, share: float, delay: float, seed: int) -> PlantParameters:
    """Return a surrogate of a machine, with parameter errors as an identification may leave them.

    ``share`` is the largest relative error of a mass, length, inertia or friction, drawn uniformly; ``delay`` the
    transport delay of each motor [s]. A ParameterError if no plant has such values.
    """
    if not 0.0 <= share < 1.0:
        raise ParameterError(f"share is {share}; expected 0 to less than 1")
    drawn = np.random.default_rng(seed)
    changes = {name: delay for name in plant.numbers if name.rpartition(".")[2] == _DELAY}
    changes |= {
        name: plant.numbers[name] * (1.0 + float(drawn.uniform(-share, share))) for name in identified_names(plant)
    }
    return replace(plant.with_values(changes), name=f"{plant.name}_stand_in")


def design_for(plant: PlantParameters) -> PlantParameters:
    """Return the plant of the LQR's design: dry friction F of passive joints as viscous friction b = F / v.

    A linear model has no dry friction, and no motor compensates it at a passive joint: without b, an LQR loses acrobot
    and pendubot as soon as they move. At the velocity v both forces are equal.
    """
    driven = plant.coordinates.driven_names
    changes = {
        f"{joint.name}.damping": own.damping + own.coulomb_friction / _SLIDING
        for joint, own in zip(plant.mechanism.joints, plant.joints, strict=True)
        if joint.name not in driven and own.coulomb_friction > 0.0
    }
    return replace(plant.with_values(changes), name=f"{plant.name}_design") if changes else plant


def design_file(folder: Path, plant: str) -> str:
    """Return the plant of the controller's design: the preset or file itself, or one stored in a folder."""
    loaded = load_mechanism(plant)
    designed = design_for(loaded)
    if designed is loaded:
        return plant
    meaning = f"{loaded.name}, dry friction of its passive joints as viscous friction at {_SLIDING:g} rad/s or m/s"
    return str(write_plant(folder / "design.yaml", designed, provenance={"design_of": meaning}))


def load_surrogate(path: str | Path, plant: PlantParameters) -> PlantParameters:
    """Return the surrogate in a file or preset; a ParameterError if its equations or joints differ from ``plant``."""
    found = load_mechanism(path)
    for what, ours, others in (
        ("model", plant.mechanism.model, found.mechanism.model),
        ("driven joints", ", ".join(plant.coordinates.driven_names), ", ".join(found.coordinates.driven_names)),
    ):
        if ours != others:
            raise ParameterError(
                f"plant file {path} has {what} {others or 'none'}; expected {ours}, as the plant that is simulated, "
                f"{plant.name}: the controller on both sides is designed for it"
            )
    return found


def has_fallen(plant: PlantParameters, position: Vector) -> bool:
    """Return whether a plant has lost half of its potential energy at n positions [rad or m]."""
    potential, p = plant.mechanism.potential, plant.packed
    return bool(potential(position, p) < 0.5 * potential(plant.coordinates.goal, p))


def fall_time(plant: PlantParameters, stamps_ns: Array, position: Array) -> float | None:
    """Return when a plant had lost half of its potential energy [s], or None; positions (N, n), stamps [ns]."""
    for stamp_ns, q in zip(stamps_ns, position, strict=True):
        if has_fallen(plant, tuple(q)):
            return float(stamp_ns - stamps_ns[0]) / NANOSECONDS
    return None


def require_upright(folder: Path, settings: JointSettings, stopped: str = "") -> None:
    """Raise a FaultError if a plant fell in the recordings ``sim`` or ``hw``, or for the reason ``stopped``."""
    plant = load_mechanism(settings.plant)
    ends: dict[str, str] = {}
    for side, words in (("sim", "simulation"), ("hw", "emulated hardware")):
        if settings.running(side) is not None:
            # It was watched while it ran, and falls when it is disarmed.
            continue
        with read_bag(folder / side) as opened:
            states = opened.joints(f"/{side}/{JOINT_STATES}")
        fell = fall_time(plant, states.stamp_ns, states.position) if len(states.stamp_ns) else None
        found = [] if fell is None else [f"fell after {fell:.2f} s"]
        ends[words] = " and ".join([*found, *([stopped] if stopped and side == "hw" else [])])
    if not any(ends.values()):
        return
    failed = [f"the {words} {end}" for words, end in ends.items() if end]
    held = [f"the {words} stayed upright" for words, end in ends.items() if not end]
    joint = next(joint for joint in plant.mechanism.joints if joint.name == settings.joint)
    raise FaultError(
        f"{'both sides failed' if not held else 'the sides part'}: {'; '.join(failed + held)}, under noise of "
        f"{settings.noise.amplitude:g} {joint.effort_unit} at {settings.joint}; expected both to stay upright: compare "
        "with a smaller --amplitude"
    )
