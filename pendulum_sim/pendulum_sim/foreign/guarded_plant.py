"""Failures of a third-party simulation, each reported in one sentence."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import FaultError, ParameterError, PendulumError
from pendulum_sim.stepping.mechanism_plant import MechanismState
from pendulum_sim.stepping.plants import JointPlant

__all__ = ["GuardedPlant", "PaceWatch", "StallWatch", "in_one_sentence"]

_LATEST = 0.5
"""Lag behind wall time at which a slow simulation ends [s]."""
_LARGEST_STEP = 10.0
"""Longest duration of one step that counts, in periods: a pause of the machine is not the simulation's."""
_MEMORY = 0.02
"""Weight of the newest step in the mean."""


class GuardedPlant:
    """A plant whose exceptions and non-finite states become a FaultError."""

    def __init__(self, plant: JointPlant, name: str) -> None:
        self._plant = plant
        self._name = name
        self.parameters = plant.parameters
        self.dt = plant.dt

    @property
    def state(self) -> MechanismState:
        """The present state."""
        return self._plant.state

    def reset(self, position: Vector, velocity: Vector) -> MechanismState:
        """Restart; raise a FaultError if that fails."""
        return self._try("reset", self._plant.reset, position, velocity)

    def step(self, effort: Vector, push: Vector) -> MechanismState:
        """Advance by one period; raise a FaultError if that fails."""
        return self._try("step", self._plant.step, effort, push)

    def _try(self, what: str, function: Callable[..., MechanismState], *arguments: Vector) -> MechanismState:
        with in_one_sentence(f"simulation {self._name}", what, FaultError):
            state = function(*arguments)
        for joint, q, v, u in zip(self.parameters.mechanism.joints, *state[1:], strict=True):
            if not (math.isfinite(q) and math.isfinite(v) and math.isfinite(u)):
                at = f"{q} {joint.unit}, {v} {joint.velocity_unit}, {u} {joint.effort_unit}"
                whose = "" if len(state.position) == 1 else f" ({joint.name})"
                raise FaultError(
                    f"simulation {self._name} is at {at}{whose} after {state.time:.3f} s; expected finite numbers"
                )
        return state


class PaceWatch:
    """Distinguishes a simulation too slow for its period [s] from a single pause of the machine."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._mean = 0.0

    def problem(self, duration: float, behind: float) -> str:
        """Record a step's wall time and the lag behind wall time [s]; return why it is too slow, or an empty string."""
        self._mean += _MEMORY * (min(duration, _LARGEST_STEP * self._period) - self._mean)
        if behind <= _LATEST or self._mean <= self._period:
            return ""
        return (
            f"the simulation needs {self._mean * 1e3:.2g} ms for a period of {self._period * 1e3:.3g} ms and is "
            f"{behind:.1f} s behind; expected it faster than real time, or clock:=lockstep"
        )


class StallWatch:
    """Calls ``on_stall`` once, from its own thread, if a step takes longer than a timeout [s]."""

    def __init__(self, timeout: float, on_stall: Callable[[], Any]) -> None:
        self._timeout = timeout
        self._on_stall = on_stall
        self._since: float | None = None
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def __enter__(self) -> StallWatch:
        self._since = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        self._since = None

    def close(self) -> None:
        """End the thread."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(0.25 * self._timeout):
            since = self._since
            if since is not None and time.monotonic() - since > self._timeout:
                self._on_stall()
                return


@contextmanager
def in_one_sentence(name: str, what: str, kind: type[PendulumError]) -> Iterator[None]:
    """Turn an exception of foreign code in ``what``, ``SystemExit`` included, into one sentence of error ``kind``."""
    try:
        yield
    except PendulumError as error:
        raise error if isinstance(error, kind) and kind is ParameterError else kind(f"{name}: {error}") from error
    except (Exception, SystemExit) as error:
        raise kind(f"{name} failed in {what}: {_in_one_line(error)}") from error


def _in_one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
