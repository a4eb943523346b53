"""What the page needs of the ROS graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

__all__ = ["Description", "Graph"]


class Description(NamedTuple):
    """A node's description of a parameter: text with the unit, domain as text, whether it can be set."""

    text: str
    domain: str
    read_only: bool


class Graph(Protocol):
    """What the page needs of the ROS graph."""

    @property
    def parameters(self) -> dict[str, dict[str, Any]]:
        """Parameters of all nodes: node -> name -> value."""

    def frame(self) -> dict[str, Any]:
        """Return the newest of everything that is drawn."""

    def plants(self) -> dict[str, str]:
        """Return namespace -> full node name."""

    async def e_stop(self, nodes: Sequence[str] = ()) -> dict[str, Any] | None:
        """Order these plants, or all, to stop; return the response of each."""

    def stop_state(self) -> dict[str, Any] | None:
        """Return the state of the stop that is in force."""

    def acknowledge_stop(self) -> list[str]:
        """End the stop for the plants that have confirmed it; return those that have not."""

    def release_stop(self, node: str) -> None:
        """Stop asking one plant."""

    async def reset(self, node: str) -> str:
        """Reset the e-stop of a plant."""

    async def trigger(self, service: str) -> str:
        """Call a service without arguments."""

    async def arm(self, node: str, *, on: bool) -> str:
        """Arm or disarm a plant."""

    def has_node(self, node: str) -> bool:
        """Return whether a node is on the graph, by its full name."""

    def said(self, node: str) -> str:
        """Return a node's latest diagnostics as text; empty once it is silent."""

    async def activate(self, node: str, *, on: bool) -> str:
        """Activate or deactivate a controller."""

    async def set_parameter(self, node: str, name: str, value: Any) -> None:
        """Set a parameter."""

    async def describe(self, node: str) -> dict[str, Description]:
        """Return a node's descriptions of its parameters."""
