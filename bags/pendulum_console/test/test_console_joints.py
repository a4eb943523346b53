"""What the console knows of the joints of a plant."""

import json
import math

import numpy as np
import pytest

from pendulum_console.console.joint_values import JointValues
from pendulum_msgs_py.contract.cdr import JointStateFields

ACROBOT = ("shoulder", "elbow")


def _state(joints: tuple[str, ...], *position: float) -> JointStateFields:
    return JointStateFields(7, "", joints, position, (0.5,) * len(joints), ())


def _efforts(joints: tuple[str, ...], *effort: float) -> JointStateFields:
    return JointStateFields(7, "", joints, (), (), effort)


def test_each_joint_has_its_own_values_and_what_upright_means_for_it() -> None:
    values = JointValues()
    values.take_state(_state(ACROBOT, 3.0, 0.1))
    values.take_effort("command", _efforts(("elbow",), 2.5), 1.0)
    picture = values.picture(1.1)
    shoulder, elbow = picture["joints"]
    assert np.linalg.norm(np.diff(picture["points"], axis=0), axis=1) == pytest.approx([0.4, 0.6])
    assert picture["points"][1] == pytest.approx([0.4 * math.sin(3.0), -0.4 * math.cos(3.0)])
    assert shoulder == {
        "name": "shoulder",
        "unit": "rad",
        "goal": math.pi,
        "theta": 3.0,
        "theta_dot": 0.5,
        "measured": 0.0,
    }
    assert (elbow["goal"], elbow["theta"], elbow["command"]) == (0.0, 0.1, 2.5)
    assert "command" not in values.picture(1.4)["joints"][1], "a torque that nobody sends any more is drawn on"


@pytest.mark.parametrize(
    ("joints", "unit", "goal", "drawn"),
    [
        (("pendulum_joint",), "rad", math.pi, 2),
        (("cart", "pole"), "m", 0.0, 2),
        (("arm", "pendulum"), "rad", 0.0, 3),
        (("swing", "wheel"), "rad", math.pi, 3),
        (("shoulder", "elbow", "wrist"), "rad", math.pi, 4),
        (("hip", "knee", "ankle"), "rad", 0.0, 0),
    ],
)
def test_only_known_mechanisms_are_drawn_and_say_what_upright_is(
    joints: tuple[str, ...], unit: str, goal: float, drawn: int
) -> None:
    values = JointValues()
    values.take_state(_state(joints, *(0.0 for _ in joints)))
    picture = values.picture(0.0)
    assert (picture["joints"][0]["unit"], picture["joints"][0]["goal"]) == (unit, goal)
    assert len(picture.get("points", ())) == drawn
    assert bool(picture.get("slides")) == (unit == "m")
    assert ("circle" in picture) == ("arm" in joints)
    if drawn:
        assert picture["points"][-1][1] < 0.0, "it hangs down"


def test_an_effort_without_a_name_is_for_the_one_joint() -> None:
    values = JointValues()
    values.take_state(_state(("pendulum_joint",), 0.0))
    values.take_effort("command", _efforts((), 1.5), 0.0)
    assert values.picture(0.0)["joints"][0]["command"] == 1.5


def test_what_is_not_finite_is_left_out_because_no_page_could_read_it() -> None:
    values = JointValues()
    values.take_state(_state(("pendulum_joint",), math.nan))
    values.take_effort("applied", _efforts(("pendulum_joint",), math.inf), 0.0)
    json.dumps(values.picture(0.0), allow_nan=False)


def test_a_state_of_other_joints_replaces_those_and_half_a_state_says_nothing() -> None:
    values = JointValues()
    values.take_state(_state(ACROBOT, 3.0, 0.1))
    for position in ((), (1.0,)):
        values.take_state(JointStateFields(9, "", ("hip",), position, (), ()))
    assert values.stamp_ns == 7
    values.take_state(_state(("hip",), 1.0))
    assert [joint["name"] for joint in values.picture(0.0)["joints"]] == ["hip"]
