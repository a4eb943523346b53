"""The answer for a comparison, with the other layers that a run folder keeps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pendulum_bags.comparison import Comparison
from pendulum_bags.verdict.layers import Answer, Layer, read_layers, sum_up
from pendulum_bags.verdict.same_run import same_run_layer

__all__ = ["answer_of"]


def answer_of(comparison: Comparison, folders: Sequence[Path] = (), *, more: str = "") -> Answer:
    """Return the answer of a comparison.

    Args:
        comparison: The first layer.
        folders: Folders in which further layers may be kept: of the run, or of experiments that measured them.
        more: How to record more, where that is what is missing.

    Raises:
        DataError: A kept layer cannot be read, or is kept in two of the folders.
    """
    others = [one for folder in folders for one in read_layers(folder) if one.layer is not Layer.SAME_RUN]
    return sum_up([same_run_layer(comparison, more=more), *others], emulated=comparison.is_emulated)
