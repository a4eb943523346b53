"""Monte Carlo of plants of several joints: chunks are pure, plants differ, noise acts, replays are the runs."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.studies.monte_carlo import MonteCarlo, replay, run_chunk, run_monte_carlo, sobol
from pendulum_bags.studies.region_map import RegionMap, run_map
from pendulum_bags.studies.uncertain import Uncertainty, parse_uncertainty
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism, load_plant, write_plant

SHARES = {"cart_mass": 0.1, "pole.damping": 0.5}
SMALL = MonteCarlo.of("cart_pole", runs=250, chunk=100, duration=0.5, uncertainty=Uncertainty(SHARES), start=0.02)


def test_a_chunk_depends_on_settings_and_index_alone() -> None:
    first, again = run_chunk(SMALL, 1), run_chunk(SMALL, 1, threads=1)
    for name, values in first.items():
        assert np.array_equal(values, again[name]), name
    assert len(run_chunk(SMALL, 2)["max_pole"]) == 50
    assert not np.array_equal(first["max_pole"], run_chunk(SMALL, 0)["max_pole"])


def test_parameters_scatter_as_configured_about_their_value() -> None:
    drawn = run_chunk(replace(SMALL, runs=20_000, chunk=20_000, duration=0.01), 0)
    plant = load_mechanism("cart_pole")
    for name, share in SHARES.items():
        assert drawn[name].mean() == pytest.approx(plant.value(name), rel=0.02)
        assert drawn[name].std() == pytest.approx(share * plant.value(name), rel=0.05)
        assert drawn[name].min() > 0.0
    assert abs(np.corrcoef(drawn["cart_mass"], drawn["pole.damping"])[0, 1]) < 0.03
    # About upright, each joint by itself.
    assert np.abs(drawn["start_cart"]).max() == pytest.approx(0.02, rel=0.01)
    assert np.abs(drawn["start_pole"] - np.pi).max() == pytest.approx(0.02, rel=0.01)
    assert abs(np.corrcoef(drawn["start_cart"], drawn["start_pole"])[0, 1]) < 0.03


def test_studies_of_one_joint_and_of_several_refuse_a_gain_whose_sampled_loop_grows_with_lag_and_delay(
    tmp_path: Path,
) -> None:
    several = load_mechanism("cart_pole").with_values({"cart.transport_delay": 0.15, "cart.time_constant": 0.05})
    one = load_plant("dfki").with_values(transport_delay=0.15, actuator_time_constant=0.05)
    files = [str(write_plant(tmp_path / "several.yaml", several)), str(write_plant(tmp_path / "one.yaml", one))]
    runs: list[Callable[[], object]] = [
        lambda: run_chunk(replace(SMALL, plant=files[0], uncertainty=Uncertainty()), 0),
        lambda: run_chunk(MonteCarlo(plant=files[1], runs=10, chunk=10), 0),
        lambda: RegionMap.of(files[0]).gain,
        lambda: RegionMap(plant=files[1]).gain,
    ]
    for run in runs:
        with pytest.raises(
            ParameterError, match=r"lqr asked every 0\.002 s does not settle on plant .*: deviations grow"
        ):
            run()


@pytest.mark.parametrize("lag", [0.0, 0.03])
def test_maps_and_runs_of_a_lagging_plant_are_those_of_the_gain_that_knows_the_lag(tmp_path: Path, lag: float) -> None:
    several = load_mechanism("cart_pole").with_values({"cart.time_constant": lag})
    file = str(write_plant(tmp_path / "several.yaml", several))
    columns = run_chunk(replace(SMALL, plant=file, uncertainty=Uncertainty(), amplitude=0.0, duration=8.0, runs=20), 0)
    assert np.abs(columns["end_pole"] - np.pi).max() < 1e-3
    region = RegionMap.of(file, plants=1, points=5, spans=(0.05, 0.02))
    assert run_map(tmp_path / "several", region).share.all()
    one = write_plant(tmp_path / "one.yaml", load_plant("thesis").with_values(actuator_time_constant=lag))
    assert run_map(tmp_path / "one", RegionMap(str(one), plants=1, points=5, angle_span=0.1)).share[2].all()


@pytest.mark.parametrize("change", [{"uncertainty": Uncertainty()}, {"amplitude": 0.0}, {"start": 0.0}])
def test_plants_noise_and_starts_each_make_a_difference(change: dict[str, object]) -> None:
    without = run_chunk(replace(SMALL, **change), 0)  # type: ignore[arg-type]
    assert not np.allclose(run_chunk(SMALL, 0)["std_pole"], without["std_pole"], rtol=1e-6)
    assert np.ptp(without["std_pole"]) > 0.0


def test_one_run_replayed_alone_is_the_run_of_the_batch() -> None:
    columns = run_chunk(SMALL, 1)
    row, motion = replay(SMALL, 100 + 17)
    for name in ("max_cart", "max_pole", "end_pole", "cart_mass", "noise_seed"):
        assert row[name] == columns[name][17]
    assert motion.shape == (SMALL.steps, 6)
    assert np.abs(motion[:, 1] - np.pi).max() == pytest.approx(row["max_pole"], rel=0.05)


def test_runs_are_summed_up_gone_on_with_and_added_to(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")

    def stop(done: int, _total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_monte_carlo(tmp_path / "one", SMALL, on_progress=stop)
    one = run_monte_carlo(tmp_path / "one", SMALL)
    assert one == run_monte_carlo(tmp_path / "other", SMALL)
    farthest = np.concatenate(
        [np.maximum(c["max_cart"], c["max_pole"]) for c in (run_chunk(SMALL, i) for i in range(3))]
    )
    assert one["probability_inside"] == np.mean(farthest <= SMALL.bound)
    assert one["worst"][0]["run"] == int(np.argmax(farthest))
    assert one["worst"][0]["max_deviation"] == farthest.max()
    tight = float(np.median(farthest))
    half = run_monte_carlo(tmp_path / "tight", replace(SMALL, bound=tight))
    assert half["probability_inside"] == pytest.approx(0.5, abs=0.01)
    low, high = half["probability_interval"]
    assert low < 0.5 < high
    with pytest.raises(BagError, match="of 250 runs; expected at most the 100 of this one"):
        run_monte_carlo(tmp_path / "one", replace(SMALL, runs=100))
    with pytest.raises(BagError, match="other settings"):
        run_monte_carlo(tmp_path / "one", replace(SMALL, seed=2))


def test_shares_are_read_by_name_for_all_or_from_intervals(tmp_path: Path) -> None:
    plant = load_mechanism("cart_pole")
    every = parse_uncertainty("0.05", "cart_pole").shares
    assert set(every.values()) == {0.05}
    assert {"cart_mass", "pole_length", "pole.damping"} <= set(every)
    # Nobody identifies gravity, limits or delays; and what is nothing has no share.
    assert not [name for name in every if "gravity" in name or "effort_limit" in name or "delay" in name]
    assert all(plant.value(name) for name in every)
    assert parse_uncertainty("cart_mass=0.1, pole.damping=0.5", "cart_pole").shares == SHARES
    file = write_plant(tmp_path / "found.yaml", plant, intervals={"cart_mass": [0.902, 1.098]})
    assert parse_uncertainty("identified", str(file)).shares == {"cart_mass": pytest.approx(0.05, rel=1e-3)}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("identified", "plant cart_pole has no intervals"),
        ("cart_mas=0.1", "uncertainty of 'cart_mas' is unknown; expected one of cart_mass, "),
        ("cart_mass=-0.1", "uncertainty of cart_mass is -0.1; expected a share from 0 to 1"),
        ("cart_mass=nan", "expected a share from 0 to 1"),
        ("much", "expected identified, one share, or NAME=SHARE"),
        ("cart_mass=0.1,pole.damping", "uncertainty has 'pole.damping'"),
    ],
)
def test_what_is_no_share_is_refused(text: str, words: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_uncertainty(text, "cart_pole")
    assert words in str(refused.value)


@pytest.mark.parametrize(
    "change",
    [{"runs": 0}, {"seed": -1}, {"bound": 0.0}, {"start": float("nan")}, {"duration": 0.0}, {"amplitude": -1.0}],
)
def test_what_cannot_be_run_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=f"{next(iter(change))} is"):
        replace(SMALL, **change)  # type: ignore[arg-type]


def test_sobol_indices_of_each_joint_name_the_start_or_the_noise_that_moves_it_and_no_friction() -> None:
    for start, amplitude, cause in ((0.05, 0.0, "start_pole"), (0.0, 0.5, "noise")):
        found = sobol(replace(SMALL, start=start, amplitude=amplitude), base=128)
        assert [each["output"] for each in found] == ["std_cart", "std_pole"]
        total = {each["factor"]: each["total"] for each in found[1]["indices"]}
        assert max(total, key=lambda name: total[name]) == cause
        assert abs(total["pole.damping"]) < 0.02
        # Saltelli: one run for each factor's own sample, and two of the base.
        assert found[0]["runs"] == 128 * (len(total) + 2)


def test_the_command_tells_and_replays_and_refuses_options_of_one_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow")
    own = ["monte_carlo", "--plant", "cart_pole", "--runs", "50", "--duration", "0.2", "--out", str(tmp_path / "mc")]
    assert main([*own, "--sobol", "2", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [found["output"] for found in content["sobol"]] == ["std_cart", "std_pole"]
    assert content["runs"] == 50
    assert content["units"]["max_cart"] == "m"
    assert content["units"]["max_effort_cart"] == "N"
    assert content["settings"]["shares"]["cart_mass"] == 0.05
    assert main([*own, "--replay", "7"]) == 0
    with (tmp_path / "mc" / "replay_7.csv").open(encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time_s", "cart_m", "pole_rad", "cart_m_s", "pole_rad_s", "cart_effort_n", "pole_effort_n_m"]
    assert len(rows) == 101
    assert "cart_mass" in capsys.readouterr().out
    for option in (["--q", "1", "2"], ["--r", "1"]):
        assert main([*own, *option]) == 2
        assert f"error: {option[0]} is for a plant of one joint, and cart_pole has several" in capsys.readouterr().err
