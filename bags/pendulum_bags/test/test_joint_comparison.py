"""Simulation and hardware of several joints, compared joint by joint: real plants in memory, real bags."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_bags.commands.compare_cli import main
from pendulum_bags.commands.report_cli import main as report_main
from pendulum_bags.comparison import Outcome, compare_runs
from pendulum_bags.comparison.pairs import Pair
from pendulum_bags.report.joint_page import joint_page
from pendulum_bags.report.write import write_joint_report
from pendulum_bags.runs.run_data import joints_of, read_run
from pendulum_bags.runs.run_record import RUN_RECORD
from pendulum_bags.verdict.answer import answer_of, join_joints
from pendulum_bags.verdict.layers import Evidence, Layer, LayerResult, Mark
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_msgs_py.contract.cdr import encode_joints
from pendulum_msgs_py.contract.noise import uniform_array
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism
from pendulum_rosbag.reader import Bag
from pendulum_rosbag.reader import bag as bag_module
from pendulum_rosbag.reader.joint_table import JointTable, joint_table
from pendulum_rosbag.reader.open_source import BagFolder
from pendulum_rosbag.storage import BagWriter
from pendulum_sim.stepping.mechanism_plant import MechanismPlant

STATE = "sensor_msgs/msg/JointState"
EPOCH_NS = 1_700_000_000_000_000_000
JOINTS = ("cart", "pole")


def regulate(plant: PlantParameters, sensor_seed: int, *, duration: float = 8.0) -> dict[str, np.ndarray]:
    """Hold the cart-pole upright under noise on the cart; rows of position, velocity, command and noise."""
    period = 0.01
    model = MechanismPlant(plant, period)
    controller = make_controller("lqr", load_mechanism("cart_pole"), period)
    state = model.reset((0.0, np.pi))
    count = round(duration / period)
    noise = uniform_array(5, 0, count, 3.0)
    sensor = np.random.default_rng(sensor_seed)
    rows = np.empty((count, 6))
    for k in range(count):
        q = tuple(np.asarray(state.position) + 1e-5 * sensor.standard_normal(2))
        v = tuple(np.asarray(state.velocity) + 1e-3 * sensor.standard_normal(2))
        (command,) = controller.efforts(k * period, q, v)
        rows[k] = *q, *v, command, noise[k]
        state = model.step((command + float(noise[k]),))
    return {"position": rows[:, :2], "velocity": rows[:, 2:4], "command": rows[:, 4:5], "noise": rows[:, 5:]}


def write(
    path: Path, columns: Mapping[str, np.ndarray], *, offset: tuple[float, float] = (0.0, 0.0), stand_in: str = ""
) -> Path:
    record = {"namespace": "/plant", "plant": "cart_pole", "design_plant": "cart_pole", "seed": 5}
    if stand_in:
        record["stand_in"] = stand_in
    with BagWriter(path, metadata={RUN_RECORD: record}) as bag:
        for topic in ("joint_states", "effort_command", "disturbance"):
            bag.add_topic(f"/plant/{topic}", STATE)
        for k in range(len(columns["noise"])):
            stamp = EPOCH_NS + k * 10_000_000
            q, v = (tuple(map(float, columns[name][k])) for name in ("position", "velocity"))
            q = (q[0] + offset[0], q[1] + offset[1])
            command, noise = float(columns["command"][k, 0]), float(columns["noise"][k, 0])
            state = encode_joints(stamp, "plant", JOINTS, q, v, (command + noise, 0.0))
            bag.write("/plant/joint_states", stamp + 100_000, state)
            for topic, value in (("effort_command", command), ("disturbance", noise)):
                bag.write(f"/plant/{topic}", stamp + 200_000, encode_joints(stamp, topic, ("cart",), effort=(value,)))
    return path


@pytest.fixture(scope="module")
def recordings() -> dict[str, dict[str, np.ndarray]]:
    plant = load_mechanism("cart_pole")
    return {
        "sim": regulate(plant, 1),
        "alike": regulate(plant, 2),
        "other": regulate(plant.with_values({"cart_mass": 3.0}), 3),
    }


@pytest.fixture(scope="module")
def bags(recordings: dict[str, dict[str, np.ndarray]], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("joints")
    return {name: write(folder / name, columns) for name, columns in recordings.items()}


@contextmanager
def each_read_once(first: Path, second: Path) -> Iterator[None]:
    """Check that two bags are opened, and their tables of joints made, once however many joints are asked for."""
    opened: Counter[Path] = Counter()
    tables: Counter[str] = Counter()

    def open_counted(bag: Bag, folder: BagFolder, *rest: Any) -> None:
        opened[folder.path] += 1
        make(bag, folder, *rest)

    def table_counted(messages: Any, where: str) -> JointTable:
        tables[where] += 1
        return joint_table(messages, where)

    make = Bag.__init__
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bag, "__init__", open_counted)
        patch.setattr(bag_module, "joint_table", table_counted)
        yield
    assert dict(opened) == {first: 1, second: 1}
    # States, commands and disturbance of each bag.
    assert len(tables) == 6
    assert set(tables.values()) == {1}


def told(capsys: pytest.CaptureFixture[str], *arguments: Any) -> dict[str, Any]:
    assert main([*map(str, arguments), "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    return content


def test_the_same_plant_twice_is_reported_alike_in_every_joint(
    bags: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    with each_read_once(bags["sim"], bags["alike"]):
        content = told(capsys, bags["sim"], bags["alike"])
    assert list(content["joints"]) == list(JOINTS) == list(joints_of(bags["sim"]))
    tests = {joint: [test["quantity"] for test in one["verdict"]["tests"]] for joint, one in content["joints"].items()}
    assert [one["verdict"]["outcome"] for one in content["joints"].values()] == ["equivalent", "equivalent"]
    assert content["answer"]["mark"] == "yes"
    # What slides has positions and a force; a joint without a motor has no torque that could be tested.
    assert {"mean position difference", "spread of force (ratio)", "distance of positions"} <= set(tests["cart"])
    assert {"mean angle difference", "distance of angles"} <= set(tests["pole"])
    assert not [name for name in tests["pole"] if "torque" in name or "force" in name]
    # Noise on the cart moves the pole too: both joints are paired by it.
    assert all("position" in one["paired"] for one in content["joints"].values())
    plants = {layer["sentence"].partition("--plant ")[2].split()[0] for layer in content["answer"]["layers"][1:]}
    assert plants == {"cart_pole."}


def test_another_plant_is_reported_by_the_joint_that_shows_it(
    bags: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = told(capsys, bags["sim"], bags["other"], "-o", tmp_path)
    assert content["answer"]["mark"] == "no"
    assert content["joints"]["cart"]["verdict"]["outcome"] == "not equivalent"
    assert content["answer"]["sentence"].startswith("No: cart: ")
    (step,) = [step for step in content["answer"]["next_steps"] if "identify" in step]
    assert f"(python -m pendulum_bags identify {bags['other']} --out plant.yaml --plant cart_pole)" in step
    assert (tmp_path / "figures" / "joints_together.png").stat().st_size > 10_000
    assert main([str(bags["sim"]), str(bags["other"])]) == 0
    shown = capsys.readouterr().out
    assert "std of x [m]" in shown
    assert "std of theta [rad]" in shown
    assert "experiment frequency_response" not in shown, "no layer is offered that only plants of one joint have"


def test_one_joint_may_be_asked_alone(bags: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert list(told(capsys, bags["sim"], bags["other"], "--joint", "pole")["joints"]) == ["pole"]
    assert main([str(bags["sim"]), str(bags["other"]), "--joint", "elbow"]) == 2
    assert "joint is 'elbow'; expected one of cart, pole" in capsys.readouterr().err


def test_only_an_angle_is_known_but_for_whole_turns(
    recordings: dict[str, dict[str, np.ndarray]], bags: dict[str, Path], tmp_path: Path
) -> None:
    """A cart 6.28 m away is elsewhere; a pole a turn further is where it was."""
    turn = 2.0 * np.pi
    moved = write(tmp_path / "moved", recordings["alike"], offset=(turn, turn))
    means = {
        joint: Pair.of(read_run(bags["sim"], joint=joint), read_run(moved, joint=joint)).difference.position.mean()
        for joint in JOINTS
    }
    assert means["cart"] == pytest.approx(turn, abs=0.01)
    assert means["pole"] == pytest.approx(0.0, abs=0.01)


def test_margins_of_what_slides_are_shares_and_millimetres(bags: dict[str, Path]) -> None:
    wide = compare_runs(
        bags["sim"], bags["other"], joint="cart", margin={"mean_position": "1 m", "spread_velocity": 900}
    )
    tests = {test.quantity: test for test in wide.verdict.tests}
    assert tests["mean position difference"].outcome is Outcome.EQUIVALENT
    assert tests["mean position difference"].high == 1.0
    with pytest.raises(ParameterError, match=r"margin path_angle is 0.2 deg, and this joint slides; expected a share"):
        compare_runs(bags["sim"], bags["other"], joint="cart", margin={"path_angle": "0.2 deg"})
    compare_runs(bags["sim"], bags["other"], joint="pole", margin={"path_angle": "0.2 deg"})


def test_a_joint_that_stood_still_is_named(recordings: dict[str, dict[str, np.ndarray]], tmp_path: Path) -> None:
    still = {**recordings["sim"], "position": recordings["sim"]["position"] * np.array([0.0, 1.0])}
    bag = write(tmp_path / "still", still)
    with pytest.raises(DataError, match=r"stood still in cart at 0 m under the noise"):
        compare_runs(bag, bag, joint="cart")


def test_plants_that_fell_are_not_compared(recordings: dict[str, dict[str, np.ndarray]], tmp_path: Path) -> None:
    turning = recordings["sim"]["position"] + np.outer(
        np.linspace(0.0, 20.0, len(recordings["sim"]["noise"])), (0.0, 1.0)
    )
    bag = write(tmp_path / "fell", {**recordings["sim"], "position": turning})
    fallen = read_run(bag, joint="pole")
    with pytest.raises(DataError, match=r"fell: pole turned by 20 rad under the noise"):
        Pair.of(fallen, fallen)


@pytest.mark.parametrize(
    ("marks", "expected"),
    [
        ((Mark.YES, Mark.YES), Mark.YES),
        ((Mark.YES, Mark.UNDECIDED), Mark.UNDECIDED),
        ((Mark.NO, Mark.UNDECIDED), Mark.NO),
        ((Mark.UNDECIDED, Mark.NO), Mark.NO),
    ],
)
def test_a_plant_is_as_alike_as_its_least_alike_joint(marks: tuple[Mark, Mark], expected: Mark) -> None:
    results = {
        joint: LayerResult(
            Layer.SAME_RUN, mark, f"Says {mark.value}.", (Evidence("delay", "ms", 1.0),), reason=mark.value
        )
        for joint, mark in zip(JOINTS, marks, strict=True)
    }
    joined = join_joints(results)
    assert joined.mark is expected
    assert [row.quantity for row in joined.evidence] == ["cart: delay", "pole: delay"]
    because = [joint for joint, mark in zip(JOINTS, marks, strict=True) if mark is expected]
    assert joined.reason == "; ".join(f"{joint}: {expected.value}" for joint in because)


@pytest.fixture(scope="module")
def report(bags: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    with each_read_once(bags["sim"], bags["alike"]):
        assert report_main([str(bags["sim"]), str(bags["alike"]), "--png-only", "-o", str(folder)]) == 0
    return folder


def embedded(report: Path, name: str) -> Any:
    text = (report / "report.html").read_text(encoding="utf-8")
    return json.loads(text.partition(f'id="{name}">')[2].partition("</script>")[0])


def test_a_report_shows_each_joint_in_its_own_unit_below_one_answer(report: Path) -> None:
    text = (report / "report.html").read_text(encoding="utf-8")
    assert '<div class="verdict yes"' in text
    assert "Tests against the margins: cart" in text
    assert "Tests against the margins: pole" in text
    assert "of cart [m]" in text.replace('<abbr class="term" title="', "")
    labels = {
        axis["title"]["text"]
        for graph in embedded(report, "graphs").values()
        for axis in graph["layout"].values()
        if isinstance(axis, dict) and "title" in axis
    }
    assert {"cart [m]", "force at cart [N]", "pole [rad]", "Δ pole [rad]", "velocity PSD [(m/s)²/Hz]"} <= labels
    assert "torque at pole [N m]" not in labels
    drawn = sorted(path.stem for path in (report / "figures").iterdir())
    joined = ["joint_differences", "joint_spectra", "joints_together", "timing"]
    assert drawn == [*(f"equivalence_{joint}" for joint in JOINTS), *joined]


def test_a_page_of_several_runs_says_where_it_shows_the_first(bags: dict[str, Path]) -> None:
    one = {joint: compare_runs(bags["sim"], bags["alike"], joint=joint) for joint in JOINTS}
    three = {joint: replace(found, pairs=[*found.pairs] * 3) for joint, found in one.items()}
    for comparisons, runs, words in ((one, 1, "all samples; "), (three, 3, "all samples of the first of 3 runs; ")):
        page = joint_page(comparisons, answer_of(comparisons), title="")
        assert page.runs == runs
        sentence = page.tables[0].sentence
        assert sentence.startswith(f"Spreads are of {words}the tests take both motions at the slower plant's sampling")


def test_a_report_moves_the_links_of_both_plants(report: Path, recordings: dict[str, dict[str, np.ndarray]]) -> None:
    animation = embedded(report, "animation-data")
    sim, hw = np.array(animation["sim"]), np.array(animation["hw"])
    assert sim.shape == hw.shape == (sim.shape[0], 2, 2), "a cart and the end of its pole"
    assert sim.shape[0] == pytest.approx(8.0 * 50.0, abs=3)
    for frames in (sim, hw):
        assert frames.min() >= 0.0
        assert frames[..., 0].max() <= 640.0
        assert frames[..., 1].max() <= 300.0
    # The pole's end is above the cart, and both go to and fro as the cart does.
    assert (sim[:, 1, 1] < sim[:, 0, 1]).all()
    moved = np.interp(np.arange(sim.shape[0]) * 0.02, np.arange(800) * 0.01, recordings["sim"]["position"][:, 0])
    assert np.corrcoef(sim[:, 0, 0], moved)[0, 1] > 0.999


def test_a_report_says_that_an_emulator_stood_in_for_the_machine(
    recordings: dict[str, dict[str, np.ndarray]], bags: dict[str, Path], tmp_path: Path
) -> None:
    other = write(tmp_path / "hw", recordings["alike"], stand_in="emulated machine")
    found = {joint: compare_runs(bags["sim"], other, joint=joint) for joint in JOINTS}
    page = write_joint_report(tmp_path, found, folders=[], formats=(), answer=answer_of(found))
    text = page.read_text(encoding="utf-8")
    assert "no machine was measured: an emulator took the place of the hardware" in text


def test_a_report_of_several_joints_refuses_what_is_of_one(
    bags: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert report_main([str(bags["sim"]), str(bags["alike"]), "--design", "lqr"]) == 2
    assert "are of plants of one joint; expected none of them for a plant of 2 (cart, pole)" in capsys.readouterr().err


def test_a_report_judges_by_the_margins_that_the_run_was_judged_by_and_says_that_a_second_simulation_stood_in(
    recordings: dict[str, dict[str, np.ndarray]],
    bags: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "sim").symlink_to(bags["sim"])
    write(run / "hw", recordings["other"], stand_in="simulation")
    shares = [
        f"{kind}=900%" for kind in ("spread_angle", "spread_velocity", "spread_torque", "path_angle", "path_velocity")
    ]
    wide = [*shares, "delay=90ms", "mean_angle=20deg", "mean_position=1m"]
    assert main([str(run), *(word for margin in wide for word in ("--margin", margin)), "-o", str(run)]) == 0
    capsys.readouterr()
    assert report_main([str(run), "--png-only"]) == 0
    # By the default margins it is a no; too little is alike for a delay.
    assert capsys.readouterr().out.startswith("Undecided: ")
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "no machine was measured: a second simulation took the place of the hardware" in text


def test_the_page_of_several_joints_is_drawn_on_a_phone(report: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-gpu"])
        page = opened.new_page(viewport={"width": 390, "height": 900})
        messages: list[str] = []
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.goto((report / "report.html").resolve().as_uri())
        page.wait_for_function("document.documentElement.dataset.ready === 'true'", timeout=60_000)
        inked = (
            "() => { const c = document.getElementById('animation'); const pixels = c.getContext('2d')"
            ".getImageData(0, 0, c.width, c.height).data;"
            " return pixels.reduce((n, v, i) => n + (i % 4 === 3 && v > 0), 0); }"
        )
        assert page.evaluate(inked) > 500
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert messages == []
        opened.close()
