"""What the console knows of the folders that its programs write, and where it refuses to listen."""

import json
import os
import socket
from pathlib import Path

import pytest

from pendulum_console.console.console_node import main
from pendulum_console.console.jobs import Jobs, NewestPage
from pendulum_msgs_py.errors import FaultError
from pendulum_testing.fixtures import wait_for


def test_the_newest_page_of_a_kind_is_found_among_all_runs(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path)
    assert jobs.newest("frequency_response.html") is None
    for name, written in (("b_first", 100.0), ("a_last", 200.0), ("c_other", 300.0)):
        page = tmp_path / name / ("report.html" if name == "c_other" else "frequency_response.html")
        page.parent.mkdir()
        page.touch()
        os.utime(page, (written, written))
    assert jobs.newest("frequency_response.html") == tmp_path / "a_last"
    assert Jobs(tmp_path / "missing").newest("frequency_response.html") is None


def test_the_newest_page_has_changed_when_it_is_another_or_was_written_again_or_has_gone(tmp_path: Path) -> None:
    newest = NewestPage(Jobs(tmp_path), "summary.json")
    assert not newest.changed()
    pages = [tmp_path / name / "summary.json" for name in ("first", "second")]
    for written, page in ((100.0, pages[0]), (200.0, pages[1]), (300.0, pages[0])):
        page.parent.mkdir(exist_ok=True)
        page.touch()
        os.utime(page, (written, written))
        assert newest.changed()
        assert not newest.changed()
        assert (newest.folder, newest.written) == (page.parent, written)
    for page in pages:
        page.unlink()
    assert newest.changed()
    assert newest.folder is None


def test_a_port_that_is_taken_is_refused_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert main(["--port", str(port), "--runs", str(tmp_path)]) == 2
    assert f"port is {port}, which another program listens on; expected a free one" in capsys.readouterr().err
    assert main(["--host", "nowhere.invalid", "--runs", str(tmp_path)]) == 2
    assert "host is 'nowhere.invalid', which is no address of this machine" in capsys.readouterr().err


def test_the_answer_of_a_run_is_its_sentence_and_what_each_layer_says_with_a_sign(tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    from pendulum_bags.verdict.layers import Layer, LayerResult, Mark, sum_up
    from pendulum_console.console.layers_card import read_answer

    answer = sum_up([LayerResult(Layer.SAME_RUN, Mark.NO, "It answers 9 ms later.", [])])
    (tmp_path / "summary.json").write_text(json.dumps({"answer": answer.to_json()}), encoding="utf-8")
    found = read_answer(tmp_path)
    assert found["sentence"] == answer.sentence
    assert len(found["layers"]) == len(Layer)
    assert found["layers"][0] == ("same run", "✗ no", "It answers 9 ms later.")
    assert {sign for _, sign, _ in found["layers"][1:]} == {"– not measured"}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"answer": null}', '{"answer": {"layers": [{"mark": "perhaps"}]}}'])
def test_a_summary_without_an_answer_shows_none(text: str, tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    from pendulum_console.console.layers_card import read_answer

    assert read_answer(tmp_path) == {}
    (tmp_path / "summary.json").write_text(text, encoding="utf-8")
    assert read_answer(tmp_path) == {}


def test_controllers_are_offered_that_fit_the_plant_and_need_no_file(tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    from pendulum_console.console.controller_choice import offered

    assert offered("acrobot") == [
        "lqr",
        "lqi",
        "lqg",
        "discrete_lqr",
        "energy_swing_up",
        "tvlqr",
        "ilqr",
        "mpc",
        "nmpc",
    ]
    for plant in ("", "thesis", str(tmp_path / "of_another_machine.yaml")):
        assert {"lqr", "pid", "energy_swing_up"} <= set(offered(plant))
        assert not {"policy", "playback"} & set(offered(plant))


def test_a_disturbance_that_is_started_waits_and_ends_with_its_console(tmp_path: Path, domain_id: int) -> None:
    jobs = Jobs(tmp_path)
    job = jobs.disturb("/sim")
    wait_for(lambda: "ready" in job.log.read_text(encoding="utf-8"), 200, "the disturbance")
    assert "noise_start" not in job.log.read_text(encoding="utf-8")
    with pytest.raises(FaultError, match="disturb/sim runs already"):
        jobs.disturb("/sim")
    jobs.close()
    assert not job.running
