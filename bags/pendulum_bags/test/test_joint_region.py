"""Maps of the starts from which plants of several joints come to rest upright."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.commands.experiment_cli import main
from pendulum_bags.studies.chunks import chunk_path, read_columns
from pendulum_bags.studies.region_map import RegionMap, RegionResult, run_map
from pendulum_bags.studies.uncertain import Uncertainty
from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.errors import BagError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_mechanism

pytest.importorskip("pyarrow")

SMALL = RegionMap.of(
    "cart_pole", plants=3, points=9, spans=(0.4, 1.2), duration=6.0, uncertainty=Uncertainty({"cart_mass": 0.3})
)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RegionResult]:
    """Return the small map and its folder, for tests that read it."""
    folder = tmp_path_factory.mktemp("small")
    return folder, run_map(folder, SMALL)


def test_near_starts_are_caught_far_ones_are_not_and_the_sampled_region_is_inside(
    small: tuple[Path, RegionResult],
) -> None:
    _, result = small
    assert result.share.shape == (9, 9)
    assert result.share[4, 4] == 1.0
    # A pole that leans by 1.2 rad is lost, whichever way.
    assert not result.share[[0, -1]].any()
    assert result.level is not None
    assert result.share_inside == 1.0
    # A mirror image of a start ends as its mirror image.
    assert np.array_equal(result.believed, result.believed[::-1, ::-1])


def test_axes_are_the_ones_that_were_asked_for(tmp_path: Path) -> None:
    there = replace(SMALL, plants=1, axes=("pole", "cart"), spans=(1.2, 0.4))
    own, other = run_map(tmp_path / "own", replace(SMALL, plants=1)), run_map(tmp_path / "t", there)
    assert not np.array_equal(own.believed, own.believed.T)
    assert np.array_equal(own.believed, other.believed.T)
    fast = run_map(tmp_path / "fast", replace(SMALL, plants=1, axes=("pole", "pole_dot"), spans=(0.8, 4.0)))
    # Falling outwards is lost where falling back is caught.
    lean, speed = fast.settings.starts()
    x, v = np.meshgrid(lean, speed)
    assert fast.believed[(x * v) < 0].mean() > fast.believed[(x * v) > 0].mean() + 0.1


def test_plant_0_is_the_believed_one_and_the_others_differ(small: tuple[Path, RegionResult]) -> None:
    columns = read_columns(chunk_path(small[0], 0), ("plant", "cart_mass", "end_pole", "attracted"))
    mass = load_mechanism("cart_pole").value("cart_mass")
    drawn = [np.unique(columns["cart_mass"][columns["plant"] == i]) for i in range(3)]
    assert [len(values) for values in drawn] == [1, 1, 1]
    assert drawn[0][0] == mass
    assert len({float(values[0]) for values in drawn}) == 3
    assert np.abs(wrap(columns["end_pole"][columns["attracted"]])).max() < SMALL.tolerance[0]


def test_a_map_is_gone_on_with_and_others_are_refused(small: tuple[Path, RegionResult]) -> None:
    folder, first = small
    before = chunk_path(folder, 0).stat().st_mtime_ns
    assert np.array_equal(run_map(folder, SMALL).share, first.share)
    assert chunk_path(folder, 0).stat().st_mtime_ns == before
    with pytest.raises(BagError, match="other settings"):
        run_map(folder, replace(SMALL, seed=2))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": ("cart", "wheel")}, "axis is 'wheel'; expected two of cart, pole, cart_dot, pole_dot"),
        ({"axes": ("cart", "cart")}, "axes are cart, cart; expected two different ones"),
        ({"axes": ("cart",)}, "axes are cart; expected two different ones"),
        ({"plants": 0}, "plants is 0"),
        ({"points": 2}, "points is 2"),
        ({"spans": (0.0, 1.0)}, "first span is 0.0"),
        ({"duration": float("nan")}, "duration is nan"),
    ],
)
def test_what_is_no_map_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ParameterError) as refused:
        replace(SMALL, **change)  # type: ignore[arg-type]
    assert words in str(refused.value)


def test_the_command_maps_draws_and_refuses_options_of_the_other_kind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ["region_of_attraction", "--plant", "cart_pole", "--plants", "2", "--points", "5", "--duration", "1"]
    own += ["--axes", "pole,pole_dot", "--spans", "0.3", "3", "--out", str(tmp_path / "map")]
    assert main([*own, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert [axis["unit"] for axis in content["axes"]] == ["rad", "rad/s"]
    assert content["runs"] == 50
    assert (tmp_path / "map" / "region.png").stat().st_size > 10_000
    for option in (["--q", "1", "2"], ["--effort-limit", "1"], ["--angle-span", "1"]):
        assert main([*own, *option]) == 2
        assert f"error: {option[0]} is for a plant of one joint, and cart_pole has several" in capsys.readouterr().err
    assert main(["region_of_attraction", "--axes", "cart,pole"]) == 2
    assert "error: --axes is for a plant of several joints, and thesis has one" in capsys.readouterr().err
