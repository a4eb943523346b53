"""Monte Carlo: chunks are pure functions, whoever computes them; probabilities and replays are right."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.analyse.bag_table import analyse_bags, find_pieces
from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.studies.chunks import chunk_path, cluster_client, read_columns
from pendulum_bags.studies.monte_carlo import MonteCarlo, draw_chunk, replay, run_chunk, run_monte_carlo, sobol
from pendulum_bags.studies.uncertain import Uncertainty, parse_uncertainty, uncertainty_of
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_testing.fixtures import PROJECT, in_repository, wait_for

EXAMPLES = PROJECT / "bags" / "examples"
SMALL = MonteCarlo(runs=700, chunk=300, duration=0.4)


def has_arrow() -> bool:
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        return False
    return True


arrow = pytest.mark.skipif(not has_arrow(), reason="pyarrow cannot be imported with this numpy")


def test_a_chunk_depends_on_settings_and_index_alone() -> None:
    first, again = run_chunk(SMALL, 1), run_chunk(SMALL, 1, threads=1)
    for name, values in first.items():
        assert np.array_equal(values, again[name]), name
    assert len(run_chunk(SMALL, 2)["max_theta"]) == 100


def test_parameters_scatter_as_configured_and_stay_positive() -> None:
    drawn = draw_chunk(replace(SMALL, runs=200_000, chunk=200_000), 0)
    assert drawn["damping"].mean() == pytest.approx(11.77, rel=1e-3)
    assert drawn["damping"].std() == pytest.approx(0.05 * 11.77, rel=1e-2)
    assert drawn["inertia"].min() > 0.0


def test_every_run_of_every_chunk_and_of_every_monte_carlo_has_noise_of_its_own() -> None:
    seeds = [
        draw_chunk(replace(SMALL, seed=seed), index)["noise_seed"] for seed in (1, 2) for index in range(SMALL.chunks)
    ]
    assert len(np.unique(np.concatenate(seeds))) == 2 * SMALL.runs


def test_one_run_replayed_alone_is_the_run_of_the_batch() -> None:
    columns = run_chunk(SMALL, 1)
    row, motion = replay(SMALL, 300 + 17)
    assert row["max_theta"] == columns["max_theta"][17]
    assert row["theta_end"] == columns["theta_end"][17]
    assert np.abs(motion[:, 0] - np.pi).max() == pytest.approx(row["max_theta"], abs=1e-15)


@arrow
@pytest.mark.parametrize("before", [300, 450])
def test_runs_are_added_to_those_there_are(tmp_path: Path, before: int) -> None:
    run_monte_carlo(tmp_path / "grown", replace(SMALL, runs=before))
    kept = (tmp_path / "grown" / "runs_00000.parquet").stat().st_mtime_ns
    grown = run_monte_carlo(tmp_path / "grown", SMALL)
    assert (tmp_path / "grown" / "runs_00000.parquet").stat().st_mtime_ns == kept
    assert grown == run_monte_carlo(tmp_path / "at_once", SMALL)
    with pytest.raises(BagError, match=f"of 700 runs; expected at most the {before} of this one"):
        run_monte_carlo(tmp_path / "grown", replace(SMALL, runs=before))


def test_a_run_is_the_same_however_many_follow_it() -> None:
    few, many = draw_chunk(replace(SMALL, runs=310), 1), draw_chunk(SMALL, 1)
    assert {name: values.tolist() for name, values in few.items()} == {
        name: values[:10].tolist() for name, values in many.items()
    }


@arrow
def test_an_interrupted_monte_carlo_goes_on_and_workers_change_no_bit(tmp_path: Path) -> None:
    def stop(done: int, _total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_monte_carlo(tmp_path / "one", SMALL, on_progress=stop)
    one = run_monte_carlo(tmp_path / "one", SMALL)
    other = run_monte_carlo(tmp_path / "other", SMALL)
    assert one == other
    for file in (tmp_path / "one").glob("*.parquet"):
        assert file.read_bytes() == (tmp_path / "other" / file.name).read_bytes()
    low, high = one["probability_interval"]
    assert low <= one["probability_inside"] <= high
    with pytest.raises(BagError, match="other settings"):
        run_monte_carlo(tmp_path / "one", replace(SMALL, seed=2))


@arrow
@in_repository
def test_a_cluster_that_loses_a_worker_mid_run_gives_the_same_bits(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    settings = replace(SMALL, chunk=50)
    here = run_monte_carlo(tmp_path / "here", settings)
    with cluster_client(workers=2) as client:
        connect = partial(nullcontext, client)
        before = set(client.run(os.getpid).values())
        victim = max(before)

        def kill(done: int, _total: int) -> None:
            if done == 1:
                os.kill(victim, signal.SIGKILL)

        cluster = run_monte_carlo(tmp_path / "cluster", settings, connect=connect, on_progress=kill)
        wait_for(lambda: len(client.scheduler_info()["workers"]) == 2, 30, "the cluster to replace its worker")
        after = set(client.run(os.getpid).values())
        pieces = find_pieces([EXAMPLES], ["metrics"])
        bags = analyse_bags(tmp_path / "bags_there", pieces, ["metrics"], connect=connect)
    assert analyse_bags(tmp_path / "bags_here", pieces, ["metrics"]) == bags
    assert bags.failed == 0
    for name in ("bags.csv", "bags.json"):
        assert (tmp_path / "bags_there" / name).read_bytes() == (tmp_path / "bags_here" / name).read_bytes()
    assert victim not in after
    assert here == cluster
    for file in (tmp_path / "here").glob("*.parquet"):
        assert file.read_bytes() == (tmp_path / "cluster" / file.name).read_bytes()


def test_indices_of_what_does_not_vary_are_null_for_readers_of_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = ["--uncertainty", "inertia=0", "--start", "0", "--amplitude", "0"]
    short = ["--runs", "2", "--duration", "0.1", "--sobol", "2", "--workers", "0"]
    assert main(["monte_carlo", *nothing, *short, "--out", str(tmp_path / "mc"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert told["sobol"]["indices"] == [
        {"factor": "noise", "first": None, "first_confidence": None, "total": None, "total_confidence": None}
    ]


@arrow
def test_studies_on_a_simulated_gpu_have_the_numbers_of_the_processor(tmp_path: Path) -> None:
    studies = (
        ("monte_carlo", "--runs", "5", "--hold-time", "0.01", "--sobol", "0"),
        ("region_of_attraction", "--plants", "1", "--points", "3"),
    )
    commands = {
        device: [
            [*study, "--duration", "0.02", "--device", device, "--out", str(tmp_path / device / study[0])]
            for study in studies
        ]
        for device in ("cpu", "auto")
    }
    assert [main(command) for command in commands["cpu"]] == [0, 0]
    script = "import json, sys\nfrom pendulum_bags.commands.experiment_cli import main\n"
    script += "raise SystemExit(max(main(command) for command in json.loads(sys.argv[1])))"
    there = [sys.executable, "-c", script, json.dumps(commands["auto"])]
    subprocess.run(there, env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}, check=True, capture_output=True)
    for name, *_ in studies:
        settings = json.loads((tmp_path / "auto" / name / "settings.json").read_text())["settings"]
        assert settings["device"] == "cuda"
        here, gpu = (
            read_columns(chunk_path(tmp_path / device / name, 0), ("theta_end", "theta_dot_end")) for device in commands
        )
        for column, values in here.items():
            np.testing.assert_allclose(values, gpu[column], rtol=0.0, atol=1e-12)
            assert np.ptp(values) > 0.0


def test_without_a_gpu_the_program_says_so_in_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pendulum_bags", "experiment", "monte_carlo", "--device", "cuda"]
    environment = {**os.environ, "NUMBA_DISABLE_CUDA": "1", "NUMBA_ENABLE_CUDASIM": "0"}
    done = subprocess.run(
        [*command, "--out", str(tmp_path)], env=environment, check=False, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "device is 'cuda', but numba finds no GPU here" in done.stderr
    assert not list(tmp_path.iterdir())


def test_sobol_indices_see_that_noise_rules_and_damping_comes_next() -> None:
    (found,) = sobol(replace(SMALL, duration=1.0, uncertainty=Uncertainty({"damping": 0.2, "gravity": 0.05})), base=256)
    total = {entry["factor"]: entry["total"] for entry in found["indices"]}
    assert total["noise"] > total["damping"] > total["gravity"]


IDENTIFIED = (
    "format: pendulum_plant/1\nname: found\nparameters:\n"
    "  inertia: {value: 0.05, unit: kg m^2, interval: [0.0402, 0.0598]}\n"
    "  damping: {value: 10.0, unit: N m s/rad, interval: [9.8, 10.2]}\n  gravity: {value: 1.6, unit: N m}\n"
)


def test_uncertainty_comes_from_the_intervals_where_an_identification_left_no_covariance(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(IDENTIFIED, encoding="utf-8")
    found = uncertainty_of(str(file))
    assert found.shares == {"inertia": pytest.approx(0.1, rel=1e-4), "damping": pytest.approx(0.0102, rel=1e-3)}
    assert not found.correlation
    with pytest.raises(ParameterError, match="plant thesis has no intervals"):
        uncertainty_of("thesis")


def test_plants_are_drawn_with_the_covariance_of_the_identification(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(IDENTIFIED, encoding="utf-8")
    # Standard deviations of 0.005 kg m^2 and 0.1 N m s/rad, correlation -0.8; a third parameter stands between.
    matrix = [[2.5e-5, 0.0, -4e-4], [0.0, 1.0, 0.0], [-4e-4, 0.0, 1e-2]]
    told = {"covariance": {"names": ["inertia", "load_friction", "damping"], "matrix": matrix}}
    file.with_suffix(".json").write_text(json.dumps(told), encoding="utf-8")
    found = parse_uncertainty("identified", str(file))
    assert found.shares == pytest.approx({"inertia": 0.1, "damping": 0.01})
    drawn = draw_chunk(MonteCarlo(plant=str(file), uncertainty=found, runs=200_000, chunk=200_000), 0)
    sample = np.cov(drawn["inertia"], drawn["damping"])
    assert sample == pytest.approx(np.array([[2.5e-5, -4e-4], [-4e-4, 1e-2]]), rel=0.02)
    assert (drawn["gravity"] == 1.6).all()
    file.with_suffix(".json").write_text("{}", encoding="utf-8")
    with pytest.raises(ParameterError, match="no covariance of inertia, damping"):
        uncertainty_of(str(file))


def test_an_uncertainty_that_makes_no_distribution_is_refused() -> None:
    with pytest.raises(ParameterError, match="expected one of inertia, damping, gravity"):
        parse_uncertainty("mass=0.1", "thesis")
    with pytest.raises(ParameterError, match="not positive definite"):
        Uncertainty({"inertia": 0.1, "damping": 0.1}, [[1.0, 1.5], [1.5, 1.0]])
    with pytest.raises(ParameterError, match="'damping'; expected identified"):
        parse_uncertainty("damping", "thesis")


def test_a_series_elastic_plant_is_refused_since_the_batch_has_no_motor() -> None:
    with pytest.raises(ParameterError, match=r"plant 'x5_9' is series elastic; expected a rigid one"):
        run_chunk(replace(SMALL, plant="x5_9"), 0)
