"""Benchmarks beside peers: an area is a module ``bench_<area>.py`` whose ``rows()`` yields what it measured.

``make bench`` runs them all, ``make bench ONLY=sim`` one. An area looks like this::

    from tests.benchmarks import Row, measured, peer

    def rows() -> Iterator[Row]:
        theirs = peer("gymnasium", lambda: steps_per_second_of_gymnasium())
        yield measured("env.step", ours, "1/s", peer=theirs, at_least_times_peer=4.0)

A figure without a check that the result is right is worth nothing: assert it before measuring. An exception
of an area becomes a row of its own that does not hold; the other areas still run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from scipy import stats

__all__ = ["Peer", "Row", "counted", "measured", "peer"]


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement beside its peer.

    Attributes:
        what: What was measured, on which work.
        unit: Unit of ``ours`` and ``peer``.
        ours: Our figure; None when it could not be measured.
        peer: The peer's figure on the same work in the same run; None when there is none.
        peer_name: Which peer that is.
        ratio: How many times better than the peer we are, in the sense of the target; None without a peer.
        target: What must be reached, in words; empty for a figure that is only told.
        holds: Whether it is reached; None where there is no target, or no peer to compare with.
        note: Anything that a reader must know, such as why a peer is missing.
        area: Set by the harness from the module's name.
    """

    what: str
    unit: str = ""
    ours: float | None = None
    peer: float | None = None
    peer_name: str = ""
    ratio: float | None = None
    target: str = ""
    holds: bool | None = None
    note: str = ""
    area: str = ""


@dataclass(frozen=True, slots=True)
class Peer:
    """A peer's figure, or why there is none.

    Attributes:
        name: Its name.
        value: Its figure, in the unit of the row.
        note: Why ``value`` is None.
    """

    name: str
    value: float | None
    note: str = ""


def peer(name: str, measure: Callable[[], float]) -> Peer:
    """Measure a peer; one that is not installed or fails becomes a note, so that it is told and not hidden.

    Args:
        name: Its name for the table.
        measure: Does the same work with the peer and returns its figure.
    """
    try:
        return Peer(name, float(measure()))
    except ImportError as error:
        return Peer(name, None, f"{name} is not installed: {error}")
    # Whatever a foreign library raises must not cost us the other rows.
    except Exception as error:  # noqa: BLE001
        return Peer(name, None, f"{name} failed: {type(error).__name__}: {error}")


def measured(
    what: str,
    ours: float,
    unit: str,
    *,
    peer: Peer | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    at_least_times_peer: float | None = None,
    at_most_times_peer: float | None = None,
    less_is_better: bool | None = None,
    note: str = "",
) -> Row:
    """Return the row of a measurement, with ratio, target in words and verdict.

    Args:
        what: What was measured, on which work.
        ours: Our figure.
        unit: Unit of it and of the peer's.
        peer: Peer on the same work in the same run.
        at_least: Smallest figure that is good enough.
        at_most: Largest figure that is good enough.
        at_least_times_peer: How many times better than the peer we must be.
        at_most_times_peer: What is good enough of a time or a cost, in the peer's: for a peer that is a limit.
        less_is_better: True for times and errors; by default when an ``at_most`` is given.
        note: Anything that a reader must know.
    """
    less = (at_most is not None or at_most_times_peer is not None) if less_is_better is None else less_is_better
    theirs = peer.value if peer else None
    ratio = None
    if theirs is not None and theirs > 0.0 and ours > 0.0:
        ratio = theirs / ours if less else ours / theirs
    targets: list[str] = []
    verdicts: list[bool | None] = []
    if at_least is not None:
        targets.append(f">= {at_least:g} {unit}".strip())
        verdicts.append(ours >= at_least)
    if at_most is not None:
        targets.append(f"<= {at_most:g} {unit}".strip())
        verdicts.append(ours <= at_most)
    if at_least_times_peer is not None:
        targets.append(f">= {at_least_times_peer:g} x {peer.name if peer else 'peer'}")
        verdicts.append(None if ratio is None else ratio >= at_least_times_peer)
    if at_most_times_peer is not None:
        targets.append(f"<= {at_most_times_peer:g} x {peer.name if peer else 'peer'}")
        verdicts.append(None if theirs is None else ours <= at_most_times_peer * theirs)
    if not math.isfinite(ours) or False in verdicts:
        holds: bool | None = False
    else:
        holds = None if not verdicts or None in verdicts else True
    return Row(
        what=what,
        unit=unit,
        ours=ours,
        peer=theirs,
        peer_name=peer.name if peer else "",
        ratio=ratio,
        target=", ".join(targets),
        holds=holds,
        note="; ".join(text for text in (note, peer.note if peer else "") if text),
    )


def counted(
    what: str,
    count: int,
    trials: int,
    *,
    at_least: float | None = None,
    at_most: float | None = None,
    note: str = "",
) -> Row:
    """Return the row of a share of trials, with its counts and its interval in the note.

    Args:
        what: What was counted, in which trials.
        count: How many trials had it.
        trials: How many there were.
        at_least: Smallest share that is good enough [%].
        at_most: Largest share that is good enough [%].
        note: Anything that a reader must know.
    """
    # Clopper and Pearson's, which never covers less than it says.
    interval = stats.binomtest(count, trials).proportion_ci(0.95, method="exact")
    counts = f"{count} of {trials}, 95 % interval {100.0 * interval.low:.1f} to {100.0 * interval.high:.1f} %"
    return measured(
        what,
        100.0 * count / trials,
        "%",
        at_least=at_least,
        at_most=at_most,
        note="; ".join(text for text in (counts, note) if text),
    )
