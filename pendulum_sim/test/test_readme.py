"""The README's tables of parameters are those of the nodes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pendulum_msgs_py.parameters import markdown_table
from pendulum_sim.pictures import viewer_node
from pendulum_sim.simulator import adopt_node, engines, simulator_node

README = Path(__file__).parents[1] / "README.md"


@pytest.mark.parametrize(
    ("node", "specs"),
    [
        ("simulator", simulator_node.SPECS),
        ("mujoco", engines.MUJOCO.specs),
        ("gymnasium", engines.GYMNASIUM.specs),
        ("adopt", adopt_node.SPECS),
        ("viewer", viewer_node.SPECS),
    ],
)
def test_the_readme_has_the_parameters_of_the_node(node: str, specs: tuple) -> None:
    match = re.search(rf"<!-- parameters: {node} -->\n(.*?)<!-- end -->", README.read_text(encoding="utf-8"), re.DOTALL)
    assert match is not None
    assert match[1] == markdown_table(specs), f"replace the table by:\n{markdown_table(specs)}"
