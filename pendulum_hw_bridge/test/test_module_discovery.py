"""Which HEBI module is driven: on a network that has none, one, twins, a silent one, or one of another type.

The entries are hebi-py's own; only the network behind them is ours, since no module is at hand where tests run.
"""

import json
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge.backends import hebi as backend_module
from pendulum_hw_bridge.backends.hebi import connect_group
from pendulum_hw_bridge.backends.hebi_discovery import ModuleRecord, ModuleSelection, discover, select_module
from pendulum_hw_bridge.lab import scan_cli
from pendulum_hw_bridge.port.actuator import ActuatorError

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
lookup_module = pytest.importorskip("hebi._internal.lookup")


class Group:
    size = 1

    def __init__(self, module: ModuleRecord) -> None:
        self.module = module

    def request_info(self, timeout_ms: int) -> Any:
        if not self.module.serial:
            return None
        one = {"serial": self.module.serial, "mechanical_type": self.module.type, "firmware_revision": "15.2"}
        return SimpleNamespace(**{name: [value] for name, value in one.items()})


class Network:
    """Stands for ``hebi.Lookup``; modules appear one look after another, as they answer."""

    def __init__(self, *modules: ModuleRecord, at_once: bool = True) -> None:
        self.modules = modules
        self.looks = len(modules) if at_once else 0

    @property
    def entrylist(self) -> list[Any]:
        self.looks += 1
        return [
            lookup_module.Entry(
                module.name,
                module.family,
                lookup_module.MacAddress(*bytes.fromhex(module.mac_address.replace(":", ""))),
                0x0100007F,
                int(module.stale),
            )
            for module in self.modules[: self.looks - 1]
        ]

    def get_group_from_macs(self, addresses: list[str], timeout_ms: int) -> Group | None:
        return next((Group(module) for module in self.modules if module.mac_address in addresses), None)


def module(number: int, name: str = "Pendulum", **changes: Any) -> ModuleRecord:
    known = {"serial": f"X5-0{number}", "type": "X5-9", **changes}
    return ModuleRecord("Lab", name, f"D8:80:39:00:00:{number:02X}", **known)


def look(*modules: ModuleRecord, at_once: bool = True) -> list[ModuleRecord]:
    return discover(Network(*modules, at_once=at_once), wait=lambda seconds: None)


def test_each_module_is_reported_with_all_that_tells_it_from_others() -> None:
    (seen,) = look(module(1))
    assert seen == ModuleRecord(
        "Lab", "Pendulum", "D8:80:39:00:00:01", "X5-01", "X5-9", "15.2", "127.0.0.1", stale=False
    )


def test_a_twin_that_answers_later_is_seen_before_a_choice_is_made() -> None:
    seen = look(module(1), module(2), at_once=False)
    assert len(seen) == 2
    with pytest.raises(ActuatorError, match=r"Lab/Pendulum is not the only one: .*X5-01.*X5-02.*choose by serial"):
        select_module(seen, ModuleSelection("Lab", "Pendulum"), seconds=2.0)


@pytest.mark.parametrize(
    "wanted",
    [
        ModuleSelection(serial="x5-02"),
        ModuleSelection(mac_address="D8-80-39-00-00-02"),
        ModuleSelection("Lab", "Pendulum", mac_address="d88039000002"),
    ],
    ids=["serial", "address", "all"],
)
def test_of_two_twins_the_one_with_the_serial_number_or_address_is_taken(wanted: ModuleSelection) -> None:
    assert select_module(look(module(1), module(2)), wanted, seconds=2.0).serial == "X5-02"


@pytest.mark.parametrize(
    ("seen", "wanted", "message"),
    [
        ([], ModuleSelection("Lab", "Pendulum"), r"Lab/Pendulum answered within 2 s; modules seen: none"),
        (
            [module(1, "Arm")],
            ModuleSelection("Lab", "Pendulum"),
            r"modules seen: Lab/Arm \(X5-01, D8:80:39:00:00:01\)",
        ),
        ([module(1, stale=True)], ModuleSelection(), r"was seen but is silent now"),
        ([module(1)], ModuleSelection(serial="X5-07"), r"no HEBI module \*/\* \(X5-07\) answered"),
        ([module(1, type="X5-16")], ModuleSelection(module_type="X5-1"), r"is 'X5-16'; expected 'X5-1'"),
        (
            [module(1, serial="", type="")],
            ModuleSelection(module_type="X5-9"),
            r"not known, for it did not answer",
        ),
    ],
    ids=["none", "another", "stale", "serial", "type", "mute"],
)
def test_a_module_that_is_not_meant_is_not_driven(
    seen: list[ModuleRecord], wanted: ModuleSelection, message: str
) -> None:
    with pytest.raises(ActuatorError, match=message):
        select_module(look(*seen), wanted, seconds=2.0)


def test_a_type_is_the_same_however_it_is_written() -> None:
    assert select_module([module(1, type="X5_9")], ModuleSelection(module_type="x5-9"), seconds=2.0)


def test_a_stale_entry_beside_a_living_module_is_no_twin() -> None:
    old = module(1, stale=True)
    assert select_module([old, module(2)], ModuleSelection("Lab", "Pendulum"), seconds=2.0).serial == "X5-02"


def test_the_group_is_made_by_address_not_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hebi, "Lookup", lambda *arguments: Network(module(1), module(2)))
    assert connect_group(ModuleSelection(serial="X5-02"), look_time=0.25).module.serial == "X5-02"
    with pytest.raises(ActuatorError, match="not the only one"):
        connect_group(ModuleSelection(), look_time=0.25)


def test_scan_lists_what_is_there_and_says_which_would_be_driven(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = (module(1), module(2, "Arm", type="X8-3"), module(3, stale=True))
    monkeypatch.setattr(backend_module, "open_lookup", lambda interface="": Network(*seen))
    assert scan_cli.main(["--json", "--look-time", "0.25", "--name", "Pendulum"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [entry["serial"] for entry in printed["modules"]] == ["X5-02", "X5-01", ""]
    assert printed["chosen"]["serial"] == "X5-01"
    assert scan_cli.main(["--look-time", "0.25", "--name", "Arm"]) == 1
    text = capsys.readouterr()
    for word in ("D8:80:39:00:00:02", "X8-3", "15.2", "127.0.0.1", "stale"):
        assert word in text.out
    assert "expected 'X5-9'" in text.out + text.err


def test_scan_on_a_network_without_modules_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # hebi-py's own lookup, bound to this machine.
    assert scan_cli.main(["--interface", "127.0.0.1", "--look-time", "0.5"]) == 1
    assert "modules seen: none" in "".join(capsys.readouterr())
