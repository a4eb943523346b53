"""Table of controllers, their common classes, and design by name.

A controller is a class in a file under ``controllers/`` plus one line in ``CONTROLLERS``. It maps the states of all
joints to efforts of the driven ones, independent of ROS and clocks.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.law import Law, clamped, deviation
from pendulum_lqr.controller_interface.loop_check import require_stable
from pendulum_lqr.controller_interface.velocity import VELOCITY_ESTIMATORS, VelocityEstimator
from pendulum_msgs_py.contract.angles import UPRIGHT, wrap_angle
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, suggestion, validate
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = [
    "COMMON_PARAMETERS",
    "CONTROLLERS",
    "ONE_JOINT",
    "RIGID",
    "SEVERAL_JOINTS",
    "START_TIME",
    "BaseController",
    "EstimatedVelocity",
    "LawController",
    "Row",
    "SoftStart",
    "VoltageOutput",
    "controller_class",
    "controller_names",
    "controller_parameters",
    "make_controller",
    "soft_start",
]

ONE_JOINT, SEVERAL_JOINTS, RIGID = "one joint", "several joints", "a plant without a drivetrain"
"""What a controller may need."""


class Row(NamedTuple):
    """Row of the table of controllers.

    Attributes:
        target: ``module:class``, imported on demand, so that LQR does not import CasADi.
        needs: Required properties of the plant.
        several: ``module:class`` of the method of this name for several joints.
    """

    target: str
    needs: tuple[str, ...] = (ONE_JOINT,)
    several: str = ""


_ANY: tuple[str, ...] = ()
_RIGID = (ONE_JOINT, RIGID)
_HERE = "pendulum_lqr.controllers"
CONTROLLERS: dict[str, Row] = {
    "lqr": Row(f"{_HERE}.lqr:Lqr", _ANY),
    "lqi": Row(f"{_HERE}.lqi:Lqi", _ANY),
    "lqg": Row(f"{_HERE}.lqg:Lqg", _ANY),
    "lqr_friction": Row(f"{_HERE}.lqr_friction:LqrFriction"),
    "lqr_tracking": Row(f"{_HERE}.lqr_tracking:LqrTracking"),
    "discrete_lqr": Row(f"{_HERE}.discrete_lqr:DiscreteLqr", _ANY),
    "pid": Row(f"{_HERE}.pid:Pid"),
    "pd_gravity": Row(f"{_HERE}.pd_gravity:PdGravity"),
    "energy_swing_up": Row(
        f"{_HERE}.energy_swing_up:EnergySwingUp", _RIGID, f"{_HERE}.joint_energy_swing_up:JointEnergySwingUp"
    ),
    "time_optimal": Row(f"{_HERE}.time_optimal:TimeOptimal", _RIGID),
    "tvlqr": Row(f"{_HERE}.tvlqr:Tvlqr", _RIGID, f"{_HERE}.joint_swing_up:JointSwingUp"),
    "ilqr": Row(f"{_HERE}.joint_ilqr:JointIlqr", (SEVERAL_JOINTS,)),
    "mpc": Row(f"{_HERE}.mpc:LinearMpc", _ANY),
    "nmpc": Row(f"{_HERE}.nmpc:NonlinearMpc", _RIGID, f"{_HERE}.joint_nmpc:JointNmpc"),
    "sliding_mode": Row(f"{_HERE}.sliding_mode:SlidingMode", _RIGID),
    "playback": Row(f"{_HERE}.playback:Playback", _ANY),
    "policy": Row(f"{_HERE}.policy:LearnedPolicy", _ANY),
}

START_TIME = ParameterSpec(
    "start_time",
    0.0,
    "s",
    "Time in which the torque limit rises from zero after the first state, for plants with `start_effort_limit`; "
    "0 for at once.",
    minimum=0.0,
    maximum=5.0,
)
COMMON_PARAMETERS: tuple[ParameterSpec, ...] = (
    ParameterSpec("set_point", 0.0, "rad", "Angle to hold, from upright.", minimum=-math.pi, maximum=math.pi),
    ParameterSpec(
        "effort_limit", 0.0, "N m", "Largest torque of the controller; 0 for the plant's own limit.", minimum=0.0
    ),
    ParameterSpec("velocity", "measured", "", "Source of the velocity.", choices=("measured", *VELOCITY_ESTIMATORS)),
    START_TIME,
)
"""Parameters of every controller of one joint; those of several joints have only the last one."""


def soft_start(effort: float, limit: float, t: float, start_time: float) -> float:
    """Return a torque within the limit [N m], which rises from 0 to ``limit`` [N m] over ``start_time`` [s]."""
    bound = limit if t >= start_time else limit * max(0.0, t) / start_time
    return min(bound, max(-bound, effort))


class BaseController(Controller):
    """A controller of one joint with ``command``: ``effort_limit`` [N m], ``set_point`` from upright [rad]."""

    def __init__(self, effort_limit: float, set_point: float = 0.0) -> None:
        super().__init__((effort_limit,))
        self.effort_limit = effort_limit
        self.set_point = set_point

    def clamp(self, effort: float) -> float:
        """Return the torque within the limit [N m]."""
        return clamped(effort, self.effort_limit)

    def error(self, angle: float) -> float:
        """Return the deviation of an angle (from upright) from the set-point, the short way round [rad]."""
        return deviation(angle, self.set_point)


class LawController(BaseController):
    """A controller that is one pure function of numbers, which its node can run compiled.

    Args:
        law: Module-level function; its numbers begin with ``effort_limit`` and ``set_point``.
        effort_limit: [N m].
        set_point: Angle to hold, from upright [rad].
        numbers: The law's own numbers, at most ``MOST_NUMBERS - OWN``.
        memory: Its memory before the first state, at most ``MOST_MEMORY``.

    Attributes:
        law: The function; None where a subclass has none for its plant.
        numbers: All of its numbers.
        memory: Its state.
    """

    law: Law | None
    numbers: tuple[float, ...]

    def __init__(
        self, law: Law, effort_limit: float, set_point: float, numbers: Iterable[float], memory: Iterable[float] = ()
    ) -> None:
        super().__init__(effort_limit, set_point)
        self._use(law, numbers, memory)

    def _use(self, law: Law | None, numbers: Iterable[float], memory: Iterable[float] = ()) -> None:
        """Set the law, its own numbers and its initial memory."""
        self.law = law
        self._call = self._without_law if law is None else law
        # Direct call unless a subclass overrides command: each wrapping call costs as much as a law.
        self._direct = law if type(self).command is LawController.command else None
        # Floats: indexing arrays on every state costs more than the law itself.
        self.numbers = tuple(float(number) for number in (self.effort_limit, self.set_point, *numbers))
        self._at_first = [float(value) for value in memory]
        self.memory = list(self._at_first)

    def reset(self) -> None:
        """Restore the memory before the first state."""
        self.memory[:] = self._at_first

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the law's torque for the state [N m]."""
        if self._direct is None:
            return super().efforts(t, position, velocity)
        return (self._direct(t, wrap_angle(position[0] - UPRIGHT), velocity[0], self.memory, self.numbers),)

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the law's torque for the state [N m]."""
        return self._call(t, x[0], x[1], self.memory, self.numbers)

    def _without_law(self, t: float, angle: float, velocity: float, _memory: Any, _numbers: Any) -> float:
        return self.efforts(t, (UPRIGHT + angle,), (velocity,))[0]


class EstimatedVelocity(Controller):
    """A controller of one joint with estimated velocity; the estimator's input is the torque of the last command."""

    def __init__(self, inner: Controller, estimator: VelocityEstimator) -> None:
        super().__init__(inner.effort_limits)
        self.inner: Controller = inner
        self.estimator = estimator
        self._last_effort = 0.0

    def reset(self) -> None:
        """Forget everything."""
        self.inner.reset()
        self.estimator.reset()
        self._last_effort = 0.0

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the inner controller's torque for the estimated state [N m]."""
        velocity = self.estimator.update(t, x[0], x[1], self._last_effort)
        self._last_effort = self.inner.command(t, (x[0], velocity))
        return self._last_effort

    def describe(self) -> str:
        """Return the inner controller's line and the estimator's name."""
        return f"{self.inner.describe()}, velocity by {type(self.estimator).__name__}"

    def carry_over(self, previous: Controller) -> None:
        """Take over the filter too, if the previous controller had one of the same kind."""
        if isinstance(previous, EstimatedVelocity):
            if type(previous.estimator) is type(self.estimator):
                self.estimator = previous.estimator
            self._last_effort = previous._last_effort
        self.inner.carry_over(previous)


class SoftStart(Controller):
    """A controller whose effort limits rise from zero over ``start_time`` [s]; a predictive one ignores it."""

    def __init__(self, inner: Controller, start_time: float) -> None:
        super().__init__(inner.effort_limits)
        self.inner: Controller = inner
        self.start_time = start_time

    def reset(self) -> None:
        """Forget everything."""
        self.inner.reset()

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the inner controller's efforts, within the limits at this time [N m or N]."""
        wanted = zip(self.inner.efforts(t, position, velocity), self.effort_limits, strict=True)
        return tuple(soft_start(effort, limit, t, self.start_time) for effort, limit in wanted)

    def describe(self) -> str:
        """Return the inner controller's line and the time."""
        return f"{self.inner.describe()}, torque rises in {self.start_time:g} s"

    def carry_over(self, previous: Controller) -> None:
        """Take over the previous controller's state; the caller keeps the start time."""
        self.inner.carry_over(previous)


class VoltageOutput(Controller):
    """Converts the efforts of a controller of the plant behind the motors to volts; dead bands stay uncompensated."""

    def __init__(self, inner: Controller, plant: PlantParameters) -> None:
        limits = zip(plant.command_limits, inner.effort_limits, plant.gains, strict=True)
        super().__init__(tuple(min(volts, effort / gain) for volts, effort, gain in limits))
        self.inner: Controller = inner
        self._gains = plant.gains

    def reset(self) -> None:
        """Forget everything."""
        self.inner.reset()

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return the voltages of the inner controller's efforts [V]."""
        efforts = self.inner.efforts(t, position, velocity)
        return tuple(effort / gain for effort, gain in zip(efforts, self._gains, strict=True))

    def check(self, period: float) -> None:
        """Check the inner controller."""
        self.inner.check(period)

    def describe(self) -> str:
        """Return the inner controller's line, in efforts."""
        return f"{self.inner.describe()}, efforts given as volts"

    def carry_over(self, previous: Controller) -> None:
        """Take over the previous controller's state."""
        self.inner.carry_over(previous)


def controller_names(*, several: bool = False) -> list[str]:
    """Return the names of the controllers for plants of one joint, or of several."""
    return [name for name, row in CONTROLLERS.items() if _target(row, several=several)]


def controller_class(name: str, plant: PlantParameters | None = None) -> type[Controller]:
    """Return the class of a name in ``CONTROLLERS``, for a plant, or None for any of one joint.

    Raises:
        ParameterError: No such controller for this plant (the message lists those available), or a library is missing.
    """
    several = plant is not None and not plant.is_pendulum
    if not isinstance(name, str) or name not in CONTROLLERS:  # a file may say 7
        raise ParameterError(f"controller is {name!r}; {suggestion(name, controller_names(several=several))}")
    row = CONTROLLERS[name]
    target = _target(row, several=several)
    if not target:
        has = f", and plant {plant.name!r} has {', '.join(plant.coordinates.names)}" if plant is not None else ""
        raise ParameterError(
            f"{name} is for plants of {row.needs[0]}{has}; expected one of "
            f"{', '.join(controller_names(several=several))}"
        )
    if RIGID in row.needs and plant is not None and plant.drivetrain is not None:
        others = [other for other in controller_names() if RIGID not in CONTROLLERS[other].needs]
        raise ParameterError(
            f"{name} knows rigid plants alone, and plant {plant.name!r} is series elastic; expected one of "
            f"{', '.join(others)}, or a plant file without a drivetrain"
        )
    module, kind = target.split(":")
    try:
        return cast("type[Controller]", getattr(importlib.import_module(module), kind))
    except ImportError as error:
        if text := how_to_install(error):
            raise ParameterError(f"controller {name}: {text}") from error
        raise


def _target(row: Row, *, several: bool) -> str:
    """Return ``module:class`` of a row for plants of one joint or several; empty if it has none."""
    if several and row.several:
        return row.several
    return "" if (ONE_JOINT if several else SEVERAL_JOINTS) in row.needs else row.target


def controller_parameters(name: str, plant: PlantParameters | None = None) -> tuple[ParameterSpec, ...]:
    """Return the specs of a controller for a plant (None: any of one joint), common ones first unless overridden."""
    kind = controller_class(name, plant)
    if plant is not None and plant.coordinates.volts and not kind.IN_VOLTS:
        own = tuple(
            replace(spec, unit="V") if spec.name == "effort_limit" else spec
            for spec in kind.parameters(plant.torque_plant)
        )
    else:
        own = kind.parameters(plant)
    common = COMMON_PARAMETERS if plant is None or plant.is_pendulum else (START_TIME,)
    names = {spec.name for spec in own}
    return (*(spec for spec in common if spec.name not in names), *own)


def make_controller(
    name: str,
    plant: PlantParameters,
    period: float,
    values: Mapping[str, object] | None = None,
    *,
    checked: bool = True,
) -> Controller:
    """Design a controller.

    Args:
        name: Name in ``CONTROLLERS``.
        plant: Plant to design for.
        period: Sampling period of the loop [s].
        values: Parameters by name; others have defaults.
        checked: Refuse an unstable loop; not while the period is a guess. Manual gains (``tuning`` manual) are not
            checked.

    Raises:
        ParameterError: Unknown controller or parameter, a value out of domain, no such design, or a loop that is
            unstable on the linear model of the plant at this period, including delay.
    """
    kind = controller_class(name, plant)
    p = validate(controller_parameters(name, plant), values or {})
    if not (math.isfinite(period) and period > 0.0):
        raise ParameterError(f"period is {period} s; expected a finite value > 0")
    if plant.is_pendulum:
        p["effort_limit"] = min(p["effort_limit"] or math.inf, plant.effort_limit)
    if plant.coordinates.volts and not kind.IN_VOLTS:
        limit = {"effort_limit": p["effort_limit"] * min(plant.gains)} if "effort_limit" in p else {}
        designed: Controller = VoltageOutput(kind.design(plant.torque_plant, period, {**p, **limit}), plant)
    else:
        designed = kind.design(plant, period, p)
    if checked:
        designed.check(period)
    controller: Controller = designed
    if p["start_time"] > 0.0 and not kind.STARTS_SOFTLY:
        controller = SoftStart(controller, p["start_time"])
    if not plant.is_pendulum:
        return controller
    if p["velocity"] != "measured":
        controller = EstimatedVelocity(controller, VELOCITY_ESTIMATORS[p["velocity"]](plant, period))
    if checked and kind.FEEDBACK and p.get("tuning") != "manual":
        for changed in kind.judged_at(p):
            judged, at = controller, {**p, **changed}
            if changed:
                judged = make_controller(name, plant, period, {**(values or {}), **changed}, checked=False)
            require_stable(name, judged, plant, period, at["set_point"])
    return controller
