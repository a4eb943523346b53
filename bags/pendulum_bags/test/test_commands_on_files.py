"""The commands of docs/recordings.md on files of others: tables of trials, two recordings, one joint and several."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.io
import scipy.signal
import yaml

from pendulum_bags.commands.analyse_cli import main as analyse_main
from pendulum_bags.commands.compare_cli import main as compare_main
from pendulum_bags.commands.frequency_response_cli import main as response_main
from pendulum_bags.commands.ranking_cli import main as ranking_main
from pendulum_bags.commands.replay_cli import main as replay_main
from pendulum_bags.commands.report_cli import main as report_main
from pendulum_bags.frequency_response.analyse import read_responses
from pendulum_bags.recordings.reading import Reading
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_testing.synthetic_runs import regulate

TIMES = {"stiff": 1.0, "mid": 1.2, "soft": 1.5, "slack": 2.0}
"""By what the motion of each controller is larger than that of the first."""


def upright(path: Path, *, seed: int = 1, hardware: bool = False, duration: float = 3.0, size: float = 1.0) -> Path:
    """Write a run that stays upright as CSV or MATLAB file, in names of nobody's contract."""
    run = regulate(rate=200, seed=seed, duration=duration, hardware=hardware)
    columns = {
        "t": run["t"],
        "theta": np.pi + size * (run["position"] - np.pi),
        "omega": size * run["velocity"],
        "tau": run["applied"],
        "noise": run["disturbance"],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mat":
        scipy.io.savemat(path, {name: values[:, None] for name, values in columns.items()})
    else:
        table = np.stack(list(columns.values()), axis=1)
        np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")
    return path


def trials(folder: Path, runs: int = 2) -> list[dict[str, str]]:
    """Write trials of four controllers on both sides; soft and mid are the other way round on the hardware."""
    rows = []
    for side in ("simulation", "hardware"):
        for name in TIMES:
            other = {"mid": "soft", "soft": "mid"}.get(name, name) if side == "hardware" else name
            for run in range(runs):
                path = folder / side / name / f"{run}{'.mat' if run else '.csv'}"
                upright(path, seed=10 * run + (side == "hardware"), hardware=side == "hardware", size=TIMES[other])
                rows.append({"controller": name, "side": side, "file": str(path.relative_to(folder))})
    return rows


def table(path: Path, rows: list[dict[str, Any]]) -> Path:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


# -- ranking -------------------------------------------------------------------------------------------------------


def ranked(capsys: Any, *words: str | Path, code: int = 0) -> Any:
    assert ranking_main([*map(str, words), "--json"]) == code
    said = capsys.readouterr()
    return json.loads(said.out) if code == 0 else " ".join(said.err.split())


def test_folders_options_and_tables_of_trials_give_one_ranking(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = trials(tmp_path / "trials")
    found = ranked(capsys, tmp_path / "trials")
    assert found["names"] == ["stiff", "soft", "mid", "slack"]
    assert found["pick"] == "stiff"
    assert [(pair["picked"], pair["better"]) for pair in found["wrong"]] == [("mid", "soft")]
    assert found["regret"]["value"] == 0.0
    assert found["spearman"] == pytest.approx(0.8)
    assert all(mean["low"] < mean["value"] < mean["high"] for mean in found["means"])
    assert "4 controllers are few: by chance the best of them is picked in 1 of 4 cases" in found["layer"]["sentence"]
    # The cost of one run by its definition, from the file.
    run = np.loadtxt(tmp_path / "trials" / "hardware" / "slack" / "0.csv", delimiter=",", skiprows=1)
    t, angle, speed, torque = run[:, 0], run[:, 1] - np.pi, run[:, 2], run[:, 3]
    first = scipy.integrate.trapezoid(100.0 * angle**2 + 0.1 * torque**2, t) / t[-1] + 0.01 * np.mean(speed**2)
    once = ranked(capsys, *(f"--trial={row['controller']},{row['side']},{tmp_path / 'trials' / row['file']}"
                            for row in rows if row["file"].endswith("0.csv")))  # fmt: skip
    assert once["hw"][once["names"].index("slack")] == pytest.approx(first, rel=1e-6)
    assert once["no_interval"] == "each controller ran once on the hardware"
    named = ranked(capsys, table(tmp_path / "trials" / "trials.csv", rows))
    assert (named["hw"], named["mmrv"]["value"]) == (found["hw"], found["mmrv"]["value"])
    written = tmp_path / "columns.yaml"
    assert ranking_main([str(tmp_path / "trials"), "--write-mapping", str(written), "--out", str(tmp_path / "o")]) == 0
    assert "mapped alike" in capsys.readouterr().out
    assert ranked(capsys, tmp_path / "trials", "--mapping", written)["hw"] == found["hw"]
    assert "soft" in (tmp_path / "o" / "ranking.html").read_text(encoding="utf-8")


def test_runs_without_seeds_are_judged_with_more_care(tmp_path: Path, capsys: Any) -> None:
    generator = np.random.default_rng(0)
    rows: list[dict[str, Any]] = [
        {"controller": name, "side": side, "cost": cost * (1.0 + 0.01 * generator.standard_normal())}
        for name, cost in (("a", 1.0), ("b", 1.2), ("c", 1.5))
        for side in ("simulation", "hardware")
        for _ in range(4)
    ]
    without = ranked(capsys, table(tmp_path / "without.csv", rows))
    seeded = [row | {"seed": seed} for seed, row in enumerate(rows)]
    with_seeds = ranked(capsys, table(tmp_path / "with.csv", seeded))
    assert (without["unknown_seeds"], with_seeds["unknown_seeds"]) == (True, False)
    assert "upper limit of the regret is taken at 0.25 %" in without["layer"]["sentence"]
    assert "0.25 %" not in with_seeds["layer"]["sentence"]
    # A worse pick, so that the limit is not at zero.
    for row in seeded:
        row["cost"] *= {("a", "hardware"): 1.22}.get((row["controller"], row["side"]), 1.0)
    narrow = ranked(capsys, table(tmp_path / "with.csv", seeded))["regret_share"]["high"]
    wide = ranked(capsys, table(tmp_path / "without.csv", [row | {"seed": ""} for row in seeded]))
    assert wide["regret_share"]["high"] > narrow + 0.005
    for seed in ("1.7", "-1"):
        said = ranked(capsys, table(tmp_path / "x.csv", [rows[0] | {"seed": seed}]), code=2)
        assert f"row 1 of {tmp_path / 'x.csv'}: seed is '{seed}'; expected a whole number, 0 or more" in said


def test_a_table_of_scores_is_ranked_by_its_numbers(tmp_path: Path, capsys: Any) -> None:
    scores = {"ar": (0.97, 0.616), "hs": (0.90, 0.50), "mpc": (0.80, 0.755), "vi": (0.70, 0.40)}
    rows: list[dict[str, Any]] = [
        {"controller": name, "side": side, "score": score}
        for name, pair in scores.items()
        for side, score in zip(("simulation", "machine"), pair, strict=True)
    ]
    found = ranked(capsys, table(tmp_path / "scores.csv", rows))
    assert (found["pick"], found["best"]) == ("ar", "mpc")
    assert found["names"] == ["mpc", "ar", "hs", "vi"]
    assert found["hw"] == [0.755, 0.616, 0.5, 0.4]
    assert found["regret"]["value"] == pytest.approx(0.755 - 0.616)
    assert found["regret_share"]["value"] == pytest.approx(1.0 - 0.616 / 0.755)
    # mpc is better than ar and hs on the machine, by 0.139 and 0.255, and worse in simulation.
    assert found["mmrv"]["value"] == pytest.approx((0.139 + 0.255 + 0.255 + 0.0) / 4)
    assert found["spearman"] == pytest.approx(0.4)
    text = "trials:\n" + "".join(
        f"- {{controller: {r['controller']}, side: {r['side']}, score: {r['score']}}}\n" for r in rows
    )
    (tmp_path / "scores.yaml").write_text(text, encoding="utf-8")
    assert ranked(capsys, tmp_path / "scores.yaml")["hw"] == found["hw"]
    repeated = [{**row, "score": row["score"] + d} for row in rows for d in (-0.01, 0.0, 0.01)]
    again = ranked(capsys, table(tmp_path / "scores.csv", repeated))
    share = again["regret_share"]
    assert 0.1 < share["low"] < share["value"] < share["high"] < 0.3
    assert again["spearman_ends"] == [pytest.approx(0.4), pytest.approx(0.4)]
    failed = [*repeated, {"controller": "ar", "side": "machine", "score": ""}]
    assert (
        "fails on the hardware in 1 of 4 runs" in ranked(capsys, table(tmp_path / "s.csv", failed))["layer"]["sentence"]
    )


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([{"controller": "a", "side": "left", "score": 1}], "row 1 of TABLE: side is 'left'; expected simulation or"),
        ([{"controller": "a", "side": "sim", "score": "x"}], "row 1 of TABLE: score is 'x'; expected a finite number"),
        (
            [{"controller": "a", "side": "sim"}],
            "row 1 of TABLE has controller, side; expected controller, side, one of",
        ),
        ([{"name": "a", "side": "sim", "cost": 1}], "TABLE has the columns name, side, cost; expected a folder, or a"),
        ([{"controller": "a", "side": "sim", "file": "no.csv"}], "no.csv does not exist"),
        ([{"controller": " ", "side": "sim", "cost": 1}], "row 1 of TABLE names no controller"),
        (
            [
                {"controller": name, "side": side, "cost": 1}
                for side in ("sim", "hw")
                for name in ("LQR" if side == "sim" else "lqr", "b", "c", "d")
            ],
            "LQR on simulation, lqr on hardware alone: a controller that is left out may be the one",
        ),
    ],
)
def test_a_row_that_is_no_trial_is_refused(tmp_path: Path, capsys: Any, rows: Any, words: str) -> None:
    path = table(tmp_path / "t.csv", rows)
    assert words.replace("TABLE", str(path)) in ranked(capsys, path, code=2)


@pytest.mark.parametrize("row", ["a,sim", "a,sim,1,5"])
def test_a_row_with_a_cell_too_few_or_too_many_is_refused(tmp_path: Path, capsys: Any, row: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(f"controller,side,cost\nb,hw,\n{row}\n", encoding="utf-8")
    assert f"row 2 of {path} has not as many cells as there are columns" in ranked(capsys, path, code=2)


def test_a_trial_that_cannot_be_ranked_is_named(tmp_path: Path, capsys: Any) -> None:
    rows = trials(tmp_path, runs=1)
    run = np.loadtxt(tmp_path / rows[0]["file"], delimiter=",", skiprows=1)
    (tmp_path / rows[0]["file"]).write_text("t,theta,omega\n", encoding="utf-8")
    with (tmp_path / rows[0]["file"]).open("a", encoding="utf-8") as file:
        np.savetxt(file, run[:, :3], delimiter=",")
    said = ranked(capsys, tmp_path, code=2)
    assert "1 of 8 recordings cannot be ranked" in said
    assert "0.csv has no input; expected the torque, or --weights with a third of 0" in said
    assert ranked(capsys, tmp_path, "--weights", "100", "0.01", "0")["pick"] == "stiff"


# -- two recordings ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Return a simulation as MATLAB file and a machine as CSV, under one noise."""
    folder = tmp_path_factory.mktemp("two")
    simulation = upright(folder / "simulation.mat", duration=8.0)
    return str(simulation), str(upright(folder / "machine.csv", hardware=True, duration=8.0))


def test_a_report_of_two_files_shows_what_was_guessed(two: tuple[str, str], tmp_path: Path, capsys: Any) -> None:
    written = tmp_path / "columns.yaml"
    out = ["--out", str(tmp_path / "page"), "--png-only", "--write-mapping", str(written)]
    assert report_main([*two, *out, "--start", "1"]) == 0
    text = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert "What was guessed" in text
    assert text.count("(assumed)") >= 2
    assert "tested: 0 hangs down" in text
    assert "recording of the hardware" in text
    # No plant is known, and what was recorded may hold the disturbance.
    assert "The recorded input on hardware spends" in text
    assert not re.search("[Cc]ontrollers? (use|ask|never)|Block diagram|Torque and noise</h3>", text)
    assert not re.search(r">(None|unknown)<", text)
    assert compare_main([*two, "--mapping", str(written), "--json"]) == 0
    assert "What was guessed" not in capsys.readouterr().out


def test_two_files_have_a_frequency_response(two: tuple[str, str], tmp_path: Path, capsys: Any) -> None:
    assert response_main([*two, "--json"]) == 2
    assert "simulation.mat does not name its plant; expected --plant" in " ".join(capsys.readouterr().err.split())
    plant = ["--plant", "thesis"]
    assert response_main([*two, *plant, "--out", str(tmp_path / "out"), "--json", "--start", "0.5"]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert [layer["layer"] for layer in found["layers"]] == ["same_plant", "which_controllers"]
    assert found["responses"]["hw"]["largest_torque_nm"] > 1.0
    assert "Guessed from names" in said.err
    # A reference that moves excites the loop, too.
    followed = response_main([*two, *plant, "--json", "--topic", "reference=noise"])
    assert (followed, len(json.loads(capsys.readouterr().out)["layers"])) == (0, 2)
    assert response_main([two[0], *plant, "--topic", "input=noise"]) == 2
    assert "holds no disturbance during the noise; expected columns of both" in " ".join(
        capsys.readouterr().err.split()
    )


def test_files_are_analysed_beside_bags(two: tuple[str, str], tmp_path: Path, capsys: Any) -> None:
    assert analyse_main([*two, "--out", str(tmp_path / "tables"), "--json"]) == 0
    rows = {row["bag"]: row for row in json.loads(capsys.readouterr().out)["bags"]}
    run = np.loadtxt(two[1], delimiter=",", skiprows=1)
    found = rows["machine.csv"]
    assert found["rms_error"] == pytest.approx(float(np.sqrt(np.mean((run[:, 1] - np.pi) ** 2))), rel=1e-6)
    assert (found["states_count"], found["states_missing"], found["error"]) == (1600, 0, "")
    assert found["states_rate"] == pytest.approx(200.0)
    assert "position: theta [rad] (assumed)" in found["guessed"]
    folder = str(Path(two[0]).parent)
    assert analyse_main([folder, "--out", str(tmp_path / "tables"), "--json", "--stop", "4"]) == 0
    rows = {row["bag"]: row for row in json.loads(capsys.readouterr().out)["bags"]}
    assert rows.keys() == {"machine.csv", "simulation.mat"}
    assert rows["machine.csv"]["duration_s"] == pytest.approx(4.0, abs=0.01)


def test_a_file_is_replayed(two: tuple[str, str], capsys: Any) -> None:
    assert replay_main([two[0], "--params", "thesis", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rms_rad"] < 1e-3


def test_a_disturbance_of_the_other_sign_is_called_so_and_the_hint_mends_it(
    two: tuple[str, str], tmp_path: Path, capsys: Any
) -> None:
    table_ = np.loadtxt(two[1], delimiter=",", skiprows=1)[:, [0, 1, 2, 4]] * np.array([1.0, 1.0, 1.0, -1.0])
    turned = tmp_path / "turned.csv"
    np.savetxt(turned, table_, delimiter=",", header="t,theta,omega,noise", comments="", fmt="%.9g")
    written = tmp_path / "columns.yaml"
    assert compare_main([two[0], str(turned), "--json", "--write-mapping", str(written)]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("the disturbances of both have opposite signs (correlation -1.00)" in note for note in notes)
    content = yaml.safe_load(written.read_text(encoding="utf-8"))
    content["recordings"]["turned.csv"]["disturbance"]["sign"] = -1
    written.write_text(yaml.safe_dump(content), encoding="utf-8")
    assert compare_main([two[0], str(turned), "--json", "--mapping", str(written)]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("where the disturbances of both are most alike (correlation 1.000)" in note for note in notes)


def test_a_cart_on_a_spring_is_not_found_to_be_an_angle_in_degrees(tmp_path: Path) -> None:
    dt, rows = 0.005, []
    place, speed = 0.4, 0.0
    for push in np.repeat(np.random.default_rng(0).normal(0.0, 2.0, 200), 20):
        rows.append((place, speed, push))
        speed += dt * (-9.0 * place - 0.3 * speed + push)
        place += dt * speed
    table_ = np.column_stack([dt * np.arange(len(rows)), rows])
    np.savetxt(tmp_path / "y.csv", table_, delimiter=",", header="time,y1_position,y1_velocity,u", comments="")
    (guess,) = [one for one in Reading(tmp_path / "y.csv").guesses if one.quantity == "position"]
    assert guess.assumed
    assert "rad: assumed, for the file does not say: small angles in degrees, and a place in m, move alike" in guess.how


def test_trials_of_several_joints_cost_what_the_plants_lqr_weighs(tmp_path: Path, capsys: Any) -> None:
    plant = load_mechanism("acrobot")
    q, r = plant.mechanism.weights
    costs = {}
    t = 0.01 * np.arange(400.0)
    for side in ("simulation", "hardware"):
        for number, name in enumerate(("a", "b", "c"), start=1):
            size = 0.01 * number if side == "simulation" else 0.01 * (4 - number)
            angles = size * np.stack([np.sin(3.0 * t), np.cos(5.0 * t)], axis=1)
            speeds = size * np.stack([3.0 * np.cos(3.0 * t), -5.0 * np.sin(5.0 * t)], axis=1)
            torque = size * np.sin(4.0 * t)
            costs[side, name] = float(np.mean(angles**2, axis=0) @ q[:2] + np.mean(speeds**2, axis=0) @ q[2:])
            costs[side, name] += float(r * np.mean(torque**2))
            rows = np.column_stack([t, angles + np.array([np.pi, 0.0]), speeds, torque])
            path = tmp_path / side / f"{name}.csv"
            path.parent.mkdir(exist_ok=True)
            header = "time,shoulder_pos,elbow_pos,shoulder_vel,elbow_vel,elbow_torque"
            np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.12g")
    sections = {
        joint: {
            "position": {"column": f"{joint}_pos", "unit": "rad"},
            "velocity": {"column": f"{joint}_vel", "unit": "rad/s"},
        }
        for joint in ("shoulder", "elbow")
    }
    sections["elbow"]["input"] = {"column": "elbow_torque", "unit": "N m"}
    mapping = tmp_path / "columns.yaml"
    content = {"format": "pendulum_columns/1", "time": {"column": "time", "unit": "s"}, "joints": sections}
    mapping.write_text(yaml.safe_dump(content), encoding="utf-8")
    found = ranked(capsys, tmp_path, "--mapping", mapping, "--plant", "acrobot")
    assert found["names"] == ["c", "b", "a"]
    assert found["hw"] == pytest.approx([costs["hardware", name] for name in "cba"], rel=1e-6)
    assert found["spearman"] == pytest.approx(-1.0)
    assert "expected --plant, whose LQR weighs them" in ranked(capsys, tmp_path, "--mapping", mapping, code=2)


def cart_with_pole(path: Path, seed: int, *, late: int = 0, order: Sequence[int] = range(7), flip: int = 0) -> str:
    """Write a cart on a spring and what hangs from it, under noise; columns in some order, the sign of one turned."""
    t = 0.01 * np.arange(4000)
    noise = np.repeat(np.random.default_rng(0).normal(0.0, 2.0, 400), 10)
    a = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-9.0, 0.0, -3.0, 0.0], [9.0, -25.0, 3.0, -4.0]])
    b = np.array([[0.0], [0.0], [1.0], [-1.0]])
    felt = np.concatenate([np.zeros(late), noise[: noise.size - late]])
    motion = scipy.signal.lsim((a, b, np.eye(4), np.zeros((4, 1))), felt, t)[1]
    rows = np.column_stack([t, motion + np.random.default_rng(seed).normal(0.0, 1e-4, motion.shape), felt, noise])
    if flip:
        rows[:, [flip, flip + 2]] *= -1.0
    names = ["time", "cart_pos", "pole_angle", "cart_vel", "pole_vel", "cart_force [N]", "disturbance"]
    header = ",".join(names[place] for place in order)
    np.savetxt(path, rows[:, list(order)], delimiter=",", header=header, comments="")
    return str(path)


def test_a_disturbance_at_one_joint_is_that_of_all(tmp_path: Path, capsys: Any) -> None:
    order = (0, 1, 2, 3, 4, 6)
    paths = [cart_with_pole(tmp_path / f"{i}.csv", i, late=late, order=order) for i, late in enumerate((0, 4))]
    assert compare_main([*paths, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["answer"]["mark"] == "no"
    delays = [
        test["estimate"] for one in found["joints"].values() for test in one["verdict"]["tests"]
        if test["quantity"] == "delay"
    ]  # fmt: skip
    assert delays == [pytest.approx(40.0, abs=2.0)] * 2


def test_joints_in_another_order_are_the_same_and_an_opposite_sign_names_its_joint(tmp_path: Path, capsys: Any) -> None:
    plain, other = cart_with_pole(tmp_path / "a.csv", 0), (0, 2, 1, 4, 3, 5, 6)
    turned = cart_with_pole(tmp_path / "b.csv", 1, order=other)
    (ours, theirs), _, _ = read_responses([Path(plain), Path(turned)])
    assert (ours.joints, theirs.joints) == (("cart", "pole_angle"),) * 2
    (same,), _, _ = read_responses([Path(cart_with_pole(tmp_path / "c.csv", 1))])
    np.testing.assert_allclose(theirs.response, same.response, rtol=1e-9)
    assert read_responses([Path(plain)], ("pole_angle", "cart"))[0][0].joints == ("pole_angle", "cart")
    assert compare_main([plain, cart_with_pole(tmp_path / "d.csv", 1, flip=2)]) == 2
    assert "the hardware's angle of pole_angle in" in " ".join(capsys.readouterr().err.split())
    assert compare_main([plain, "--start", "50"]) == 2
    assert f"got {plain}; expected recordings" in " ".join(capsys.readouterr().err.split())
    assert compare_main([plain, turned, "--start", "50"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "has 0 samples from 50 s after its start, and ends at 39.99 s; expected at least 4" in said
