"""``foxglove``: show and stop the plants of a ROS domain live in Foxglove and Lichtblick."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pendulum_console.console.security import is_loopback
from pendulum_msgs_py.programs.executables import command_line

if TYPE_CHECKING:
    from pendulum_console.live.foxglove_node import LiveNode

__all__ = ["LAYOUT", "main"]

LAYOUT = Path(__file__).parents[1] / "live" / "foxglove_layout.json"


def foxglove(
    context: typer.Context,
    host: Annotated[
        str, typer.Option(help="Address to listen on; beyond this machine a token is needed.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.", min=1, max=65535)] = 8765,
    origin: Annotated[
        list[str] | None,
        typer.Option(help="Let pages of this address in, too, such as https://lichtblick.example; may be repeated."),
    ] = None,
) -> int:
    """Serve topics, parameters and services to Foxglove and Lichtblick until Ctrl-C.

    Example: python -m pendulum_console foxglove --port 8765. ROS arguments follow --ros-args; the ROS domain is that
    of ROS_DOMAIN_ID.
    """
    from pendulum_console.live.foxglove_node import LiveNode, LiveOptions
    from pendulum_msgs_py.ros.runner import run_node

    token = "" if is_loopback(host) else secrets.token_urlsafe(16)
    options = LiveOptions(host, port, token, tuple(origin or ()))

    def make(stop: Callable[[], None]) -> LiveNode:
        node = LiveNode(options, stop)
        name = "localhost" if is_loopback(host) else host
        print(f"foxglove at ws://{name}:{node.port}/{'?token=' * bool(token)}{token}", flush=True)
        print(f"layout to import: {LAYOUT}", flush=True)
        return node

    return run_node(make, list(context.obj), program="pendulum_console foxglove", description="Live in Foxglove.")


main = command_line(foxglove, "python -m pendulum_console foxglove", takes_ros_arguments=True)
