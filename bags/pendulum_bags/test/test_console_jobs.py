"""What the console knows of the folders that its programs write."""

import os
from pathlib import Path

from pendulum_bags.console.jobs import Jobs


def test_the_newest_page_of_a_kind_is_found_among_all_runs(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path)
    assert jobs.newest("frequency_response.html") is None
    for name, written in (("b_first", 100.0), ("a_last", 200.0), ("c_other", 300.0)):
        page = tmp_path / name / ("report.html" if name == "c_other" else "frequency_response.html")
        page.parent.mkdir()
        page.touch()
        os.utime(page, (written, written))
    assert jobs.newest("frequency_response.html") == tmp_path / "a_last"
    assert Jobs(tmp_path / "missing").newest("frequency_response.html") is None
