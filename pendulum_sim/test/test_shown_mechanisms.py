"""Pictures and markers of plants of several joints: one geometry, and the window that shows whichever plant runs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_differences import describe_plants
from pendulum_msgs_py.plants.plant_parameters import MECHANISM_PRESETS, load_mechanism
from pendulum_msgs_py.ros import qos
from pendulum_sim.pictures.joint_frames import joint_frames
from pendulum_sim.pictures.markers_node import arrow_points, joint_marker
from pendulum_sim.pictures.plant_picture import PlantPicture
from pendulum_sim.pictures.shown_plant import ShownPlant, shown_pendulum
from pendulum_testing.graph_peer import GraphPeer

_SIZE = (200, 200)


@pytest.mark.parametrize("name", [*MECHANISM_PRESETS, "dfki"])
def test_joints_are_where_the_links_of_the_picture_meet(name: str) -> None:
    plant = load_mechanism(name)
    for q in np.random.default_rng(3).uniform(-4.0, 4.0, (20, len(plant.joints))).tolist():
        frames = joint_frames(plant, tuple(q))
        ends = [frame.tip for frame in frames]
        chain = plant.mechanism.chain(tuple(q), plant.packed)
        np.testing.assert_allclose(ends, chain[-len(ends) :], atol=1e-12)
        for before, frame in zip(chain[-len(ends) - 1 :], frames, strict=False):
            np.testing.assert_allclose(frame.origin, before if len(chain) > len(ends) else chain[0], atol=1e-12)


@pytest.mark.parametrize("name", MECHANISM_PRESETS)
def test_a_positive_angle_turns_from_right_to_up(name: str) -> None:
    plant = load_mechanism(name)
    q, step = (0.3, -0.7, 1.1)[: len(plant.joints)], 1e-6
    for index, frame in enumerate(joint_frames(plant, q)):
        moved = joint_frames(plant, tuple(value + step * (k == index) for k, value in enumerate(q)))[index]
        arm = frame.tip - frame.origin
        turning = np.cross(np.cross(frame.right, frame.up), arm)
        expected = frame.axis if plant.mechanism.joints[index].unit == "m" else turning
        np.testing.assert_allclose((moved.tip - frame.tip) / step, expected, atol=1e-5)


def test_each_effort_changes_the_picture_and_is_written_in_the_unit_of_its_joint() -> None:
    for name in ("cart_pole", "double_pendulum", "furuta"):
        plant = load_mechanism(name)
        picture = PlantPicture(plant, _SIZE)
        seen = []
        for joint in (None, *plant.coordinates.names):
            picture.draw((0.1, 0.2), effort={joint: 0.5 * plant.effort_limits[0]} if joint else {})
            seen.append(picture.array())
            picture.draw((0.1, 0.2), disturbance={joint: 0.5 * plant.effort_limits[0]} if joint else {})
            seen.append(picture.array())
        assert np.array_equal(seen[0], seen[1])
        assert all(not np.array_equal(seen[0], other) for other in seen[2:])
    rows = PlantPicture(load_mechanism("dfki"), _SIZE)._rows((3.0,), (1.0,), {names.JOINT: -2.0}, {names.JOINT: 0.5})
    written = ["theta +3.0000 rad", "from upright -0.1416 rad", "theta' +1.000 rad/s", "torque -2.000 N m"]
    assert [text for text, _ in rows] == [*written, "disturbance +0.500 N m"]
    rows = PlantPicture(load_mechanism("cart_pole"), _SIZE)._rows((0.1, 3.0), (1.0, 2.0), {"cart": -2.0}, {"pole": 1})
    assert [text for text, _ in rows] == [
        "cart +0.1000 m, +1.000 m/s",
        "pole +3.0000 rad, +2.000 rad/s",
        "cart -2.000 N",
        "disturbance pole +1.000 N m",
    ]


def test_the_rail_ends_at_the_stops() -> None:
    plant = load_mechanism("cart_pole")
    (low, high), _ = plant.stops
    inside = PlantPicture(plant, _SIZE)
    inside.draw((0.0, 0.0))
    dark = (inside.array().max(axis=2) < 90)[60:150]
    left, right = dark.any(axis=0).nonzero()[0][[0, -1]]
    assert left + right == pytest.approx(_SIZE[0], abs=2)
    assert (right - left) / (high - low) == pytest.approx(0.45 * _SIZE[0] / max(high, 1.2), rel=0.03)


def test_markers_are_in_frames_of_the_urdf() -> None:
    def frame(name: str, index: int, effort: float = 0.05) -> tuple[str, np.ndarray]:
        frame_id, points = joint_marker(load_mechanism(name), index, effort, 0.1, 1.0, "sim/base_link")
        return frame_id, np.array(points)

    assert [frame("acrobot", index)[0] for index in (0, 1)] == ["sim/base_link", "sim/upper_link"]
    assert [frame("furuta", index)[0] for index in (0, 1)] == ["sim/base_link", "sim/arm"]
    frame_id, arrow = frame("cart_pole", 0, -10.0)
    assert (frame_id, arrow[1][0]) == ("sim/cart", pytest.approx(-0.3))
    assert frame("cart_pole", 1)[0] == "sim/cart"
    # That of the arm turns about the vertical.
    assert np.ptp(frame("furuta", 0)[1], axis=0)[2] == 0.0
    assert joint_marker(load_mechanism("acrobot"), 1, 0.0, 0.1, 1.0, "base_link") == ("upper_link", [])
    assert arrow_points(0.0, 1.0, 0.1) == []


def test_a_plant_is_known_by_names_and_parameters_and_nothing_else_is_drawn() -> None:
    pendulum = shown_pendulum(13.0)
    shown = ShownPlant("/sim/joint_states", pendulum)
    shown.take_names(("cart", "pole"))
    assert shown.missing == "waiting for the parameters of cart, pole"
    shown.take_description(describe_plants([load_mechanism("furuta")]))
    assert shown.missing
    shown.take_description(describe_plants([load_mechanism("cart_pole")]))
    assert shown.parameters == load_mechanism("cart_pole")
    shown.take_names((names.JOINT, "other"))
    assert (shown.joints, shown.missing, shown.parameters) == ((names.JOINT,), "", pendulum)
    for wrong in (("pole", "cart"), ("cart",), ("cart", "cart"), ("left", "right"), ()):
        with pytest.raises(ParameterError, match=r"/sim/joint_states tells of .*, which cannot be drawn; expected"):
            shown.take_names(wrong)
    with pytest.raises(ParameterError, match="plant_parameters is no description of plants"):
        shown.take_description("[{")


def test_the_window_shows_whichever_plant_runs_and_refuses_what_it_cannot_draw(
    processes, domain_id: int, tmp_path: Path
) -> None:
    png = tmp_path / "seen.png"
    viewer = processes.start(
        "pendulum_sim", "viewer", "--ros-args", "-p", "fps:=20.0", "-p", "width:=200", "-p", "height:=200",
        "-p", f"png:={png}", env={**os.environ, "SDL_VIDEODRIVER": "dummy"},
    )  # fmt: skip
    peer = GraphPeer()
    peer.patience = 60.0
    try:
        for name in ("cart_pole", "acrobot", "furuta"):
            plant = load_mechanism(name)
            picture = PlantPicture(plant, _SIZE)
            picture.draw((0.0, 0.0))
            # Between the lines of text.
            between = picture.array()[80:180]
            simulator = processes.start(
                "pendulum_sim", "simulator", "--ros-args", "-p", f"plant:={name}", "-p", "rate_hz:=50.0"
            )

            def is_drawn(expected: np.ndarray = between) -> bool:
                answer = peer.call(Trigger, "viewer/snapshot", Trigger.Request())
                assert answer.success, answer.message
                with Image.open(png) as seen:
                    return np.array_equal(np.asarray(seen)[80:180], expected)

            peer.until(is_drawn, f"the picture of {name}")
            simulator.send_signal(signal.SIGINT)
            assert simulator.wait(60.0) == 0
        foreign = peer.node.create_publisher(JointState, names.JOINT_STATES, qos.STATE)
        message = JointState(name=["left", "right"], position=[0.0, 0.0], velocity=[0.0, 0.0])
        peer.until(lambda: foreign.publish(message) or viewer.returncode is not None, "the end of the viewer")
    finally:
        peer.close()
    assert viewer.wait(60.0) == 2
    assert "/joint_states tells of left, right, which cannot be drawn; expected the joints" in viewer.output
    assert "Traceback" not in viewer.output


@pytest.mark.parametrize("display", [{}, {"DISPLAY": ":4095"}], ids=["no display", "a display that is not there"])
def test_a_viewer_that_would_have_no_window_ends_at_once_with_a_sentence(
    domain_id: int, display: dict[str, str]
) -> None:
    unset = {"DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"}
    environment = {name: value for name, value in os.environ.items() if name not in unset} | display
    done = subprocess.run(
        [sys.executable, "-m", "pendulum_sim", "viewer"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert done.returncode == 2
    assert "ready" not in done.stdout + done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("error: ")
    assert last.endswith("expected a display (ssh -X, or window:=false with png or gif)")
