"""Intervals of shares: of how many runs of those carried out."""

from __future__ import annotations

__all__ = ["share_interval"]


def share_interval(hits: int, runs: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability, which is good at 0 and 1 too.

    Args:
        hits: Runs in which it happened.
        runs: Of so many, at least one.

    Source:
        Wilson, Journal of the American Statistical Association 22 (1927), as in statsmodels.
    """
    from statsmodels.stats.proportion import proportion_confint

    low, high = proportion_confint(hits, runs, alpha=0.05, method="wilson")
    return float(low), float(high)
