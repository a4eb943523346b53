"""The README's tables are those of the code."""

from __future__ import annotations

import re
from pathlib import Path

from pendulum_hw_bridge.drive.safety import FAULTS
from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def between(mark: str) -> str:
    match = re.search(rf"<!-- {mark} -->\n(.*?)<!-- end -->", README, re.DOTALL)
    assert match is not None
    return match[1]


def test_the_readme_has_every_fault() -> None:
    rows = "".join(f"| `{name}` | {meaning} |\n" for name, meaning in FAULTS.items())
    assert between("faults") == "| fault | meaning |\n|---|---|\n" + rows


def test_the_readme_names_every_quantity_of_the_feedback() -> None:
    for quantity in FEEDBACK_QUANTITIES:
        assert quantity.removesuffix("_temperature").removesuffix("_command") in README
