"""The answer for a comparison, or for those of several joints, with the other layers of a run folder."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from pendulum_bags.comparison import Comparison
from pendulum_bags.verdict.layers import Answer, Layer, LayerResult, Mark, read_layers, sum_up
from pendulum_bags.verdict.same_run import design_plant, how_to_measure, same_run_layer

__all__ = ["answer_of", "answer_of_joints", "join_joints"]

_WORST_FIRST = (Mark.NO, Mark.UNDECIDED, Mark.NOT_MEASURED, Mark.YES)
_HOW = {
    Layer.SAME_PLANT: "{} measures it where one joint is driven.",
    Layer.WHICH_CONTROLLERS: "{} measures it where one joint is driven.",
    Layer.SAME_CHOICE: "{} --rank-seeds 3 measures it.",
}
"""How a missing layer is measured, for a plant of several joints."""


def answer_of(
    comparison: Comparison,
    folders: Sequence[Path] = (),
    *,
    more: str = "",
    anew: Sequence[LayerResult] = (),
    how: Mapping[Layer, str] = MappingProxyType({}),
) -> Answer:
    """Return the answer of a comparison.

    Args:
        comparison: The first layer.
        folders: Folders that may have further layers: of the run, or of experiments that measured them.
        more: How to record more, where that is what is missing.
        anew: Layers that were judged again, and replace those of the folders.
        how: The command that measures a layer, where it is another than that of the recordings' plants.

    Raises:
        DataError: A stored layer cannot be read, is in two of the folders, or is of other plants.
    """
    first = same_run_layer(comparison, more=more)
    known = {Layer.SAME_RUN, *(one.layer for one in anew)}
    others = [one for folder in folders for one in read_layers(folder, first.case) if one.layer not in known]
    commands = {**how_to_measure(comparison), **how}
    return sum_up([first, *anew, *others], emulated=comparison.is_emulated, how=commands)


def join_joints(results: Mapping[str, LayerResult]) -> LayerResult:
    """Return a layer's result for a plant, from those for each joint: yes if all are.

    Since all joints have to agree, more of them make a wrong yes no likelier (an intersection-union test).

    Args:
        results: The layer's result for each joint, at least one, all of one layer.
    """
    first = next(iter(results.values()))
    mark = next(mark for mark in _WORST_FIRST if any(one.mark is mark for one in results.values()))
    because = {joint: one for joint, one in results.items() if one.mark is mark}
    return LayerResult(
        first.layer,
        mark,
        " ".join(f"{joint}: {one.sentence}" for joint, one in because.items()),
        tuple(
            replace(row, quantity=f"{joint}: {row.quantity}") for joint, one in results.items() for row in one.evidence
        ),
        tuple(dict.fromkeys(step for one in because.values() for step in one.next_steps)),
        reason="; ".join(f"{joint}: {one.reason}" for joint, one in because.items()),
        case=first.case,
    )


def answer_of_joints(comparisons: Mapping[str, Comparison], folders: Sequence[Path] = ()) -> Answer:
    """Return the answer for a plant of several joints.

    Args:
        comparisons: The comparison of each joint, at least one.
        folders: As :func:`answer_of` takes them.

    Raises:
        DataError: As of :func:`answer_of`.
    """
    joined = join_joints({joint: same_run_layer(one) for joint, one in comparisons.items()})
    kept = [one for folder in folders for one in read_layers(folder, joined.case) if one.layer is not Layer.SAME_RUN]
    asked = {one.layer for one in (joined, *kept)}
    plant = shlex.quote(design_plant(next(iter(comparisons.values()))))
    command = f"python -m pendulum_bags experiment joints --plant {plant}"
    others = [
        LayerResult(layer, Mark.NOT_MEASURED, f"Not asked: {_HOW[layer].format(command)}")
        for layer in Layer
        if layer not in asked
    ]
    return sum_up([joined, *kept, *others], emulated=all(one.is_emulated for one in comparisons.values()))
