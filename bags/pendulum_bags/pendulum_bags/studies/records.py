"""What one run of a study left behind."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pendulum_bags.studies.study_file import StudyRun

__all__ = ["read_record"]


def read_record(folder: Path, run: StudyRun) -> dict[str, Any] | None:
    """Return what is known about a run that has ended, well or not; None for one that has not."""
    path = folder / "runs" / run.name / "run.json"
    if not path.is_file():
        return None
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record
