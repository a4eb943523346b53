"""The first day in a lab, lived through; and the page that tells of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pendulum_testing.processes import ProcessGroup
from tests.acceptance.first_day import live_through
from tests.acceptance.first_day_bench import Day
from tests.acceptance.first_day_page import PAGE, skeleton, steps_of, text_of


@pytest.mark.timeout(600)
def test_a_first_day_from_the_first_scan_to_the_last_restore_is_as_its_page_tells(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    pytest.importorskip("hebi", reason="hebi-py is not installed")
    folder = tmp_path / "lab"
    folder.mkdir()
    day = Day(processes, folder, domain_id)
    try:
        # Without what waits for a pendulum to come to rest, and what check refuses: other tests do that faster.
        steps = live_through(day, whole=False)
    finally:
        day.close()
    told = steps_of(PAGE.read_text(encoding="utf-8"))
    for step in steps:
        text = text_of([step])
        assert skeleton(text[text.index("```") :]) in told, (
            f"the page is out of date; python -m tests.acceptance.first_day writes it anew\n{text}"
        )
    bridge = steps[-3].output
    assert "e-stop" in bridge
    assert "button is pressed" in bridge
