"""Figures of the designs that carry over to the hardware, where its frequency response was measured."""

from __future__ import annotations

from collections.abc import Callable

from threadpoolctl import threadpool_limits

from pendulum_bags.figures.figure import Figure
from pendulum_bags.frequency_response.figures import (
    certified_gains_figure,
    certified_weights_figure,
    gap_figure,
)
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.report.data import ReportData
from pendulum_lqr.certificate import Certifier

__all__ = ["gains", "gap", "weights"]


def gap(data: ReportData) -> Figure | str:
    """Draw the distance of model and hardware over frequency beside the margin of each design."""
    return _drawn(data, lambda found, certifier: gap_figure(certifier, None, found.designs))


def gains(data: ReportData) -> Figure | str:
    """Draw which gains of u = -kp theta - kd theta_dot are certified for the hardware."""
    return _drawn(data, lambda found, certifier: certified_gains_figure(certifier, found.designs))


def weights(data: ReportData) -> Figure | str:
    """Draw which LQR weights give gains that are certified for the hardware."""
    return _drawn(data, lambda found, certifier: certified_weights_figure(certifier, found.model))


def _drawn(data: ReportData, draw: Callable[[Analysis, Certifier], Figure]) -> Figure | str:
    found = data.certified
    if found is None or found.certifier is None:
        return "needs the hardware's measured response (python -m pendulum_bags experiment frequency_response)"
    # Thousands of small matrices: threads of the linear algebra would only get into each other's way.
    with threadpool_limits(1):
        return draw(found, found.certifier)
