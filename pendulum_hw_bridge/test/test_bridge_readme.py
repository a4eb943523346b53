"""The README's list of feedback is that of the code."""

from __future__ import annotations

from pathlib import Path

from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_readme_names_every_quantity_of_the_feedback() -> None:
    for quantity in FEEDBACK_QUANTITIES:
        assert quantity.removesuffix("_temperature").removesuffix("_command") in README
