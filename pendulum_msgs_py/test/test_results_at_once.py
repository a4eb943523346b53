"""Jobs in processes: results in order, none of no jobs, and no process left after one that fails."""

from functools import partial
from multiprocessing import active_children

import pytest
from rich.console import Console

from pendulum_msgs_py.programs.counted_progress import results_at_once


def test_results_come_in_order_and_a_failure_leaves_no_process() -> None:
    assert results_at_once(Console(quiet=True), "jobs", []) == []
    assert results_at_once(Console(quiet=True), "jobs", [partial(int, "3"), partial(int, "4")], workers=2) == [3, 4]
    with pytest.raises(ValueError, match="invalid literal"):
        results_at_once(Console(quiet=True), "jobs", [partial(int, "none"), partial(int, "4")], workers=2)
    assert not active_children()
