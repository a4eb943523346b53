"""The short form of :mod:`tests.tools.faults.press_times`: an e-stop in a flood, by the motor's own record."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tools.faults.plants import PLANTS, Plant
from tests.tools.faults.press_times import FLOODS, press_in_flood

_LATEST = 1000.0
"""Far above the 100 ms of the long form: the plant may have no priority here [ms]."""


@pytest.mark.parametrize(("plant", "flood"), list(zip(PLANTS, reversed(FLOODS), strict=True)), ids=str)
def test_an_e_stop_ends_torque_in_a_flood_beside_a_busy_loop(
    tmp_path: Path, domain_id: int, plant: Plant, flood: str
) -> None:
    times = press_in_flood(tmp_path, plant, flood, 2, busy=1)
    assert len(times.driven) == 2
    assert max(times.driven) < _LATEST
