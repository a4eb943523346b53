"""Which joints and commands of an adopted plant are whose."""

from __future__ import annotations

from typing import Any

import pytest

from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_sim.simulator.adopt_node import SPECS, entries_of

DEFAULTS = {spec.name: spec.default for spec in SPECS}
CART_POLE = load_mechanism("cart_pole").coordinates


def _entries(coordinates: Any = CART_POLE, **changes: Any) -> Any:
    return entries_of({**DEFAULTS, **changes}, coordinates)


def test_joints_and_commands_are_the_plants_own_unless_named_otherwise() -> None:
    assert _entries() == (("cart", "pole"), (1.0, 1.0), (0.0, 0.0), (0,), 1)
    named = _entries(joints=["-slide", "tilt"], zeros=[0.5, 3.0], command_joints=["wheel", "slide"])
    assert named == (("slide", "tilt"), (-1.0, 1.0), (0.5, 3.0), (1,), 2)
    former = _entries(ONE_JOINT, joint="hip", sign=-1, zero=0.2, command_index=1, command_size=3)
    assert former == (("hip",), (-1.0,), (0.2,), (1,), 3)
    assert _entries(ONE_JOINT, joints=["-hip"], zeros=[0.2]) == (("hip",), (-1.0,), (0.2,), (0,), 1)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"joints": ["slide"]}, r"joints are slide; expected 2 names, of cart \[m\], pole \[rad\]"),
        ({"joints": ["slide", "-slide"]}, "joints are slide, -slide; expected 2 names"),
        ({"zeros": [0.0, 0.0, 0.0]}, "zeros has 3 values; expected 2"),
        ({"command_joints": ["tilt"]}, "command_joints are tilt; expected cart, which is driven, in it"),
    ],
)
def test_entries_that_do_not_fit_the_plant_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        _entries(**changes)
