"""The README explains every name of the contract."""

from __future__ import annotations

from pathlib import Path

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.commands import Refusal
from pendulum_msgs_py.contract.supervisor import Mode
from pendulum_msgs_py.plants.plant_parameters import PRESETS

_README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def test_every_name_mode_refusal_and_preset_is_explained() -> None:
    words = [name for key, name in vars(names).items() if key in names.__all__ and isinstance(name, str)]
    words.remove(names.LINK)
    words.remove(names.CLOCK)
    words += [value for name, value in vars(names.Event).items() if name.isupper()]
    words += [mode.value for mode in Mode] + [refusal.value for refusal in Refusal] + list(PRESETS)
    assert [word for word in words if word not in _README] == []
