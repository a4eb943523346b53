"""A hold-to-run switch: a plant is armed only while it is held and heard."""

from __future__ import annotations

import math

import pytest

from pendulum_msgs_py.contract.ordinary import ORDINARY, lend
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, limits_from_parameters
from pendulum_msgs_py.contract.supervisor import DriveKind, Input, Mode, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate

_MS = NANOSECONDS // 1000


class Plant:
    """A plant that stays where it is and is commanded with 1 N m."""

    def __init__(self, **limits: float) -> None:
        self.now_ns = 1000 * NANOSECONDS
        self.supervisor = PlantSupervisor(PlantLimits(effort=(13.0,), **{"enable_timeout": 0.2, **limits}))

    def arm(self) -> str:
        return self.supervisor.arm(self.now_ns, self._sample())

    def _sample(self) -> JointSample:
        return JointSample.of_one(self.now_ns, 0.0, 0.0, 0.0)

    def wait(self, milliseconds: int) -> float:
        self.now_ns += milliseconds * _MS
        self.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(self.now_ns, 1.0, "lqr"), self.now_ns)
        drive = self.supervisor.decide(self.now_ns, self._sample())
        self.supervisor.report_applied(drive.effort)
        return drive.effort[0]


def _held(**limits: float) -> Plant:
    plant = Plant(**limits)
    plant.supervisor.receive_enable(plant.now_ns, held=True)
    assert plant.arm() == ""
    assert plant.wait(10) == 1.0
    return plant


def test_a_plant_without_a_switch_asks_for_none() -> None:
    plant = Plant(enable_timeout=math.inf)
    assert plant.arm() == ""
    assert plant.wait(60_000) == 1.0
    plant.supervisor.receive_enable(plant.now_ns, held=False)
    assert plant.wait(10) == 1.0


def test_a_switch_that_is_not_held_refuses_arming() -> None:
    plant = Plant()
    for _ in range(2):
        assert plant.arm() == "enable switch is not held; expected true on enable_input, all the time"
        assert plant.supervisor.mode is Mode.DISARMED
        plant.supervisor.receive_enable(plant.now_ns, held=False)
    plant.supervisor.receive_enable(plant.now_ns, held=True)
    plant.now_ns += 201 * _MS
    assert plant.arm() == "enable switch is silent for 201 ms; expected a message within 0.2 s"
    plant.supervisor.receive_enable(plant.now_ns, held=True)
    assert plant.arm() == ""


def test_its_release_disarms_before_the_next_decision() -> None:
    plant = _held()
    plant.supervisor.receive_enable(plant.now_ns, held=False)
    assert plant.supervisor.mode is Mode.DISARMED
    assert plant.supervisor.reason.startswith("disarmed: enable switch is not held")
    assert plant.supervisor.decide(plant.now_ns, None).kind is DriveKind.OFF


@pytest.mark.parametrize(("silence", "armed"), [(190, True), (191, False), (5000, False)])
def test_its_silence_disarms(silence: int, armed: bool) -> None:
    plant = _held()
    assert (plant.wait(silence) == 1.0) is armed
    assert plant.supervisor.mode.armed is armed
    assert armed or "enable switch is silent for" in plant.supervisor.reason


def test_a_clock_that_steps_back_keeps_no_switch_held() -> None:
    plant = _held()
    plant.wait(-NANOSECONDS // _MS)
    assert not plant.supervisor.mode.armed


def test_holding_it_goes_on_and_holding_it_again_does_not_arm() -> None:
    plant = _held()
    for _ in range(20):
        plant.supervisor.receive_enable(plant.now_ns, held=True)
        assert plant.wait(100) == 1.0
    assert plant.wait(500) == 0.0
    plant.supervisor.receive_enable(plant.now_ns, held=True)
    assert plant.wait(10) == 0.0
    assert plant.supervisor.mode is Mode.DISARMED


def test_a_release_stops_by_the_category_that_was_set_and_clears_no_latch() -> None:
    plant = _held(stop_time=0.1)
    plant.supervisor.receive_enable(plant.now_ns, held=False)
    assert plant.wait(10) == pytest.approx(0.9)
    plant = _held()
    plant.supervisor.e_stop(plant.now_ns)
    plant.supervisor.receive_enable(plant.now_ns, held=False)
    assert plant.supervisor.mode is Mode.E_STOP


def test_compiled_periods_are_not_taken_where_silence_is_looked_for_at_each() -> None:
    import numpy as np

    record = np.zeros(1, ORDINARY).view(np.recarray)[0]
    assert not lend(_held().supervisor, record)
    assert lend(_held(enable_timeout=1e9).supervisor, record) is False
    assert lend(_held(enable_timeout=math.inf).supervisor, record)


def test_no_switch_is_held_in_lockstep_and_none_for_no_time() -> None:
    values = validate(LIMIT_SPECS, {"enable_timeout": 0.5})
    assert limits_from_parameters(values, (5.0,), lockstep=False).enable_timeout == 0.5
    with pytest.raises(ParameterError, match=r"enable_timeout is 0.5 s in lockstep; expected 0"):
        limits_from_parameters(values, (5.0,), lockstep=True)
    assert limits_from_parameters(validate(LIMIT_SPECS, {}), (5.0,), lockstep=True).enable_timeout == math.inf
    with pytest.raises(ParameterError, match=r"enable_timeout is 0.0 s; expected > 0"):
        PlantLimits(effort=(5.0,), enable_timeout=0.0)
