"""What the fit of several joints asks of a model: parameters by name, and motions under many sets of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

from pendulum_bags.arrays import Array
from pendulum_bags.identification.arrowhead import Model
from pendulum_msgs_py.contract.joints import Coordinates

__all__ = ["DELAY", "LAG", "MotionModel", "Timeline"]

DELAY = "delay"
"""Time from the recorded effort to its effect, negative where the effort is recorded late [s]."""

LAG = "time_constant"
"""First-order lag of the actuators [s]."""

_Self = TypeVar("_Self", bound="MotionModel")


class Timeline(Protocol):
    """The instants of w windows, and the efforts between them."""

    @property
    def time(self) -> Array:
        """Instants, shape (w, l) [s]."""

    def input(self, delay: float, lag: float) -> Array:
        """Return straight lines for the effort in each step, delayed and lagging: start and slope, (w, l - 1, 2 n)."""


class MotionModel(Model, Protocol):
    """Parameters of a simulation of n joints, and its motions."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters, in the order of the vector; ``DELAY`` and ``LAG`` are the last two."""

    @property
    def coordinates(self) -> Coordinates:
        """Its joints."""

    @property
    def label(self) -> str:
        """Name of the plant."""

    @property
    def start(self: _Self) -> _Self:
        """The model as it was before the fit."""

    @property
    def smooth(self: _Self) -> _Self:
        """The model without dry friction, which hides an unstable equilibrium as long as a joint rests."""

    @property
    def sizes(self) -> tuple[str, ...]:
        """Names of masses, lengths and inertias that motion tells apart; positive, and far from 0."""

    @property
    def near(self) -> tuple[str, ...]:
        """Names of the sizes whose start is near the machine's: 10 times as much is another one."""
        return self.sizes

    @property
    def own_offsets(self) -> tuple[tuple[str, ...], ...]:
        """Offsets that each recording may have of its own: of the efforts, and of the angles that gravity shows."""

    def unit(self, name: str) -> str:
        """Return the unit of a parameter."""

    def fitted(self, *, offsets: bool = False, delay: bool = False, lag: bool = False) -> tuple[str, ...]:
        """Return the names that are free."""

    def held(self, free: Sequence[str]) -> str:
        """Return in a sentence what is not free."""

    def motions(self, values: Array, data: Timeline, states: Array) -> Array:
        """Return motions, shape (c, w, l, 2 n), of values (c, parameters) and start states (c, w, 2 n)."""

    def index(self, names: Sequence[str]) -> list[int]:
        """Return where some parameters are."""
        own = self.names
        return [own.index(name) for name in names]

    def __getitem__(self, name: str) -> float:
        """Return a value by name."""
        return float(self.vector[self.names.index(name)])

    def with_changes(self: _Self, changes: Mapping[str, float]) -> _Self:
        """Return the model with some values changed."""
        vector = self.vector.copy()
        vector[self.index(list(changes))] = list(changes.values())
        return self.with_vector(vector)
