"""The README says what the tables in the code say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.commands import Refusal
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.parameters import ParameterSpec, markdown_table
from pendulum_msgs_py.plants.plant_parameters import DRIVETRAIN_SPECS, PLANT_SPECS, PRESETS

_README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def _table(name: str) -> str:
    found = re.search(rf"<!-- table: {name} -->\n\n(.*?)\n<!-- end -->", _README, re.DOTALL)
    assert found, f"README.md has no table {name!r}"
    return found.group(1)


@pytest.mark.parametrize(("name", "specs"), [("plant", PLANT_SPECS), ("drivetrain", DRIVETRAIN_SPECS)])
def test_the_tables_of_plant_files_are_those_of_the_code(name: str, specs: tuple[ParameterSpec, ...]) -> None:
    assert _table(name) == markdown_table(specs)


def test_the_tables_of_a_plant_node_are_those_of_the_code() -> None:
    pytest.importorskip("rclpy")
    from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, LOOP_SPECS

    assert _table("limits") == markdown_table(LIMIT_SPECS)
    assert _table("loop") == markdown_table(LOOP_SPECS)


def test_every_name_mode_refusal_and_preset_is_explained() -> None:
    said = set(names.__all__) - {"LINK", "CLOCK", "SIGNALS", "Event", "full_name"}
    words = [getattr(names, name) for name in sorted(said)]
    words += [value for name, value in vars(names.Event).items() if name.isupper()]
    words += [mode.value for mode in Mode] + [refusal.value for refusal in Refusal] + list(PRESETS)
    assert [word for word in words if word not in _README] == []
