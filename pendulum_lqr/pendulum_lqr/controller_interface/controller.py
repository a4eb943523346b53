"""One interface for every controller, and the table that a name is looked up in.

A controller is a class in a file of its own under ``controllers/`` plus one line in ``CONTROLLERS``. It sees
x = [wrap(theta - pi), theta_dot] and returns a torque; it depends on neither ROS nor a clock.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, cast

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.joint_controller import JOINT_CONTROLLERS
from pendulum_lqr.controller_interface.law import Law, clamped, deviation
from pendulum_lqr.controller_interface.loop_check import require_stable
from pendulum_lqr.controller_interface.velocity import VELOCITY_ESTIMATORS, VelocityEstimator
from pendulum_lqr.linear.analysis import Feedback
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import ParameterSpec, suggestion, validate
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.extras import how_to_install

__all__ = [
    "COMMON_PARAMETERS",
    "CONTROLLERS",
    "BaseController",
    "EstimatedVelocity",
    "LawController",
    "SoftStart",
    "controller_class",
    "controller_parameters",
    "make_controller",
    "soft_start",
    "unwrapped",
]

CONTROLLERS: dict[str, str] = {
    "lqr": "pendulum_lqr.controllers.lqr:Lqr",
    "lqi": "pendulum_lqr.controllers.lqi:Lqi",
    "lqg": "pendulum_lqr.controllers.lqg:Lqg",
    "lqr_friction": "pendulum_lqr.controllers.lqr_friction:LqrFriction",
    "lqr_tracking": "pendulum_lqr.controllers.lqr_tracking:LqrTracking",
    "discrete_lqr": "pendulum_lqr.controllers.discrete_lqr:DiscreteLqr",
    "pid": "pendulum_lqr.controllers.pid:Pid",
    "pd_gravity": "pendulum_lqr.controllers.pd_gravity:PdGravity",
    "energy_swing_up": "pendulum_lqr.controllers.energy_swing_up:EnergySwingUp",
    "time_optimal": "pendulum_lqr.controllers.time_optimal:TimeOptimal",
    "tvlqr": "pendulum_lqr.controllers.tvlqr:Tvlqr",
    "mpc": "pendulum_lqr.controllers.mpc:LinearMpc",
    "nmpc": "pendulum_lqr.controllers.nmpc:NonlinearMpc",
    "sliding_mode": "pendulum_lqr.controllers.sliding_mode:SlidingMode",
    "playback": "pendulum_lqr.controllers.playback:Playback",
    "policy": "pendulum_lqr.controllers.policy:LearnedPolicy",
}
"""Name -> ``module:class``; modules are imported on demand, so that LQR does not pay for CasADi."""

COMMON_PARAMETERS: tuple[ParameterSpec, ...] = (
    ParameterSpec("set_point", 0.0, "rad", "Angle to hold, from upright.", minimum=-math.pi, maximum=math.pi),
    ParameterSpec(
        "effort_limit",
        0.0,
        "N m",
        "Largest torque of the controller; 0 for the plant's own limit.",
        minimum=0.0,
    ),
    ParameterSpec(
        "velocity", "measured", "", "Where the velocity comes from.", choices=("measured", *VELOCITY_ESTIMATORS)
    ),
    ParameterSpec(
        "start_time",
        0.0,
        "s",
        "Time in which the torque that it may ask for rises from zero to its limit, after the first state, for a plant "
        "that lets nobody begin with much (`start_effort_limit`); 0 for at once.",
        minimum=0.0,
        maximum=5.0,
    ),
)
"""Parameters that every controller has."""


def soft_start(effort: float, limit: float, t: float, start_time: float) -> float:
    """Return a torque within the limit that applies at this time after the first state [N m].

    Args:
        effort: The desired torque [N m].
        limit: Largest torque in the end [N m].
        t: Time since the first state [s].
        start_time: Time in which the largest torque rises from zero to the limit [s].
    """
    bound = limit if t >= start_time else limit * max(0.0, t) / start_time
    return min(bound, max(-bound, effort))


class BaseController:
    """What most controllers share: a limit, a set-point, and no state.

    Attributes:
        effort_limit: Largest torque [N m].
        set_point: Angle to hold, from upright [rad].
        notice: Notice for the user while it runs; empty for nothing.
        feedback: What it is near its set-point where that is a gain; None for any other law.
    """

    feedback: Feedback | None = None
    SUMMARY: ClassVar[str] = ""
    """One sentence for tables."""
    PARAMETERS: ClassVar[tuple[ParameterSpec, ...]] = ()
    """Parameters of this controller beyond ``COMMON_PARAMETERS``."""
    SERIES_ELASTIC: ClassVar[bool] = True
    """Whether its design reckons with motor and spring; others refuse such a plant."""
    PREDICTS: ClassVar[bool] = False
    """Whether it predicts the plant from the torques that it sent, and so needs the holding torque."""
    STARTS_SOFTLY: ClassVar[bool] = False
    """Whether it applies ``start_time`` itself; for others :class:`SoftStart` does."""
    FEEDBACK: ClassVar[bool] = True
    """Whether it closes a loop whose linear model has to be stable."""

    TIME_INVARIANT: ClassVar[bool] = True
    """Whether a state gives the same command at any time, so that the loop has a frequency response."""

    def __init__(self, effort_limit: float, set_point: float = 0.0) -> None:
        self.notice = ""
        self.effort_limit = effort_limit
        self.set_point = set_point

    @classmethod
    def design(cls, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> BaseController:
        """Return the controller for a plant; by default what the class makes of these three.

        Args:
            plant: Plant parameters.
            period: Sampling period of the loop [s].
            p: Checked values of ``COMMON_PARAMETERS`` and ``PARAMETERS``; ``effort_limit`` is already the one to keep.

        Raises:
            ParameterError: The values do not make a controller for this plant.
        """
        make: Any = cls
        designed: BaseController = make(plant, period, p)
        return designed

    @classmethod
    def judged_at(cls, p: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
        """Return what is set, one judgement after the other, where the loop is judged before it moves a plant.

        Where a loop rests is one thing, whether it is stable another: the holding torque belongs to the first.

        Args:
            p: Checked values of all parameters.
        """
        return ({} if p.get("feedforward", True) else {"feedforward": True},)

    def check(self, plant: PlantParameters, period: float) -> None:
        """Refuse a period at which states come and for which this controller is not; any period by default.

        Args:
            plant: Plant parameters.
            period: Period of the states [s].

        Raises:
            ParameterError: It is not for this period.
        """

    def reset(self) -> None:
        """Forget everything."""

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m] for the state x = [angle from upright [rad], velocity [rad/s]] at time t [s]."""
        raise NotImplementedError(f"{type(self).__name__}.command")

    def describe(self) -> str:
        """Return gains and figures in one line."""
        return type(self).__name__

    def carry_over(self, previous: Controller) -> None:
        """Take over what the previous controller remembers, wherever its velocity came from."""
        self.take_over(unwrapped(previous))

    def take_over(self, previous: Controller) -> None:
        """Take over what the previous controller remembers; nothing by default."""

    def clamp(self, effort: float) -> float:
        """Return the torque within the limit [N m]."""
        return clamped(effort, self.effort_limit)

    def error(self, angle: float) -> float:
        """Return the deviation of an angle (from upright) from the set-point, the short way round [rad]."""
        return deviation(angle, self.set_point)


class LawController(BaseController):
    """A controller that is one pure function of numbers: its node can run it in compiled code.

    Args:
        law: The function, of a module; it begins with ``effort_limit`` and ``set_point`` among its numbers.
        effort_limit: Largest torque [N m].
        set_point: Angle to hold, from upright [rad].
        numbers: The law's own numbers, at most ``MOST_NUMBERS - OWN``.
        memory: Its memory before the first state, at most ``MOST_MEMORY``.

    Attributes:
        law: The function.
        numbers: All of its numbers.
        memory: Its state.
    """

    def __init__(
        self,
        law: Law,
        effort_limit: float,
        set_point: float,
        numbers: Iterable[float],
        memory: Iterable[float] = (),
    ) -> None:
        super().__init__(effort_limit, set_point)
        self.law = law
        # Plain floats: indexing an array of two on every state costs more than the law itself.
        self.numbers = tuple(float(number) for number in (effort_limit, set_point, *numbers))
        self._at_first = [float(value) for value in memory]
        self.memory = list(self._at_first)

    def reset(self) -> None:
        """Remember what it did before its first state."""
        self.memory[:] = self._at_first

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the torque [N m] that the law has for the state."""
        return self.law(t, x[0], x[1], self.memory, self.numbers)


class EstimatedVelocity(BaseController):
    """A controller that sees an estimated velocity in place of the measured one.

    Args:
        inner: The controller.
        estimator: The velocity estimator; its input is the torque of the last command.
    """

    def __init__(self, inner: Controller, estimator: VelocityEstimator) -> None:
        super().__init__(inner.effort_limit)
        self.inner = inner
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
        """Take over the filter too, where the previous controller had one of the same kind."""
        if isinstance(previous, EstimatedVelocity):
            if type(previous.estimator) is type(self.estimator):
                self.estimator = previous.estimator
            self._last_effort = previous._last_effort
        self.inner.carry_over(previous)


class SoftStart(BaseController):
    """A controller whose torque begins at zero and may reach its limit after a while; a predictive one ignores it.

    Args:
        inner: The controller.
        start_time: Time from the first state until it has all of its torque [s].
    """

    def __init__(self, inner: Controller, start_time: float) -> None:
        super().__init__(inner.effort_limit)
        self.inner = inner
        self.start_time = start_time

    def reset(self) -> None:
        """Forget everything."""
        self.inner.reset()

    def command(self, t: float, x: Sequence[float]) -> float:
        """Return the inner controller's torque, within what it may have so long after its start [N m]."""
        return soft_start(self.inner.command(t, x), self.effort_limit, t, self.start_time)

    def describe(self) -> str:
        """Return the inner controller's line and the time."""
        return f"{self.inner.describe()}, torque rises in {self.start_time:g} s"

    def carry_over(self, previous: Controller) -> None:
        """Take over what the previous controller remembers; how long ago it began is the caller's."""
        self.inner.carry_over(previous)


def unwrapped(controller: Controller) -> Controller:
    """Return the controller itself, without what gives it its velocity and what lets its torque rise."""
    while isinstance(controller, (EstimatedVelocity, SoftStart)):
        controller = controller.inner
    return controller


def controller_class(name: str) -> type[BaseController]:
    """Return the class behind a name of ``CONTROLLERS``.

    Raises:
        ParameterError: No such controller; the message lists those there are. Or a library of it is not installed.
    """
    if not isinstance(name, str) or name not in CONTROLLERS:  # a file may say 7
        if name in list(JOINT_CONTROLLERS):
            raise ParameterError(f"{name} is for plants of several joints; expected one of {', '.join(CONTROLLERS)}")
        raise ParameterError(f"controller is {name!r}; {suggestion(name, CONTROLLERS)}")
    module, kind = CONTROLLERS[name].split(":")
    try:
        return cast("type[BaseController]", getattr(importlib.import_module(module), kind))
    except ImportError as error:
        if text := how_to_install(error):
            raise ParameterError(f"controller {name}: {text}") from error
        raise


def controller_parameters(name: str) -> tuple[ParameterSpec, ...]:
    """Return the specs of a controller: common ones first, but for those of which it has its own."""
    kind = controller_class(name)
    own = {spec.name for spec in kind.PARAMETERS}
    return (*(spec for spec in COMMON_PARAMETERS if spec.name not in own), *kind.PARAMETERS)


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
        plant: Parameters of the plant to design for.
        period: Sampling period of the loop [s].
        values: Parameters by name; others at their default.
        checked: Whether a loop that is unstable is refused; not where the period is a guess. Gains set by hand
            (``tuning`` manual) are not checked.

    Raises:
        ParameterError: Unknown controller or parameter, a value out of domain, a design that does not exist, or a loop
            that is unstable on the linear model of the plant at this period, delay included.
    """
    kind = controller_class(name)
    p = validate(controller_parameters(name), values or {})
    if not (math.isfinite(period) and period > 0.0):
        raise ParameterError(f"period is {period} s; expected a finite value > 0")
    p["effort_limit"] = min(p["effort_limit"], plant.effort_limit) if p["effort_limit"] > 0.0 else plant.effort_limit
    if plant.drivetrain is not None and not kind.SERIES_ELASTIC:
        raise ParameterError(
            f"{name} knows rigid plants alone, and plant {plant.name!r} is series elastic; expected lqr, lqi, lqg, "
            "lqr_friction, lqr_tracking, mpc, pid or pd_gravity, or a plant file without a drivetrain"
        )
    designed = kind.design(plant, period, p)
    if checked:
        designed.check(plant, period)
    controller: Controller = designed
    if p["start_time"] > 0.0 and not kind.STARTS_SOFTLY:
        controller = SoftStart(controller, p["start_time"])
    if p["velocity"] != "measured":
        controller = EstimatedVelocity(controller, VELOCITY_ESTIMATORS[p["velocity"]](plant, period))
    if checked and kind.FEEDBACK and p.get("tuning") != "manual":
        for changed in kind.judged_at(p):
            judged, at = controller, {**p, **changed}
            if changed:
                judged = make_controller(name, plant, period, {**(values or {}), **changed}, checked=False)
            require_stable(name, judged, plant, period, at["set_point"])
    return controller
