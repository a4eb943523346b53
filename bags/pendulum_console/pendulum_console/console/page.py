"""The server of the console's page; it uses the graph through a :class:`Graph` only."""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated

import uvicorn
from fastapi import FastAPI, Query, WebSocket, WebSocketDisconnect
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from nicegui import app as pages
from nicegui import ui

from pendulum_console.console.graph import Graph
from pendulum_console.console.jobs import Jobs
from pendulum_console.console.layout import Layout
from pendulum_console.console.security import Guard

__all__ = ["serve"]

FRAME_PERIOD = 1.0 / 60.0
_RECONNECT_TIMEOUT = 15.0
"""Time for which the server remembers a page that has lost its connection [s]."""
_STATIC = Path(__file__).parent / "static"


def serve(
    graph: Graph, jobs: Jobs, *, host: str, port: int, token: str = "", ready: Callable[[], None] = lambda: None
) -> None:
    """Serve the page until SIGINT or SIGTERM; ``ready`` is called when it can be opened.

    Every request needs the ``token``, which is empty on loopback. ``jobs`` are the programs that the page may start.
    """

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        asyncio.get_running_loop().call_later(0.2, ready)
        yield

    app = FastAPI(lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url=None)
    # Lets a page detect a restarted server, which has lost the state of the last one.
    server = secrets.token_hex(4)
    jobs.runs.mkdir(parents=True, exist_ok=True)
    app.mount("/runs", StaticFiles(directory=jobs.runs), name="runs")
    app.mount("/console", StaticFiles(directory=_STATIC), name="console")

    @app.post("/e_stop")
    async def e_stop(node: Annotated[list[str] | None, Query()] = None) -> JSONResponse:
        return JSONResponse(await graph.e_stop(node or ()))

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
                picture = {"t": now, "server": server, "plants": graph.frame(), "stop": graph.stop_state()}
                await socket.send_text(json.dumps(picture, separators=(",", ":")))
                # Counted from the last due time: the work does not add to the period, missed frames are skipped.
                due = max(due + FRAME_PERIOD, now)
                await asyncio.sleep(due - time.monotonic())
        except (WebSocketDisconnect, RuntimeError):
            return

    @ui.page("/", title="Pendulum console", language="en-US")
    def page() -> None:
        Layout(graph, jobs).build()

    # A page that a busy computer keeps waiting for longer is loaded again, and what is pressed meanwhile is lost.
    ui.run_with(app, dark=None, show_welcome_message=False, reconnect_timeout=_RECONNECT_TIMEOUT)
    # Quasar's request bar has no name for a screen reader, and adds nothing to the page.
    pages.config.quasar_config["loadingBar"]["skipHijack"] = True
    uvicorn.run(
        Guard(app, token), host=host, port=port, log_level="warning", timeout_graceful_shutdown=1, ws_max_size=65536
    )
