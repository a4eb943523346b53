"""Measured rate of states, and whether a controller is stable at it."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Callable, Sequence

from pendulum_lqr.controller_interface.interface import Controller
from pendulum_lqr.controller_interface.loop_check import settles
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["ASSUMED_PERIOD", "PeriodWatch", "differs", "goes_on", "rate_problem", "require_period"]

ASSUMED_PERIOD = 0.01
"""Design period before the first states [s]: that of the thesis's loop."""
TOLERANCE = 0.2
"""Relative tolerance of the measured period, since single states may be late."""
_WINDOW = 15
_ENOUGH = 9
_GAP_NS = NANOSECONDS
_FAST_PERIOD = 2e-3
"""Period at which a stable continuous-time design settles [s]."""


class PeriodWatch:
    """Measures the period of states by their stamps: the median of the last intervals.

    A lost state doubles one interval, and a stall can bring two together; neither changes the median.

    Args:
        exact: Stamps are simulated time, in which one interval suffices.
    """

    def __init__(self, *, exact: bool = False) -> None:
        self._exact = exact
        self.newest_ns: int | None = None
        """Stamp of the newest state [ns]; None before the first."""
        self._intervals_ns: deque[int] = deque(maxlen=1 if exact else _WINDOW)

    def add(self, stamp_ns: int) -> bool:
        """Add the stamp of a state [ns]; return whether the plant has restarted, which voids earlier intervals."""
        newest, self.newest_ns = self.newest_ns, stamp_ns
        if newest is None or stamp_ns == newest:
            return False
        interval = stamp_ns - newest
        if goes_on(interval):
            self._intervals_ns.append(interval)
            return False
        self._intervals_ns.clear()
        return True

    def extend(self, stamps_ns: Sequence[int]) -> None:
        """Add stamps of consecutive states, the oldest first [ns]."""
        most = self._intervals_ns.maxlen
        assert most is not None
        newest = stamps_ns[-most - 1 :]
        if len(newest) < len(stamps_ns):
            self.newest_ns = newest[0]
        for stamp_ns in newest:
            self.add(stamp_ns)

    @property
    def only_interval_ns(self) -> int | None:
        """The one interval that suffices in simulated time [ns]; None in real time, or before it is known."""
        return self._intervals_ns[0] if self._exact and self._intervals_ns else None

    @property
    def period(self) -> float | None:
        """Period [s], to three digits; None before it is known."""
        if len(self._intervals_ns) < (1 if self._exact else _ENOUGH):
            return None
        return float(f"{statistics.median(self._intervals_ns) / NANOSECONDS:.3g}")


def goes_on(interval_ns: int) -> bool:
    """Return whether a state after this interval [ns] is of the same run, not of a restarted plant."""
    return 0 < interval_ns < _GAP_NS


def differs(measured: float, designed: float) -> bool:
    """Return whether a measured period differs from that of the design [s]."""
    return abs(measured / designed - 1.0) > TOLERANCE


def require_period(what: str, designed: float, period: float) -> None:
    """Raise ParameterError if states come at another period than the design's [s]; ``what`` starts the message."""
    if differs(period, designed):
        raise ParameterError(f"{what} every {designed:g} s; expected states at that period")


def rate_problem(
    kind: type[Controller],
    name: str,
    make: Callable[[], Controller],
    plant: PlantParameters,
    designed: float,
    measured: float,
    *,
    uses: bool,
    set_point: float = 0.0,
) -> str:
    """Return why a controller must not run on states at another period than designed [s]; empty if it may.

    Only a controller that settles at its own rate is refused: one that never settles, such as zero torque, is intended.
    ``uses`` tells whether its commands depend on the period; ``set_point`` is from upright [rad].
    """
    if not kind.BALANCES or (uses and not differs(measured, designed)):
        return ""
    own = (designed,) if uses else (designed, _FAST_PERIOD)
    if settles(make(), plant, measured, set_point) or not any(settles(make(), plant, at, set_point) for at in own):
        return ""
    if uses:
        return (
            f"period is {designed:g} s, but states come every {measured:g} s, at which {name} designed for the former "
            f"does not settle; expected period:={measured:g}, or 0 to take it from the states"
        )
    return (
        f"states come every {measured:g} s, at which {name} does not settle on plant {plant.name!r}; expected a faster "
        "plant, or a controller that is designed for its period, such as discrete_lqr"
    )
