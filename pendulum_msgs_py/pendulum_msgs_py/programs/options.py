"""Options of several command lines, declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

__all__ = ["Domain", "Json", "Lab", "RunningDomain", "Storage", "Yes", "out_option"]

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Storage = Annotated[str, typer.Option(help="Storage of the bags: mcap or sqlite3.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default ROS_DOMAIN_ID, or the first free one.")]
"""For programs that start their own nodes."""
RunningDomain = Annotated[int | None, typer.Option(help="ROS domain; by default ROS_DOMAIN_ID.")]
"""For programs that use running nodes."""
Lab = Annotated[Path | None, typer.Option(help="Lab file of the real actuator, for --hardware hebi.")]
Yes = Annotated[bool, typer.Option("--yes", help="Do not ask before the real machine moves.")]


def out_option(what: str) -> Any:
    """Return the option ``-o``, ``--out`` (``--output`` is accepted) with this help."""
    return typer.Option("-o", "--out", help=what)
