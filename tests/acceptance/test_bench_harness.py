"""The benchmark harness tells what was measured, what a peer did, and what could not be measured."""

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path

import pytest

from pendulum_learning.task import VARIED
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant
from tests.benchmarks import Peer, Row, bench_learn, measured, peer, run
from tests.benchmarks.limit_loop import build_limit


def test_a_ratio_above_one_always_means_that_we_are_better() -> None:
    faster = measured("speed", 8.0, "1/s", peer=peer("them", lambda: 2.0), at_least_times_peer=4.0)
    assert (faster.ratio, faster.holds, faster.target) == (4.0, True, ">= 4 x them")
    shorter = measured("time", 2.0, "s", peer=peer("them", lambda: 8.0), at_most=1.0)
    assert (shorter.ratio, shorter.holds, shorter.target) == (4.0, False, "<= 1 s")


def test_a_limit_is_a_peer_that_ours_may_cost_so_much_more_than() -> None:
    limit = peer("the limit", lambda: 10.0)
    row = measured("cost", 12.5, "%", peer=limit, at_most_times_peer=1.2)
    assert (row.ratio, row.holds, row.target) == (0.8, False, "<= 1.2 x the limit")
    assert measured("cost", 11.5, "%", peer=limit, at_most_times_peer=1.2).holds is True
    assert measured("cost", 11.5, "%", peer=Peer("the limit", None), at_most_times_peer=1.2).holds is None


def test_the_loop_in_c_says_why_it_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="no C compiler is installed"):
        build_limit(tmp_path)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler is installed")
def test_the_loop_in_c_compiles_against_the_headers_that_came_with_rclpy(tmp_path: Path) -> None:
    library = build_limit(tmp_path)
    assert {b"run_plant", b"run_answerer"} <= set(library.read_bytes().split(b"\0"))


def test_a_missing_peer_is_reported_and_leaves_the_verdict_open() -> None:
    def absent() -> float:
        importlib.import_module("no_such_library_of_anyone")

        return 1.0

    row = measured("speed", 8.0, "1/s", peer=peer("them", absent), at_least_times_peer=4.0)
    assert row.ratio is None
    assert row.holds is None
    assert row.note.startswith("them is not installed: ")


def test_a_peer_that_fails_does_not_hide_a_target_of_ours_that_is_missed() -> None:
    theirs = peer("them", lambda: 1.0 / 0.0)
    row = measured("speed", 8.0, "1/s", peer=theirs, at_least=9.0, at_least_times_peer=4.0)
    assert row.holds is False
    assert "them failed: ZeroDivisionError" in row.note


def test_a_figure_that_is_not_finite_never_holds() -> None:
    assert measured("speed", float("nan"), "1/s").holds is False


def test_measuring_one_area_again_keeps_the_rows_of_the_others() -> None:
    old = [{"area": "bags", "what": "a"}, {"area": "sim", "what": "b"}]
    assert run.merge(old, [{"area": "bags", "what": "c"}]) == [
        {"area": "bags", "what": "c"},
        {"area": "sim", "what": "b"},
    ]


def test_an_area_that_breaks_becomes_a_row_and_an_exit_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "RESULTS", tmp_path / "build" / "bench.json")
    monkeypatch.setattr(run, "areas", lambda: ["absent_area"])
    assert run.main([]) == 1
    (row,) = json.loads(run.RESULTS.read_text())
    assert row["holds"] is False
    assert "absent_area" in row["note"]
    assert {"area", "what", "ours", "peer", "ratio", "target", "holds"} <= set(row)
    assert "absent_area" in capsys.readouterr().out


def test_an_unknown_area_is_refused_with_the_known_ones(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run, "areas", lambda: ["sim"])
    with pytest.raises(SystemExit):
        run.main(["--only", "simm"])
    assert "area is 'simm'; expected one of sim" in capsys.readouterr().err


def test_a_table_has_a_line_for_each_row() -> None:
    assert run.table([Row(what="speed", unit="1/s", ours=1.0, area="sim")]).row_count == 1


def test_a_stand_in_of_a_machine_is_late_and_a_little_off_and_its_equal_frictions_stay_equal() -> None:
    plant = load_plant("dfki").with_values(coulomb_friction=0.09, static_friction=0.09)
    found = [bench_learn._surrogate(plant, seed) for seed in range(1, 201)]
    for each in found:
        assert isinstance(each, PlantParameters)
        assert each.transport_delay == 0.004
        assert each.static_friction == each.coulomb_friction
    shares = [each.value(name) / plant.value(name) for each in found for name in VARIED if plant.value(name)]
    assert 0.95 <= min(shares) < 0.96
    assert 1.04 < max(shares) <= 1.05
