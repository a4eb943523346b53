"""A controller in compiled code: its state is lent to a loop, and taken back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pendulum_lqr.controller_interface.controller import LawController
from pendulum_lqr.controller_interface.interface import Controller, unwrapped
from pendulum_lqr.controller_interface.law import MOST_MEMORY, MOST_NUMBERS
from pendulum_lqr.controller_interface.sampling import PeriodWatch
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract.values import JointSample
from pendulum_msgs_py.loops.answer_record import LoopKind

__all__ = ["ANSWERING", "CompiledController", "law_of"]

_LENT = np.dtype([
    ("simulated", "i8"), ("timeout_ns", "i8"), ("start_ns", "i8"), ("interval_ns", "i8"), ("watched_ns", "i8"),
    ("newest_ns", "i8"), ("limit", "f8"),
], align=True)  # fmt: skip
"""``interval_ns`` is 0 if any interval between states is permitted."""
_NEWEST = np.dtype([("position", "f8"), ("velocity", "f8"), ("measured", "f8"), ("effort", "f8"), ("saturated", "i8")])
"""Newest state (``measured`` is its effort), its reply, and the number of replies at the limit."""
ANSWERING = np.dtype([
    ("lent", _LENT), ("newest", _NEWEST), ("numbers", "f8", (MOST_NUMBERS,)), ("remembered", "i8"),
    ("memory", "f8", (MOST_MEMORY,)), ("before", "f8", (MOST_MEMORY,)),
], align=True)  # fmt: skip
"""What is lent for a slice, its newest reply, and the law's numbers and memory."""


class CompiledController:
    """Runs the law of a controller, :class:`pendulum_msgs_py.loops.answer_record.Answerer`.

    Args:
        controller: First controller. The loop is for its law whatever its parameters, whose change must not wait for a
            compiler.
        watch: Measures the period of states.
        answering: Returns the answer loop, or None if the next state is not a nominal one.
        refusal: Why no loop is used, or empty.
    """

    def __init__(
        self,
        controller: Controller | None,
        watch: PeriodWatch,
        answering: Callable[[], ControlLoop | None],
        refusal: str = "",
    ) -> None:
        self._watch = watch
        self._answering = answering
        alone = None if controller is None else unwrapped(controller)
        own = law_of(alone)
        law = self._law = None if own is None else own.law
        self._lent: LawController | None = None
        self.refusal = refusal
        self.kind: LoopKind | None = None
        if refusal:
            return
        if law is None:
            self.refusal = f"{type(alone or controller).__name__} is no law of numbers"
        else:
            choice = (f"{law.__module__}:{law.__name__}",)
            self.kind = LoopKind(ANSWERING, "pendulum_lqr.nodes.controller_kernel:law_loop", choice)

    def lend(self, own: Any) -> bool:
        """Write the state of commands into a record; return whether the next state may be a nominal one."""
        loop = self._answering()
        if loop is None:
            return False
        controller, watch = law_of(loop.controller), self._watch
        self.refusal = ""
        if controller is None or controller.law is not self._law:
            self.refusal = f"{type(loop.controller).__name__} is no law of numbers"
            return False
        newest, interval_ns = loop.newest, watch.only_interval_ns
        if newest is None or loop.start_ns is None or watch.newest_ns is None:
            return False
        if loop.simulated_time and interval_ns is None:
            return False
        # One assignment: each item alone takes as long.
        own["lent"] = (
            loop.simulated_time,
            loop.timeout_ns,
            loop.start_ns,
            interval_ns or 0,
            watch.newest_ns,
            newest.stamp_ns,
            controller.effort_limit,
        )
        own["newest"]["saturated"] = 0
        if controller is not self._lent:
            own["numbers"][: len(controller.numbers)] = controller.numbers
            own["remembered"] = len(controller.memory)
            self._lent = controller
        if controller.memory:
            own["memory"][: len(controller.memory)] = controller.memory
        return True

    def take_back(self, record: Any) -> None:
        """Take over the changes by one or more replies."""
        loop, count, own = self._answering(), int(record["answers"]), record["own"]
        assert loop is not None
        assert isinstance(loop.controller, LawController)
        if memory := loop.controller.memory:
            memory[:] = own["memory"][: len(memory)].tolist()
        position, velocity, measured, effort, saturated = own["newest"].item()
        stamps_ns = record["stamp_ns"][:count].tolist()
        loop.count(
            JointSample.of_one(stamps_ns[-1], position, velocity, measured),
            (effort,),
            answered=count,
            saturated=saturated,
            ages_ns=record["age_ns"][:count].tolist(),
            compute_times_ns=record["compute_ns"][:count].tolist(),
        )
        self._watch.extend(stamps_ns)


def law_of(controller: object) -> LawController | None:
    """Return a controller that consists of its law alone; None for any other."""
    if (
        not isinstance(controller, LawController)
        or controller.law is None
        or type(controller).command is not LawController.command
    ):
        return None
    fits = len(controller.numbers) <= MOST_NUMBERS and len(controller.memory) <= MOST_MEMORY
    return controller if fits else None
