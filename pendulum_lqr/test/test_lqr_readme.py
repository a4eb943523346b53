"""The README and the page on new controllers agree with the code."""

import re
from pathlib import Path

import pytest

from pendulum_lqr.controller_interface.controller import CONTROLLERS, Row, make_controller
from pendulum_lqr.linear.design import DesignError
from pendulum_lqr.nodes.answering import StateRefusal
from pendulum_msgs_py.plants.plant_parameters import load_plant

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
HOW_TO = (Path(__file__).resolve().parents[2] / "pendulum_msgs_py/docs/bring_your_own.md").read_text(encoding="utf-8")


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


def test_the_example_of_a_new_controller_runs_as_it_stands(tmp_path, monkeypatch):
    import importlib
    import textwrap

    blocks = re.findall(r"^   ```python\n(.*?)^   ```", HOW_TO, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 1
    (tmp_path / "mine_of_the_readme.py").write_text(textwrap.dedent(blocks[0]), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module("mine_of_the_readme")
    monkeypatch.setitem(CONTROLLERS, "mine", Row("mine_of_the_readme:Mine"))
    controller = make_controller("mine", load_plant("thesis"), period=0.01, values={"kp": 20.0})
    assert controller.command(0.0, (0.1, 0.0)) == pytest.approx(-2.0)
    with pytest.raises(DesignError, match="mine makes the loop unstable"):
        make_controller("mine", load_plant("thesis"), period=0.01, values={"kp": -1.0})
