"""Is the simulation good enough to design a controller on? Four layers of evidence and their sum."""

from pendulum_bags.verdict.layers import Answer, Evidence, Layer, LayerResult, Mark, read_layers, sum_up, write_layer
from pendulum_bags.verdict.naming import name_hardware, name_in

__all__ = [
    "Answer",
    "Evidence",
    "Layer",
    "LayerResult",
    "Mark",
    "name_hardware",
    "name_in",
    "read_layers",
    "sum_up",
    "write_layer",
]
