"""Figures of the designs that carry over to the hardware, where its frequency response was measured."""

from __future__ import annotations

from threadpoolctl import threadpool_limits

from pendulum_bags.figures.figure import Figure
from pendulum_bags.frequency_response.figures import (
    certified_gains_figure,
    certified_weights_figure,
    gap_figure,
)
from pendulum_bags.report.data import ReportData

__all__ = ["gains", "gap", "weights"]

_MISSING = "needs the hardware's measured response (python -m pendulum_bags experiment frequency_response)"


def gap(data: ReportData) -> Figure | str:
    """Draw the distance of model and hardware over frequency beside the margin of each design."""
    found = data.certified
    if found is None or found.certifier is None:
        return _MISSING
    return gap_figure(found.certifier, None, found.designs)


def gains(data: ReportData) -> Figure | str:
    """Draw which gains of u = -kp theta - kd theta_dot are certified for the hardware."""
    found = data.certified
    if found is None or found.certifier is None:
        return _MISSING
    # Thousands of small matrices: threads of the linear algebra would only get into each other's way.
    with threadpool_limits(1):
        return certified_gains_figure(found.certifier, found.designs)


def weights(data: ReportData) -> Figure | str:
    """Draw which LQR weights give gains that are certified for the hardware."""
    found = data.certified
    if found is None or found.certifier is None:
        return _MISSING
    with threadpool_limits(1):
        return certified_weights_figure(found.certifier, found.model)
