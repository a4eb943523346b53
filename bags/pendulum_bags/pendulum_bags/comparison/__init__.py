"""Comparison of simulation and hardware: the thesis's analysis, the paired one, statistics, spectra, metrics."""

from pendulum_bags.comparison.compare import Comparison, compare, compare_folders, compare_joints
from pendulum_bags.comparison.equivalence import EquivalenceTest, Outcome, Verdict
from pendulum_bags.comparison.margins import Margins
from pendulum_bags.comparison.recordings import compare_runs
from pendulum_bags.comparison.same_run import Looks
from pendulum_bags.runs.run_data import RunData, read_run
from pendulum_bags.runs.series import Series, Signal

__all__ = [
    "Comparison",
    "EquivalenceTest",
    "Looks",
    "Margins",
    "Outcome",
    "RunData",
    "Series",
    "Signal",
    "Verdict",
    "compare",
    "compare_folders",
    "compare_joints",
    "compare_runs",
    "read_run",
]
