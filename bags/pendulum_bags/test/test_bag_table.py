"""Many bags, the same questions: rows as the single commands give them, kept answers, what cannot be asked."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import pytest

from pendulum_bags.analyse.analyse_cli import main
from pendulum_bags.analyse.bag_table import analyse_bags, find_pieces
from pendulum_bags.comparison import compare_runs
from pendulum_bags.runs.run_data import plant_summary, read_run
from pendulum_msgs_py.errors import BagError, ParameterError

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Return a folder with two run folders and a bag that is none."""
    folder = tmp_path / "runs"
    for day in ("monday", "tuesday"):
        for side in ("sim", "hw"):
            shutil.copytree(EXAMPLES / f"regulation_{side}", folder / day / side)
    (folder / "wednesday").mkdir()
    (folder / "wednesday" / "broken.mcap").write_bytes(b"not a bag")
    return folder


def test_rows_hold_what_the_single_commands_say(runs: Path, tmp_path: Path) -> None:
    questions = ["metrics", "timing", "compare"]
    table = analyse_bags(tmp_path / "out", find_pieces([runs], questions), questions)
    assert [(row["bag"], row["plant"]) for row in table.bags] == [
        ("monday/hw", "/hw"),
        ("monday/sim", "/sim"),
        ("tuesday/hw", "/hw"),
        ("tuesday/sim", "/sim"),
        ("wednesday", ""),
    ]
    assert table.failed == 1
    assert "broken.mcap" in table.bags[-1]["error"]
    alone = plant_summary(read_run(EXAMPLES / "regulation_hw"))
    assert {name: table.bags[0][name] for name in ("std_theta", "max_abs_u", "rate_hz")} == {
        name: alone[name] for name in ("std_theta", "max_abs_u", "rate_hz")
    }
    verdict = compare_runs(EXAMPLES / "regulation_sim", EXAMPLES / "regulation_hw").verdict
    assert [row["outcome"] for row in table.runs] == [verdict.outcome.value] * 2
    with (tmp_path / "out" / "bags.csv").open(encoding="utf-8") as file:
        written = list(csv.DictReader(file))
    assert float(written[0]["std_theta"]) == alone["std_theta"]
    assert written[1]["controller"] == "lqr"


def test_interrupted_analysis_goes_on_and_a_changed_bag_is_asked_again(runs: Path, tmp_path: Path) -> None:
    pieces = find_pieces([runs], ["metrics"])

    def stop(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        analyse_bags(tmp_path / "out", pieces, ["metrics"], on_progress=stop)
    first = analyse_bags(tmp_path / "out", pieces, ["metrics"])
    assert first.kept == 2
    again = analyse_bags(tmp_path / "out", pieces, ["metrics"])
    assert (again.kept, again.bags) == (5, first.bags)
    shutil.rmtree(runs / "wednesday")
    shutil.copytree(EXAMPLES / "regulation_sim", runs / "wednesday")
    mended = analyse_bags(tmp_path / "out", find_pieces([runs], ["metrics"]), ["metrics"])
    assert (mended.kept, mended.failed) == (4, 0)


def test_what_cannot_be_asked_is_refused(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ParameterError, match="expected one of metrics, timing, identify, compare, report"):
        find_pieces([runs], ["matrix"])
    with pytest.raises(BagError, match="no run folder with the bags sim and hw in there"):
        find_pieces([EXAMPLES], ["compare"])
    assert main([str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    assert "does not exist; expected a folder of bags" in capsys.readouterr().err
    assert main([str(runs), "--ask", "metrics", "--out", str(tmp_path / "out")]) == 1
    assert "wednesday" in capsys.readouterr().out
