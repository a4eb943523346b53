"""Parameters of the plant, identified from one recording."""

from __future__ import annotations

from typing import Any

from pendulum_bags.identification.identify import identify
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.read_recording import read_recording

__all__ = ["answer"]


def answer(path: Reading, plant: str) -> dict[str, Any]:
    """Return identified parameters with intervals of a plant in a recording, by name."""
    found = identify([read_recording(path, namespace=plant)], profiles=0).to_dict()
    row: dict[str, Any] = {"friction": found["friction"], "window_rms": found["training_rms"]}
    row |= {"refused": found["explained"]["refused"], "model_incomplete": found["incomplete"]}
    for name in found["fitted"]:
        row[name] = found["parameters"][name]
        if name in found["intervals"]:
            interval = found["intervals"][name]
            row[f"{name}_low"], row[f"{name}_high"] = interval["low"], interval["high"]
    return row
