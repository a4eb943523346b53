"""Parameters that are wrong together are refused by name, before anything moves."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pendulum_hw_bridge.backends import BACKENDS
from pendulum_hw_bridge.bridge.bridge_consistency import check_consistency
from pendulum_hw_bridge.bridge.bridge_parameters import (
    BRIDGE_SPECS,
    bridge_settings,
    effort_mapping,
    safety_limits,
    supervisor_limits,
    trajectory_gains,
)
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_msgs_py.contract.drive import PlantLimits
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.lab_file import EMULATED_BACKENDS
from pendulum_msgs_py.plants.plant_parameters import load_plant

LIMITS: dict[str, float] = {
    "effort": (13.0,),
    "velocity": 1.5,
    "position_min": (-4.0,),
    "position_max": (4.0,),
    "slew": 2000.0,
    "start_effort": 2.0,
    "starvation": 30.0,
}


def check(limits: dict[str, float] | None = None, **values: Any) -> None:
    check_consistency(validate(BRIDGE_SPECS, values), PlantLimits(**{**LIMITS, **(limits or {})}))


@pytest.mark.parametrize("backend", ["emulator", "hebi"])
def test_the_defaults_fit_together(backend: str) -> None:
    check(backend=backend)


@pytest.mark.parametrize("backend", ["emulator", "hebi"])
def test_a_stop_may_not_fade_through_the_torque_loop_which_drove_five_times_harder_than_before(backend: str) -> None:
    check(backend=backend, effort_strategy="effort_loop")
    for strategy in ("direct_pwm", "direct_pwm_compensated"):
        check({"stop_time": 0.3}, backend=backend, effort_strategy=strategy)
    with pytest.raises(ParameterError, match=r"stop_time is 0.3 s; expected 0 with effort_strategy 'effort_loop'"):
        check({"stop_time": 0.3}, backend=backend, effort_strategy="effort_loop")


def test_no_backend_that_can_hurt_is_taken_for_an_emulator() -> None:
    assert BACKENDS.keys() >= EMULATED_BACKENDS
    assert not [name for name in EMULATED_BACKENDS if BACKENDS[name].is_machine]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"feedback_rate": 19.0}, "feedback_rate is 19 Hz; expected at least 20 Hz"),
        ({"feedback_rate": 25.0, "feedback_watchdog": 26}, "feedback_watchdog is 26 periods"),
        ({"command_lifetime": 0.019}, "command_lifetime is 0.019 s; expected at least two periods, 0.02 s"),
        ({"backend": "hebi", "command_lifetime": 0.11}, "command_lifetime is 0.11 s; expected at most 0.1 s"),
        ({"backend": "hebi", "feedback_watchdog": 11}, "feedback_watchdog is 11 periods, 0.11 s; expected at most 10"),
    ],
)
def test_times_that_let_a_fault_act_too_long_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        check(**values)


@pytest.mark.parametrize(
    "values",
    [
        {"feedback_rate": 20.0, "command_lifetime": 0.1},
        {"feedback_rate": 25.0, "feedback_watchdog": 25, "command_lifetime": 0.1},
        {"command_lifetime": 0.02},
        {"command_lifetime": 0.03},
        {"backend": "hebi", "command_lifetime": 0.1},
        {"backend": "hebi", "feedback_watchdog": 10},
    ],
)
def test_times_of_just_the_limit_are_taken(values: dict[str, Any]) -> None:
    check(**values)


@pytest.mark.parametrize(("backend", "timeout"), [("emulator", 0.01), ("emulator", 1.0), ("hebi", 0.1)])
def test_a_command_may_count_for_one_cycle_or_for_the_longest_time(backend: str, timeout: float) -> None:
    check({"command_timeout": timeout}, backend=backend)


@pytest.mark.parametrize(
    ("backend", "timeout"), [("emulator", 1e9), ("emulator", 1.1), ("emulator", 0.009), ("hebi", 0.11)]
)
def test_a_command_counts_for_a_cycle_at_least_and_never_for_long(backend: str, timeout: float) -> None:
    with pytest.raises(ParameterError, match="command_timeout is"):
        check({"command_timeout": timeout}, backend=backend)


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ({"effort": (6.0, 40.0)}, "effort_limit is 40 N m; expected at most"),
        ({"effort": (40.0, 6.0)}, "effort_limit is 40 N m; expected at most"),
        ({"position_min": (-1.0, -40.0), "position_max": (1.0, 40.0)}, "position_window is 80 rad; expected at most"),
        ({"position_min": (-40.0, -1.0), "position_max": (40.0, 1.0)}, "position_window is 80 rad; expected at most"),
    ],
)
def test_of_several_joints_the_one_with_the_widest_limit_counts(limit: dict[str, Any], message: str) -> None:
    check(limit, backend="emulator")
    with pytest.raises(ParameterError, match=message):
        check(limit, backend="hebi")


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("velocity_limit", {"velocity": math.inf}),
        ("effort_slew_limit", {"slew": math.inf}),
        ("start_effort_limit", {"start_effort": math.inf}),
        ("starvation_limit", {"starvation": math.inf}),
        ("position_window", {"position_max": (math.inf,)}),
        ("position_window", {"position_min": (-math.inf,)}),
        ("position_window", {"position_min": (-math.inf,), "position_max": (math.inf,)}),
    ],
)
def test_a_real_machine_needs_every_limit(name: str, limit: dict[str, float]) -> None:
    check(limit, backend="emulator")
    with pytest.raises(ParameterError, match=f"{name} is none"):
        check(limit, backend="hebi")


_BOUNDS = [
    ("effort_limit", {"effort": (13.01,)}, {"effort": (13.0,)}, "at most 13 N m"),
    ("handover_time", {"handover_time": 1.001}, {"handover_time": 1.0}, "at most 1 s"),
    ("handover_effort_limit", {"handover_effort": 5.01}, {"handover_effort": 5.0}, "at most 5 N m"),
    ("start_effort_limit", {"start_effort": 5.01}, {"start_effort": 5.0}, "at most 5 N m"),
    ("velocity_limit", {"velocity": 3.01}, {"velocity": 3.0}, "at most 3 rad/s"),
    ("tracking_error_limit", {"tracking_error": 1.01}, {"tracking_error": 1.0}, "at most 1 rad"),
    ("effort_slew_limit", {"slew": 26.1e3}, {"slew": 26e3}, "at most 26000 N m/s"),
    ("position_window", {"position_max": (60.1,)}, {"position_max": (60.0,)}, "at most 64 rad"),
    ("starvation_limit", {"starvation": 120.5}, {"starvation": 120.0}, "at most 120 s"),
]
_VALUE_BOUNDS = [
    ("measured_effort_limit", 15.1, 15.0, "at most 15 N m"),
    ("measured_effort_limit", 1000.0, 0.0, "at most 15 N m"),
    ("voltage_window", [17.9, 50.0], [18.0, 50.0], "inside 18 to 52 V"),
    ("voltage_window", [22.0, 52.1], [22.0, 52.0], "inside 18 to 52 V"),
    ("voltage_window", [-1e9, 1e9], [30.0, 40.0], "inside 18 to 52 V"),
    ("m_stop_action", "disabled", "motor_off", "motor_off or hold_position"),
    ("m_stop_action", "disabled", "hold_position", "motor_off or hold_position"),
    ("e_stop_input_timeout", 1e-9, 0.05, "0.05 to 1 s, or 0 for no such input"),
    ("e_stop_input_timeout", 1.01, 1.0, "0.05 to 1 s, or 0 for no such input"),
    ("e_stop_input_timeout", 0.049, 0.0, "0.05 to 1 s, or 0 for no such input"),
]


@pytest.mark.parametrize(("name", "refused", "taken", "expected"), _BOUNDS)
def test_a_limit_of_a_real_machine_that_limits_nothing_is_refused(
    name: str, refused: dict[str, float], taken: dict[str, float], expected: str
) -> None:
    check(refused, backend="emulator")
    check(taken, backend="hebi")
    with pytest.raises(
        ParameterError, match=rf"^{name} is [\d.]+ \S+( m\S*)?; expected {expected} with backend 'hebi': "
    ):
        check(refused, backend="hebi")


@pytest.mark.parametrize(("name", "refused", "taken", "expected"), _VALUE_BOUNDS)
def test_a_value_that_no_real_machine_can_have_is_refused(
    name: str, refused: float | list[float] | str, taken: float | list[float] | str, expected: str
) -> None:
    check(backend="emulator", **{name: refused})
    check(backend="hebi", **{name: taken})
    with pytest.raises(ParameterError, match=f"^{name} is .*; expected {expected} with backend 'hebi': "):
        check(backend="hebi", **{name: refused})


def test_a_plant_file_gives_a_real_machine_no_more_torque_than_its_actuator_has() -> None:
    plant = load_emulator("thesis").plant.with_values(effort_limit=38.0)
    for backend, wanted in (("emulator", 0.0), ("emulator", 14.0), ("hebi", 13.0)):
        values = validate(SPECS, {"backend": backend, "effort_limit": wanted})
        check_consistency(values, supervisor_limits(values, (plant.effort_limit,)))
    for wanted in (0.0, 14.0):
        values = validate(SPECS, {"backend": "hebi", "effort_limit": wanted})
        with pytest.raises(ParameterError, match=r"^effort_limit is (38|14) N m; expected at most 13 N m with backend"):
            check_consistency(values, supervisor_limits(values, (plant.effort_limit,)))


@pytest.mark.parametrize(
    ("rate", "watchdog", "patience"), [(100.0, 3, 0.04), (100.0, 10, 0.11), (1000.0, 2, 0.003), (50.0, 3, 0.08)]
)
def test_the_rules_of_the_plant_wait_for_feedback_one_period_longer_than_the_check_that_names_the_fault(
    rate: float, watchdog: int, patience: float
) -> None:
    values = validate(SPECS, {"feedback_rate": rate, "feedback_watchdog": watchdog})
    limits = supervisor_limits(values, (load_emulator("thesis").plant.effort_limit,))
    assert limits.feedback_timeout == pytest.approx(patience)


@pytest.mark.parametrize("lockstep", [False, True])
def test_a_disturbance_that_waits_is_judged_as_a_command_is_but_in_lockstep(lockstep: bool) -> None:
    values = validate(SPECS, {"start_effort_limit": 1.5, "handover_effort_limit": 1.2})
    limits = supervisor_limits(values, (load_emulator("thesis").plant.effort_limit,), lockstep=lockstep)
    assert (limits.start_effort, limits.handover_effort) == (1.5, 1.2)
    assert (limits.start_sum, limits.handover_sum) == ((math.inf, math.inf) if lockstep else (1.5, 1.2))


def test_the_cut_off_of_a_hot_winding_is_the_one_that_was_set() -> None:
    values = validate(BRIDGE_SPECS, {"winding_temperature_limit": 80.0})
    assert safety_limits(values, 1.0).winding_temperature == 80.0
    assert safety_limits(validate(BRIDGE_SPECS, {}), 1.0).winding_temperature == 120.0


@pytest.mark.parametrize(
    ("sign", "offset", "ends"), [(1, 0.0, (-3.0, 4.0)), (1, 0.5, (-3.5, 3.5)), (-1, 0.5, (-3.5, 3.5))]
)
def test_the_firmware_gets_the_window_in_its_own_angle(sign: int, offset: float, ends: tuple[float, float]) -> None:
    values = validate(BRIDGE_SPECS, {"joint_sign": sign, "joint_offset": offset})
    settings = bridge_settings(values, effort=1.0, velocity=1.0, gains=trajectory_gains(values), window=(-3.0, 4.0))
    assert (settings.limits.position_min, settings.limits.position_max) == ends


def test_a_joint_that_turns_neither_way_and_a_window_of_one_voltage_are_refused() -> None:
    values = validate(SPECS, {"joint_sign": 0, "voltage_window": [24.0]})
    with pytest.raises(ParameterError, match="joint_sign is 0; expected 1 or -1"):
        bridge_settings(values, effort=1.0, velocity=1.0, gains=trajectory_gains(values))
    with pytest.raises(ParameterError, match=r"voltage_window has 1 values; expected \[low, high\] in V"):
        safety_limits(values, 1.0)


def test_measured_torque_is_limited_with_the_effort_limit() -> None:
    assert safety_limits(validate(BRIDGE_SPECS, {}), 1.0).measured_effort == 2.0
    assert safety_limits(validate(BRIDGE_SPECS, {}), 13.0).measured_effort == 14.0
    assert safety_limits(validate(BRIDGE_SPECS, {"measured_effort_limit": 3.0}), 1.0).measured_effort == 3.0


def test_position_control_may_ask_for_no_more_than_the_velocity_limit_nor_the_motor_s_own() -> None:
    plant, values = load_emulator("thesis").plant, validate(BRIDGE_SPECS, {})
    slow, fast = (
        effort_mapping(values, plant, DEFAULT_GAINS[3], PlantLimits(**{**LIMITS, "velocity": velocity})).velocity_limit
        for velocity in (0.5, 1e3)
    )
    assert slow == 0.5
    assert fast < 10.0


def test_a_plant_without_a_drivetrain_has_no_mapping_of_efforts() -> None:
    limits = PlantLimits(**LIMITS)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="plant 'thesis' has no drivetrain; expected one for the effort mapping"):
        effort_mapping(validate(BRIDGE_SPECS, {}), load_plant("thesis"), DEFAULT_GAINS, limits)


def test_a_motor_keeps_the_limit_of_its_own_joint() -> None:
    limits = PlantLimits(effort=(3.0, 1.5))
    values, plant = validate(BRIDGE_SPECS, {}), load_emulator("thesis").plant
    mappings = [effort_mapping(values, plant, DEFAULT_GAINS[3], limits, joint=joint) for joint in (0, 1)]
    assert [mapping.effort_limit for mapping in mappings] == [3.0, 1.5]
