"""What slides has N, N/s, m and m/s in every message about it, never N m or rad."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from pendulum_hw_bridge.bridge.assembly import assemble, for_plant
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.drive.current_drive import CurrentMapping
from pendulum_hw_bridge.drive.effort_mapping import EffortStrategy
from pendulum_hw_bridge.emulation.quasi_direct_drive import QuasiDirectDrive
from pendulum_hw_bridge.port.actuator import ActuatorError, Command, HardwareLimits, Strategy
from pendulum_hw_bridge.port.clocks import WallClock
from pendulum_hw_bridge.port.command_check import check_command
from pendulum_hw_bridge.port.settings import expect_limits
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.contract.joints import ONE_JOINT
from pendulum_msgs_py.contract.plant_specs import in_units_of
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_testing.feedback_records import feedback_record

CART_POLE = load_mechanism("cart_pole").coordinates
CART = CART_POLE.joints[0]
LIMITS = HardwareLimits(effort=10.0, joint=CART)


def mapping(effort_limit: float) -> CurrentMapping:
    drive = QuasiDirectDrive().constants(CART, 10.0)
    return CurrentMapping(EffortStrategy.EFFORT_LOOP, drive, effort_limit=effort_limit, joint=CART)


def plant(**given: object) -> PlantLimits:
    return replace(PlantLimits((10.0,), coordinates=CART_POLE), **given)


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: plant(effort=(-1.0,)), "effort_limit is -1.0 N; expected a finite number > 0"),
        (lambda: plant(handover_effort=-1.0), "handover_effort is -1.0 N; expected > 0"),
        (lambda: plant(start_sum=-1.0), "start_sum is -1.0 N; expected > 0"),
        (lambda: plant(slew=-1.0), "slew is -1.0 N/s; expected > 0"),
        (lambda: plant(arm_effort=-1.0), "arm_effort is -1.0 N; expected >= 0"),
        (lambda: plant(velocity=0.0), "velocity is 0.0 m/s or rad/s; expected > 0"),
        (lambda: replace(LIMITS, effort=0.0), "effort limit is 0.0 N; expected a finite number > 0"),
        (lambda: replace(LIMITS, velocity=0.0), "velocity limit is 0.0 m/s; expected a finite number > 0"),
        (lambda: replace(LIMITS, position_min=2.0, position_max=1.0), "position window is [2.0, 1.0] m; expected"),
        (
            lambda: check_command(Command(effort=math.inf), Strategy.PARALLEL_PWM, LIMITS),
            "effort setpoint is inf N; expected a finite number",
        ),
        (
            lambda: check_command(Command(position=math.inf), Strategy.PARALLEL_PWM, LIMITS),
            "position setpoint is inf m; expected a finite number",
        ),
        (
            lambda: expect_limits(replace(LIMITS, effort=4.0), LIMITS),
            "effort limit reads back as 4 N; expected 10 N",
        ),
        (lambda: mapping(-1.0), "effort_limit is -1.0 N; expected a finite number > 0"),
        (
            lambda: validate(for_plant(SPECS, "cart_pole"), {"handover_effort_limit": -1.0}),
            "handover_effort_limit is -1.0 N; expected > 0",
        ),
        (
            lambda: validate(for_plant(SPECS, "cart_pole"), {"effort_slew_limit": -1.0}),
            "effort_slew_limit is -1.0 N/s; expected >= 0",
        ),
    ],
)
def test_a_refusal_about_a_cart_is_in_newtons(refused: Callable[[], object], message: str) -> None:
    with pytest.raises((ParameterError, ActuatorError)) as caught:
        refused()
    assert message in str(caught.value)
    assert "N m" not in str(caught.value)


def test_a_drive_of_a_cart_that_does_not_follow_is_reported_in_newtons() -> None:
    specs = for_plant(SPECS, "cart_pole")
    values = validate(specs, {"plant": "cart_pole", "backend": "emulator"})
    cart, pole = assemble(values, specs).modules(WallClock())
    assert isinstance(cart, DrivenModule)
    assert (cart.settings.limits.joint, pole.settings.limits.joint) == CART_POLE.joints
    check = cart.monitor.output
    assert check is not None
    records = [feedback_record(number, number, effort=3.0) for number in range(9)]
    faults = [check.check(record, Strategy.PARALLEL_PWM, [Command(effort=0.0)]) for record in records]
    assert faults[-1] is not None
    assert faults[-1].message == (
        "measured effort is 3.000 N, commanded is 0.000 N; expected them within 1 N: is the drive stuck?"
    )


def test_the_parameters_of_a_pendulum_keep_their_units() -> None:
    assert in_units_of(SPECS, ONE_JOINT) == SPECS
    units = {spec.name: spec.unit for spec in for_plant(SPECS, "double_pendulum")}
    assert units == {spec.name: spec.unit for spec in SPECS}


def test_the_simulator_refuses_a_limit_of_a_cart_in_newtons(processes, domain_id: int) -> None:
    arguments = ("--ros-args", "-p", "plant:=cart_pole", "-p", "handover_effort_limit:=-1.0")
    simulator = processes.start("pendulum_sim", "simulator", *arguments)
    assert simulator.wait(60.0) == 2
    assert "handover_effort_limit is -1.0 N; expected > 0" in simulator.output
