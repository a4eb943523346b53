"""What a layer of the answer rests on, as a table."""

from __future__ import annotations

from pendulum_bags.figures.numbers import quantity
from pendulum_bags.figures.table import Table
from pendulum_bags.verdict.layers import LayerResult

__all__ = ["evidence_table"]


def evidence_table(result: LayerResult) -> Table:
    """Return what a layer of the answer rests on."""
    rows = []
    for row in result.evidence:
        ends = ("–" if end is None else quantity(end) for end in (row.low, row.high))
        interval = "–" if row.low is None and row.high is None else " to ".join(ends)
        name = row.quantity + (f" [{row.unit}]" if row.unit else "")
        estimate = "–" if row.estimate is None else quantity(row.estimate)
        rows.append((name, estimate, interval, row.expected or "–", row.mark.value if row.expected else "–", row.note))
    head = ("quantity", "estimate", "interval", "expected", "result", "note")
    return Table(f"Evidence: {result.layer.title}", result.sentence, head, rows, "Verdict")
