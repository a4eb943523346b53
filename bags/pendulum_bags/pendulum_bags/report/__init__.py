"""Reports: one self-contained page with a verdict, and the same figures as files."""

from pendulum_bags.report.figures import FIGURES, comparison_figures
from pendulum_bags.report.write import write_report

__all__ = ["FIGURES", "comparison_figures", "write_report"]
