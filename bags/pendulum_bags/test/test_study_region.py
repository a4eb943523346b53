"""Map of the starts that reach upright: bits, physics, the proven ellipse inside, resumption."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.studies.chunks import cluster_client, read_columns
from pendulum_bags.studies.region_figure import region_sentence, write_region_figure
from pendulum_bags.studies.region_map import RegionMap, run_map
from pendulum_bags.studies.uncertain import Uncertainty
from pendulum_lqr.linear.roa import rigid_rollout
from pendulum_msgs_py.errors import BagError, FaultError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import pendulum_plant, write_plant

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> RegionMap:
    """Return a map of a light pendulum whose motor cannot hold it level: from most starts it falls."""
    file = tmp_path_factory.mktemp("plant") / "weak.yaml"
    plant = pendulum_plant(inertia=0.15, damping=0.1, gravity=3.0, effort_limit=1.5)
    write_plant(file, plant)
    return RegionMap(
        plant=str(file), uncertainty=Uncertainty({"gravity": 0.1}), plants=5, points=21, duration=6.0, dt=0.01
    )


def test_map_has_the_ellipse_inside_and_agrees_with_another_integrator(tmp_path: Path, weak: RegionMap) -> None:
    result = run_map(tmp_path, weak)
    assert result.level is not None
    assert result.level > 0.0
    assert result.counterexamples == 0
    assert result.share_inside == 1.0
    assert 0.0 < result.certain_area <= result.area < 2.0 * math.pi * 20.0
    x, v = np.meshgrid(*weak.starts())
    end, speed = rigid_rollout(weak.nominal, weak.gain, 1.5, 6.0)(x.ravel(), v.ravel())
    other = ((np.abs(end) < 0.1) & (np.abs(speed) < 0.2)).reshape(x.shape)
    # Only starts on the edge may be told differently.
    assert np.count_nonzero(other != result.believed) <= 8
    # The pendulum is symmetric: so is its map, but for the two columns that are one and the same angle, and rounding.
    inner = result.believed[:, 1:-1]
    assert np.count_nonzero(inner != inner[::-1, ::-1]) <= 4
    # Beyond the angle at which gravity beats 1.5 N m, sin(x) = 1.5 / 3, a pendulum at rest falls.
    held = np.abs(weak.starts()[0]) < math.asin(0.5)
    assert np.array_equal(result.believed[10], held)


def test_interrupted_map_goes_on_and_keeps_every_bit(tmp_path: Path, weak: RegionMap) -> None:
    settings = replace(weak, plants=250, points=21, duration=0.05)
    assert settings.chunks == 3

    def stop(done: int, _total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_map(tmp_path / "one", settings, on_progress=stop)
    run_map(tmp_path / "one", settings)
    run_map(tmp_path / "other", settings)
    files = sorted(path.name for path in (tmp_path / "one").glob("*.parquet"))
    assert files == ["map.parquet", "runs_00000.parquet", "runs_00001.parquet", "runs_00002.parquet"]
    for name in files:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()
    believed = read_columns(tmp_path / "one" / "runs_00000.parquet", ["gravity"])["gravity"][: 21 * 21]
    assert (believed == 3.0).all()
    with pytest.raises(BagError, match="other settings"):
        run_map(tmp_path / "one", replace(settings, seed=2))


def test_picture_is_grey_and_the_sentence_says_what_was_found(tmp_path: Path, weak: RegionMap) -> None:
    from matplotlib.image import imread

    result = run_map(tmp_path / "map", replace(weak, plants=2))
    picture = imread(write_region_figure(tmp_path / "region.png", result))
    assert picture.shape[0] > 500
    assert np.abs(picture[..., 0] - picture[..., 1]).max() < 0.02
    assert np.abs(picture[..., 0] - picture[..., 2]).max() < 0.02
    sentence = region_sentence(result)
    assert "1.5 N m at most" in sentence
    assert f"{100.0 * float(result.share.mean()):.1f} % of them reach upright" in sentence
    assert json.loads((tmp_path / "map" / "region.json").read_text())["counterexamples"] == 0


def test_what_cannot_be_mapped_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"velocity_span is -1\.0 rad/s"):
        RegionMap(velocity_span=-1.0)
    with pytest.raises(ParameterError, match="plants is 0"):
        RegionMap(plants=0)


def test_a_scheduler_that_is_not_there_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("pendulum_bags.studies.chunks._CONNECT_TIMEOUT", 0.2)
    with (
        pytest.raises(FaultError, match=r"no Dask scheduler responds at 'tcp://127\.0\.0\.1:9'"),
        cluster_client("tcp://127.0.0.1:9"),
    ):
        pass
