"""Rankings against their definitions, and what is said of pairs in the wrong order."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pendulum_bags.commands.ranking_cli import main
from pendulum_bags.distributions import Interval
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.ranking.collect import collect_contenders, cost_parts
from pendulum_bags.ranking.contender import Contender, compared_runs, contenders_of
from pendulum_bags.ranking.present import same_choice, write_ranking
from pendulum_bags.ranking.ranking import Ranking, mmrv, rank
from pendulum_bags.verdict import Layer, Mark
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.reader.mcap_source import McapSource
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.policies import linear_policy
from pendulum_testing.synthetic_runs import regulate, run_metadata, write_bag, write_events_and_torque

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


def test_a_simulation_that_orders_all_is_reported_so():
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


def test_few_rankings_of_equal_controllers_name_a_pair_that_is_surely_in_the_wrong_order():
    generator = np.random.default_rng(8)
    named = 0
    for _ in range(60):
        hw = np.exp(0.15 * generator.normal(size=(6, 3, 1)))
        named += any(pair.sure for pair in rank([Contender(f"{i}", np.array([[i]]), hw[i]) for i in range(6)]).wrong)
    assert named <= 7


def test_a_controller_that_fails_on_the_hardware_alone_is_the_dearest_pick():
    fails = contender("wild", 0.5, 1.0)
    fails = Contender("wild", fails.sim, fails.hw[:0], 0, 4)
    found = rank([fails, contender("a", 1.0, 1.0), contender("b", 2.0, 2.0), contender("c", 3.0, 3.0)])
    assert found.failures == ["wild"]
    assert found.wrong[0].reason == "wild fails on the hardware"
    assert same_choice(found).mark is Mark.NO
    json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.parametrize("fell", [1, 3])
def test_a_pick_that_falls_on_the_hardware_is_a_no_however_near_the_others_are(fell, tmp_path):
    wild = contender("wild", 0.8, 1.0)
    wild = Contender("wild", wild.sim, wild.hw[: 3 - fell], 0, fell)
    others = [contender(name, cost, cost) for name, cost in (("a", 1.0), ("b", 1.01), ("c", 1.02))]
    found = rank([wild, *others])
    layer = same_choice(found)
    assert layer.mark is Mark.NO
    assert layer.sentence.startswith(f"The simulation picks wild, which fails on the hardware in {fell} of 3 runs.")
    assert layer.reason.endswith(f"picked wild, which fails on the hardware in {fell} of 3 runs")
    assert layer.evidence[0].estimate is None
    assert same_choice(replace(found, regret_share=Interval(0.0, 0.0, 0.0))).mark is Mark.NO
    assert found.to_json()["regret_share"] == {"value": None, "low": None, "high": None}
    json.dumps(layer.to_json(), allow_nan=False)
    text = write_ranking(tmp_path, found, formats=("png",)).read_text(encoding="utf-8")
    assert f"fails on the hardware in {fell} of 3 runs" in text


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("side", ["sim", "hw"])
def test_a_cost_that_is_no_number_is_refused_and_not_taken_for_a_failure(value, side):
    costs = {name: {at: [(7, np.ones(3)), (4, np.ones(3))] for at in ("sim", "hw")} for name in ("a", "b", "c")}
    costs["b"][side][0] = (7, np.array([1.0, value, 1.0]))
    with pytest.raises(DataError, match=rf"the cost of b on {side} under seed 7 is angle 1, velocity {value:g}, torq"):
        rank(contenders_of(costs))
    bare = [contender(name, 1.0, 1.0) for name in "abc"]
    getattr(bare[2], side)[1, 0] = value
    with pytest.raises(DataError, match=rf"the cost of c on {side} in run 2 of 4 is angle"):
        rank(bare)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("runs", [1, 4])
def test_a_best_that_costs_nothing_makes_any_other_pick_a_no(runs, tmp_path):
    idle = Contender("idle", np.full((runs, 3), 2.0), np.zeros((runs, 3)))
    others = [contender("picked", 2.0, 2.05, runs=runs), contender("last", 3.0, 3.0, runs=runs)]
    layer = same_choice(found := rank([idle, *others]))
    assert (found.pick, found.best, found.regret_share.low) == ("picked", "idle", np.inf)
    assert layer.mark is Mark.NO
    assert "not idle: a regret without bound, since idle costs nothing on the hardware" in layer.sentence
    assert layer.reason.endswith("picked picked, though idle costs nothing on the hardware")
    json.dumps([found.to_json(), layer.to_json()], allow_nan=False)
    write_ranking(tmp_path, found, formats=("png",))


@pytest.mark.filterwarnings("error")
def test_a_pick_that_costs_nothing_has_no_regret():
    others = [contender("a", 2.0, 2.0), contender("b", 3.0, 3.0)]
    found = rank([Contender("idle", np.zeros((4, 3)), np.zeros((4, 3))), *others])
    assert (found.regret.value, found.regret.high) == (0.0, 0.0)
    assert same_choice(found).mark is Mark.YES
    once = same_choice(rank([Contender("idle", np.zeros((4, 3)), np.zeros((1, 3))), *others]))
    assert once.mark is Mark.UNDECIDED
    assert "no interval: idle ran once on the hardware" in once.sentence


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
        Contender(name, *(np.column_stack([share * seeds, np.zeros((3, 2))]) for _ in range(2)), hw_seeds=(1, 2, 3))
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


def test_it_says_who_ran_once_where_that_takes_the_interval():
    contenders = campaign(np.random.default_rng(1), 6)
    once = [Contender(one.name, one.sim, one.hw[:1]) for one in contenders]
    layer = same_choice(rank([once[0], contenders[1], contenders[2], once[3]]))
    assert layer.mark is Mark.UNDECIDED
    assert "no interval: picked, the pick, ran once on the hardware, and so did last)" in layer.sentence
    assert layer.reason.endswith("has no interval: picked, the pick, ran once on the hardware, and so did last")


def costing(name: str, sim: float, hw: Sequence[float], seeds: Sequence[int] = ()) -> Contender:
    """Return a contender with given costs on the hardware."""
    rows = [np.column_stack([costs, np.zeros((len(costs), 2))]) for costs in ([sim, sim], hw)]
    return Contender(name, *rows, hw_seeds=tuple(seeds))


PICKED, BEST = [1.30, 1.10, 1.24, 1.16, 1.20], [1.02, 0.95, 1.03]
FAR = [costing("far", 5.0, [50.0, 51.0]), costing("farther", 6.0, [60.0, 61.0])]
"""Contenders that cost so much more on the hardware that the pick's regret is against the best alone."""


def limits(found: Ranking) -> tuple[float, float]:
    """Return the ends of the regret, as logarithms of ratios."""
    return math.log1p(found.regret_share.low), math.log1p(found.regret_share.high)


def test_the_limits_of_independent_runs_are_those_of_welch():
    found = rank([costing("picked", 1.0, PICKED), costing("best", 2.0, BEST), *FAR])
    own, other = (np.array(costs) / np.mean(costs) for costs in (PICKED, BEST))
    test = stats.ttest_ind(own, other, equal_var=False)
    ratio = math.log(np.mean(PICKED) / np.mean(BEST))
    # Three others: the lower limit is corrected for three comparisons, the upper one for none.
    expected = test.confidence_interval(1.0 - 0.05 / 3.0).low, test.confidence_interval(0.95).high
    assert limits(found) == pytest.approx([ratio + end for end in expected], rel=1e-9)


def test_the_limits_of_pairs_are_those_of_their_differences():
    seeds = (3, 1, 9)
    picked = [1.60, 1.40, 1.55]
    found = rank([costing("picked", 1.0, picked, seeds), costing("best", 2.0, BEST, seeds), *FAR])
    own, other = (np.array(costs) / np.mean(costs) for costs in (picked, BEST))
    test = stats.ttest_rel(own, other)
    ratio = math.log(np.mean(picked) / np.mean(BEST))
    expected = test.confidence_interval(1.0 - 0.05 / 3.0).low, test.confidence_interval(0.95).high
    assert limits(found) == pytest.approx([ratio + end for end in expected], rel=1e-9)


def test_a_pick_that_ran_once_is_predicted_from_the_scatter_of_the_other():
    found = rank([costing("picked", 1.0, [1.5]), costing("best", 2.0, BEST), *FAR])
    scatter = np.std(np.array(BEST) / np.mean(BEST), ddof=1)
    # A new run and the mean of n: the variances of both count, 1 + 1/n (prediction interval).
    deviation = scatter * math.sqrt(1.0 + 1.0 / 3.0)
    ratio = math.log(1.5 / np.mean(BEST))
    expected = [ratio - stats.t.ppf(1.0 - 0.025 / 3.0, 2) * deviation, ratio + stats.t.ppf(0.975, 2) * deviation]
    assert limits(found) == pytest.approx(expected, rel=1e-9)


def test_runs_that_repeat_one_cost_show_no_scatter_and_are_not_said_to_be_one():
    equal = {name: np.full((2, 1), cost) for name, cost in (("a", 1.0), ("b", 2.0), ("c", 3.0))}
    found = rank([Contender(name, costs, costs[::-1]) for name, costs in equal.items()])
    assert np.isnan(found.regret_share.high)
    assert found.no_interval == "a, the pick, had one and the same cost in all runs on the hardware, and so did b, c"


def test_a_pick_is_made_under_other_noise_than_judges_it_or_has_a_wider_limit():
    def campaign(seeds):
        sim = [*np.full((3, 1), 5.0), *np.full((3, 1), 0.5)]
        rows = [np.pad(np.array(sim[: len(seeds)]), ((0, 0), (0, 2))), np.full((len(seeds), 3), 1.0)]
        judged = [np.diag([1.1, 1.0, 1.2]), np.diag([1.0, 1.05, 1.0])]
        judged = [np.pad(one.sum(axis=1)[:, None], ((0, 0), (0, 2))) for one in judged]
        both = [
            Contender(name, own, theirs, sim_seeds=seeds, hw_seeds=(1, 2, 3))
            for name, own, theirs in zip("ab", rows, judged, strict=True)
        ]
        return rank([*both, *FAR])

    # Under the hardware's noise "b" is cheaper in simulation, under other noise "a".
    assert campaign((1, 2, 3)).pick == "b"
    assert campaign((1, 2, 3, 11, 12, 13)).pick == "a"
    assert not campaign((1, 2, 3, 11, 12, 13)).failures  # of those without seeds
    own, shared = campaign((11, 12, 13)).regret_share, campaign((1, 2, 3)).regret_share
    assert own.value == shared.value == 0.0
    assert 3.0 * own.high < shared.high


def test_scores_under_shared_noise_have_a_wider_limit_too():
    def limit(seeds):
        values = {"a": [2.0, 2.1, 1.9], "b": [1.97, 2.12, 1.95], "far": [0.5, 0.6, 0.7]}
        rows = {name: -np.array(scores)[:, None] for name, scores in values.items()}
        both = [Contender(name, one, one, sim_seeds=seeds, hw_seeds=(1, 2, 3)) for name, one in rows.items()]
        return rank(both, of_scores=True).regret_share.high

    # The tail of Student's t at 0.25 % and two degrees of freedom is 3.3 times as far as at 2.5 %.
    assert 3.0 * limit((11, 12, 13)) < limit((1, 2, 3)) < 1.0


def test_runs_are_pairs_by_their_seeds_and_not_by_their_number():
    noise = {1: 1.0, 2: 2.0, 3: 5.0, 4: 2.0, 5: 3.0, 6: 6.0, 7: 9.0}
    a = costing("a", 1.0, [noise[seed] for seed in (1, 2, 3)], (1, 2, 3))
    shared = costing("b", 2.0, [1.05 * noise[seed] for seed in (1, 2, 3, 7)], (1, 2, 3, 7))
    others = costing("b", 2.0, [1.05 * noise[seed] for seed in (4, 5, 6)], (4, 5, 6))
    far = [costing("c", 3.0, [90.0, 91.0]), costing("d", 4.0, [90.0, 91.0])]
    # Four runs and three share three seeds, under which a is better each time.
    assert rank([a, shared, *far]).regret_share.high == 0.0
    # As many runs under other seeds are no pairs: the noise of the seeds hides who is better.
    assert rank([a, others, *far]).regret_share.high > 0.5
    for seeds, sure in (((1, 2, 3, 7), True), ((4, 5, 6), False)):
        dearer = [noise[seed] + 0.5 + 0.01 * seed for seed in seeds]
        (pair,) = rank([a, costing("b", 0.1, dearer, seeds), *far]).wrong
        assert (pair.picked, pair.sure) == ("b", sure)


def test_a_seed_that_was_repeated_counts_once():
    own = costing("a", 1.0, [1.0, 3.0, 2.5], (1, 1, 2))
    other = costing("b", 2.0, [4.0, 2.0], (2, 1))
    first, second, paired = compared_runs(own, other)
    assert paired
    np.testing.assert_allclose(first, [2.0, 2.5])
    np.testing.assert_allclose(second, [2.0, 4.0])


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Return a folder of bags in which ``lqr`` fell under seed 2 on the hardware, and a bag of something else."""
    for name in ("lqr", "pid", "lqi"):
        for side in ("sim", "hw"):
            for seed in (1, 2):
                metadata = run_metadata(seed)
                metadata["pendulum.run"].update(controller={"kind": name}, side=side)
                columns = regulate(rate=100, seed=seed, duration=0.5, hardware=side == "hw")
                if (name, side, seed) == ("lqr", "hw", 2):
                    columns["position"] += 1.0
                write_bag(tmp_path / f"{name}_{side}_{seed}", columns, f"/{side}", metadata=metadata, ramps=False)
    write_events_and_torque(tmp_path / "other", "/hw", [], lambda _t: 0.0, 0.1)
    return tmp_path


def test_a_damaged_recording_is_named_and_not_left_out(recorded, capsys):
    fallen = {one.name: one.hw_failed for one in collect_contenders([recorded])[0]}
    assert fallen == {"lqr": 1, "pid": 0, "lqi": 0}
    (file,) = (recorded / "lqr_hw_2").glob("*.mcap")
    chunk = McapSource(file).chunks[0]
    content = bytearray(file.read_bytes())
    content[chunk.data_start + chunk.data_size - 3] ^= 1
    file.write_bytes(content)
    assert main([str(recorded)]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "1 of 12 recordings cannot be ranked" in told
    assert "lqr_hw_2" in told
    assert "is damaged" in told
    # What a repair could not save is no success either; the broken bag that it keeps is no second run.
    repair_bag(recorded / "lqr_hw_2")
    assert (recorded / "lqr_hw_2.broken").is_dir()
    with pytest.raises(DataError, match=r"1 of 12 recordings cannot be ranked, .*lqr_hw_2 has 0 states"):
        collect_contenders([recorded])
    # A run of which nothing but its record is left.
    metadata = run_metadata(3)
    metadata["pendulum.run"].update(controller={"kind": "lqr"}, side="hw")
    with BagWriter(recorded / "empty", metadata=metadata) as bag:
        bag.add_topic("/hw/joint_states", "sensor_msgs/msg/JointState")
    # A recorder that was killed: the end is missing, and with it perhaps the fall.
    (file,) = (recorded / "pid_hw_1").glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])
    (file.parent / "metadata.yaml").unlink()
    with pytest.raises(DataError, match=r"3 of 13 recordings cannot be ranked, .*empty has 0 states.*pid_hw_1"):
        collect_contenders([recorded])


def test_a_recording_whose_angle_is_no_number_is_no_success(recorded):
    metadata = run_metadata(5)
    metadata["pendulum.run"].update(controller={"kind": "lqr"}, side="hw")
    columns = regulate(rate=100, seed=5, duration=0.5, hardware=True)
    columns["position"][20] = np.nan
    write_bag(recorded / "blind", columns, "/hw", metadata=metadata, ramps=False)
    with pytest.raises(DataError, match=r"1 of 13 recordings .*blind: position is nan"):
        collect_contenders([recorded])


def test_weights_that_are_no_weights_are_refused(tmp_path):
    with pytest.raises(ParameterError, match="weights are 100, nan, -1; expected finite ones >= 0"):
        collect_contenders([tmp_path], (100.0, float("nan"), -1.0))


def test_a_record_of_a_study_that_cannot_be_read_is_named(tmp_path):
    metrics = {"ise": None, "rms_velocity": 1.0, "effort_energy": 1.0, "success": 1.0}
    nothing = {"status": "done", "labels": {"controller": "lqr"}, "metrics": metrics}
    for number, content in (("1", "{"), ("2", '{"status": "done"}'), ("3", json.dumps(nothing))):
        (tmp_path / number).mkdir()
        (tmp_path / number / "spec.json").write_text(json.dumps(RunSpec(side="hw", seed=1).to_json()))
        (tmp_path / number / "run.json").write_text(content)
    with pytest.raises(DataError, match=r"3 of 3 recordings .*the cost of lqr on hw under seed 1 is no finite number"):
        collect_contenders([tmp_path])


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
    contenders, _ = collect_contenders([tmp_path])
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


def test_two_policies_of_one_file_name_are_two_and_named_by_their_files(tmp_path):
    plant = load_plant("thesis")
    for number, gains in enumerate(((33.0, 1.0), (20.0, 1.0), (50.0, 2.0))):
        # Trained anew, to the same file: the record tells them apart.
        path = write_policy(tmp_path / "trained.npz", linear_policy(plant, *gains))
        for side in ("sim", "hw"):
            spec = RunSpec(side=side, controller="policy", controller_parameters={"policy": str(path)})
            columns = regulate(rate=100, seed=1, duration=0.5, hardware=side == "hw")
            bag = tmp_path / f"{side}_{number}"
            write_bag(bag, columns, f"/{side}", metadata=spec.metadata(), ramps=False)
    names = {one.name for one in collect_contenders([tmp_path])[0]}
    assert len(names) == 3
    assert all(name.startswith("policy trained (file=") and str(tmp_path) not in name for name in names)


def test_the_lost_score_of_a_pick_that_scores_nothing_has_an_interval():
    """The best scores 0.4 in the mean: neither is all of it surely lost, nor is the rest of its score known better."""
    best = [0.45, 0.3, 0.5, 0.35]
    rows = {"pick": [0.0, 0.0, 0.0, 0.0], "best": best, "other": [0.2, 0.1, 0.1, 0.2]}
    seeds = {"pick": (1, 2, 3, 4), "best": (5, 6, 7, 8), "other": (9, 10, 11, 12)}
    both = [
        Contender(name, np.array([[-float(name == "pick")]]), -np.array(row)[:, None], 0, 0, (0,), seeds[name])
        for name, row in rows.items()
    ]
    found = rank(both, of_scores=True)
    error = np.std(best, ddof=1) / 2.0
    # Student's t of three degrees of freedom at 1.25 % (two rivals) and at 2.5 %.
    assert (found.pick, found.regret.value) == ("pick", pytest.approx(0.4))
    assert (found.regret.low, found.regret.high) == pytest.approx(
        (0.4 - 4.1765 * error, 0.4 + 3.1824 * error), rel=1e-3
    )
