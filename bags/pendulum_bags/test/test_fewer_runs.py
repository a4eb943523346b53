"""Intervals that simulated runs narrow, where the truth is known."""

import json
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.ranking_cli import main
from pendulum_bags.ranking.contender import Contender
from pendulum_bags.ranking.fewer_runs import narrow, narrow_all
from pendulum_msgs_py.errors import DataError

TRIALS = 1500


@pytest.mark.parametrize("share", [0.95, 0.0], ids=["a simulation that tells much", "one that tells nothing"])
@pytest.mark.parametrize("pairs", [5, 12])
def test_the_truth_is_held_as_often_as_promised_and_the_interval_is_narrower(share: float, pairs: int) -> None:
    generator = np.random.default_rng(5)
    held, widths = np.zeros(2), np.zeros(2)
    for _ in range(TRIALS):
        # Costs are means of squares, so not normal; the simulation is biased by 40 % and scaled otherwise.
        seeds = generator.chisquare(8, pairs + 200) / 8
        own = generator.chisquare(8, pairs) / 8
        simulation = 0.6 * seeds
        hardware = share * seeds[:pairs] + (1.0 - share) * own
        found = narrow(hardware, simulation[:pairs], simulation[pairs:])
        for i, one in enumerate((found.alone, found.together)):
            held[i] += one.low <= 1.0 <= one.high
            widths[i] += one.high - one.low
    # 95 %, less what Student's t loses on skewed costs, with or without simulated runs.
    assert held[1] / TRIALS > min(0.935, held[0] / TRIALS - 0.01)
    assert (widths[1] / widths[0] < 0.35) if share else (widths[1] / widths[0] < 1.6)


def test_seeds_tell_which_runs_are_pairs_and_a_repeated_one_counts_once() -> None:
    def rows(costs: list[float]) -> np.ndarray:
        return np.column_stack([costs, np.zeros((len(costs), 2))])

    seeds = (1, 2, 3, 4, 5, 6, 7)
    sim = [1.0, 2.0, 1.5, 3.0, 2.5, 1.2, 2.8]
    one = Contender("lqr", rows(sim), rows([2.1, 3.0, 5.9, 3.1, 3.3, 5.2]), 0, 0, seeds, (1, 3, 4, 2, 2, 5))
    found = narrow_all([one])["lqr"]
    expected = narrow([2.1, 3.2, 3.0, 5.9, 5.2], [1.0, 2.0, 1.5, 3.0, 2.5], [1.2, 2.8])
    assert found.to_json() == expected.to_json()
    assert found.pairs == 5
    assert narrow_all([Contender("lqr", one.sim, one.hw)]) == {}
    with pytest.raises(DataError, match="got 3 hardware and 3 simulated runs"):
        narrow([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [1.0])


def test_the_command_narrows_emulated_hardware_only_when_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generator = np.random.default_rng(1)
    for i, name in enumerate(("lqr", "pid", "lqi")):
        for seed in range(1, 13):
            luck = 1.0 + 0.3 * generator.standard_normal()
            for side in ("sim", "hw")[: 1 if seed > 5 else 2]:
                ise = (0.01 + 0.002 * i) * luck * (1.2 + 0.01 * generator.standard_normal() if side == "hw" else 1.0)
                run = tmp_path / "runs" / f"{name}_{side}_{seed}"
                run.mkdir(parents=True)
                metrics = {"ise": ise, "rms_velocity": 0.1, "effort_energy": 2.0, "success": 1.0}
                told = {"status": "done", "labels": {"controller": name}, "metrics": metrics}
                (run / "run.json").write_text(json.dumps(told))
                (run / "spec.json").write_text(json.dumps({"side": side, "seed": seed, "duration": 5.0}))
    assert main([str(tmp_path), "--json"]) == 0
    assert "narrowed" not in json.loads(capsys.readouterr().out)
    assert main([str(tmp_path), "--use-simulation", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["narrowed"]
    assert (found["lqr"]["pairs"], found["lqr"]["further"]) == (5, 7)
    assert found["lqr"]["worth"] > 6.0
    assert main([str(tmp_path), "--use-simulation"]) == 0
    assert "with simulated runs" in capsys.readouterr().out
