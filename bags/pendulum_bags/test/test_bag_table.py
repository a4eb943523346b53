"""Many bags, the same questions: rows as the single commands give them, kept answers, what cannot be asked."""

from __future__ import annotations

import csv
import re
import shutil
from pathlib import Path

import pytest
import zstandard

from pendulum_bags.analyse import bag_table
from pendulum_bags.analyse.bag_table import analyse_bags, find_pieces
from pendulum_bags.analyse.questions import timing
from pendulum_bags.commands.analyse_cli import main
from pendulum_bags.comparison import compare_runs
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.run_data import plant_summary, read_run
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.fixtures import PROJECT, in_repository

EXAMPLES = PROJECT / "bags" / "examples"
pytestmark = in_repository


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


def test_a_repeat_belongs_to_its_run_and_is_no_run_of_its_own(runs: Path, tmp_path: Path) -> None:
    for side in ("sim", "hw"):
        shutil.copytree(EXAMPLES / f"regulation_{side}", runs / "monday" / "repeats" / "1" / side)
        # A folder of that name that belongs to no run is one.
        shutil.copytree(EXAMPLES / f"regulation_{side}", runs / "other" / "repeats" / "1" / side)
    found = [piece.name for piece in find_pieces([runs], ["compare"])]
    assert found == ["monday", "other/repeats/1", "tuesday"]


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
    assert first.cached == 2
    again = analyse_bags(tmp_path / "out", pieces, ["metrics"])
    assert (again.cached, again.bags) == (5, first.bags)
    shutil.rmtree(runs / "wednesday")
    shutil.copytree(EXAMPLES / "regulation_sim", runs / "wednesday")
    mended = analyse_bags(tmp_path / "out", find_pieces([runs], ["metrics"]), ["metrics"])
    assert (mended.cached, mended.failed) == (4, 0)


def test_bags_of_one_name_have_rows_of_their_own(runs: Path, tmp_path: Path) -> None:
    def rows(*folders: Path) -> dict[str, str]:
        pieces = find_pieces(list(folders), ["timing"])
        return {piece.name: str(Path(piece.path).relative_to(runs.resolve())) for piece in pieces}

    assert rows(runs / "monday" / "sim", runs / "tuesday" / "sim") == {
        "monday/sim": "monday/sim",
        "tuesday/sim": "tuesday/sim",
    }
    shutil.copytree(runs / "monday", runs / "a" / "week" / "monday")
    shutil.copytree(runs / "monday", runs / "b" / "week" / "monday")
    assert list(rows(runs / "a" / "week", runs / "b" / "week").values()) == [
        f"{place}/week/monday/{side}" for place in "ab" for side in ("hw", "sim")
    ]
    # One bag that is named twice is one bag.
    assert list(rows(runs / "monday", runs / "monday" / "sim")) == ["monday/hw", "monday/sim"]
    assert [piece.name for piece in find_pieces([runs / "a" / "week", runs / "b" / "week"], ["compare"])] == [
        "a/week/monday",
        "b/week/monday",
    ]


@pytest.mark.parametrize("ending", [".mcap", ".db3"])
def test_bags_compressed_as_a_whole_are_asked_too(tmp_path: Path, ending: str) -> None:
    folder = tmp_path / "runs" / "packed"
    bag = read_bag(EXAMPLES / "regulation_sim")
    with BagWriter(folder, "mcap" if ending == ".mcap" else "sqlite3") as writer:
        for topic, info in bag.topics.items():
            writer.add_topic(topic, info.type)
            writer.write_many((topic, *row) for row in bag.raw(topic))
    (file,) = folder.glob(f"*{ending}")
    file.with_name(f"{file.name}.zstd").write_bytes(zstandard.compress(file.read_bytes()))
    file.unlink()
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(ending, f"{ending}.zstd"))
    table = analyse_bags(tmp_path / "out", find_pieces([tmp_path / "runs"], ["timing"]), ["timing"])
    assert [(row["bag"], row["error"], row["states_count"]) for row in table.bags] == [("packed", "", 2501)]


def test_a_bag_whose_files_are_gone_and_a_program_that_stumbles_have_rows_that_say_so(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file in (runs / "monday" / "hw").glob("*.mcap"):
        file.unlink()

    def stumble(reading: Reading, plant: str) -> dict[str, object]:
        if reading.path.parent.name == "tuesday":
            raise KeyError("noise")
        return {"fine": 1}

    monkeypatch.setattr(timing, "answer", stumble)
    table = analyse_bags(tmp_path / "out", find_pieces([runs / "monday", runs / "tuesday"], ["timing"]), ["timing"])
    assert [row["bag"] for row in table.bags] == ["monday/hw", "monday/sim", "tuesday/hw", "tuesday/sim"]
    assert "is no bag" in table.bags[0]["error"]
    assert table.bags[1]["fine"] == 1
    assert table.bags[3]["error"] == "KeyError: 'noise'"


def test_another_version_of_the_program_asks_again(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pieces = find_pieces([runs / "monday"], ["timing"])
    analyse_bags(tmp_path / "out", pieces, ["timing"])
    assert analyse_bags(tmp_path / "out", pieces, ["timing"]).cached == 2
    monkeypatch.setattr(bag_table, "program_hash", lambda: "another")
    assert analyse_bags(tmp_path / "out", pieces, ["timing"]).cached == 0


def test_answers_are_kept_by_all_packages_that_they_depend_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = Path(bag_table.__file__).parents[1]
    imported = {
        name
        for file in source.rglob("*.py")
        for name in re.findall(r"^\s*(?:from|import) (pendulum_\w+)", file.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert imported <= set(bag_table.ANSWERING)
    for package in bag_table.ANSWERING:
        (tmp_path / package).mkdir()
    monkeypatch.setattr(bag_table.resources, "files", lambda package: tmp_path / package)
    seen = [bag_table.program_hash.__wrapped__()]
    for changed in ("pendulum_lqr/design.py", "pendulum_bags/margins.yaml", "pendulum_sim/design.py"):
        (tmp_path / changed).write_text("x")
        seen.append(bag_table.program_hash.__wrapped__())
    assert len(set(seen)) == 4
    (tmp_path / "pendulum_lqr" / "design.pyc").write_bytes(b"x")
    assert bag_table.program_hash.__wrapped__() == seen[-1]


def test_what_cannot_be_asked_is_refused(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ParameterError, match="expected one of metrics, timing, identify, compare, report"):
        find_pieces([runs], ["matrix"])
    with pytest.raises(BagError, match="no run folder with the bags sim and hw in there"):
        find_pieces([EXAMPLES], ["compare"])
    assert main([str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    assert "does not exist; expected a folder of bags" in capsys.readouterr().err
    assert main([str(runs), "--ask", "metrics", "--out", str(tmp_path / "out")]) == 1
    assert "wednesday" in capsys.readouterr().out


def test_the_printed_table_has_units(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(EXAMPLES / "regulation_sim"), "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert not [unit for unit in ("rate [Hz]", "rms error [rad]", "max |u| [N m]") if unit not in text]
