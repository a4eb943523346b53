"""Rankings against their definitions, and what is said of pairs in the wrong order."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.ranking.collect import collect_contenders, cost_parts
from pendulum_bags.ranking.present import same_choice, write_ranking
from pendulum_bags.ranking.ranking import Contender, contenders_of, mmrv, rank
from pendulum_bags.ranking.ranking_cli import main
from pendulum_bags.verdict import Layer, Mark
from pendulum_msgs_py.errors import DataError

COSTS = st.lists(st.tuples(st.floats(0.1, 10.0), st.floats(0.1, 10.0)), min_size=3, max_size=8)


def contender(name: str, sim: float, hw: float, scatter: float = 0.01, runs: int = 4, part: int = 0) -> Contender:
    """Return a contender whose costs scatter by a share, all in one part."""
    spread = 1.0 + scatter * np.linspace(-1.0, 1.0, runs)
    rows = {}
    for side, cost in (("sim", sim), ("hw", hw)):
        rows[side] = np.full((runs, 3), 0.01)
        rows[side][:, part] = cost * spread - 0.02
    return Contender(name, rows["sim"], rows["hw"])


@given(COSTS)
@settings(deadline=None)
def test_mmrv_is_its_definition(costs):
    sim, hw = (np.array(column) for column in zip(*costs, strict=True))
    n = len(costs)
    expected = (
        sum(max(abs(hw[i] - hw[j]) * ((sim[i] > sim[j]) != (hw[i] > hw[j])) for j in range(n)) for i in range(n)) / n
    )
    assert mmrv(sim, hw) == pytest.approx(expected)
    assert mmrv(hw, hw) == 0.0


def test_a_simulation_that_orders_all_is_told_so():
    found = rank([contender(f"c{i}", cost, 1.1 * cost) for i, cost in enumerate((1.0, 2.0, 3.0, 5.0, 8.0))])
    assert found.srcc.value == pytest.approx(1.0)
    assert found.spearman == pytest.approx(1.0)
    assert (found.mmrv.value, found.regret.value, found.wrong) == (0.0, 0.0, [])
    assert same_choice(found).mark is Mark.YES
    assert same_choice(found).layer is Layer.SAME_CHOICE


def test_the_wrong_pair_is_named_with_its_reason_and_its_price():
    found = rank([contender("stiff", 1.0, 4.0, part=2), contender("soft", 2.0, 2.0), contender("slack", 6.0, 6.5)])
    (pair,) = found.wrong
    assert (pair.picked, pair.better, pair.sure) == ("stiff", "soft", True)
    assert pair.sim == pytest.approx(1.0)
    assert pair.hw == pytest.approx(2.0)
    assert pair.reason.startswith("the torque of stiff costs 0.98 in simulation and 3.98 on the hardware")
    assert (found.pick, found.best) == ("stiff", "soft")
    assert found.regret.value == pytest.approx(2.0)
    # stiff and soft are each in one wrong comparison of 2; slack is in none.
    assert found.mmrv.value == pytest.approx(4.0 / 3.0)
    layer = same_choice(found)
    assert layer.mark is Mark.NO
    assert "stiff before soft" in layer.sentence


def test_a_pair_within_the_scatter_of_its_runs_is_not_called_wrong_for_sure():
    generator = np.random.default_rng(3)
    close = [contender("a", 1.0, 1.01), contender("b", 1.01, 1.0), contender("c", 3.0, 3.0)]
    noisy = [Contender(one.name, one.sim, one.hw * generator.uniform(0.7, 1.3, size=(4, 1))) for one in close]
    assert not any(pair.sure for pair in rank(noisy).wrong)


def test_a_controller_that_fails_on_the_hardware_alone_is_the_dearest_pick():
    fails = contender("wild", 0.5, 1.0)
    fails = Contender("wild", fails.sim, fails.hw[:0], 0, 4)
    found = rank([fails, contender("a", 1.0, 1.0), contender("b", 2.0, 2.0), contender("c", 3.0, 3.0)])
    assert found.failures == ["wild"]
    assert found.wrong[0].reason == "wild fails on the hardware"
    assert same_choice(found).mark is Mark.NO
    json.dumps(found.to_json(), allow_nan=False)


def test_the_intervals_hold_the_truth_of_many_campaigns():
    generator = np.random.default_rng(0)
    true_sim = np.linspace(1.0, 4.0, 8)
    true_hw = true_sim + 0.3 * np.array([1, -1, 1, -1, 1, -1, 1, -1])
    regret = float(true_hw[0] - true_hw.min())
    held = 0
    for _ in range(24):
        contenders = [
            Contender(f"c{i}", *(np.column_stack([c * generator.normal(1.0, 0.05, 6), np.zeros((6, 2))]) for c in pair))
            for i, pair in enumerate(zip(true_sim, true_hw, strict=True))
        ]
        found = rank(contenders, generator)
        held += found.regret.low <= regret + 1e-9 <= found.regret.high + 1e-9 or found.regret.value == regret
    assert held >= 20


def test_a_noise_that_all_contenders_share_does_not_blur_the_choice():
    # Seeds differ by far more than the contenders do, but by the same for all: the pick is sure.
    seeds = np.array([1.0, 2.0, 5.0])
    contenders = [
        Contender(name, *(np.column_stack([share * seeds, np.zeros((3, 2))]) for _ in range(2)))
        for name, share in (("a", 1.0), ("b", 1.05), ("c", 1.2))
    ]
    found = rank(contenders)
    assert found.regret.high == 0.0
    assert same_choice(found).mark is Mark.YES


def campaign(generator: np.random.Generator, runs: int, scatter: float = 0.06) -> list[Contender]:
    """Return runs of contenders of which the simulation's pick costs exactly a tenth more than the best."""
    costs = {"picked": (1.0, 1.1), "best": (1.1, 1.0), "other": (1.5, 1.4), "last": (3.0, 2.5)}
    return [
        Contender(
            name,
            *(np.column_stack([cost * generator.normal(1.0, scatter, runs), np.zeros((runs, 2))]) for cost in pair),
        )
        for name, pair in costs.items()
    ]


def test_three_runs_on_the_margin_are_seldom_called_the_same_choice():
    generator = np.random.default_rng(3)
    wrong = sum(same_choice(rank(campaign(generator, 3), generator)).mark is Mark.YES for _ in range(60))
    assert wrong <= 0.05 * 60


def test_one_run_of_each_decides_nothing():
    found = rank(campaign(np.random.default_rng(1), 1))
    layer = same_choice(found)
    assert layer.mark is Mark.UNDECIDED
    assert "no interval: each controller ran once" in layer.sentence
    assert layer.next_steps == ("record more seeds: --seeds 10",)
    assert found.to_json()["regret"]["high"] is None
    json.dumps(layer.to_json(), allow_nan=False)


def test_a_contender_that_ran_once_does_not_take_the_interval_from_all():
    contenders = campaign(np.random.default_rng(1), 6)
    last = contenders[-1]
    found = rank([*contenders[:-1], Contender(last.name, last.sim, last.hw[:1])])
    assert 0.0 < found.regret_share.high < 1.0
    assert "95 % interval" in same_choice(found).sentence


def test_runs_of_a_study_and_a_folder_are_collected(tmp_path, capsys):
    metrics = {"ise": 0.01, "rms_velocity": 0.1, "effort_energy": 2.0, "success": 1.0}
    for side, factor in (("sim", 1.0), ("hw", 1.2)):
        for i, name in enumerate(("lqr", "pid", "lqi")):
            for seed in (1, 2):
                place = tmp_path / "runs" / f"{side}_{name}_{seed}"
                place.mkdir(parents=True)
                spec = RunSpec(side=side, controller=name, seed=seed)
                scaled = {key: factor * (1 + i) * value for key, value in metrics.items()}
                (place / "spec.json").write_text(json.dumps(spec.to_json()))
                record = {"status": "done", "labels": {"controller": name}, "metrics": scaled}
                (place / "run.json").write_text(json.dumps(record))
    contenders = collect_contenders([tmp_path])
    assert [one.name for one in contenders] == ["lqr", "lqi", "pid"] or len(contenders) == 3
    first = next(one for one in contenders if one.name == "lqr")
    np.testing.assert_allclose(first.parts("sim"), cost_parts(metrics, 5.0))
    assert main([str(tmp_path), "--out", str(tmp_path / "page"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pick"] == "lqr"
    assert "Ranking of controllers" in (tmp_path / "page" / "ranking.html").read_text(encoding="utf-8")
    assert (tmp_path / "page" / "layers" / "same_choice.json").is_file()


def test_too_little_is_refused(tmp_path):
    with pytest.raises(DataError, match="got 1 controllers with runs on both sides; expected at least 3"):
        rank([contender("a", 1.0, 1.0)])
    with pytest.raises(DataError, match="holds no runs"):
        collect_contenders([tmp_path])
    assert contenders_of({"a": {"sim": [(1, np.ones(3))], "hw": []}}) == []


def test_the_page_names_the_pairs(tmp_path):
    found = rank([contender("stiff", 1.0, 4.0), contender("soft", 2.0, 2.0), contender("slack", 6.0, 6.5)])
    text = write_ranking(tmp_path, found, formats=("png",)).read_text(encoding="utf-8")
    assert "Pairs in the wrong order" in text
