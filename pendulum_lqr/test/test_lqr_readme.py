"""The README and the page on new controllers agree with the code."""

import re
from pathlib import Path

import pytest

from pendulum_lqr.controller_interface.controller import CONTROLLERS
from pendulum_lqr.nodes.answering import StateRefusal

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", CONTROLLERS)
def test_every_controller_is_listed(name):
    assert f"`{name}`" in README


def test_refusals_of_states_are_explained():
    assert "refused.no_answer" in README
    words = {
        "malformed": "carries none of our joint",
        "duplicate": "repeated",
        "from_future": "from the future",
    }
    for refusal in StateRefusal:
        assert words.get(refusal.value, refusal.value.replace("_", " ")) in README or "no_answer" in refusal.value


def test_the_example_of_the_readme_runs():
    code = re.search(r"```python\n(from pendulum_lqr.*?)```", README, re.DOTALL)
    assert code
    names: dict[str, object] = {}
    exec(code.group(1), names)
    assert names["effort"] == pytest.approx(-3.3345265, abs=1e-6)
