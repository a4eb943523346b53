"""The console's page, one object per client."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from nicegui import ui

from pendulum_console.console.certified import CertifiedDesigns
from pendulum_console.console.controller_choice import ControllerChoice
from pendulum_console.console.graph import Graph
from pendulum_console.console.jobs import Jobs
from pendulum_console.console.layers_card import LayersCard
from pendulum_console.console.notices import Notices
from pendulum_console.console.parameter_table import ParameterTable
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.programs.typed_commands import as_typed

__all__ = ["Layout"]

_PLANTS = """\
python -m pendulum_sim simulator --ros-args -r __ns:=/sim
python -m pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p backend:=emulator"""
"""Commands that start plants."""
REFRESH_PERIOD = 0.5
"""Period of polls of everything that changes [s]."""


class _Card(NamedTuple):
    node: str
    section: ui.element
    choice: ControllerChoice


class Layout:
    """The page as one client sees it."""

    def __init__(self, graph: Graph, jobs: Jobs) -> None:
        self._graph = graph
        self._jobs = jobs
        self._tables = [
            ParameterTable(graph, "controller", self._carefully),
            ParameterTable(graph, "disturbance", self._carefully),
        ]
        self._notices = Notices()
        self._certified = CertifiedDesigns(jobs)
        self._layers = LayersCard(jobs)
        self._job_labels: dict[str, tuple[ui.label, ui.link]] = {}
        self._cards: dict[str, _Card] = {}

    def build(self) -> None:
        """Build the page."""
        ui.add_head_html('<link rel="stylesheet" href="/console/console.css">')
        ui.add_body_html('<script src="/console/console.js"></script>')
        with ui.element("header").classes("bar"):
            ui.html('<h1 class="title">Pendulum console</h1>', sanitize=False)
            ui.html('<span id="link" role="status">connecting</span>', sanitize=False)
            self._notices.build()
            # Plain HTML with its own request: works while the page waits for the server.
            ui.html(
                '<button id="e_stop" type="button" aria-keyshortcuts="Space Escape Enter"'
                ' title="Space, Escape or Enter">E-STOP<small>Space, Esc or Enter</small></button>',
                sanitize=False,
            )
        ui.html('<div id="alarms" role="alert" aria-live="assertive"></div>', sanitize=False)
        with ui.element("div").classes("grid"):
            with ui.element("section").classes("card").props('aria-label="Plants"'):
                ui.html('<canvas id="pendulum" role="img" aria-label="pendulums, drawn live"></canvas>', sanitize=False)
                ui.html('<div id="plants"></div>', sanitize=False)
                ui.html('<div id="joints"></div>', sanitize=False)
                # Where it moves no button when a plant appears.
                with ui.element("div").classes("hint") as self._hint:
                    ui.label("Start one in a terminal with the same ROS_DOMAIN_ID; it appears here by itself:")
                    ui.html(f"<pre>{as_typed(_PLANTS)}</pre>", sanitize=False)
                self._hint.set_visibility(False)
            with ui.element("section").classes("card wide").props('aria-label="Signals"'):
                ui.html(
                    '<canvas id="plots" role="img" aria-label="angle, velocity and torques of the last 10 s"></canvas>',
                    sanitize=False,
                )
        self._plants = ui.element("div").classes("cards plants")
        with ui.element("div").classes("cards"):
            with ui.element("section").classes("card wide"):
                _heading("Controllers")
                self._tables[0].build()
            with ui.element("section").classes("card wide"):
                _heading("Disturbances")
                self._tables[1].build()
                with ui.row():
                    _button("Add to each plant", self._add_disturbances)
                    _button("Start noise", lambda: self._each("disturbance/start"), filled=True)
                    _button("Stop noise", lambda: self._each("disturbance/stop"))
            with ui.element("section").classes("card"):
                _heading("Record and compare")
                self._job_buttons()
        ui.timer(REFRESH_PERIOD, self._refresh)

    def _show_plants(self, plants: Mapping[str, str]) -> None:
        """Give each plant a card, the newest last; cards stay in place, so that no click hits another button."""
        for space, node in sorted(plants.items()):
            card = self._cards.get(space)
            if card is None:
                with self._plants:
                    section = ui.element("section").classes("card").props(f'aria-label="{space}" data-card="{space}"')
            elif card.node != node:
                section = card.section
                section.clear()
            else:
                continue
            with section:
                self._cards[space] = _Card(node, section, self._plant_card(space, node))
        for space, card in self._cards.items():
            if space in plants:
                card.section.classes(remove="gone")
                card.choice.refresh()
            else:
                card.section.classes(add="gone")

    def _plant_card(self, space: str, node: str) -> ControllerChoice:
        _heading(space)
        with ui.row():
            _button("Arm", lambda: self._carefully(self._graph.arm(node, on=True)), filled=True, of=space)
            _button("Disarm", lambda: self._carefully(self._graph.arm(node, on=False)), of=space)
            # Sent by the page's script, repeated until there is a response.
            _button("Stop", lambda: None, of=space, danger=True).props(f'data-stop="{node}"')
            _button("Reset e-stop", lambda: self._carefully(self._graph.reset(node)), of=space)
        with ui.row():
            for goal in ("upright", "down"):
                _button(f"Bring {goal} ...", partial(self._ask_to_move, space, goal), of=space)
            _button("Cancel the move", lambda: self._finish(f"move{space}"), of=space)
        self._job_line(f"move{space}")
        choice = ControllerChoice(self._graph, self._jobs, space, node, self._carefully, _button)
        choice.build()
        return choice

    def _job_buttons(self) -> None:
        with ui.row():
            _button("Start recording", lambda: self._try(self._jobs.record), filled=True)
            _button("Stop recording", lambda: self._finish("record"))
        self._job_line("record")
        with ui.row():
            seed = ui.number("Seed", value=1, min=0, step=1, precision=0).props("dense").classes("seed")
            _button(
                "Run the experiment",
                lambda: self._try(lambda: self._jobs.experiment(int(seed.value or 0))),
                filled=True,
            )
            _button("Cancel", lambda: self._finish("experiment"))
        self._job_line("experiment")
        self._layers.build()
        self._certified.build()

    def _job_line(self, kind: str) -> None:
        label = ui.label().classes("small").props('role="status"')
        link = ui.link("Open its report", "#", new_tab=True)
        link.set_visibility(False)
        self._job_labels[kind] = (label, link)

    async def _carefully(self, work: Awaitable[Any]) -> bool:
        try:
            answer = await work
        except PendulumError as error:
            self._notices.say(str(error), bad=True)
            return False
        if answer:
            self._notices.say(str(answer))
        return True

    async def _each(self, service: str) -> None:
        for space in self._graph.plants():
            await self._carefully(self._graph.trigger(f"{space}/{service}"))

    async def _add_disturbances(self) -> None:
        """Start a disturbance node for each plant without one; it adds no torque until it is started."""
        spaces = [space for space in self._graph.plants() if not self._graph.has_node(f"{space}/disturbance")]
        if not spaces:
            self._notices.say("each plant has a disturbance already" if self._graph.plants() else "there is no plant")
        for space in spaces:
            self._try(partial(self._jobs.disturb, space))

    def _ask_to_move(self, space: str, goal: str) -> None:
        end = "the controller takes over" if goal == "upright" else "the plant is disarmed"
        with ui.dialog() as dialog, ui.card():
            ui.label(
                f"{space} will be armed and will move {goal} under position control, at most 0.3 rad/s, for up to 16 s."
                f" Its controller waits meanwhile. At the end {end}. Keep clear of the pendulum; the e-stop ends it."
            )
            with ui.row():

                def agree() -> None:
                    dialog.close()
                    self._try(lambda: self._jobs.move(space, goal))

                _button("Move it", agree, filled=True)
                _button("Leave it", dialog.close)
        dialog.open()

    def _try(self, work: Callable[[], object]) -> None:
        try:
            work()
        except PendulumError as error:
            self._notices.say(str(error), bad=True)

    async def _finish(self, kind: str) -> None:
        self._notices.say(await asyncio.to_thread(self._jobs.stop, kind))

    async def _refresh(self) -> None:
        plants = self._graph.plants()
        self._hint.set_visibility(not self._cards and not plants)
        self._show_plants(plants)
        for table in self._tables:
            await table.refresh(sorted(plants))
        self._certified.refresh()
        self._layers.refresh()
        for kind, (label, link) in self._job_labels.items():
            job = self._jobs[kind]
            label.text = job.describe() if job is not None else ""
            report = job is not None and not job.running and (job.folder / "report.html").is_file()
            link.set_visibility(report)
            if job is not None and report:
                link.props(f'href="/runs/{job.folder.name}/report.html"')


def _heading(text: str) -> None:
    ui.html(f"<h2>{text}</h2>", sanitize=False)


def _button(
    text: str, work: Callable[[], Any], *, filled: bool = False, danger: bool = False, of: str = ""
) -> ui.button:
    """Make a button with the contrast of WCAG AA and its plant in the accessible name."""
    button = ui.button(text, on_click=work, color=None).props("unelevated no-caps")
    button.classes("filled" if filled else "danger" if danger else "plain")
    return button.props(f'aria-label="{text} {of}"') if of else button
