"""The answer of a comparison, or of those of several joints, with the other layers of a run folder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from pendulum_bags.comparison import Comparison
from pendulum_bags.verdict.layers import Answer, Layer, LayerResult, Mark, read_layers, sum_up
from pendulum_bags.verdict.same_run import how_to_measure, layers_of_files, same_run_layer

__all__ = ["answer_of", "join_joints"]

_WORST_FIRST = (Mark.NO, Mark.UNDECIDED, Mark.NOT_MEASURED, Mark.YES)


def answer_of(
    compared: Comparison | Mapping[str, Comparison],
    folders: Sequence[Path] = (),
    *,
    more: str = "",
    updated: Sequence[LayerResult] = (),
    how: Mapping[Layer, str] = MappingProxyType({}),
    refused: str = "",
) -> Answer:
    """Return the answer of a comparison, or of those of the joints of a plant.

    Args:
        compared: The first layer, or that of each joint by its name, at least one.
        folders: Folders that may have further layers: of the run, or of experiments that measured them.
        more: How to record more if that is missing.
        how: The command that measures a layer, if it differs for the recordings' plants.
        refused: Why no plant could be identified from the recordings, as a sentence, or empty.

    Raises:
        DataError: A stored layer cannot be read, is in two of the folders, or is of other plants.
    """
    results = compared if isinstance(compared, Mapping) else {"": compared}
    comparison = next(iter(results.values()))
    layers = {joint: same_run_layer(one, more=more, refused=refused) for joint, one in results.items()}
    first = layers[""] if "" in layers else join_joints(layers)
    if first.mark is Mark.UNDECIDED:
        # One recording serves all joints: the one that needs most of it decides.
        neediest = max(results, key=lambda joint: _needed(results[joint]))
        first = replace(first, next_steps=layers[neediest].next_steps)
    known = {Layer.SAME_RUN, *(one.layer for one in updated)}
    others = [one for folder in folders for one in read_layers(folder, first.case) if one.layer not in known]
    commands = {**how_to_measure(comparison), **how}
    if comparison.of_files:
        found = {one.layer for one in (*updated, *others)}
        others += [one for one in layers_of_files(comparison) if one.layer not in found]
    emulated = all(one.is_emulated for one in results.values())
    return sum_up([first, *updated, *others], emulated=emulated, how=commands)


def _needed(comparison: Comparison) -> float:
    """Return the further runs that an undecided comparison needs; infinity if more hardly decide it."""
    runs = comparison.verdict.more_runs
    return math.inf if runs is None else float(runs)


def join_joints(results: Mapping[str, LayerResult]) -> LayerResult:
    """Return a layer's result for a plant, from those of its joints (at least one): yes if all are.

    More joints make a wrong yes no likelier, since all must agree (an intersection-union test).
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
