"""The report: figures told once, files, and a page that needs nothing else."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message

from pendulum_bags.commands.report_cli import main
from pendulum_bags.comparison import Comparison, compare_folders
from pendulum_bags.figures import render_files
from pendulum_bags.figures.figure import ROLES, Figure, Panel, Trace, thinned
from pendulum_bags.figures.numbers import quantity, ratio_in_words
from pendulum_bags.figures.render_plotly import graphs_of
from pendulum_bags.figures.table import Table
from pendulum_bags.pages.terms import Terms
from pendulum_bags.report import FIGURES, write_report
from pendulum_bags.report.data import ReportData
from pendulum_bags.report.figures import comparison_figures, make_figures
from pendulum_bags.report.page import page_of
from pendulum_bags.report.provenance import emulator_table, provenance_table, settings_table
from pendulum_bags.report.tables import make_tables
from pendulum_bags.report.write import title_of
from pendulum_bags.verdict import Evidence, Layer, LayerResult, Mark, write_layer
from pendulum_bags.verdict.answer import answer_of
from pendulum_bags.verdict.naming import name_in
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.plants.plant_differences import PLANT_PARAMETERS, describe_plants
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.fixtures import PROJECT, in_repository
from pendulum_testing.npm import install_packages
from pendulum_testing.synthetic_runs import write_run_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run_folder(tmp_path_factory.mktemp("report") / "first", seed=1)


@pytest.fixture(scope="module")
def comparison(folder: Path) -> Comparison:
    return compare_folders([folder])


@pytest.fixture(scope="module")
def page(folder: Path, comparison: Comparison) -> Path:
    told = {"seed": 7, "strategy": "</script>"}
    return write_report(folder, told, comparison=comparison, recordings=[], formats=["png"])


def test_every_figure_has_units_a_sentence_from_the_data_and_known_roles(comparison: Comparison) -> None:
    figures = comparison_figures(comparison)
    assert len(figures) >= 14
    for figure in figures:
        assert re.search(r"\d", figure.sentence), figure.name
        assert "nan" not in figure.sentence.lower().split()
        for panel in figure.panels:
            assert panel.traces, figure.name
            numbered = [panel.x_label] if panel.y_ticks else [panel.x_label, panel.y_label]
            for label in numbered:
                assert re.search(r"\[.+\]|in margins|run", label), f"{figure.name}: {label}"
            assert {trace.role for trace in panel.traces} <= set(ROLES)


def test_curves_in_one_panel_differ_in_more_than_colour(comparison: Comparison) -> None:
    for figure in comparison_figures(comparison):
        for panel in figure.panels:
            looks = {}
            for trace in panel.traces:
                style = ROLES[trace.role]
                mark = style.marker if trace.kind in {"points", "interval"} else (style.dash, style.width)
                looks.setdefault((trace.kind, mark), set()).add(trace.label)
            assert all(len(labels) == 1 for labels in looks.values()), (figure.name, looks)


def test_a_figure_that_the_data_do_not_allow_says_why(comparison: Comparison) -> None:
    made, missing = make_figures(ReportData(comparison, comparison.to_json()))
    assert len(made) + len(missing) == len(FIGURES)
    assert dict(missing)["All runs"] == "needs at least two runs"


def test_provenance_tells_when_where_and_by_which_command_and_what_every_node_was_set_to(
    comparison: Comparison,
) -> None:
    told = {
        "pendulum.run": {"command": "python -m pendulum_bags experiment thesis"},
        "pendulum.recorder": {
            "started_ns": 1_795_309_798_590_099_724,
            "host": "bench",
            "system": "Linux-6",
            "rmw": "dds",
        },
        "pendulum.parameters": {"/sim/simulator": {"rate_hz": 500.0, "plant": "thesis"}},
    }
    pair = comparison.pairs[0]
    other = {"pendulum.recorder": {"host": "robot"}, "pendulum.parameters": {"/hw/bridge": {"velocity_limit": 1.5}}}
    pairs = [
        replace(
            pair, simulation=replace(pair.simulation, metadata=told), hardware=replace(pair.hardware, metadata=other)
        )
    ]
    data = ReportData(replace(comparison, pairs=pairs), {})
    rows = provenance_table(data).rows
    assert ("recorded", "2026-11-22 01:09 UTC") in rows
    assert "Pendulum maintainers (2026). " in dict(rows)["cite as"]
    assert ("command", "python -m pendulum_bags experiment thesis") in rows
    assert [value for what, value in rows if what == "computer"] == ["bench · Linux-6 · dds", "robot"]
    settings = settings_table(data)
    assert settings is not None
    assert settings.folded
    assert dict(settings.rows) == {
        "/sim/simulator": "plant 'thesis'; rate_hz 500.0",
        "/hw/bridge": "velocity_limit 1.5",
    }
    # A foreign bag may have anything under these names.
    strange = {"pendulum.recorder": "by hand", "pendulum.parameters": {"/a": 3}}
    pairs = [
        replace(
            each, simulation=replace(each.simulation, metadata=strange), hardware=replace(each.hardware, metadata={})
        )
        for each in pairs
    ]
    data = ReportData(replace(comparison, pairs=pairs), {})
    assert settings_table(data) is None
    assert not {"recorded", "command", "computer"} & {what for what, _ in provenance_table(data).rows}


def test_page_is_complete_in_itself_and_small(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < 3_400_000
    assert not re.search(r"(?:src|href)=\"(?:https?:)?//", text)
    assert "@import" not in text
    assert "url(" not in text.split("</style>")[0]
    for heading in (
        "Paired comparison",
        "Provenance",
        "Equivalence tests",
        "Eigenvalues of the linearised system",
    ):
        assert heading in text
    assert "2.687959" in text
    assert "This section shows run 1" not in text


def test_every_term_that_the_page_links_has_its_sentence_and_every_command_is_set_as_code(page: Path) -> None:
    text = page.read_text(encoding="utf-8").split('<script type="application/json"')[0]
    linked = set(re.findall(r'class="term" href="#(term-[a-z-]+)"', text))
    assert {
        "term-margin",
        "term-delay",
        "term-std",
        "term-ks",
        "term-jackknife",
        "term-long-run",
        "term-mean-end",
    } <= linked
    assert linked == set(re.findall(r'<div id="(term-[a-z-]+)"><dt>', text))
    assert "steady state" not in text  # nothing settles under noise
    assert "python -m" in text
    assert not re.search(r"(?<!<code>)python -m", text)
    assert "kg m²" in text
    assert not re.search(r"\^\d|>1/s|\[1/s\]", text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Not measured yet; to measure it: python -m a_b x.", "python -m pendulum_bags experiment ranking"),
        ("Identify (python -m a_b x), then simulate with --plant plant.yaml.", "python -m a_b x"),
    ],
)
def test_a_command_ends_where_its_sentence_goes_on(text: str, expected: str) -> None:
    text = text.replace("a_b x", "pendulum_bags experiment ranking")
    expected = expected.replace("a_b x", "pendulum_bags experiment ranking")
    assert f"<code>{expected}</code>" in Terms().mark(text)


def test_the_longest_name_of_a_term_wins_and_text_stays_text() -> None:
    marked = Terms().mark("<b> is not equivalent within the default margins")
    assert marked.startswith('&lt;b&gt; is <a class="term" href="#term-equivalent">not equivalent</a>')
    assert "standard deviation" not in Terms().mark("stdout")


def test_page_escapes_its_texts(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "&lt;/script&gt;" in text
    assert text.count("</script>") == 4


def test_plots_of_the_page_are_those_of_the_files(page: Path, comparison: Comparison) -> None:
    text = page.read_text(encoding="utf-8")
    found = re.search(r'id="graphs">(.*?)</script>', text, re.DOTALL)
    assert found
    graphs = json.loads(found.group(1))
    names = {figure.name for figure in comparison_figures(comparison)}
    assert {name.rsplit("-", 1)[0] for name in graphs} == names | {"lead"}
    assert {path.stem for path in (page.parent / "figures").glob("*.png")} == names


def test_plotly_graphs_hold_the_numbers(comparison: Comparison) -> None:
    figure = next(figure for figure in comparison_figures(comparison) if figure.name == "both_together")
    graph = graphs_of(figure)[0]
    assert len(graph["data"]) == 6
    assert graph["layout"]["xaxis3"]["title"]["text"] == "time since the noise began [s]"
    assert [trace["showlegend"] for trace in graph["data"]] == [True, True, False, False, False, False]


def test_tables_have_a_cell_for_every_heading(comparison: Comparison) -> None:
    data = ReportData(comparison, comparison.to_json())
    tables = [*make_tables(data), provenance_table(data)]
    assert len(tables) == 8
    for table in tables:
        assert table.rows
        assert all(len(row) == len(table.head) for row in table.rows), table.title


def test_a_table_is_wide_where_a_phone_cannot_hold_a_row() -> None:
    numbers, words = ("a", "1", "2", "3"), ("a", "1", "m", "a long meaning")
    assert not Table("", "", numbers, [numbers], "").is_wide
    assert Table("", "", words, [words], "").is_wide
    assert Table("", "", (*numbers, "4"), [(*numbers, "4")], "").is_wide
    assert not Table("", "", words[1:], [words[1:]], "").is_wide


def test_what_few_read_is_folded_and_the_answers_tables_are_not(comparison: Comparison) -> None:
    data = ReportData(comparison, comparison.to_json())
    folded = {table.title: table.folded for table in [*make_tables(data), provenance_table(data)]}
    assert [title for title, is_folded in folded.items() if is_folded] == [
        "Metrics of the regulation",
        "Parameters of the model",
    ]
    assert not folded["Tests against the margins"]
    assert dict(provenance_table(data).rows)["versions"] == "pendulum_bags 0.1.0, python 3.11.0"


def test_thinning_keeps_ends_and_extremes() -> None:
    x = np.linspace(0.0, 1.0, 100_000)
    y = np.sin(200.0 * x)
    y[54_321] = 7.0
    fewer_x, fewer_y = thinned(x, y, 2000)
    assert fewer_x.size < 2100
    assert fewer_y.max() == 7.0
    assert (fewer_x[0], fewer_x[-1]) == (0.0, 1.0)
    assert np.all(np.diff(fewer_x) > 0.0)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0 rad"),
        (0.00546, "0.00546 rad"),
        (-6.7e-6, "−6.70×10⁻⁶ rad"),
        (1234567.0, "1.23×10⁶ rad"),
        (1234.0, "1234 rad"),
        (float("nan"), "–"),
    ],
)
def test_quantities_are_written_for_readers(value: float, text: str) -> None:
    assert quantity(value, "rad") == text


def test_labels_of_two_lines_are_two_lines_on_the_page() -> None:
    panel = Panel(
        "time [s]", "coherence of the angle\nwith the excitation [-]", [Trace(np.arange(3.0), np.ones(3), "", "sim")]
    )
    (graph,) = graphs_of(Figure("one", "One", "A sentence.", [panel]))
    assert graph["layout"]["yaxis"]["title"]["text"] == "coherence of the angle<br>with the excitation [-]"


def test_ratios_are_said_in_words() -> None:
    assert ratio_in_words(1.001) == "equal within half a per cent"
    assert ratio_in_words(1.1) == "10 % larger"
    assert ratio_in_words(0.5) == "50 % smaller"
    assert ratio_in_words(2.2) == "2.2 times as large"


def test_two_bags_make_a_report_too(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Drawing the others takes seconds; the page's own test does.
    own = [(title, maker) for title, maker in FIGURES if title in {"Equivalence tests", "Replay of a real pendulum"}]
    monkeypatch.setattr("pendulum_bags.report.figures.FIGURES", own)
    shutil.copytree(folder / "sim", tmp_path / "a")
    shutil.copytree(folder / "hw", tmp_path / "b")
    assert main([str(tmp_path / "a"), str(tmp_path / "b"), "--png-only"]) == 0
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "<title>a and b" in page
    assert "2 runs" not in page
    # Somebody's recording that happens to lie on this machine is not theirs.
    assert not (tmp_path / "report" / "figures" / "replay.png").exists()


def test_two_bags_of_one_name_are_distinguished_in_the_title() -> None:
    assert title_of([Path("/x/mon/sim"), Path("/x/tue/sim")], 1) == "mon/sim and tue/sim"
    assert title_of([Path("/x/mon"), Path("/x/tue")], 2) == "2 runs"


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "has no bags sim and hw" in capsys.readouterr().err


# -- the thesis's identification experiments -------------------------------------------------------------------


def write_trial(path: Path, t: np.ndarray, position: np.ndarray, effort: np.ndarray) -> None:
    velocity = np.gradient(position, t)
    with BagWriter(path) as bag:
        bag.add_topic("/hw/joint_states", "sensor_msgs/msg/JointState")
        bag.add_topic("/hw/events", "std_msgs/msg/String")
        for name, time in (("trial_start", t[0]), ("trial_end", t[-1] + 0.01)):
            stamp = round((10.0 + time) * 1e9)
            content = json.dumps({"stamp_ns": stamp, "name": name}).encode() + b"\0"
            bag.write("/hw/events", stamp, b"\0\1\0\0" + len(content).to_bytes(4, "little") + content)
        for time, angle, speed, torque in zip(t, position, velocity, effort, strict=True):
            stamp = round((10.0 + time) * 1e9)
            data = encode_joint_state(stamp, position=angle, velocity=speed, effort=torque)
            bag.write("/hw/joint_states", stamp, data)


def hand_trials(folder: Path) -> Path:
    t = np.arange(0.0, 6.0, 0.01)
    for number in (1, 2):
        position = 0.5 * np.pi * (1.0 - np.cos(2.0 * np.pi * t / 6.0)) + 0.02 * number * np.sin(9.0 * t)
        velocity = np.gradient(position, t)
        write_trial(folder / f"trial_{number}", t, position, -11.77 * velocity - 0.055 * np.gradient(velocity, t))
    return folder


def staircase_trials(folder: Path) -> Path:
    steps = np.radians([0, 10, 20, 30, 40, 50, 60, 70, 80, 90, 60, 30, 10, 0, -10, -40, -70, -90, -40, -10, 0])
    t = np.arange(0.0, 2.0 * steps.size, 0.01)
    share = np.clip((t % 2.0) / 0.8, 0.0, 1.0)
    index = (t // 2.0).astype(int)
    position = np.r_[0.0, steps][index] * (1.0 - share) + steps[index] * share
    noise = 0.01 * np.random.default_rng(0).standard_normal(t.size)
    way = 0.03 * np.sign(np.gradient(np.abs(steps)))[index] * np.sign(position)
    write_trial(folder / "trial_1", t, position, 1.678 * np.sin(position) + way + noise)
    return folder


def test_several_runs_are_pooled_and_identification_experiments_join_the_report(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The others of pooled runs are made by the next test, and those of one run drawn by that of the page.
    others = {"Equivalence tests", "All runs", "Trials by hand", "Dynamic phase", "Static phase"}
    own = [(title, maker) for title, maker in FIGURES if title.startswith("Effort over") or title in others]
    monkeypatch.setattr("pendulum_bags.report.figures.FIGURES", own)
    second = write_run_folder(tmp_path / "second", seed=2, ramps=False)
    trials = [str(hand_trials(tmp_path / "table")), str(staircase_trials(tmp_path / "staircase"))]
    assert main([str(folder), str(second), *trials, "-o", str(tmp_path / "out"), "--png-only"]) == 0
    assert "report" in capsys.readouterr().out
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "2 runs" in text
    assert '"dtick":1' in text.replace(" ", ""), "runs are counted in whole numbers"
    assert re.search(r"damping 11\.77 N m s/rad", text)
    assert re.search(r"gravity 1\.6[678]\d* N m", text)
    for name in (
        "pooled_runs",
        "effort_over_velocity",
        "effort_over_acceleration",
        "trials",
        "dynamic_phase",
        "static_phase",
    ):
        assert (tmp_path / "out" / "figures" / f"{name}.png").exists()
    for title in ("Regression of experiment 1", "Coefficients of experiment 2"):
        assert title in text


def test_every_pooled_run_is_listed_with_seed_bags_and_versions(tmp_path: Path) -> None:
    """As an experiment leaves them: the repeat in a folder of the run, with a seed and a command of its own."""
    run = write_run_folder(tmp_path / "private" / "exp", seed=1, ramps=False)
    repeat = write_run_folder(run / "repeats" / "1", seed=10_000_001, ramps=False)
    shutil.rmtree(repeat / "sim_500hz")
    comparison = compare_folders([run])
    assert len(comparison.pairs) == 2
    page = write_report(run, comparison=comparison, recordings=[], formats=[]).read_text(encoding="utf-8")
    # One joint or several: nothing else of the page is in the table.
    rows = provenance_table(ReportData(comparison, comparison.to_json())).rows
    told = dict(rows)
    assert (told["run 1, seed"], told["run 2, seed"]) == ("1", "10000001")
    assert "seed" not in told
    assert told["run 1, bag of the simulation"] == "exp/sim (plant thesis)"
    assert told["run 2, bag of the simulation"] == "exp/repeats/1/sim (plant thesis)"
    assert told["run 2, bag of the hardware"] == "exp/repeats/1/hw (plant thesis)"
    assert told["bag of the simulation, own noise"] == "exp/sim_500hz (seed 1000001)"
    assert told["run 1, revision and versions"] == "git 0123456789ab, pendulum_bags 0.1.0, python 3.11.0"
    assert told["run 2, revision and versions"] == "as run 1"
    assert "run 2, command" not in told
    # An experiment that ended before it simulated the repeat's other side leaves a run that can be reported.
    shutil.rmtree(repeat / "sim")
    assert len(compare_folders([run]).pairs) == 1
    assert not any("private" in value for value in told.values())
    head = page.split("<nav")[0]
    assert "<dt>seeds</dt><dd>1, 10000001</dd>" in head
    body = page.split("<main>")[1]
    assert body.count("This section shows run 1 of 2;") == 4
    for section in ("paired-comparison", "plants-under-noise", "the-thesis-s-analysis", "timing"):
        assert "This section shows run 1 of 2;" in body.split(f'<section id="{section}"')[1].split("</section>")[0]


def test_a_pooled_run_of_other_software_tells_its_own(comparison: Comparison) -> None:
    (pair,) = comparison.pairs
    record = {**pair.hardware.metadata["pendulum.run"], "seed": 2, "versions": {"numpy": "2.0"}, "command": "again"}
    other = replace(
        pair,
        simulation=replace(pair.simulation, damage=("no index",)),
        hardware=replace(pair.hardware, metadata={"pendulum.run": record}),
    )
    rows = provenance_table(ReportData(replace(comparison, pairs=[pair, other]), {})).rows
    told = dict(rows)
    assert told["run 2, seed"] == "1 and 2"
    assert told["run 2, command"] == "again"
    assert told["run 2, damage of the simulation's bag"] == "no index"
    assert told["run 2, revision and versions"] == (
        "simulation: git 0123456789ab, pendulum_bags 0.1.0, python 3.11.0; hardware: git 0123456789ab, numpy 2.0"
    )
    bare = replace(pair, simulation=replace(pair.simulation, metadata={}), hardware=replace(pair.hardware, metadata={}))
    rows = provenance_table(ReportData(replace(comparison, pairs=[other, bare]), {})).rows
    assert dict(rows)["run 2, revision and versions"] == "git unknown"
    assert dict(rows)["run 1, command"] == "again"
    assert "run 2, command" not in dict(rows)
    told_first = replace(pair, simulation=other.hardware)
    rows = provenance_table(ReportData(replace(comparison, pairs=[told_first, bare]), {})).rows
    assert [what for what, _ in rows if what.endswith("command")] == ["command"]
    rows = provenance_table(ReportData(replace(comparison, pairs=[bare, bare]), {})).rows
    assert not [what for what, _ in rows if what.endswith("command")]
    rows = provenance_table(ReportData(replace(comparison, pairs=[pair, other, other]), {})).rows
    assert [what for what, _ in rows if what.endswith("command")] == ["run 2, command"]


def test_the_head_of_a_page_names_some_seeds_of_many(comparison: Comparison) -> None:
    many = replace(comparison, pairs=[*comparison.pairs] * 4)
    data = ReportData(many, {"seed": 7})
    page = page_of(data, [], [], [], title="")
    assert dict(page.facts)["seeds"] == "1, 1, 1, …"
    alone = dict(page_of(ReportData(comparison, {"seed": 7}), [], [], [], title="").facts)
    assert alone["seed"] == "7"
    assert alone["delay"].endswith(" ms (±5 ms)")
    assert alone["spread of velocity (ratio)"].endswith(" (0.87 to 1.15)")


def test_trials_alone_point_to_the_command_that_shows_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(hand_trials(tmp_path / "table"))]) == 2
    assert "holds trials and no run" in capsys.readouterr().err


def test_page_begins_with_the_answer_its_layers_and_what_to_do_next(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    top = text.split("<nav")[0]
    assert "</span>Yes</p>" in top
    assert "In this run simulation and the hardware move alike" in top
    titles = ("1 same run", "2 same for feedback", "3 which controllers", "4 same choice")
    found = [top.index(title) for title in titles]
    assert found == sorted(found)
    assert top.index("What to do next") > top.index("4 same choice")


def test_layers_that_a_run_folder_keeps_are_in_its_report(comparison: Comparison, tmp_path: Path) -> None:
    row = Evidence("nu-gap", "", 0.31, 0.28, 0.35, "below 0.2", Mark.NO)
    kept = LayerResult(Layer.SAME_PLANT, Mark.NO, "The gap is 0.31.", (row,), reason="the hardware is 0.31 away")
    write_layer(tmp_path, kept)
    text = write_report(tmp_path, comparison=comparison, recordings=[], formats=[]).read_text(encoding="utf-8")
    assert "</span>No</p>" in text
    assert "<p>The hardware is 0.31 away." in text
    assert "Evidence: same for feedback" in text
    assert "0.28 to 0.35" in text
    other = tmp_path / "other"
    ranked = LayerResult(Layer.SAME_CHOICE, Mark.YES, "It would.", holds="the simulation's pick is the hardware's")
    write_layer(other, ranked)
    answer = answer_of(comparison, [tmp_path, other])
    assert answer.sentence.endswith("What holds: the simulation's pick is the hardware's.")


def test_every_text_of_a_report_says_that_the_hardware_was_emulated() -> None:
    figure = Figure("hardware", "Hardware", "On the hardware, u.", [Panel("hardware [s]", "", [])], section="Verdict")
    named = name_in(figure, emulated=True)
    assert (named.title, named.sentence) == ("Emulated hardware", "On the emulated hardware, u.")
    assert named.panels[0].x_label == "emulated hardware [s]"
    assert name_in(named, emulated=True).sentence == named.sentence
    assert name_in(figure, emulated=False) is figure
    assert name_in("python -m pendulum_bags experiment thesis --hardware hebi", emulated=True).endswith(
        "--hardware hebi"
    )


@in_repository
def test_provenance_names_plant_and_citation_and_the_file_at_the_root_agrees(comparison: Comparison) -> None:
    rows = dict(provenance_table(ReportData(comparison, {"versions": {"pendulum_bags": "0.1.0"}})).rows)
    assert rows["plant of the design"].startswith("thesis: inertia 0.055 kg m², damping 11.77 N m s/rad, gravity 1.6")
    told = yaml.safe_load((PROJECT / "CITATION.cff").read_text(encoding="utf-8"))
    name, title, version = told["authors"][0]["name"], told["title"], told["version"]
    assert rows["cite as"].startswith(f"{name} (n.d.). {title} (version {version}) [Computer software]. Git revision ")
    manifest = ElementTree.parse(PROJECT / "bags" / "pendulum_bags" / "package.xml").getroot()
    assert told["version"] == manifest.findtext("version")


def test_a_report_on_emulated_hardware_lists_the_constants_of_the_emulator(
    comparison: Comparison, tmp_path: Path
) -> None:
    data = ReportData(comparison, {})
    assert emulator_table(data) is None, "this hardware is no emulator"
    told = {"pendulum.run": {"plant": "emulator", "namespace": "/hw", "strategy": "direct_pwm"}}
    plants = {"/sim/simulator": load_plant("thesis"), "/hw/bridge": load_plant("x5_9")}
    with BagWriter(tmp_path / "hw") as bag:
        bag.add_topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        for node, plant in plants.items():
            pair = KeyValue(key=PLANT_PARAMETERS, value=describe_plants([plant]))
            status = DiagnosticStatus(name=f"{node}: plant", values=[pair])
            bag.write("/diagnostics", 1, serialize_message(DiagnosticArray(status=[status])))
    pair = comparison.pairs[0]
    hardware = replace(pair.hardware, metadata=told, source=str(tmp_path / "hw"))
    data = ReportData(replace(comparison, pairs=[replace(pair, hardware=hardware)]), {})
    table = emulator_table(data)
    assert table is not None
    assert "x5_9" in table.sentence
    assert table.folded
    assert ("gear_ratio", "1742.22", "–") in [row[:3] for row in table.rows]
    assert "Ω" in {row[0]: row[2] for row in table.rows}["winding_resistance"]
    assert "unit" in table.head
    missing = replace(hardware, source=str(tmp_path / "gone"))
    data = ReportData(replace(comparison, pairs=[replace(pair, hardware=missing)]), {})
    assert emulator_table(data) is None


def test_two_dampings_that_cannot_be_compared_are_not_shown_without_a_word(comparison: Comparison) -> None:
    data = ReportData(comparison, {})
    assert "b is not" in next(it.sentence for it in make_figures(data)[0] if it.name == "gravity_fit")


@pytest.mark.parametrize("size", [1e-7, 1.0])
def test_a_title_gives_way_to_the_factor_above_the_axis(size: float) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    times = np.linspace(0.0, 1.0, 50)
    panel = Panel("time [s]", "torque [N m]", [Trace(times, size * np.sin(times), "sim", "sim")], title="One run")
    canvas = render_files._draw(Figure("one", "One run", "A sentence.", [panel]), Canvas)
    FigureCanvasAgg(canvas).draw()
    (ax,) = canvas.axes
    factor, title = ax.yaxis.offsetText, ax.get_title(loc="left")
    assert title == "One run"
    assert bool(factor.get_text()) is (size < 1.0)
    assert not factor.get_text() or not ax._left_title.get_window_extent().overlaps(factor.get_window_extent())


# -- in a real browser, offline, at desktop and phone width ---------------------------------------------------------

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SWITCHES = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
WIDTHS = {"desktop": 1280, "phone": 390}

needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=BROWSER, args=SWITCHES)
        yield opened
        opened.close()


@pytest.fixture(scope="module", params=WIDTHS)
def visit(request: pytest.FixtureRequest, browser: Any, page: Path) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": WIDTHS[request.param], "height": 900}, offline=True)
    opened = context.new_page()
    opened.messages = []
    opened.on("console", lambda message: opened.messages.append(message.text))
    opened.on("pageerror", lambda error: opened.messages.append(str(error)))
    opened.goto(page.resolve().as_uri())
    opened.wait_for_function("document.documentElement.dataset.ready === 'true'", timeout=60_000)
    yield opened
    context.close()


_RESULT_OF_ROW = """row => {
    const [name, result] = ["th", "td.result"].map((it) => row.querySelector(it).getBoundingClientRect());
    return [result.right, Math.abs(result.y - name.y)];
}"""


@needs_browser
def test_page_is_whole_and_usable(visit: Any) -> None:
    # One visit for all that is seen at one width: loading takes seconds on a small machine.
    assert visit.messages == []

    # The first screen has the answer, its margins and the motion; what the answer does not rest on is folded.
    lead = visit.locator("#lead .main-svg").first.bounding_box()
    if visit.viewport_size["width"] == WIDTHS["desktop"]:
        assert lead["y"] + lead["height"] <= 500
    assert " allowed" in visit.locator(".verdict").inner_text()
    assert "(±5 ms)" in visit.locator(".facts").inner_text()
    assert "std of" not in visit.locator(".facts").inner_text()
    folded = visit.locator("section > details")
    assert {"The thesis's analysis", "Model"} <= set(folded.locator("h2").all_inner_texts())
    assert visit.locator('[data-graph="unpaired_difference-0"] .main-svg').count() == 0
    visit.locator("nav a[href='#model']").click()
    assert visit.locator("#model > details").get_attribute("open") is not None
    visit.evaluate("document.querySelectorAll('section > details').forEach((one) => { one.open = true; })")
    visit.wait_for_function("[...document.querySelectorAll('.graph')].every((one) => one.querySelector('.main-svg'))")
    plots = visit.locator(".graph")
    assert plots.count() >= 20
    assert visit.locator(".graph .main-svg").count() >= plots.count()
    drawn = "nodes => nodes.every(n => n.querySelector('.xy path, .xy g.points path, .scatterlayer path'))"
    assert plots.evaluate_all(drawn)
    assert visit.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    outside = "nodes => nodes.filter(n => n.getBoundingClientRect().right > window.innerWidth + 1).length"
    assert visit.locator("header, figure, .graph").evaluate_all(outside) == 0
    assert visit.locator("#failure").is_hidden()

    # Names of rows leave half of the width to the rows, on a phone too.
    share = "n => n._fullLayout._size.w / n._fullLayout.width"
    assert visit.locator('[data-graph="equivalence-0"]').evaluate(share) > 0.45

    # The result of a test stands beside its name, inside the screen; on a phone every other cell is labelled.
    tests = visit.locator("figure.table", has=visit.locator("h3:text-is('Tests against the margins')"))
    for row in tests.locator("tbody tr").all():
        # Both in one call: plots that are still being drawn move the rows.
        right, apart = row.evaluate(_RESULT_OF_ROW)
        assert right <= visit.viewport_size["width"]
        assert apart < 2.0
    cut = "nodes => nodes.filter(n => n.scrollWidth > n.clientWidth + 1).map(n => n.ariaLabel)"
    assert visit.locator(".scroll").evaluate_all(cut) == []
    label = "n => getComputedStyle(n, '::before').content"
    narrow = visit.viewport_size["width"] == WIDTHS["phone"]
    first = tests.locator("tbody tr").first.locator("td")
    assert first.first.evaluate(label) == ('"estimate"' if narrow else "none")
    assert tests.locator("td.result").first.evaluate(label) == "none"
    assert tests.locator("td.result").first.inner_text() in {"equivalent", "not equivalent", "undecided"}

    # Headings that are labels already take no room on a phone.
    heading = "n => n.querySelector('tbody').getBoundingClientRect().y - n.getBoundingClientRect().y"
    assert (tests.locator("table").evaluate(heading) < 5.0) == narrow

    # Long tables open at a click, and not before.
    visit.evaluate("document.querySelectorAll('section > details').forEach((one) => { one.open = false; })")
    metrics = visit.locator("figure.table", has=visit.locator("h3:text-is('Metrics of the regulation')"))
    assert metrics.locator("table").is_hidden()
    assert tests.locator("table").is_visible()
    metrics.locator("summary").click()
    assert metrics.locator("table").is_visible()
    assert visit.locator(".scroll").evaluate_all(cut) == []
    # Before the page is printed all are open; then those again that the reader opened.
    shut = visit.locator("details:not([open])")
    before = shut.count()
    assert before >= 1
    visit.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert shut.count() == 0
    visit.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert shut.count() == before
    assert metrics.locator("table").is_visible()

    # By keyboard: a plot takes the focus, zooms, moves and comes back.
    plot = visit.locator('[data-graph="both_together-0"]')
    plot.focus()
    span = "(n => n._fullLayout.xaxis.range[1] - n._fullLayout.xaxis.range[0])"
    before = plot.evaluate(span)
    node = plot.element_handle()
    visit.keyboard.press("+")
    visit.wait_for_function(f"([n, before]) => {span}(n) < 0.8 * before", arg=[node, before])
    visit.keyboard.press("0")
    visit.wait_for_function(f"([n, before]) => Math.abs({span}(n) / before - 1) < 0.02", arg=[node, before])

    # The animation runs from its button, also where the browser began the next picture before the press.
    visit.evaluate("{ const now = performance.now.bind(performance); performance.now = () => now() + 200; }")
    visit.locator("#play").focus()
    visit.keyboard.press("Enter")
    visit.wait_for_function("Number(document.getElementById('seek').value) > 2")
    visit.keyboard.press("Enter")
    visit.wait_for_function("document.getElementById('play').innerText === 'Play'")
    assert visit.messages == []


@in_repository
@needs_browser
@pytest.mark.parametrize("visit", ["phone"], indirect=True)  # whose rules of style come on top of the desktop's
def test_axe_finds_nothing_on_a_report(visit: Any) -> None:
    axe = PROJECT / "tests" / "axe"
    install_packages(axe, "axe-core")
    visit.add_script_tag(path=str(axe / "node_modules" / "axe-core" / "axe.min.js"))
    visit.evaluate("document.querySelectorAll('section > details').forEach((one) => { one.open = true; })")
    visit.wait_for_function("[...document.querySelectorAll('.graph')].every((one) => one.querySelector('.main-svg'))")
    found = visit.evaluate("axe.run(document)")
    assert len(found["passes"]) > 15, "axe saw next to nothing"
    assert {it["id"]: it["nodes"][0]["html"][:120] for it in found["violations"]} == {}


@needs_browser
@pytest.mark.parametrize("scripts", [True, False], ids=["with scripts", "without scripts"])
def test_paper_shows_every_figure_as_a_picture(browser: Any, page: Path, scripts: bool) -> None:
    assert page.stat().st_size < 5_000_000
    context = browser.new_context(offline=True, java_script_enabled=scripts)
    visit = context.new_page()
    visit.goto(page.resolve().as_uri())
    # At once, as a browser that prints from the command line does: before any plot is drawn.
    visit.emulate_media(media="print")
    figures = visit.locator("figure:has(.graphs)")
    assert figures.count() >= 12
    for index in range(figures.count()):
        picture = figures.nth(index).locator("img.paper")
        box = picture.bounding_box()
        assert box is not None
        assert box["width"] > 300
        assert box["height"] > 100
        assert figures.nth(index).locator(".graphs").is_hidden()
    # What is folded on a screen is all there.
    tables = visit.locator("figure.table table")
    assert visit.locator("details table").count() >= 2
    assert all(one.bounding_box()["height"] > 40 for one in tables.all())
    assert visit.locator("summary").first.is_hidden()
    context.close()
