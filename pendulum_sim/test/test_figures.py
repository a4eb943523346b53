"""Figures and drawing: fixed points by theory, files that exist, arguments that are refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_sim.drawing import PendulumPicture, rotation_matrix, save_gif, save_png
from pendulum_sim.figures import fixed_points, plot_evolution, save_figure
from pendulum_sim.phase_plot import main


def test_the_thesis_has_a_stable_point_below_and_an_unstable_one_above() -> None:
    points = fixed_points(load_plant("thesis"))
    assert [(point.theta, point.stable) for point in points] == [(-math.pi, False), (0.0, True)]
    # The slow pole of the linearisation at the top is 0.1425 1/s: the overdamped limit is close.
    assert points[0].rate == pytest.approx(0.142566, abs=1e-6)


@pytest.mark.parametrize("torque", [-1.2, 0.3, 1.6])
def test_fixed_points_balance_torque_and_weight(torque: float) -> None:
    parameters = load_plant("thesis")
    points = fixed_points(parameters, torque)
    assert len(points) == 2
    assert sum(point.stable for point in points) == 1
    for point in points:
        assert parameters.gravity * math.sin(point.theta) == pytest.approx(torque, abs=1e-12)


def test_beyond_the_weight_there_is_no_fixed_point() -> None:
    assert fixed_points(load_plant("thesis"), 1.7) == []


def test_phase_plot_writes_a_figure_and_prints_the_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure = tmp_path / "phase.svg"
    assert main(["--torque", "0.5", "--output", str(figure), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [point["stable"] for point in printed["fixed_points"]] == [True, False]
    assert figure.stat().st_size > 1000
    assert main(["--output", str(tmp_path / "phase.bmp")]) == 2
    assert "ends in '.bmp'; expected .png, .svg or .pdf" in capsys.readouterr().err


def test_the_evolution_of_a_run_is_drawn_with_its_torques(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 50)
    figure = plot_evolution(t, np.stack([np.sin(t), np.cos(t)], axis=1), efforts=t, disturbances=-t)
    assert len(figure.axes) == 3
    assert save_figure(figure, tmp_path / "run.png").stat().st_size > 1000
    with pytest.raises(DataError, match=r"expected \(N,\) and \(N, 2\)"):
        plot_evolution(t, np.zeros((3, 2)))


def test_the_rotation_matrix_turns_counter_clockwise() -> None:
    assert rotation_matrix(math.pi / 2) @ [0.0, -1.0] == pytest.approx([1.0, 0.0])
    assert np.linalg.det(rotation_matrix(1.234)) == pytest.approx(1.0)


def test_pictures_become_png_and_gif_that_can_be_read_again(tmp_path: Path) -> None:
    from PIL import Image

    picture = PendulumPicture((160, 120), 13.0)
    frames = []
    for theta in (0.0, 1.0, 2.0):
        picture.draw(theta, 0.5, 3.0, disturbance=-1.0, time=theta, note="test")
        frames.append(picture.array())
    with Image.open(save_png(tmp_path / "a.png", frames[0])) as image:
        assert image.size == (160, 120)
    with Image.open(save_gif(tmp_path / "a.gif", frames, 25.0)) as image:
        assert image.n_frames == 3
    with pytest.raises(ParameterError, match="expected at least one"):
        save_gif(tmp_path / "b.gif", [], 25.0)


def test_a_screen_size_that_makes_no_picture_is_refused() -> None:
    with pytest.raises(
        ParameterError, match=r"screen size is \(10, 99999\) px; expected two numbers from 120 to 4096"
    ):
        PendulumPicture((10, 99999), 13.0)
