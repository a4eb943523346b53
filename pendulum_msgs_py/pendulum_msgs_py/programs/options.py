"""Options that several command lines have, declared once: an option has one name and one meaning everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["Domain", "Json", "Lab", "RunningDomain", "Storage", "Yes", "out_option"]

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Storage = Annotated[str, typer.Option(help="Storage of the bags: mcap or sqlite3.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default ROS_DOMAIN_ID, or the first free one.")]
"""Of programs that start the nodes they talk to."""
RunningDomain = Annotated[int | None, typer.Option(help="ROS domain; by default ROS_DOMAIN_ID.")]
"""Of programs that talk to nodes that run already."""
Lab = Annotated[Path | None, typer.Option(help="Lab file of the real actuator, for --hardware hebi.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before the real machine moves.")]


def out_option(what: str) -> Any:
    """Return the option ``-o``, ``--out`` of a program that writes; ``--output`` is accepted, too.

    Args:
        what: What is written where, and what happens without the option: its help.
    """
    return typer.Option("-o", "--out", help=what)
