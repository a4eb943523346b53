"""Is the simulation good enough to design a controller on? Four layers of evidence and their sum."""

from pendulum_bags.verdict.layers import (
    Answer,
    Evidence,
    Layer,
    LayerResult,
    Mark,
    name_hardware,
    read_layers,
    sum_up,
    write_layer,
)

__all__ = [
    "Answer",
    "Evidence",
    "Layer",
    "LayerResult",
    "Mark",
    "name_hardware",
    "read_layers",
    "sum_up",
    "write_layer",
]
