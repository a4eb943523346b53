"""Plant and controller on two machines, and a cable pulled; ``python -m tests.faults.network`` also for 30 s."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.bag_property import COMMAND_LIFE, check_bag
from tests.faults.network import cut_cable, why_not

_MACHINE_PATIENCE = 0.060


@pytest.mark.timeout(150)
def test_a_pulled_cable_ends_the_torque_and_a_plugged_one_brings_it_back(tmp_path: Path) -> None:
    reason = why_not()
    if reason:
        pytest.skip(reason)
    (report,) = cut_cable(tmp_path, [1.0])
    assert report.time_to_zero <= COMMAND_LIFE + _MACHINE_PATIENCE
    assert report.largest <= 5.0
    (record,) = check_bag(tmp_path / "bag", limit=5.0, allowance=_MACHINE_PATIENCE)
    assert record.violations == ()


@pytest.mark.parametrize("side", ["sim", "hw"])
def test_recorded_examples_keep_the_rule_of_the_last_command(side: str) -> None:
    example = Path(__file__).parents[2] / "bags" / "examples" / f"regulation_{side}"
    (record,) = check_bag(example, limit=13.0)
    assert record.samples > 100
    assert record.violations == ()
