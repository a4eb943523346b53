"""What the bridge's parameters make of a plant of several joints on HEBI modules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pendulum_hw_bridge.backends.hebi_group import GroupDrive, GroupEncoder
from pendulum_hw_bridge.bridge.assembly import Assembly, assemble, for_plant
from pendulum_hw_bridge.bridge.group_assembly import GroupAssembly
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.errors import ParameterError


def assembled(plant: str = "acrobot", *, lockstep: bool = False, **given: Any) -> Assembly:
    specs = for_plant(SPECS, plant, "hebi")
    values = {spec.name: spec.default for spec in specs} | {"plant": plant, "backend": "hebi"} | given
    return assemble(values, specs, lockstep=lockstep)


def test_each_joint_has_its_own_zero_sign_tare_and_window_and_a_passive_one_a_port_that_is_read() -> None:
    assembly = assembled(
        joint_offsets=[1.0, 0.5],
        joint_signs=[1.0, -1.0],
        effort_tares=[0.0, 0.25],
        position_window=[-2.0, 3.0, -1.0, 4.0],
    )
    shoulder, elbow = assembly.modules(SteppedClock())
    assert (type(shoulder.port), type(elbow.port)) == (GroupEncoder, GroupDrive)
    assert (isinstance(shoulder, DrivenModule), isinstance(elbow, DrivenModule)) == (False, True)
    assert (shoulder.joint, elbow.joint) == ("shoulder", "elbow")
    settings = [shoulder.settings, elbow.settings]
    assert [(own.joint_offset, own.joint_sign, own.effort_tare) for own in settings] == [(1.0, 1, 0.0), (0.5, -1, 0.25)]
    ends = [(own.limits.position_min, own.limits.position_max) for own in settings]
    assert ends == [(-3.0, 2.0), (-3.5, 1.5)]


def test_all_modules_are_of_one_group_in_the_order_of_the_joints() -> None:
    assembly = assembled("double_pendulum", names=["z", "a"], families=["Lab"], serials=["", "S-2"])
    ports = [module.port for module in assembly.modules(SteppedClock())]
    assert all(isinstance(port, GroupDrive) for port in ports)
    first, second = (port.shared for port in ports if isinstance(port, GroupDrive))
    assert first is second
    assert [str(wanted) for wanted in first._wanted] == ["Lab/z", "Lab/a (S-2)"]
    assert [wanted.module_type for wanted in first._wanted] == ["X5-9", "X5-9"]
    assert first.driven == (0, 1)


@pytest.mark.parametrize("plant", ["acrobot", "double_pendulum"])
def test_silence_of_each_module_is_judged_by_the_rate_that_it_is_set_to(plant: str) -> None:
    modules = assembled(plant, feedback_rate=50.0).modules(SteppedClock())
    assert [module.monitor.period for module in modules] == [0.02, 0.02]
    assert [module.settings.feedback_rate for module in modules] == [50.0, 50.0]


def test_the_log_of_the_group_is_the_one_that_is_named_or_none() -> None:
    for name, path in (("", None), ("run.hebilog", Path("run.hebilog"))):
        port = assembled(hebi_log=name).modules(SteppedClock())[1].port
        assert isinstance(port, GroupDrive)
        assert port.shared._log == path


def test_the_limits_are_those_of_the_plant_file_and_of_an_x5() -> None:
    assembly = assembled()
    assert assembly.limits.effort == (6.0,)
    assert (assembly.limits.velocity, assembly.limits.position_max) == (1.5, (4.0, 4.0))
    elbow = assembly.modules(SteppedClock())[1]
    assert isinstance(elbow, DrivenModule)
    assert elbow.mapping.effort_limit == elbow.settings.limits.effort == 6.0
    assert elbow.settings.feedback_rate == 100.0
    assert elbow.mapping.drivetrain.gear_ratio == pytest.approx(1742.222)


@pytest.mark.parametrize(
    ("plant", "given", "sentence"),
    [
        ("cart_pole", {}, "joint 'cart' slides, and a module of backend 'hebi' turns"),
        ("acrobot", {"names": ["a", "b", "c"]}, "names has 3 values; expected 2, for shoulder, elbow, or one for all"),
        ("acrobot", {"names": []}, "names has 0 values; expected 2"),
        ("acrobot", {"joint_signs": [0.5, 1.0]}, "joint_signs has 0.5 for shoulder; expected 1 or -1"),
        ("acrobot", {"serial": "S-1"}, "serial is 'S-1', which is for one module"),
        ("acrobot", {"joint_sign": -1}, "joint_sign is -1, which is for one module"),
        ("acrobot", {"lab_file": "lab.yaml"}, "lab_file is 'lab.yaml', which is for one module"),
        ("acrobot", {"initial_positions": [1.0]}, "initial_positions is for the emulator"),
        (
            "acrobot",
            {"position_window": [-40.0, 40.0, -1.0, 1.0]},
            "position_window is 80 rad; expected at most 64 rad",
        ),
        ("acrobot", {"position_window": [-1.0, 1.0, 0.0, 0.0]}, "position_window is none; expected one"),
        ("acrobot", {"voltage_window": [40.0, 20.0]}, "voltage window is [40.0, 20.0] V; expected min < max"),
        ("acrobot", {"velocity_limit": 30.0}, "velocity_limit is 30 rad/s; expected at most 3 rad/s"),
        ("thesis", {"names": ["a", "b"]}, "names is for several joints; expected name for one"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_sentence(plant: str, given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as refused:
        assembled(plant, **given)
    assert sentence in str(refused.value)


def test_real_modules_keep_time() -> None:
    with pytest.raises(ParameterError, match="clock is 'lockstep' with backend 'hebi'"):
        assembled(lockstep=True)


def test_each_joint_has_its_own_largest_effort_in_its_module_its_mapping_and_its_checks() -> None:
    assembly = assembled("double_pendulum")
    limits = replace(assembly.limits, effort=(6.0, 2.0))
    values = {spec.name: spec.default for spec in for_plant(SPECS, "double_pendulum", "hebi")}
    values |= {"plant": "double_pendulum", "backend": "hebi"}
    group = GroupAssembly(values, assembly.coordinates, limits)
    modules = group.modules(SteppedClock())
    assert [module.settings.limits.effort for module in modules] == [6.0, 2.0]
    assert [module.mapping.effort_limit for module in modules if isinstance(module, DrivenModule)] == [6.0, 2.0]
    first, second = (module.monitor.limits.measured_effort for module in modules)
    assert first > second > 2.0


def test_modules_that_take_a_torque_get_no_plant_in_volts() -> None:
    with pytest.raises(
        ParameterError, match="'qube_servo' is driven in volts; expected one driven by an effort: so are"
    ):
        assembled("qube_servo")
