"""The choice of a plant's controller: start (inactive), activate, deactivate, end."""

from __future__ import annotations

import contextlib
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from nicegui import run, ui

from pendulum_console.console.graph import Graph
from pendulum_console.console.jobs import Jobs
from pendulum_lqr.controller_interface.controller import controller_names
from pendulum_msgs_py.errors import FaultError, PendulumError
from pendulum_msgs_py.plants.plant_parameters import is_mechanism

__all__ = ["ControllerChoice", "offered"]

_NEED_A_FILE = frozenset({"playback", "policy"})
"""Controllers that need a file, and are started from a terminal."""


def offered(plant: str) -> list[str]:
    """Return the controllers that can start with defaults for a preset or plant file, empty if unknown."""
    # The file of another machine or of an emulator may be unreadable here: the controller reports refusals.
    several = False
    with contextlib.suppress(PendulumError):
        several = bool(plant) and is_mechanism(plant)
    return [kind for kind in controller_names(several=several) if kind not in _NEED_A_FILE]


class ControllerChoice:
    """One plant's choice."""

    def __init__(
        self,
        graph: Graph,
        jobs: Jobs,
        space: str,
        node: str,
        carefully: Callable[[Awaitable[Any]], Awaitable[bool]],
        button: Callable[..., ui.button],
    ) -> None:
        self._graph = graph
        self._jobs = jobs
        self._space = space
        self._node = node
        self._controller = f"{space}/controller"
        self._carefully = carefully
        self._button = button

    @property
    def _plant(self) -> str:
        return str(self._graph.parameters.get(self._node, {}).get("plant", ""))

    def build(self) -> None:
        """Build the controls."""
        with ui.row():
            self._offered_for = self._plant
            kinds = offered(self._plant)
            self._kind = ui.select(kinds, value=kinds[0], label="Controller").props("dense outlined").classes("kind")
            self._kind.props(f'aria-label="Controller of {self._space or "/"}"')
            for text, work in (
                ("Start", self._start),
                ("Activate", lambda: self._graph.activate(self._controller, on=True)),
                ("Deactivate", lambda: self._graph.activate(self._controller, on=False)),
                ("End", self._end),
            ):
                self._button(f"{text} controller", partial(self._press, work), of=self._space or "/")
        self._state = ui.label().classes("small").props('role="status"')

    def refresh(self) -> None:
        """Show the controller's diagnostics, and the suitable controllers once the plant is known."""
        if self._plant != self._offered_for:
            self._offered_for = self._plant
            kinds = offered(self._plant)
            self._kind.set_options(kinds, value=kinds[0])
        running = self._graph.parameters.get(self._controller, {})
        said = self._graph.said(self._controller)
        job = self._jobs[f"control{self._space}"]
        self._state.text = (
            f"{running.get('controller', 'controller')}: {said or 'reports nothing'}"
            if running
            else f"no controller · {job.describe()}"
            if job is not None
            else "no controller"
        )

    async def _press(self, work: Callable[[], Awaitable[str]]) -> None:
        await self._carefully(work())

    async def _start(self) -> str:
        # On the graph, because parameters may be unknown yet: two controllers of one name would end all torque.
        if self._graph.has_node(self._controller):
            kind = self._graph.parameters.get(self._controller, {}).get("controller", "of a kind that is not known yet")
            raise FaultError(
                f"{self._controller} ({kind}) is there already; expected none: "
                "end it, or, if it was not started here, the program that runs it"
            )
        self._jobs.control(self._space, str(self._kind.value), self._plant)
        return f"{self._kind.value} starts, and waits inactive"

    async def _end(self) -> str:
        job = self._jobs[f"control{self._space}"]
        if job is None or not job.running:
            raise FaultError(f"no controller of {self._space or '/'} that runs was started here; expected one to end")
        return await run.io_bound(self._jobs.stop, f"control{self._space}")
