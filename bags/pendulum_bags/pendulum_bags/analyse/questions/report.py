"""A report page of a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pendulum_bags.comparison import compare_folders
from pendulum_bags.report.write import write_report

__all__ = ["answer"]


def answer(path: Path, out: Path, name: str) -> dict[str, Any]:
    """Write the report of a run folder, and return where it is."""
    target = out / "reports" / name
    write_report(target, comparison=compare_folders([path]), recordings=[], formats=("png",))
    return {"report": str(Path("reports", name, "report.html"))}
