"""Published controllers of the contests: policies with known torques, closed loops, predictions of hand-made trials."""

from __future__ import annotations

import io
import math
import os
import pickle
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.public_study_cli import main
from pendulum_bags.studies.real_ai_gym import CONTESTS, read_trials, score_of, trajectory_rows
from pendulum_bags.studies.real_ai_gym_policies import (
    _BOARD_POLICIES,
    BOARD_PLANT,
    board_jobs,
    closed_loop,
    prediction_jobs,
)
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism

IROS = CONTESTS[3]
PERIOD = 0.03
HEADER = "time,pos_meas1,pos_meas2,vel_meas1,vel_meas2,tau_con1,tau_con2,tau_pert1,tau_pert2"
DESIGN = Path("data/policies/design_C.1")


def sums(seed: int) -> dict[str, np.ndarray]:
    """Five Gaussians over velocities, cosines and sines."""
    rng = np.random.default_rng(seed)
    return {
        "log_lengthscales": rng.normal(0.0, 0.3, 6),
        "centers": rng.normal(0.0, 1.0, (5, 6)),
        "linear_weights": rng.normal(0.0, 3.0, (1, 5)),
    }


def torque(part: dict[str, np.ndarray], limit: float, state: np.ndarray) -> float:
    """Evaluate such a policy, Gaussian by Gaussian."""
    seen = (*state[2:], *np.cos(state[:2]), *np.sin(state[:2]))
    total = 0.0
    for centre, weight in zip(part["centers"], part["linear_weights"][0], strict=True):
        squares = sum(
            ((c - s) / math.exp(scale)) ** 2 for c, s, scale in zip(centre, seen, part["log_lengthscales"], strict=True)
        )
        total += weight * math.exp(-squares)
    return limit * math.tanh(total / limit)


@pytest.fixture
def clones(tmp_path: Path) -> tuple[Path, Path]:
    """Clones of trials and of policies: two trials of MC-PILCO on the pendubot, whose torques are the policy's."""
    parts = [sums(1), sums(2)]
    file = tmp_path / "policies" / DESIGN / "model_1.0/pendubot/MC-PILCO/policy_hardware_2024.np"
    file.parent.mkdir(parents=True)
    file.write_bytes(pickle.dumps(parts))
    rng = np.random.default_rng(3)
    for number in (1, 2):
        rows = []
        for k in range(int(10.0 / PERIOD) + 1):
            state = rng.normal(0.0, 1.0, 4)
            rows.append((k * PERIOD, *state, torque(parts[0], 6.0, state), torque(parts[1], 0.5, state), 0.0, 0.0))
        for name in ("mcpilco", "ar_eapo"):
            folder = tmp_path / "trials/data/pendubot" / IROS.folder / name / f"experiment{number:02}"
            folder.mkdir(parents=True)
            np.savetxt(folder / "trajectory.csv", rows, delimiter=",", header=HEADER, comments="")
            score = score_of(IROS, "pendubot", folder / "trajectory.csv")[0]
            (folder / "scores_v2.csv").write_text(f"RealAI Score\n{score!r}\n")
    return tmp_path / "trials", tmp_path / "policies"


def test_a_policy_is_compared_with_its_logs_and_a_plant_predicts_each_trial(clones):
    data, policies = clones
    trials = read_trials(data)
    own, other = (job() for job in prediction_jobs(data, policies, trials, ["double_pendulum"]))
    assert (own.robot, own.plant, other.plant) == ("pendubot", BOARD_PLANT, "double_pendulum")
    assert own.difference < 1e-12
    assert own.machine == tuple(one.score for one in trials if one.controller == "mcpilco")
    assert set(own.predicted) == {(False, True), (False, False)}
    assert set(other.predicted) == {(True, True), (True, False), (False, True), (False, False)}
    assert {len(scores) for scores in other.predicted.values()} == {2}
    # A log whose driven torque is 0.2 N m off in one of two trials differs by 0.2 / 2 rms over both joints.
    log = data / "data/pendubot" / IROS.folder / "mcpilco/experiment02/trajectory.csv"
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    rows[:, 5] += 0.2
    np.savetxt(log, rows, delimiter=",", header=HEADER, comments="")
    assert prediction_jobs(data, policies, trials, [])[0]().difference == pytest.approx(0.1, rel=1e-6)


def test_the_machines_loop_acts_a_period_later_on_velocities_that_are_differences():
    plant = load_mechanism(BOARD_PLANT)
    asked = []

    def policy(state):
        asked.append(state)
        return np.array([10.0, 10.0])

    on_time = closed_loop(plant, policy, PERIOD, (2.0, 0.0), as_machine=False, duration=0.3)
    assert on_time.shape == (10, 7)
    assert np.array_equal(on_time[:, 5:], np.tile([2.0, 0.0], (10, 1)))
    late = closed_loop(plant, policy, PERIOD, (2.0, 0.0), as_machine=True, duration=0.3)
    assert not late[1, 1:5].any()
    assert np.allclose(late[2:, 1:3], on_time[1:-1, 1:3], rtol=1e-12)
    assert np.allclose(late[1:, 3:5], np.diff(late[:, 1:3], axis=0) / PERIOD, rtol=1e-12)
    assert np.array_equal(np.array(asked[-10:]), late[:, 1:5])
    # Of rest, the first period's torque gives the shoulder the speed of its own inertia, M^-1 (2, 0) 30 ms.
    inertia, mass, length = plant.value("inertia_1"), plant.value("mass_2"), plant.value("length_1")
    i2, c2 = plant.value("inertia_2"), plant.value("centre_2")
    coupled = i2 + mass * length * c2
    matrix = np.array([[inertia + i2 + mass * length**2 + 2.0 * mass * length * c2, coupled], [coupled, i2]])
    assert on_time[1, 3:5] == pytest.approx(np.linalg.solve(matrix, [2.0, 0.0]) * PERIOD, rel=0.05)
    # A push acts by its own clock, without the limit, and the last one stays.
    pushed = closed_loop(
        plant,
        lambda _: np.zeros(2),
        PERIOD,
        (2.0, 0.0),
        as_machine=False,
        pushes=np.array([[0.0, 0.0]] * 15 + [[2.0, 0.0]]),
        duration=0.3,
    )
    assert np.allclose(pushed[2:, 1:5], on_time[1:-1, 1:5], rtol=1e-9)


def torch_file(tensors: dict[str, np.ndarray]) -> bytes:
    """Return the file that ``torch.save`` writes of a state, with its own pickle of names that torch has."""
    modules = {name: types.ModuleType(name) for name in ("torch", "torch._utils")}

    class FloatStorage:
        __module__ = "torch"

    def _rebuild_tensor_v2(*_: object) -> None: ...

    FloatStorage.__qualname__ = "FloatStorage"
    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    modules["torch"].FloatStorage, modules["torch._utils"]._rebuild_tensor_v2 = FloatStorage, _rebuild_tensor_v2  # type: ignore[attr-defined]

    class Stored:
        def __init__(self, key: str, size: int) -> None:
            self.key, self.size = key, size

    class Tensor:
        def __init__(self, key: str, values: np.ndarray) -> None:
            self.storage, self.values = Stored(key, values.size), values

        def __reduce__(self) -> tuple:
            strides = tuple(step // 4 for step in self.values.strides)
            return _rebuild_tensor_v2, (self.storage, 0, self.values.shape, strides, False, OrderedDict())

    class Pickler(pickle.Pickler):
        def persistent_id(self, one: object) -> object:
            return ("storage", FloatStorage, one.key, "cpu", one.size) if isinstance(one, Stored) else None

    arrays = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in tensors.items()}
    out, content = io.BytesIO(), io.BytesIO()
    sys.modules.update(modules)
    try:
        Pickler(out, protocol=2).dump(OrderedDict((n, Tensor(str(i), v)) for i, (n, v) in enumerate(arrays.items())))
    finally:
        for name in modules:
            del sys.modules[name]
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("archive/data.pkl", out.getvalue())
        for i, values in enumerate(arrays.values()):
            archive.writestr(f"archive/data/{i}", values.tobytes())
    return content.getvalue()


def test_networks_of_the_board_run_with_their_scales_and_normalisation(clones):
    data, policies = clones
    rng = np.random.default_rng(4)
    holder = types.SimpleNamespace(obs_rms=types.SimpleNamespace(mean=np.full(4, 0.1), var=np.full(4, 0.25)))
    for name, sizes in (("AR_EAPO", "mlp_extractor.policy_net action_net"), ("evolsac", "actor.latent_pi actor.mu")):
        hidden, last = sizes.split()
        state = {
            f"{hidden}.0.weight": rng.normal(size=(8, 4)), f"{hidden}.0.bias": rng.normal(size=8),
            f"{hidden}.2.weight": rng.normal(size=(8, 8)), f"{hidden}.2.bias": rng.normal(size=8),
            f"{last}.weight": 0.1 * rng.normal(size=(1, 8)), f"{last}.bias": 0.1 * rng.normal(size=1),
        }  # fmt: skip
        for robot in ("acrobot", "pendubot"):
            model = "model_1.1" if name == "AR_EAPO" else "model_1.0"
            folder = policies / DESIGN / model / robot / name
            folder.mkdir(parents=True)
            (folder / "vec_normalize_env.pkl").write_bytes(pickle.dumps(holder))
            with zipfile.ZipFile(folder / "model.zip", "w") as archive:
                archive.writestr("policy.pth", torch_file(state))
    for robot in ("acrobot", "pendubot"):
        for name in ("ar_eapo", "evolsac"):
            folder = data / "data" / robot / IROS.simulation / name
            folder.mkdir(parents=True)
            (folder / "scores.csv").write_text("RealAI Score\n0.5\n")
        state = {name: values.astype(np.float32).astype(float) for name, values in state.items()}
        scale, speed, mean, deviation = (6.0, 20.0, 0.1, 0.5) if name == "AR_EAPO" else (3.0, 50.0, 0.0, 1.0)
        read = _BOARD_POLICIES[name.lower()](policies / DESIGN, "acrobot")
        for x in (np.array([0.3, -0.2, 1.0, -2.0]), np.array([7.0, 2.0, 60.0, -60.0])):
            seen = np.array(
                [math.remainder(a - math.pi, 2.0 * math.pi) / math.pi for a in x[:2]]
                + [max(-1.0, min(1.0, v / speed)) for v in x[2:]]
            )
            out = (seen - mean) / deviation
            for i in (0, 2):
                out = np.maximum(state[f"{hidden}.{i}.weight"] @ out + state[f"{hidden}.{i}.bias"], 0.0)
            torques = scale * math.tanh(float((state[f"{last}.weight"] @ out)[0] + state[f"{last}.bias"][0]))
            assert read(x) == pytest.approx([0.0, torques], abs=1e-4)
    rows = [job() for job in board_jobs(data, policies, ["double_pendulum"])]
    assert [(one.robot, one.controller, one.published) for one in rows] == [
        (robot, name, 0.5) for robot in ("acrobot", "pendubot") for name in ("ar_eapo", "evolsac")
    ]
    assert all(0.0 <= one.computed <= 1.0 and set(one.elsewhere) == {"double_pendulum"} for one in rows)


def test_a_file_of_a_policy_runs_nothing_that_it_names(clones, capsys):
    data, policies = clones
    file = policies / DESIGN / "model_1.0/pendubot/MC-PILCO/policy_hardware_2024.np"

    class Named:
        def __reduce__(self) -> tuple:
            return print, ("code of the file ran",)

    file.write_bytes(pickle.dumps([Named(), Named()]))
    trials = read_trials(data)
    with pytest.raises(DataError, match=r"policy_hardware_2024\.np holds no two sums of Gaussians"):
        prediction_jobs(data, policies, trials, [])[0]()
    file.write_bytes(file.read_bytes()[:20])
    with pytest.raises(DataError, match=r"policy_hardware_2024\.np is no whole file of a policy"):
        prediction_jobs(data, policies, trials, [])[0]()
    assert "ran" not in capsys.readouterr().out
    assert main(["real_ai_gym", "--data", str(data), "--plant", "acrobot"]) == 2
    assert "--plant is acrobot without --policies; expected both" in capsys.readouterr().err


def test_the_published_controllers_score_as_published(shared_data):
    folders = [
        Path(os.environ.get(variable, shared_data / name))
        for variable, name in (
            ("REAL_AI_GYM_LEADERBOARD", "real_ai_gym_leaderboard"),
            ("DOUBLE_PENDULUM", "double_pendulum"),
        )
    ]
    for folder in folders:
        if not (folder / "data").is_dir():
            pytest.skip(f"no clone at {folder}; REAL_AI_GYM_LEADERBOARD and DOUBLE_PENDULUM name the folders")
    data, policies = folders
    rows = [job() for job in board_jobs(data, policies, [])]
    assert [one.computed for one in rows] == pytest.approx([one.published for one in rows], abs=1e-4)
    predictions = [job() for job in prediction_jobs(data, policies, read_trials(data), [])]
    predicted = {one.robot: one for one in predictions}
    assert all(one.difference < 1e-9 for one in predicted.values())
    assert np.mean(predicted["pendubot"].predicted[False, False]) == pytest.approx(0.6, abs=0.1)
    for trajectory in (data / "data").glob("*/real_system*/*/*/trajectory.csv"):
        rows = trajectory_rows(trajectory)
        differences = np.diff(rows[:, 1:3], axis=0) / np.diff(rows[:, 0])[:, None]
        assert np.array_equal(rows[1:, 3:5], differences), trajectory


@pytest.mark.parametrize(
    ("plants", "why"),
    [
        (["thesis"], "--plant thesis is a pendulum, driven at pendulum_joint; expected a double_pendulum"),
        (["acrobot"], "--plant acrobot is a double_pendulum, driven at elbow; expected"),
        (["double_pendulum"] * 2, "double_pendulum, double_pendulum; expected files of different names"),
        ([BOARD_PLANT], f"none {BOARD_PLANT}"),
    ],
)
def test_plants_that_cannot_be_compared_are_refused_before_any_run(clones, capsys, plants, why):
    data, policies = clones
    options = [option for plant in plants for option in ("--plant", plant)]
    assert main(["real_ai_gym", "--data", str(data), "--policies", str(policies), *options]) == 2
    assert why in capsys.readouterr().err


def test_a_file_in_place_of_the_out_folder_is_refused_before_any_run(clones, capsys, tmp_path):
    data, policies = clones
    (tmp_path / "out").write_text("")
    options = ["--data", str(data), "--policies", str(policies), "--out", str(tmp_path / "out")]
    # (the runs would ask for the board's controllers, which these clones lack)
    assert main(["real_ai_gym", *options]) == 2
    assert f"{tmp_path / 'out'} cannot be" in capsys.readouterr().err
