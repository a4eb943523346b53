"""The leaderboard: costs and scores by hand, physics of the result, a page that stands alone."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.experiments.in_process import RunArrays, simulate_plant
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.studies.leaderboard import (
    COSTS,
    PERTURBATIONS,
    contenders,
    costs_of,
    evaluate,
    push_trains,
    scores,
)
from pendulum_bags.studies.leaderboard_hardware import HARDWARE_PERTURBATIONS, arrays_of_bag
from pendulum_bags.studies.leaderboard_page import write_page
from pendulum_lqr.controller_interface.controller import CONTROLLERS, Row, controller_names
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.reader import read_bag
from pendulum_testing.fixtures import PROJECT, in_repository
from pendulum_testing.policies import linear_policy

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def test_costs_of_a_motion_known_in_closed_form() -> None:
    count = 1000
    stamp = np.arange(count + 1, dtype=np.int64) * 10_000_000
    position = np.where(np.arange(count + 1) < 300, 0.0, math.pi)
    velocity = np.full(count + 1, 0.25)
    still = np.zeros(count + 1)
    arrays = RunArrays(stamp, position, velocity, still, still, still, np.full(count, -2.0))
    success, uptime, costs = costs_of(arrays)
    assert success
    assert uptime == pytest.approx(701 / 1001)
    assert costs == pytest.approx(
        {
            "time": 3.0,
            "max_torque": 2.0,
            "energy": 5.0,
            "torque_integral": 20.0,
            "torque_squared": 40.0,
            "smoothness": 0.0,
            "velocity": 0.625,
        }
    )
    found = scores(success, uptime, costs)
    # v1 by hand: .2 * 3/10 + .1 * 2/2 + .1 * 5/100 + .1 * 20/20 + .1 * 40/40 + 0 + .2 * .625/100.
    assert found["v1"] == pytest.approx(1.0 - 0.06 - 0.1 - 0.005 - 0.1 - 0.1 - 0.00125)
    assert found["v2"] == pytest.approx(
        1.0 - np.mean(np.tanh(np.pi * np.array([0.3, 1.0, 0.05, 1.0, 1.0, 0.0, 0.00625])))
    )
    assert found["v3"] == uptime


def test_a_pendulum_that_drifts_through_the_top_at_the_end_has_not_been_brought_up() -> None:
    stamp = np.arange(1001, dtype=np.int64) * 10_000_000
    still = np.zeros(1001)
    for seconds, expected in ((0.4, False), (1.2, True)):
        position = math.pi - 0.1 + 0.2 * np.clip((stamp * 1e-9 - (10.0 - seconds)) / seconds, -10.0, 1.0) - 1e-9
        velocity = np.full(1001, 0.2 / seconds)
        arrays = RunArrays(stamp, position, np.minimum(velocity, 0.49), still, still, still, np.zeros(1000))
        assert costs_of(arrays)[0] is expected


@pytest.mark.parametrize("duration", [4.0, 10.0])
def test_a_run_of_any_length_is_pushed_at_its_half(duration: float) -> None:
    plant = load_plant("thesis")
    for push in push_trains(plant, duration):
        spec = RunSpec(controller="lqr", disturbance=push, duration=duration)
        torque = simulate_plant(spec, plant).disturbance
        begins = spec.period * (1 + np.flatnonzero((torque[1:] != 0.0) & (torque[:-1] == 0.0)))
        assert begins == pytest.approx([0.5 * duration], abs=0.004)
        assert np.abs(torque).max() == push["amplitude"]


def test_weights_of_the_first_version_sum_to_one() -> None:
    assert sum(cost.weight for cost in COSTS) == pytest.approx(1.0)


def test_a_motor_too_weak_to_lift_the_pendulum_needs_a_swing_up() -> None:
    assert not evaluate("dfki", "lqr", robustness=False).success
    assert evaluate("dfki", "energy_swing_up", robustness=False).success


def test_every_controller_is_on_the_board() -> None:
    assert set(contenders()) == set(controller_names()) - {"playback", "policy", "lqr_tracking"}


MINE = """
from pendulum_lqr.controller_interface.controller import BaseController

class Mine(BaseController):
    SUMMARY = "A spring to upright."

    @classmethod
    def design(cls, plant, period, p):
        return cls(p["effort_limit"], p["set_point"])

    def command(self, t, x):
        return self.clamp(-40.0 * self.error(x[0]) - 2.0 * x[1])
"""


def test_a_controller_that_is_added_to_the_table_is_on_the_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plugged_in.py").write_text(MINE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(CONTROLLERS, "mine", Row("plugged_in:Mine"))
    assert "mine" in contenders()
    out = tmp_path / "board"
    arguments = ["leaderboard", "--plants", "thesis", "--controllers", "mine,lqr", "--no-robustness"]
    assert main([*arguments, "--duration", "6", "--workers", "1", "--out", str(out)]) == 0
    rows = {row["controller"]: row for row in json.loads((out / "leaderboard.json").read_text(encoding="utf-8"))}
    assert rows["mine"]["success"]
    assert rows["mine"]["scores"]["v2"] != rows["lqr"]["scores"]["v2"]
    page = (out / "leaderboard.html").read_text(encoding="utf-8")
    assert 'id="thesis-mine"' in page
    assert main([*arguments[:3], "--controllers", "mein"]) == 2


def test_a_policy_file_is_on_the_board_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = write_policy(tmp_path / "learned.npz", linear_policy(load_plant("thesis"), 60.0, 1.0))
    out = tmp_path / "board"
    arguments = ["leaderboard", "--plants", "thesis", "--no-robustness", "--duration", "6", "--workers", "1"]
    assert main([*arguments, "--controllers", f"{policy},lqr", "--out", str(out)]) == 0
    rows = {row["controller"]: row for row in json.loads((out / "leaderboard.json").read_text(encoding="utf-8"))}
    assert set(rows) == {"learned", "lqr"}
    assert rows["learned"]["success"]
    assert main([*arguments, "--controllers", f"{policy},{policy}"]) == 2
    assert "shares its name with another" in capsys.readouterr().err
    assert main([*arguments, "--controllers", str(tmp_path / "none.npz")]) == 2


@in_repository
def test_a_recorded_run_of_the_machine_is_scored_as_a_simulated_one_is() -> None:
    example = PROJECT / "bags" / "examples" / "regulation_hw"
    arrays = arrays_of_bag(example, "/hw")
    assert arrays.stamp_ns.size == arrays.applied.size + 1
    success, uptime, costs = costs_of(arrays)
    assert success
    assert uptime == 1.0
    assert costs["time"] == 0.0
    with read_bag(example) as bag:
        assert costs["max_torque"] == np.abs(bag.array("/hw/applied_effort")["effort"]).max()
    assert set(HARDWARE_PERTURBATIONS) <= set(PERTURBATIONS)


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    entries = [evaluate("thesis", name, duration=4.0, robustness=False) for name in ("lqr", "pid")]
    return write_page(tmp_path_factory.mktemp("board") / "board.html", entries, 4.0)


def test_page_stands_alone_and_every_row_has_its_run(board: Path) -> None:
    text = board.read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:|#)', text)
    for anchor in re.findall(r'href="#([^"]+)"', text):
        assert f'id="{anchor}"' in text


@pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
def test_page_sorts_in_a_browser_without_an_error_and_opens_the_run_of_a_row(board: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"])
        for width in (1280, 390):
            page = browser.new_context(viewport={"width": width, "height": 900}, offline=True).new_page()
            messages: list[str] = []
            page.on("console", lambda message, told=messages: told.append(message.text))
            page.on("pageerror", lambda error, told=messages: told.append(str(error)))
            page.goto(board.resolve().as_uri())
            names = page.locator("tbody th")
            button = page.locator("thead button").first
            button.press("Enter")
            down = names.all_inner_texts()
            button.press("Enter")
            assert names.all_inner_texts() == down[::-1]
            page.locator("tbody a").first.click()
            page.locator("details[open] img").wait_for(timeout=5000)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert messages == []
        browser.close()
