"""Figures and drawing: fixed points by theory, files that exist, arguments that are refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.equilibrium import overdamped_velocity
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.pictures.drawing import save_gif, save_png
from pendulum_sim.pictures.figures import overdamped_points
from pendulum_sim.pictures.phase_plot import main
from pendulum_sim.pictures.plant_picture import PlantPicture
from pendulum_sim.stepping.plants import make_pendulum


def test_the_thesis_has_a_stable_point_below_and_an_unstable_one_above() -> None:
    points = overdamped_points(load_plant("thesis"))
    assert [(point.theta, point.stable) for point, _ in points] == [(-math.pi, False), (0.0, True)]
    # The slow pole of the linearisation at the top is 0.1425 1/s: the overdamped limit is close.
    assert points[0][1] == pytest.approx(0.142566, abs=1e-6)


@pytest.mark.parametrize("torque", [-1.2, 0.3, 1.0])
@pytest.mark.parametrize("name", ["thesis", "x5_9"])
def test_an_overdamped_plant_with_offsets_creeps_as_its_phase_plot_says(name: str, torque: float) -> None:
    parameters = load_plant(name).with_values(angle_offset=0.3, torque_offset=0.1)
    if parameters.drivetrain is not None:
        smooth = {"motor_coulomb_friction": 0.0, "motor_static_friction": 0.0, "hysteresis_torque": 0.0}
        parameters = parameters.with_values(drivetrain=replace(parameters.drivetrain, **smooth))
    plant = make_pendulum(parameters, 0.002)
    plant.reset(1.0)
    # Until the spring has come to rest.
    for _ in range(1000):
        state = plant.step(torque)
    expected = float(overdamped_velocity(parameters, np.array([state.theta]), torque)[0])
    assert state.theta_dot == pytest.approx(expected, rel=0.05, abs=2e-3)
    for point, rate in overdamped_points(parameters, torque):
        resting = overdamped_velocity(parameters, np.array([point.theta]), torque)
        assert float(resting[0]) == pytest.approx(0.0, abs=1e-12)
        assert (rate < 0.0) == point.stable


def test_beyond_the_weight_there_is_no_fixed_point() -> None:
    assert overdamped_points(load_plant("thesis"), 1.7) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--torque", "nan"], "torque is nan N m; expected a finite number"),
        (["--plant", "dfki"], "plant 'dfki' is not overdamped: its damping is 0.1 N m s/rad"),
    ],
)
def test_phase_plot_refuses_what_has_no_overdamped_limit(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "phase.png")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "phase.png").exists()


def test_the_phase_plot_of_the_series_elastic_plant_has_the_rate_of_all_its_damping(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--plant", "x5_9", "--out", str(tmp_path / "phase.svg"), "--json"]) == 0
    upright = json.loads(capsys.readouterr().out)["fixed_points"][0]
    # The slow pole of the whole linear model is 0.1290 1/s.
    assert upright["rate"] == pytest.approx(1.678 / 13.196, abs=1e-4)


def test_phase_plot_writes_a_figure_and_prints_the_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure = tmp_path / "phase.svg"
    assert main(["--torque", "0.5", "--out", str(figure), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [point["stable"] for point in printed["fixed_points"]] == [True, False]
    assert figure.stat().st_size > 1000
    assert main(["--out", str(tmp_path / "phase.bmp")]) == 2
    assert "ends in '.bmp'; expected .png, .svg or .pdf" in capsys.readouterr().err


def test_pictures_become_png_and_gif_that_can_be_read_again(tmp_path: Path) -> None:
    from PIL import Image

    picture = PlantPicture(load_plant("thesis"), (160, 120))
    frames = []
    for theta in (0.0, 1.0, 2.0):
        picture.draw((theta,), velocity=(0.5,), effort={JOINT: 3.0}, disturbance={JOINT: -1.0}, time=theta, note="test")
        frames.append(picture.array())
    with Image.open(save_png(tmp_path / "a.png", frames[0])) as image:
        assert image.size == (160, 120)
    with Image.open(save_gif(tmp_path / "a.gif", frames, 25.0)) as image:
        assert image.n_frames == 3
    with pytest.raises(ParameterError, match="expected at least one"):
        save_gif(tmp_path / "b.gif", [], 25.0)


def test_a_screen_size_that_makes_no_picture_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"screen size is \(10, 99999\) px; expected two numbers from 120 to 4096"):
        PlantPicture(load_plant("thesis"), (10, 99999))
