"""The page of the console, and its server; knows the graph through a :class:`Graph` only."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

import uvicorn
from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from nicegui import ui

from pendulum_bags.console.jobs import Jobs
from pendulum_bags.console.security import Guard
from pendulum_msgs_py.errors import PendulumError

__all__ = ["Graph", "serve"]

FRAME_PERIOD = 1.0 / 60.0
_STATIC = Path(__file__).parent / "static"


class Graph(Protocol):
    """What the page needs of the ROS graph."""

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of all nodes: node -> name -> value."""

    def frame(self) -> dict[str, Any]:
        """Return the newest of everything that is drawn."""

    def plants(self) -> dict[str, str]:
        """Return namespace -> full node name."""

    async def e_stop(self) -> dict[str, Any] | None:
        """Order every plant to stop; return what each has answered."""

    def stop_state(self) -> dict[str, Any] | None:
        """Return the state of the stop that is in force."""

    def acknowledge_stop(self) -> list[str]:
        """End the stop for the plants that have answered; return those that have not."""

    def release_stop(self, node: str) -> None:
        """Stop asking one plant."""

    async def reset(self, node: str) -> str:
        """Reset the e-stop of a plant."""

    async def trigger(self, service: str) -> str:
        """Call a service without arguments."""

    async def arm(self, node: str, *, on: bool) -> str:
        """Arm or disarm a plant."""

    async def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter."""


def serve(
    graph: Graph,
    jobs: Jobs,
    *,
    host: str,
    port: int,
    token: str = "",
    ready: Callable[[], None] = lambda: None,
) -> None:
    """Serve the page until SIGINT or SIGTERM.

    Args:
        graph: The ROS graph.
        jobs: Programs that the page may start.
        host: Address to listen on.
        port: Port to listen on.
        token: Token that every request must bear; empty on loopback.
        ready: Called when the page can be opened.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        asyncio.get_running_loop().call_later(0.2, ready)
        yield

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    jobs.runs.mkdir(parents=True, exist_ok=True)
    app.mount("/runs", StaticFiles(directory=jobs.runs), name="runs")
    app.mount("/console", StaticFiles(directory=_STATIC), name="console")

    @app.post("/e_stop")
    async def e_stop() -> JSONResponse:
        return JSONResponse(await graph.e_stop())

    @app.post("/e_stop/acknowledge")
    async def acknowledge() -> JSONResponse:
        return JSONResponse({"silent": graph.acknowledge_stop()})

    @app.post("/e_stop/give_up")
    async def give_up(node: str) -> JSONResponse:
        graph.release_stop(node)
        return JSONResponse(graph.stop_state())

    @app.websocket("/stream")
    async def stream(socket: WebSocket) -> None:
        await socket.accept()
        due = time.monotonic()
        try:
            while True:
                now = time.monotonic()
                picture = {"t": now, "plants": graph.frame(), "stop": graph.stop_state()}
                await socket.send_text(json.dumps(picture, separators=(",", ":")))
                # Counted from the last due time: the work does not add to the period, and what was missed is missed.
                due = max(due + FRAME_PERIOD, now)
                await asyncio.sleep(due - time.monotonic())
        except (WebSocketDisconnect, RuntimeError):
            return

    @ui.page("/", title="Pendulum console")
    def page() -> None:
        _Page(graph, jobs).build()

    ui.run_with(app, dark=None, show_welcome_message=False)
    uvicorn.run(
        Guard(app, token),
        host=host,
        port=port,
        log_level="warning",
        timeout_graceful_shutdown=1,
        ws_max_size=65536,
    )


class _Page:
    """The page as one client sees it.

    Args:
        graph: The ROS graph.
        jobs: Programs that the page may start.
    """

    def __init__(self, graph: Graph, jobs: Jobs) -> None:
        self._graph = graph
        self._jobs = jobs
        self._fields: dict[str, ui.number] = {}
        self._shown: dict[str, Any] = {}

    def build(self) -> None:
        """Lay the page out."""
        ui.add_head_html('<link rel="stylesheet" href="/console/console.css">')
        ui.add_body_html('<script src="/console/console.js"></script>')
        with ui.element("header").classes("bar"):
            ui.label("Pendulum console").classes("title")
            ui.html('<span id="link" role="status">connecting</span>', sanitize=False)
            # Plain HTML and a request of its own: it works while the rest of the page waits for the server.
            ui.html(
                '<button id="e_stop" type="button" aria-keyshortcuts="Space Escape Enter"'
                ' title="Space, Escape or Enter">E-STOP<small>Space, Esc or Enter</small></button>',
                sanitize=False,
            )
        ui.html('<div id="alarms" role="alert" aria-live="assertive"></div>', sanitize=False)
        with ui.element("main").classes("grid"):
            with ui.element("section").classes("card"):
                ui.html('<canvas id="pendulum" aria-label="pendulum"></canvas>', sanitize=False)
                ui.html('<div id="plants"></div>', sanitize=False)
                self._plant_buttons()
            with ui.element("section").classes("card wide"):
                ui.html('<canvas id="plots" aria-label="time series"></canvas>', sanitize=False)
            with ui.element("section").classes("card"):
                ui.label("Controller").classes("head")
                self._slider("q11", "Q angle [1/rad²]", 0.0, 500.0, 1.0)
                self._slider("q22", "Q velocity [s²/rad²]", 0.0, 1.0, 0.001)
                self._slider("r", "R [1/(N m)²]", 0.0, 2.0, 0.01)
                self._slider("set_point", "Set-point from upright [rad]", -0.5, 0.5, 0.01)
            with ui.element("section").classes("card"):
                ui.label("Disturbance").classes("head")
                self._slider("amplitude", "Largest torque [N m]", 0.0, 5.0, 0.1)
                with ui.row():
                    ui.button("Start noise", on_click=lambda: self._each("disturbance/start"))
                    ui.button("Stop noise", on_click=lambda: self._each("disturbance/stop")).props("outline")
                ui.label("Record and compare").classes("head")
                self._job_buttons()
        ui.timer(0.5, self._refresh)

    # --- pieces --------------------------------------------------------------------------------------------

    def _plant_buttons(self) -> None:
        with ui.row():
            ui.button("Arm", on_click=lambda: self._arm(on=True)).props("color=positive")
            ui.button("Disarm", on_click=lambda: self._arm(on=False)).props("outline")
            ui.button("Reset e-stop", on_click=self._reset).props("outline color=warning")

    def _slider(self, name: str, label: str, low: float, high: float, step: float) -> None:
        with ui.element("div").classes("tune"):
            slider = ui.slider(min=low, max=high, step=step).props(f'aria-label="{label}"')
            # Unlimited on purpose: the node knows what it accepts, and says why where it does not.
            field = ui.number(label, step=step).props(f'dense data-name="{name}"')
            slider.on("change", lambda event: self._set(name, event.args))
            field.on("change", lambda _: self._set(name, field.value))
            slider.bind_value_from(field, "value", lambda value: value if value is not None else low)
        self._fields[name] = field

    def _job_buttons(self) -> None:
        with ui.row():
            ui.button("Start recording", on_click=lambda: self._try(self._record)).props("color=negative")
            ui.button("Stop recording", on_click=lambda: self._finish("record")).props("outline")
        self._recording = ui.label().classes("small")
        with ui.row():
            seed = ui.number("Seed", value=1, min=0, step=1, precision=0).props("dense").classes("seed")
            ui.button(
                "Run the experiment",
                on_click=lambda: self._try(lambda: self._experiment(int(seed.value or 0))),
            )
            ui.button("Cancel", on_click=lambda: self._finish("experiment")).props("outline")
        self._study = ui.label().classes("small")
        self._report = ui.link("Open its report", "#", new_tab=True)
        self._report.set_visibility(False)

    # --- actions -------------------------------------------------------------------------------------------

    async def _carefully(self, work: Awaitable[Any]) -> bool:
        try:
            answer = await work
        except PendulumError as error:
            ui.notify(str(error), type="negative", multi_line=True, timeout=8000)
            return False
        if answer:
            ui.notify(str(answer), type="positive")
        return True

    async def _arm(self, *, on: bool) -> None:
        for node in self._graph.plants().values():
            await self._carefully(self._graph.arm(node, on=on))

    async def _reset(self) -> None:
        for node in self._graph.plants().values():
            await self._carefully(self._graph.reset(node))

    async def _each(self, service: str) -> None:
        for space in self._graph.plants():
            await self._carefully(self._graph.trigger(f"{space}/{service}"))

    async def _set(self, name: str, value: Any) -> None:
        """Set a parameter on every plant; what one refuses is shown with its reason, and the field goes back."""
        if value is None:
            return
        for space in self._graph.plants():
            node, parameter, given = self._target(space, name, float(value))
            await self._carefully(self._graph.set_parameter(node, parameter, given))
        self._shown.pop(name, None)

    def _target(self, space: str, name: str, value: float) -> tuple[str, str, Any]:
        if name == "amplitude":
            return f"{space}/disturbance", name, value
        node = f"{space}/controller"
        if name not in {"q11", "q22"}:
            return node, name, value
        q = list(self._graph.parameters.get(node, {}).get("q", [100.0, 0.01]))
        q[0 if name == "q11" else 1] = value
        return node, "q", [float(number) for number in q]

    def _try(self, work: Callable[[], None]) -> None:
        try:
            work()
        except PendulumError as error:
            ui.notify(str(error), type="negative")

    def _record(self) -> None:
        self._jobs.record()

    def _experiment(self, seed: int) -> None:
        self._jobs.experiment(seed)

    async def _finish(self, kind: str) -> None:
        ui.notify(await asyncio.to_thread(self._jobs.stop, kind))

    # --- what changes by itself ----------------------------------------------------------------------------

    def _refresh(self) -> None:
        """Show the values in force, also when somebody else has set them."""
        for space in self._graph.plants():
            known = self._graph.parameters
            controller = known.get(f"{space}/controller", {})
            q = controller.get("q", [None, None])
            force = {
                "q11": q[0],
                "q22": q[1],
                "r": controller.get("r"),
                "set_point": controller.get("set_point"),
                "amplitude": known.get(f"{space}/disturbance", {}).get("amplitude"),
            }
            for name, value in force.items():
                if value is not None and self._shown.get(name) != value:
                    self._shown[name] = value
                    self._fields[name].value = value
            break
        for kind, label in (("record", self._recording), ("experiment", self._study)):
            job = self._jobs[kind]
            label.text = "" if job is None else f"{'running' if job.running else 'ended'}: {job.last_line()}"
        job = self._jobs["experiment"]
        done = job is not None and not job.running and (job.folder / "report.html").is_file()
        self._report.set_visibility(done)
        if job is not None and done:
            self._report.props(f'href="/runs/{job.folder.name}/report.html"')
