"""Which rules are broken, and which tests have to notice: the safety rules of both plants, without DDS."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from types import FunctionType
from typing import Any

from tests.mutants.operators import Mutant, mutants_of, mutants_of_constant

__all__ = ["TARGETS", "Target", "functions_of", "mutants_of_target"]

_RULES = (
    "pendulum_msgs_py/test/test_supervisor_stop.py",
    "pendulum_msgs_py/test/test_supervisor_enable.py",
    "pendulum_msgs_py/test/test_supervisor_rules.py",
    "pendulum_msgs_py/test/test_supervisor_begin.py",
    "pendulum_msgs_py/test/test_supervisor_edges.py",
    "pendulum_msgs_py/test/test_command_gate.py",
    "pendulum_msgs_py/test/test_several_joints.py",
)
_MESSAGES = "pendulum_msgs_py/test"
_BRIDGE = "pendulum_hw_bridge/test"
_CYCLE = (f"{_BRIDGE}/test_bridge_cycle.py", f"{_BRIDGE}/test_bridge_of_several_modules.py")


@dataclass(frozen=True)
class Target:
    """Functions of one module, and the tests that watch them.

    Attributes:
        module: Where they are.
        names: Functions and methods by qualified name; a class stands for all of its methods.
        tests: Files; of these, the tests that reach a function run, the quickest first.
        choose: Expression of pytest's ``-k`` that chooses among them; empty for all.
        constants: Numbers of the module that these functions read.
    """

    module: str
    names: tuple[str, ...]
    tests: tuple[str, ...]
    choose: str = ""
    constants: tuple[str, ...] = ()


TARGETS: tuple[Target, ...] = (
    Target("pendulum_msgs_py.contract.supervisor", ("PlantSupervisor",), _RULES),
    Target("pendulum_msgs_py.contract.handover", ("Handover",), _RULES),
    Target("pendulum_msgs_py.contract.commands", ("CommandGate",), _RULES),
    Target(
        "pendulum_msgs_py.contract.rules",
        (
            "judge_stamp",
            "is_ahead",
            "has_expired",
            "has_lapsed",
            "age_of",
            "is_inside",
            "is_last",
            "within",
            "rise_within",
        ),
        _RULES,
    ),
    Target(
        "pendulum_msgs_py.loops.plant_rules",
        ("accept", "decide"),
        ("pendulum_msgs_py/test/test_plant_rules_on_records.py",),
    ),
    Target(
        "pendulum_msgs_py.contract.ordinary",
        ("lend", "take_back", "_may_act", "_lend_gate", "_take_gate_back"),
        (f"{_MESSAGES}/test_plant_rules_on_records.py", f"{_MESSAGES}/test_supervisor_enable.py"),
    ),
    Target("pendulum_msgs_py.contract.drive", ("PlantLimits", "Mode"), _RULES),
    Target(
        "pendulum_hw_bridge.port.settings",
        ("write_settings", "write_limits", "expect_limits", "_expect"),
        (f"{_BRIDGE}/test_settings_read_back.py",),
    ),
    Target(
        "pendulum_msgs_py.contract.shared_supervisor",
        ("SharedSupervisor",),
        (
            f"{_BRIDGE}/test_settings_read_back.py",
            f"{_BRIDGE}/test_bridge_states.py",
            "pendulum_msgs_py/test/test_supervisor_edges.py",
        ),
    ),
    Target(
        "pendulum_hw_bridge.bridge.bridge_consistency",
        ("check_consistency", "_check_hardware"),
        (f"{_BRIDGE}/test_bridge_consistency.py",),
    ),
    Target(
        "pendulum_hw_bridge.bridge.bridge_parameters",
        ("supervisor_limits", "bridge_settings", "effort_mapping", "safety_limits"),
        (f"{_BRIDGE}/test_bridge_consistency.py",),
    ),
    Target(
        "pendulum_hw_bridge.drive.safety",
        ("SafetyMonitor", "_or_zero", "_same"),
        (f"{_BRIDGE}/test_safety_monitor.py", f"{_BRIDGE}/test_safety_commands.py"),
    ),
    Target("pendulum_hw_bridge.drive.motor_state", ("MotorWatch",), (f"{_BRIDGE}/test_motor_state.py",)),
    Target(
        "pendulum_hw_bridge.drive.output_check",
        ("OutputCheck", "_output", "_moves", "_memoryless", "_clamped"),
        (f"{_BRIDGE}/test_output_check.py",),
    ),
    Target(
        "pendulum_hw_bridge.drive.effort_mapping",
        ("EffortMapping", "_clip"),
        (f"{_BRIDGE}/test_effort_mapping.py",),
    ),
    Target(
        "pendulum_msgs_py.ros.commander_watch",
        ("CommanderWatch",),
        ("pendulum_msgs_py/test/test_commander_watch.py",),
    ),
    Target(
        "pendulum_hw_bridge.backends.torque_drive",
        ("TorqueDrive",),
        (f"{_BRIDGE}/test_dynamixel.py", f"{_BRIDGE}/test_actuator_contract.py"),
        choose="dynamixel and not real_terminal",
    ),
    Target(
        "pendulum_hw_bridge.backends.dynamixel",
        ("DynamixelBackend",),
        (f"{_BRIDGE}/test_dynamixel.py",),
        choose="not real_terminal",
    ),
    Target(
        "pendulum_hw_bridge.backends.hebi",
        ("HebiBackend", "_known", "connect_group"),
        (f"{_BRIDGE}/test_hebi_backend.py", f"{_BRIDGE}/test_hebi_rules.py"),
        choose="not test_a_bridge_drives_a_module",
    ),
    Target(
        "pendulum_hw_bridge.backends.hebi_settings",
        ("fill_gains", "gains_of", "fill_limits", "limits_of", "_window", "_wider"),
        (f"{_BRIDGE}/test_hebi_backend.py", f"{_BRIDGE}/test_hebi_rules.py"),
        choose="not test_a_bridge_drives_a_module",
    ),
    Target(
        "pendulum_hw_bridge.backends.hebi_group",
        ("HebiGroup", "_answered", "_Row", "_Part", "_Seat", "_GroupPort", "GroupDrive", "GroupEncoder"),
        (f"{_BRIDGE}/test_hebi_group.py",),
    ),
    Target(
        "pendulum_hw_bridge.bridge.group_assembly",
        ("GroupAssembly", "refuse_slides", "values_of_joint"),
        (f"{_BRIDGE}/test_group_assembly.py",),
    ),
    Target("pendulum_hw_bridge.bridge.bridge", ("Bridge",), (*_CYCLE, f"{_BRIDGE}/test_hebi_group.py")),
    Target("pendulum_hw_bridge.bridge.module", ("Module", "DrivenModule"), _CYCLE),
    Target(
        "pendulum_hw_bridge.drive.current_drive",
        ("CurrentMapping", "CurrentCheck"),
        (f"{_BRIDGE}/test_current_drive.py",),
    ),
    Target("pendulum_hw_bridge.drive.derating", ("Derating",), (f"{_BRIDGE}/test_derating.py",)),
    Target(
        "pendulum_hw_bridge.port.actuator",
        ("no_torque", "Command.effort_field", "afterwards"),
        (f"{_BRIDGE}/test_no_torque.py", f"{_BRIDGE}/test_lifetime_proof.py"),
    ),
    Target(
        "pendulum_hw_bridge.backends.emulator_process",
        ("EmulatorProcessBackend.set_strategy", "EmulatorProcessBackend.stop", "EmulatorProcessBackend.connect"),
        (f"{_BRIDGE}/test_emulator_process_stop.py",),
    ),
    Target(
        "pendulum_hw_bridge.port.command_check",
        ("check_command", "check_lifetime", "_clip"),
        (f"{_BRIDGE}/test_command_check.py",),
    ),
    Target(
        "pendulum_hw_bridge.lab.guided",
        ("find_zero_and_sign", "measure_tare", "_turned", "_rest", "_listen", "expect_numbers"),
        (f"{_BRIDGE}/test_guided_rules.py", f"{_BRIDGE}/test_guided_procedures.py"),
    ),
    Target(
        "pendulum_hw_bridge.lab.proofs",
        (
            "prove_lifetime",
            "prove_m_stop",
            "_GentleDrive",
            "_while_pressed",
            "_has_duty",
            "_expect_driven_until",
            "_end_of_duty",
            "_expect_allowed",
            "_expect_inside",
        ),
        (
            f"{_BRIDGE}/test_proof_drive.py",
            f"{_BRIDGE}/test_proof_records.py",
            f"{_BRIDGE}/test_lifetime_proof.py",
            f"{_BRIDGE}/test_m_stop_proof.py",
            f"{_BRIDGE}/test_guided_procedures.py",
        ),
    ),
    Target(
        "pendulum_hw_bridge.checks.nudge",
        ("watch_nudge", "hand_of", "Person", "EmulatedHand"),
        (f"{_BRIDGE}/test_nudge.py",),
    ),
    Target("pendulum_hw_bridge.port.feedback_stream", ("feedback_for",), (f"{_BRIDGE}/test_nudge.py",)),
    Target(
        "pendulum_hw_bridge.lab.module_files",
        (
            "backup_group",
            "restore_group",
            "_expect_group",
            "backup_emulator",
            "restore_emulator",
            "limits_of_group",
            "_set_open_ends",
            "_ends_of",
            "_read_ends",
            "_info",
        ),
        (f"{_BRIDGE}/test_module_files.py", f"{_BRIDGE}/test_hebi_emulated.py"),
    ),
    Target("pendulum_hw_bridge.nodes.e_stop_input", ("EStopInput",), (f"{_BRIDGE}/test_e_stop_input.py",)),
    Target(
        "pendulum_hw_bridge.nodes.e_stop_input_node",
        ("EStopInputServer.__init__",),
        ("tests/integration/test_e_stop_threads.py",),
        choose="release_came_before or clock_that_nobody_sets",
        constants=("_WAITING",),
    ),
    Target(
        "pendulum_msgs_py.ros.plant_interface",
        (
            "PlantInterface._on_trajectory",
            "PlantInterface._on_arm",
            "PlantInterface._on_e_stop_reset",
            "PlantInterface._is_outdated",
            "PlantInterface._unread_press",
            "PlantInterface._receive_enable",
            "PlantInterface._on_enable",
            "PlantInterface.decide",
            "PlantInterface.e_stop",
            "PlantInterface.measured",
            "_came_before",
        ),
        (f"{_MESSAGES}/test_plant_requests.py",),
    ),
    Target("pendulum_msgs_py.programs.starter", ("_watch", "bound_environment"), (f"{_MESSAGES}/test_starter.py",)),
    Target(
        "pendulum_msgs_py.contract.plant_specs",
        ("limits_from_parameters",),
        (f"{_MESSAGES}/test_plant_limits.py", f"{_MESSAGES}/test_supervisor_enable.py"),
    ),
    Target("pendulum_msgs_py.programs.realtime", ("run_ahead",), (f"{_MESSAGES}/test_realtime.py",), choose="ahead"),
    Target(
        "pendulum_msgs_py.ros.runner",
        ("_watch_signals", "_next_stop_signal"),
        (f"{_MESSAGES}/test_stop_signals.py",),
    ),
    Target(
        "pendulum_hw_bridge.nodes.bridge_node",
        ("BridgeNode._fail", "BridgeNode._quieten", "BridgeNode.release_actuator"),
        ("tests/faults/test_bridge_node_rules.py",),
    ),
)


def functions_of(target: Target) -> Iterator[tuple[str, FunctionType]]:
    """Yield the functions of a target by their qualified names.

    Raises:
        LookupError: A name is not there any more.
    """
    module = importlib.import_module(target.module)
    for name in target.names:
        found: Any = module
        for part in name.split("."):
            if not hasattr(found, part):
                raise LookupError(f"{target.module} has no {name}; expected the functions that targets.py lists")
            found = inspect.getattr_static(found, part)
        if inspect.isclass(found):
            for part, member in vars(found).items():
                yield from _function(f"{name}.{part}", member, target.module)
        else:
            yield from _function(name, found, target.module)


def mutants_of_target(target: Target) -> list[Mutant]:
    """Return every mutant of a target's functions and constants."""
    module = importlib.import_module(target.module)
    found = [mutant for name, function in functions_of(target) for mutant in mutants_of(function, name)]
    return found + [mutant for name in target.constants for mutant in mutants_of_constant(module, name)]


def _function(name: str, member: Any, module: str) -> Iterator[tuple[str, FunctionType]]:
    inner = getattr(member, "fget", None) or getattr(member, "__func__", None) or member
    if isinstance(inner, FunctionType) and inner.__module__ == module and not inner.__qualname__.startswith("__create"):
        yield name, inner
