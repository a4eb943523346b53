"""Equivalence by two one-sided tests (Schuirmann, J. Pharmacokinet. Biopharm. 15, 1987), and their result as text."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

from pendulum_bags.comparison.margins import Margins
from pendulum_bags.comparison.statistics import Interval
from pendulum_bags.distributions import normal_probability, normal_quantile

__all__ = ["EquivalenceTest", "Outcome", "Verdict", "conclude", "equivalence_test"]

POWER = 0.8
"""Probability with which the named number of runs would decide."""
MOST_RUNS = 10_000
_UNTOLD = "the motions are too dissimilar to measure it"


class Outcome(str, Enum):
    """What a test shows."""

    EQUIVALENT = "equivalent"
    DIFFERENT = "not equivalent"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class EquivalenceTest:
    """One quantity against its margin.

    Args:
        interval: Estimate with its interval; one of 90 % is two one-sided tests at 5 % each.
        low: Lower margin; minus infinity for a one-sided test.
        more_runs: Further runs for a decision with 80 % probability; 0 where decided, None where the estimate is at the
            margin and more runs hardly help.
    """

    quantity: str
    unit: str
    interval: Interval
    low: float
    high: float
    outcome: Outcome
    more_runs: int | None
    smallest_margin: float

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            **self.interval.as_dict(),
            "margin_low": self.low if math.isfinite(self.low) else None,
            "margin_high": self.high,
            "outcome": self.outcome.value,
            "more_runs": self.more_runs,
            "smallest_margin": self.smallest_margin,
        }

    def margin_text(self) -> str:
        """Return the margin as text, without its unit."""
        if not math.isfinite(self.low):
            return f"margin {self.high:.3g}"
        if math.isclose(self.low, -self.high):
            return f"margin ±{self.high:.3g}"
        return f"margin {self.low:.3g} to {self.high:.3g}"

    def sentence(self) -> str:
        """Return the result as text."""
        if math.isnan(self.interval.estimate):
            return f"{self.quantity}: {_UNTOLD}"
        unit = _behind_a_number(self.unit)
        text = (
            f"{self.quantity}: {self.interval.estimate:.3g}{unit}, {self.interval.title} {self.interval.low:.3g} to "
            f"{self.interval.high:.3g}{unit}, {self.margin_text()}{unit}: {self.outcome.value}"
        )
        if self.outcome is Outcome.UNDECIDED:
            text += f": {_more(self.more_runs)}"
        return text


def _behind_a_number(unit: str) -> str:
    return f" {unit}" if unit not in {"", "-"} else ""


def _more(runs: int | None) -> str:
    if runs is None:
        return "more runs would hardly decide it, the estimate sits on the margin"
    return f"record {runs} more run{'s' if runs != 1 else ''}"


def equivalence_test(
    quantity: str,
    unit: str,
    interval: Interval,
    low: float,
    high: float,
    *,
    outside: Interval | None = None,
    runs: int = 1,
    ratio: bool = False,
) -> EquivalenceTest:
    """Test one quantity; ``low`` may be minus infinity, ``outside`` (by default ``interval``) shows a difference."""
    scale = _logarithm if ratio else float
    estimate, left, right = (scale(value) for value in (interval.estimate, interval.low, interval.high))
    bottom, top = (scale(value) for value in (low, high))
    if left > bottom and right < top:
        outcome = Outcome.EQUIVALENT
    elif scale((outside or interval).low) > top or scale((outside or interval).high) < bottom:
        outcome = Outcome.DIFFERENT
    else:
        outcome = Outcome.UNDECIDED
    farthest = right if not math.isfinite(low) else max(abs(left), abs(right))
    smallest = math.exp(farthest) if ratio else farthest
    more: int | None = 0
    if outcome is Outcome.UNDECIDED:
        reach = normal_quantile(0.5 + 0.5 * interval.level)
        error = max(right - left, 0.0) / (2.0 * reach)
        more = _runs_to_decide(estimate, bottom, top, error, runs, reach)
    return EquivalenceTest(quantity, unit, interval, low, high, outcome, more, smallest)


def _logarithm(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf


def _runs_to_decide(estimate: float, bottom: float, top: float, error: float, runs: int, reach: float) -> int | None:
    """Return the further runs that decide with the stated power if the estimate is true; errors fall as their root."""
    if not (math.isfinite(error) and math.isfinite(estimate)) or _power(estimate, bottom, top, 0.0, reach) < POWER:
        return None
    enough = next(
        (n for n in _doubled(runs) if _power(estimate, bottom, top, error * math.sqrt(runs / n), reach) >= POWER),
        0,
    )
    if not enough:
        return None
    few = runs
    while enough - few > 1:
        middle = (few + enough) // 2
        if _power(estimate, bottom, top, error * math.sqrt(runs / middle), reach) >= POWER:
            enough = middle
        else:
            few = middle
    return enough - runs


def _doubled(runs: int) -> Iterator[int]:
    more = 1
    while runs + more <= MOST_RUNS:
        yield runs + more
        more *= 2


def _power(estimate: float, bottom: float, top: float, error: float, reach: float) -> float:
    inside, below, above = (estimate - bottom, top - estimate), bottom - estimate, estimate - top
    if error <= 0.0:
        return float(min(inside) > 0.0 or below > 0.0 or above > 0.0)
    equivalent = sum(normal_probability(distance / error - reach) for distance in inside) - 1.0
    different = sum(normal_probability(distance / error - reach) for distance in (below, above))
    return max(equivalent, 0.0) + different


@dataclass(frozen=True)
class Verdict:
    """All tests together: equivalent if all are, not equivalent if one is not, undecided otherwise.

    ``more_runs`` are further runs for a decision; 0 where decided, None where more hardly help.
    """

    outcome: Outcome
    sentence: str
    tests: Sequence[EquivalenceTest]
    margins: Margins
    more_runs: int | None

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return {
            "outcome": self.outcome.value,
            "sentence": self.sentence,
            "more_runs": self.more_runs,
            "margins": self.margins.as_dict(),
            "tests": [test.as_dict() for test in self.tests],
        }


def conclude(tests: Sequence[EquivalenceTest], margins: Margins, first: str, second: str) -> Verdict:
    """Return the verdict on at least one test."""
    by_outcome = {outcome: [test for test in tests if test.outcome is outcome] for outcome in Outcome}
    different, undecided = by_outcome[Outcome.DIFFERENT], by_outcome[Outcome.UNDECIDED]
    whose = margins.whose
    more: int | None = 0
    if different:
        outcome = Outcome.DIFFERENT
        what = "; ".join(_short(test) for test in different)
        text = f"{first} and {second} are not equivalent within {whose}: {what}."
        if undecided:
            text += f" Undecided: {', '.join(test.quantity for test in undecided)}."
    elif undecided:
        outcome = Outcome.UNDECIDED
        counts = [test.more_runs for test in undecided]
        more = None if None in counts else max(count or 0 for count in counts)
        what = ", ".join(test.quantity for test in undecided)
        untold = any(math.isnan(test.interval.estimate) for test in undecided)
        how = _UNTOLD if untold else _more(more)
        text = f"Undecided whether {first} and {second} are equivalent within {whose} in {what}: {how}."
    else:
        outcome = Outcome.EQUIVALENT
        text = f"{first} and {second} are equivalent within {whose}, in all {len(tests)} tests."
    return Verdict(outcome, text[0].upper() + text[1:], tuple(tests), margins, more)


def _short(test: EquivalenceTest) -> str:
    return (
        f"{test.quantity} is {test.interval.estimate:.3g}{_behind_a_number(test.unit)} "
        f"({test.interval.title} {test.interval.low:.3g} to {test.interval.high:.3g}; {test.margin_text()})"
    )
