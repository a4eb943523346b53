"""How a goal ends by what a plant tells; ``tests/integration/test_trajectory_action.py`` has the plants."""

from __future__ import annotations

from typing import Any

import pytest

from pendulum_lqr.nodes.trajectory_action import End, Outcome, PlantFollowing, goal_problem
from pendulum_msgs_py.contract.names import JOINT

FOLLOWS = {"name": "plant_mode", "mode": "armed_position", "reason": "following a trajectory"}
STARVES = {"name": "plant_mode", "mode": "armed_effort", "reason": "no command"}
FINISHED = {"name": "trajectory_finished", "reason": "holding the end of a trajectory"}
REFUSED = {"name": "trajectory_refused", "reason": "too fast"}
FAULT = {"name": "plant_mode", "mode": "fault", "reason": "too hot"}
TAKEN_OVER = {"name": "plant_mode", "mode": "armed_effort", "reason": "commanded by /sim/controller"}
CANCEL: dict[str, Any] = {}


@pytest.mark.parametrize(
    ("events", "outcome"),
    [
        ([FOLLOWS, FINISHED], Outcome.REACHED),
        ([STARVES, FOLLOWS, FINISHED], Outcome.REACHED),
        # What ended before is not this goal's end.
        ([FINISHED], None),
        ([FINISHED, FOLLOWS], None),
        ([FINISHED, FOLLOWS, FINISHED], Outcome.REACHED),
        # A controller that takes over at the end may do so before the end was told.
        ([FOLLOWS, TAKEN_OVER], Outcome.REACHED),
        # Of a plant that started again, armed.
        ([FOLLOWS, STARVES], Outcome.LEFT),
        ([FOLLOWS, CANCEL, STARVES], Outcome.LEFT),
        ([REFUSED], Outcome.REFUSED),
        # That was somebody else's.
        ([FOLLOWS, REFUSED], None),
        ([FOLLOWS, FAULT], Outcome.LEFT),
        ([FAULT], Outcome.LEFT),
        ([FOLLOWS, CANCEL], None),
        ([FOLLOWS, CANCEL, FINISHED], Outcome.CANCELLED),
        ([CANCEL, FINISHED], Outcome.CANCELLED),
        ([FOLLOWS, CANCEL, TAKEN_OVER], Outcome.CANCELLED),
        ([FOLLOWS, CANCEL, REFUSED], Outcome.LEFT),
        ([FOLLOWS, CANCEL, FAULT], Outcome.LEFT),
        ([{"name": "noise_start"}, {}], None),
    ],
)
def test_a_goal_ends_by_what_the_plant_tells(events: list[dict[str, Any]], outcome: Outcome | None) -> None:
    plant = PlantFollowing()
    plant.begin()
    ends: list[End | None] = [None]
    for event in events:
        assert ends[-1] is None
        if event is CANCEL:
            plant.cancel()
        else:
            ends.append(plant.on_event(event))
    assert (ends[-1].outcome if ends[-1] else None) is outcome
    assert plant.active == (outcome is None)
    # What comes later changes nothing.
    assert outcome is None or plant.on_event(FAULT) is plant.on_other_trajectory() is plant.on_silence(9.0) is None


def test_a_plant_is_busy_from_the_first_to_the_last_of_anybodys_trajectory() -> None:
    plant = PlantFollowing()
    told = []
    for event in (STARVES, FOLLOWS, FINISHED, FOLLOWS, FAULT):
        assert plant.on_event(event) is None
        told.append(plant.busy)
    assert told == [False, True, False, True, False]


def test_a_goal_of_which_the_plant_says_nothing_is_given_up() -> None:
    plant = PlantFollowing()
    assert plant.on_wait(9.0, 2.0) is None
    plant.begin()
    assert plant.on_wait(1.9, 2.0) is None
    assert plant.on_wait(2.1, 2.0) == End(Outcome.LEFT, "plant did not begin within 2 s, and did not say why")
    plant.begin()
    plant.on_event(FOLLOWS)
    assert plant.on_wait(99.0, 2.0) is None  # on its way
    plant.cancel()
    end = plant.on_wait(2.1, 2.0)
    assert end is not None
    assert (end.outcome, plant.active) == (Outcome.LEFT, False)


def test_only_what_a_plant_can_judge_is_passed_on() -> None:
    none = {"path_tolerance": 0, "goal_tolerance": 0}
    assert goal_problem([JOINT], [], none) is None
    for joints, others in (([], []), (["elbow"], []), ([JOINT, "elbow"], []), ([JOINT], ["base"])):
        end = goal_problem(joints, others, none)
        assert end is not None
        assert end.outcome is Outcome.WRONG_JOINTS
        assert f"expected ['{JOINT}']" in end.reason
    end = goal_problem([JOINT], [], none | {"path_tolerance": 1})
    assert end is not None
    assert (end.outcome, end.reason.split(";")[0]) == (Outcome.REFUSED, "goal has path_tolerance")


def test_a_goal_after_a_cancelled_one_is_a_goal_of_its_own() -> None:
    plant = PlantFollowing()
    for cancelled, outcome in ((True, Outcome.CANCELLED), (False, Outcome.REACHED)):
        plant.begin()
        assert plant.on_event(FOLLOWS) is None
        if cancelled:
            plant.cancel()
        end = plant.on_event(FINISHED)
        assert end is not None
        assert end.outcome is outcome
