"""Swing-up of several joints on the graph: a stored trajectory by TVLQR, then LQR about upright."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.sampling import require_period
from pendulum_lqr.controllers.linear_feedback import require_catching
from pendulum_lqr.swing_up.catch import MechanismCatch
from pendulum_lqr.swing_up.mpc import MechanismMpc
from pendulum_lqr.swing_up.stored_swing_up import default_catch, stored_trajectory
from pendulum_lqr.swing_up.trajectory import MechanismTrajectory, load_trajectory
from pendulum_lqr.swing_up.tvlqr import MechanismTvlqr
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.parameters import ParameterSpec
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["CaughtController", "JointSwingUp"]

_FILE = ParameterSpec(
    "trajectory",
    "",
    "",
    "File (.json) of `python -m pendulum_lqr swing_up`; empty for the swing-up that is stored for the preset.",
)


class CaughtController(Controller):
    """A controller of whole states that ends with an LQR; ``inner`` defines how. ``period`` of the states in [s]."""

    NAME: ClassVar[str]
    """Name in refusals."""
    EVERY_STATE: ClassVar[str]
    """Action at every state, in refusals."""

    def __init__(self, inner: MechanismTvlqr | MechanismMpc, period: float) -> None:
        super().__init__(inner.plant.effort_limits)
        self.period = period
        self._inner = inner

    def check(self, period: float) -> None:
        """Refuse another period than the design's [s], and one at which its LQR does not settle."""
        require_period(self.EVERY_STATE, self.period, period)
        require_catching(self.NAME, self._inner.catch, period)

    def reset(self) -> None:
        """Restart, hanging."""
        self._inner.reset()

    def efforts(self, t: float, position: Vector, velocity: Vector) -> Vector:
        """Return m efforts."""
        return self._inner.efforts(t, position, velocity)


class JointSwingUp(CaughtController):
    """From hanging along a swing-up; no effort once it is lost.

    Raises:
        ParameterError: No swing-up is stored for this plant and none is given, its file is refused, or it is for
            another mechanism.
    """

    SUMMARY = "swing-up along the stored trajectory of a preset, or that of a file, by TVLQR, then LQR"
    NAME = "tvlqr"
    EVERY_STATE = "the trajectory is followed"
    DESIGNING = "tries out from where the LQR catches, which takes some seconds"

    def __init__(self, plant: PlantParameters, period: float, p: Mapping[str, Any]) -> None:
        catch, trajectory = self._find(plant, p)
        self._duration = trajectory.duration
        q, r = plant.weights
        super().__init__(MechanismTvlqr(period, trajectory, catch, q=q, r=r), period)

    @classmethod
    def parameters(cls, plant: PlantParameters) -> tuple[ParameterSpec, ...]:
        """Return the file."""
        return (_FILE,)

    def _find(self, plant: PlantParameters, p: Mapping[str, Any]) -> tuple[MechanismCatch, MechanismTrajectory]:
        """Return the LQR that catches, and the swing-up that leads to it."""
        given = p["trajectory"]
        trajectory = load_trajectory(Path(given).expanduser()) if given else stored_trajectory(plant)
        return default_catch(plant), trajectory

    def describe(self) -> str:
        """Return the duration of the swing-up, and the LQR's region."""
        return f"swing-up of {self._duration:.3g} s by TVLQR, then LQR within {self._inner.catch.region.describe()}"
