"""Whether simulation and hardware of a run folder agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pendulum_bags.comparison import compare_folders

__all__ = ["answer"]


def answer(path: Path, _out: Path, _name: str) -> dict[str, Any]:
    """Return the tests of equivalence of a run folder, by name."""
    found = compare_folders([path])
    content = found.to_json()
    row: dict[str, Any] = {"seed": content["seed"], "outcome": found.verdict.outcome.value, "paired": found.is_paired}
    for test in found.verdict.tests:
        row[test.quantity] = test.interval.estimate
        row[f"{test.quantity} low"], row[f"{test.quantity} high"] = test.interval.low, test.interval.high
    for plant, figures in content["plants"].items():
        for key in ("rate_hz", "std_theta", "std_theta_dot", "max_abs_u"):
            row[f"{plant}_{key}"] = figures.get(key)
    return row
