"""Limits of a plant from its parameters: each under its own name, in real time and in lockstep."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.joints import ONE_JOINT, Coordinates
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate

_INF = math.inf
_GIVEN: dict[str, Any] = {
    "effort_limit": 4.0,
    "command_timeout": 0.06,
    "velocity_limit": 3.0,
    "position_window": [-1.0, 2.0],
    "effort_slew_limit": 50.0,
    "handover_time": 0.2,
    "handover_effort_limit": 1.5,
    "start_effort_limit": 1.25,
    "starvation_limit": 7.0,
    "stop_time": 0.3,
    "tracking_error_limit": 0.4,
}
_ELBOW = Coordinates((ONE_JOINT.joints[0], ONE_JOINT.joints[0]), (1,))


def _limits(given: dict[str, Any], *, lockstep: bool = False, **options: Any) -> PlantLimits:
    return limits_from_parameters(validate(LIMIT_SPECS, given), (5.0,), lockstep=lockstep, **options)


def test_each_limit_is_that_of_its_parameter() -> None:
    assert _limits({**_GIVEN, "enable_timeout": 0.5}, feedback_timeout=0.7) == PlantLimits(
        effort=(4.0,), command_timeout=0.06, feedback_timeout=0.7, velocity=3.0, position_min=(-1.0,),
        position_max=(2.0,), slew=50.0, handover_time=0.2, tracking_error=0.4, handover_effort=1.5, handover_sum=1.5,
        start_effort=1.25, start_sum=1.25, starvation=7.0, stop_time=0.3, enable_timeout=0.5,
    )  # fmt: skip


def test_in_lockstep_noise_begins_with_the_controller_and_its_sum_is_not_limited() -> None:
    limits = _limits(_GIVEN, lockstep=True)
    assert (limits.handover_effort, limits.handover_sum) == (1.5, _INF)
    assert (limits.start_effort, limits.start_sum) == (1.25, _INF)
    assert limits.enable_timeout == _INF


def test_nothing_given_is_no_limit_but_that_of_the_plant_file() -> None:
    limits = _limits({"start_effort_limit": 0.0})
    assert limits.effort == (5.0,)
    for name in ("velocity", "slew", "start_effort", "start_sum", "starvation", "enable_timeout", "feedback_timeout"):
        assert getattr(limits, name) == _INF, name
    assert (limits.position_min, limits.position_max) == ((-_INF,), (_INF,))
    assert limits.stop_time == 0.0


def test_a_shorter_command_timeout_than_the_plants_period_allows_is_raised_to_it() -> None:
    assert _limits({"command_timeout": 0.05}, least_command_timeout=0.2).command_timeout == 0.2
    assert _limits({"command_timeout": 0.3}, least_command_timeout=0.2).command_timeout == 0.3


def test_a_limit_of_effort_lowers_that_of_each_joint_and_raises_none() -> None:
    def of_two(wanted: float) -> tuple[float, ...]:
        return limits_from_parameters(
            validate(LIMIT_SPECS, {"effort_limit": wanted}), (5.0, 2.0), lockstep=False
        ).effort

    assert of_two(0.0) == (5.0, 2.0)
    assert of_two(3.0) == (3.0, 2.0)
    assert of_two(5.0) == (5.0, 2.0)
    with pytest.raises(ParameterError, match=r"effort_limit is 5.5 N m; expected at most 5.0 N m, the limit of the pl"):
        of_two(5.5)
    # A plant without a motor has none to lower.
    with pytest.raises(ParameterError, match=r"expected at most 0.0 N m"):
        limits_from_parameters(validate(LIMIT_SPECS, {"effort_limit": 1.0}), (), lockstep=False)


def test_a_window_has_two_ends_for_each_joint_and_equal_ends_are_none() -> None:
    values = validate(LIMIT_SPECS, {"position_window": [-1.0, 1.0, 0.5, 0.5]})
    limits = limits_from_parameters(values, (5.0,), coordinates=_ELBOW, lockstep=False)
    assert (limits.position_min, limits.position_max) == ((-1.0, -_INF), (1.0, _INF))
    assert limits.coordinates is _ELBOW
    none = limits_from_parameters(validate(LIMIT_SPECS, {}), (5.0,), coordinates=_ELBOW, lockstep=False)
    assert none.for_joints(2, 1).position_max == (_INF, _INF)
    with pytest.raises(ParameterError, match=r"position_window has 3 values; expected \[low, high\] in rad"):
        _limits({"position_window": [0.0, 1.0, 2.0]})
    with pytest.raises(ParameterError, match="position_window has 2 values; expected 4, low and high of each joint"):
        limits_from_parameters(validate(LIMIT_SPECS, _GIVEN), (5.0,), coordinates=_ELBOW, lockstep=False)
