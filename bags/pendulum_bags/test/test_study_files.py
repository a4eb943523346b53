"""Study files: what they accept, what they refuse and where, and the matrix that they make."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_bags.experiments.settings import RegulationSettings
from pendulum_bags.studies.results import group_runs, groups_to_json
from pendulum_bags.studies.study_file import AXES, load_study, shipped_studies
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_testing.policies import linear_policy

HEAD = "format: pendulum_study/1\nname: small\n"
BODY = "plants:\n  sim: {}\ncontrollers:\n  lqr: {}\n"


def study_file(folder: Path, text: str) -> Path:
    path = folder / "study.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_shipped_study_is_valid_and_says_what_it_needs() -> None:
    assert set(shipped_studies()) >= {
        "thesis",
        "pid_vs_lqr",
        "strategies",
        "inertia_damping",
        "gravity",
        "random_start",
    }
    for name in shipped_studies():
        study = load_study(name)
        assert study.name == name
        assert study.description
        assert all(run.seconds > 0.0 and run.bytes > 0 for run in study.runs)
        assert len({run.name for run in study.runs}) == len(study.runs)


_WITHOUT = """
import sys
sys.modules["casadi"] = None
from pendulum_bags.studies.study_file import load_study
study = load_study(sys.argv[1])
print(*sorted({run.labels["controller"] for run in study.runs}), *study.left_out, sep="\\n")
"""


def run_without_casadi(study: Path | str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _WITHOUT, str(study)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_ranking_that_a_report_suggests_runs_without_the_extras_and_names_what_is_left_out() -> None:
    found = run_without_casadi("ranking")
    assert found.returncode == 0, found.stderr
    left_out = [line for line in found.stdout.splitlines() if line.startswith("controller ")]
    assert [line.split(":")[0] for line in left_out] == ["controller tvlqr", "controller nmpc"]
    assert all("make extras" in line for line in left_out)
    assert len(found.stdout.splitlines()) == 32
    assert not load_study("ranking").left_out


def test_a_controller_that_is_not_optional_needs_its_library_and_an_optional_one_exists(tmp_path: Path) -> None:
    text = HEAD + "plants:\n  sim: {}\ncontrollers:\n  nmpc: {}\n  lqr: {}\n"
    found = run_without_casadi(study_file(tmp_path, text))
    assert "study.yaml:6: controller nmpc: casadi is not installed" in found.stderr
    with pytest.raises(ParameterError, match=r"study.yaml:8: optional has 'mpc'; expected names of controllers"):
        load_study(study_file(tmp_path, text + "optional: [mpc]\n"))
    with pytest.raises(ParameterError, match=r"study.yaml:7: controller is 'lgr'"):
        load_study(
            study_file(tmp_path, HEAD + "plants:\n  sim: {}\ncontrollers:\n  lqr: {}\n  lgr: {}\noptional: [lgr]\n")
        )


def test_matrix_is_the_product_of_all_axes_in_their_order(tmp_path: Path) -> None:
    text = HEAD + (
        "plants:\n  a: {}\n  b: {side: hw}\ncontrollers:\n  lqr: {}\n  pid: {}\n"
        "set_points: [0.0, 0.1]\nstarts: [upright, bottom]\nseeds: {first: 4, count: 3}\nrepeats: 2\n"
    )
    runs = load_study(study_file(tmp_path, text)).runs
    assert len(runs) == 2 * 2 * 2 * 2 * 3 * 2
    assert [run.labels["seed"] for run in runs[:6]] == [4, 4, 5, 5, 6, 6]
    assert runs[-1].spec is not None
    assert (runs[-1].spec.side, runs[-1].spec.controller, runs[-1].spec.theta) == ("hw", "pid", 0.0)


def test_runs_of_several_joints_have_no_metrics_and_are_grouped_all_the_same() -> None:
    labels = dict.fromkeys(AXES, "a")
    records = [{"labels": {**labels, "seed": seed}, "status": "done"} for seed in (1, 2)]
    (group,) = group_runs(records)
    assert (group.seeds, group.values, group.failed) == ((1, 2), {}, 0)
    assert groups_to_json([group])[0]["runs"] == 2


def test_weights_of_one_joint_are_refused_for_several_before_anything_runs() -> None:
    with pytest.raises(ParameterError, match=r"q is \[100.0, 0.01\] for cart \[m\], pole \[rad\]; expected weights of"):
        RunSpec(plant="cart_pole", design_plant="cart_pole", controller_parameters={"q": [100.0, 0.01]})


def test_random_starts_follow_the_seed_alone(tmp_path: Path) -> None:
    first = load_study(study_file(tmp_path, HEAD + BODY + "starts: [random]\nseeds: [1, 2, 3]\n")).runs
    other = load_study(study_file(tmp_path, HEAD + BODY + "starts: [random]\nseeds: [3]\n")).runs
    angles = [run.spec.theta for run in first if run.spec]
    assert len(set(angles)) == 3
    assert other[0].spec is not None
    assert other[0].spec.theta == angles[2]


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        (HEAD + "plant:\n  sim: {}\n" + BODY, 3, "did you mean 'plants'"),
        ("format: pendulum_study/9\nname: x\n" + BODY, 1, "expected 'pendulum_study/1'"),
        (HEAD + "plants:\n  sim: {sidee: hw}\ncontrollers:\n  lqr: {}\n", 4, "did you mean 'side'"),
        (HEAD + "plants:\n  sim: {}\ncontrollers:\n  lqr: {q: [1.0, 0.1], rr: 0.1}\n", 6, "unknown parameter 'rr'"),
        (HEAD + BODY + "disturbances:\n  noise: {amplitud: 1.0}\n", 8, "did you mean 'amplitude'"),
        (HEAD + BODY + "starts: [upright, sideways]\n", 7, "'sideways'"),
        (HEAD + BODY + "seeds: [1, 1]\n", 7, "given twice"),
        (HEAD + BODY + "seeds: {first: 1}\n", 7, "count is missing"),
        (HEAD + BODY + "duration: long\n", 7, "expected a number of seconds"),
        (HEAD + BODY + "repeats: 0\n", 7, "expected >= 1"),
        (HEAD + "plants:\n  sim: {side: hw, engine: process}\ncontrollers:\n  lqr: {}\n", 4, "plain simulator"),
        (HEAD + BODY + "clock: fast\n", 7, "expected one of lockstep, realtime"),
        (HEAD + "clock: realtime\nplants:\n  sim: {engine: process}\ncontrollers:\n  lqr: {}\n", 5, "in real time"),
        (HEAD + "clock: realtime\nplants:\n  h: {side: hw}\ncontrollers:\n  lqr: {}\nstarts: [1.0]\n", 5, "at rest"),
        (HEAD + "experiment: thesis\nclock: lockstep\n", 4, "expected realtime"),
    ],
)
def test_a_mistake_is_refused_with_its_line(tmp_path: Path, text: str, line: int, says: str) -> None:
    path = study_file(tmp_path, text)
    with pytest.raises(ParameterError, match=r"study\.yaml") as caught:
        load_study(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:{line}: ")
    assert says in message


def test_unknown_study_lists_those_there_are() -> None:
    with pytest.raises(ParameterError, match="pid_vs_lqr"):
        load_study("pid_vs_lqg")


def test_a_study_says_whether_it_keeps_the_time_of_the_wall(tmp_path: Path) -> None:
    study = load_study(study_file(tmp_path, HEAD + BODY + "clock: realtime\n"))
    assert study.realtime
    (run,) = study.runs
    assert run.spec is not None
    program = run.spec.plant_program(4)
    assert program.parameters["clock"] == "realtime"
    assert not any(name.startswith("lockstep") for name in program.parameters)
    assert run.spec.controller_program().parameters["use_sim_time"] is False
    named = load_study(study_file(tmp_path, HEAD + "experiment: gravity\nclock: realtime\n"))
    assert named.runs[0].arguments[-1] == "--realtime"
    assert not load_study("gravity").realtime
    assert load_study("thesis").realtime


def test_a_policy_file_beside_the_study_is_a_controller_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "study").mkdir()
    write_policy(tmp_path / "study" / "mine.npz", linear_policy(load_plant("thesis"), 20.0, 1.0))
    text = HEAD + (
        "plants:\n  sim: {engine: process}\ncontrollers:\n  lqr: {}\n  mine: {kind: policy, policy: mine.npz}\n"
        "disturbances:\n  noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}\nduration: 0.5\n"
    )
    monkeypatch.chdir(tmp_path)  # the path begins at the study's folder, wherever it is called from
    lqr, mine = load_study(study_file(tmp_path / "study", text)).runs
    assert (mine.labels["controller"], mine.name) == ("mine", "00002_sim_mine_noise_upright_seed1")
    assert lqr.spec is not None
    assert mine.spec is not None
    arrays = simulate(mine.spec)
    seen = arrays.position - np.pi, arrays.velocity
    # Every fifth state is answered anew, within what a policy may ask for in its first 0.2 s.
    late = slice(100, 250, 5)
    np.testing.assert_allclose(arrays.command[late], -20.0 * np.sin(seen[0][late]) - seen[1][late], atol=1e-4)
    (tmp_path / "study" / "mine.npz").unlink()
    with pytest.raises(ParameterError, match=r"study\.yaml:\d+.*mine\.npz does not exist"):
        load_study(tmp_path / "study" / "study.yaml")


def test_plants_of_a_shipped_study_are_replaced_and_its_text_says_so(tmp_path: Path) -> None:
    own = write_plant(tmp_path / "own.yaml", load_plant("thesis").with_values(damping=12.0))
    plants = {"sim": {"plant": str(own), "design_plant": str(own)}, "hw": {"strategy": "effort_loop"}}
    study = load_study("pid_vs_lqr", seeds=[1], plants=plants)
    for run in study.runs:
        assert run.spec is not None
        sim = run.spec.side == "sim"
        assert (run.spec.plant, run.spec.design_plant) == ((str(own), str(own)) if sim else ("thesis", "thesis"))
        assert run.spec.strategy == ("direct_pwm" if sim else "effort_loop")
    (tmp_path / "study.yaml").write_text(study.text)
    assert load_study(tmp_path / "study.yaml", seeds=[1]).runs == study.runs


def test_a_run_is_of_a_plant_by_its_values_and_not_by_the_name_of_its_file(tmp_path: Path) -> None:
    thesis = RunSpec()
    copied = write_plant(tmp_path / "copied.yaml", load_plant("thesis"))
    other = write_plant(tmp_path / "other.yaml", load_plant("thesis").with_values(damping=12.0))
    assert RunSpec(plant=str(copied)).identity == thesis.identity
    assert RunSpec(plant=str(other)).identity != thesis.identity
    assert thesis.metadata()["pendulum.run"]["identity"] == thesis.identity
    machine = RunSpec(side="hw")
    assert machine.identity == RunSpec(side="hw", design_plant=str(other)).identity
    assert len({thesis.identity, machine.identity, RunSpec(side="hw", strategy="effort_loop").identity}) == 3
    # The experiment in real time is of the same plants as its repeats in lockstep.
    settings = RegulationSettings(plant=str(other))
    for side in ("sim", "hw"):
        assert settings.identity(side) == settings.run(side).identity
        assert settings.metadata("thesis", side=side)["pendulum.run"]["identity"] == settings.identity(side)
