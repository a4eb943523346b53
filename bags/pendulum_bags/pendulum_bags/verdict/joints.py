"""One layer of a plant of several joints from that of each joint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pendulum_bags.verdict.layers import LayerResult, Mark

__all__ = ["join_joints"]

_WORST_FIRST = (Mark.NO, Mark.UNDECIDED, Mark.NOT_MEASURED, Mark.YES)


def join_joints(results: Mapping[str, LayerResult]) -> LayerResult:
    """Return what a layer says of a plant, from what it says of each joint: yes where it does of all.

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
    )
