"""The answer for a comparison, with the other layers that a run folder keeps."""

from __future__ import annotations

from pathlib import Path

from pendulum_bags.comparison import Comparison
from pendulum_bags.verdict.layers import Answer, Layer, read_layers, sum_up
from pendulum_bags.verdict.same_run import same_run_layer

__all__ = ["answer_of"]


def answer_of(comparison: Comparison, folder: Path | None = None, *, more: str = "") -> Answer:
    """Return the answer of a comparison.

    Args:
        comparison: The first layer.
        folder: Run folder in which further layers may be kept.
        more: How to record more, where that is what is missing.

    Raises:
        DataError: A kept layer cannot be read.
    """
    others = [] if folder is None else [one for one in read_layers(folder) if one.layer is not Layer.SAME_RUN]
    return sum_up([same_run_layer(comparison, more=more), *others], emulated=comparison.is_emulated)
