"""The short form of the campaign on the running system; ``make faults`` is the long one."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from pendulum_bags.experiments.domain import reserve_domain
from tests.tools.faults.bag_property import check_bag
from tests.tools.faults.campaign import CAMPAIGN
from tests.tools.faults.live import EFFORT_LIMIT, LiveSystem
from tests.tools.faults.outcome import MACHINE_PATIENCE, Fault, try_fault
from tests.tools.faults.plants import PLANTS, Plant


@pytest.fixture(scope="module")
def system(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveSystem]:
    with reserve_domain() as domain, LiveSystem(tmp_path_factory.mktemp("live"), domain, request.param) as running:
        yield running


_TRIED: dict[str, dict[Path, list[int]]] = {}
"""Folders of the systems on which a fault was tried, with the commands that each probe heard, by plant: pytest may end
one system and start another."""
_SHORT = [(plant, fault) for plant in PLANTS for fault in CAMPAIGN if plant in fault.short]


@pytest.mark.parametrize(("system", "fault"), _SHORT, ids=lambda each: each.name, indirect=["system"], scope="module")
def test_running_system_survives(system: LiveSystem, fault: Fault) -> None:
    _TRIED.setdefault(system.plant.name, {})[system.folder] = system.witnessed
    outcome = try_fault(system, fault, random.Random(fault.name))
    assert outcome.survived, outcome.detail


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.name)
def test_every_bag_of_the_campaign_keeps_the_rule_of_the_last_command(plant: Plant, tmp_path: Path) -> None:
    folders = dict(_TRIED.get(plant.name, {}))
    if not folders:  # run alone: the faults above have recorded none
        fault = next(fault for each, fault in _SHORT if each is plant)
        with reserve_domain() as domain, LiveSystem(tmp_path, domain, plant) as system:
            assert try_fault(system, fault, random.Random(fault.name)).survived
            folders[system.folder] = system.witnessed
    records = {
        str(bag): check_bag(bag, limit=EFFORT_LIMIT, allowance=MACHINE_PATIENCE, witnessed=witnessed)
        for folder, witnessed in sorted(folders.items())
        for bag in sorted(folder.glob("bag_*"))
    }
    assert records
    assert any(record.judged > 0 for plants in records.values() for record in plants)
    for name, plants in records.items():
        assert plants, f"{name} has no torque"
        for record in plants:
            assert record.violations == (), f"{name}: {record}"
