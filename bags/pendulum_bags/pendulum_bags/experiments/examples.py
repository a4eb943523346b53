"""The small recordings that come with the project: one plant each, under one and the same noise."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from pendulum_bags.experiments.lockstep import run_lockstep
from pendulum_bags.experiments.settings import NoiseSettings, RegulationSettings

__all__ = ["make_examples"]


def make_examples(folder: Path) -> list[Path]:
    """Record the examples anew and return their folders.

    Two runs give the same messages, field by field, so a change of an example is a change of the programs.

    Args:
        folder: Where ``regulation_sim`` and ``regulation_hw`` are put; older ones are replaced when the new ones are
            whole.
    """
    settings = RegulationSettings(noise=NoiseSettings(seed=1, hold_time=0.01))
    made = []
    folder.mkdir(parents=True, exist_ok=True)
    for side in ("sim", "hw"):
        with tempfile.TemporaryDirectory(prefix="pendulum_examples_") as scratch:
            name = f"regulation_{side}"
            recorded = run_lockstep(Path(scratch) / name, settings, side=side)
            target = folder / name
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(recorded, target)
            made.append(target)
    return made
