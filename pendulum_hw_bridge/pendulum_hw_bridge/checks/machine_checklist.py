"""Checklist of a machine of several modules: the items of one module for each joint.

Drives are set, read back, listened to, and tried at zero effort; encoders of passive joints are only read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.checks.check_item import HOST_ITEM, CheckItem, Checklist, error_item
from pendulum_hw_bridge.checks.check_timing import HostWatch, Punctuality
from pendulum_hw_bridge.checks.checklist import (
    acknowledgement_item,
    identity,
    listen,
    monitor_item,
    setting_items,
    state_items,
    strategy_item,
)
from pendulum_hw_bridge.drive.safety import SafetyMonitor
from pendulum_hw_bridge.port.actuator import Feedback
from pendulum_msgs_py.contract.joints import Joint
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["names_problem", "run_machine_checklist"]

_LEAST_ZERO_TOLERANCE = 0.15
"""Tolerance of the zero of a hanging link [rad]."""
_EFFORT_TOLERANCE = 0.05
"""Tolerance of the mean effort of a drive that is off, as a share of its limit [-]."""


def run_machine_checklist(
    modules: Sequence[Module],
    parameters: PlantParameters,
    windows: Sequence[tuple[float, float]],
    *,
    host: Callable[[], Punctuality] = HostWatch,
    progress: Callable[[str], None] = lambda text: None,
) -> Checklist:
    """Run the checklist; no motor gets an effort, and all are off at the end.

    Modules are in the plant's order and not connected yet. If they do not match the joints, nothing is set in any of
    them. ``windows`` has the allowed positions of each joint [rad or m].
    """
    found = Checklist()
    try:
        if not _connect(modules, found, progress):
            return found
        for index, module in enumerate(modules):
            part = Checklist()
            try:
                _check(module, index, parameters, windows[index], part, host(), progress)
            except PendulumError as error:
                part.items.append(error_item(error))
            _add(found, part, module.joint)
    finally:
        for module in modules:
            try:
                module.port.close()
            except PendulumError as error:
                found.items.append(_named(error_item(error), module.joint))
    _judge_host_once(found)
    return found


def names_problem(reported: Sequence[str], joints: Sequence[str]) -> str:
    """Return why reported module names differ from those of the joints or their order; empty if they match."""
    problems = [f"{name} is there {count} times" for name, count in Counter(reported).items() if count > 1]
    problems += [f"{name} is missing" for name in joints if name not in reported]
    problems += [f"{name} is no joint of this plant" for name in dict.fromkeys(reported) if name not in joints]
    if not problems and tuple(reported) != tuple(joints):
        problems = ["they are swapped"]
    return "; ".join(problems)


def _connect(modules: Sequence[Module], found: Checklist, progress: Callable[[str], None]) -> bool:
    """Connect all; return whether each is the module of its joint."""
    reported: list[str] = []
    for module in modules:
        progress(f"{module.joint}: connecting")
        try:
            info = module.port.connect()
        except PendulumError as error:
            found.items.append(_named(error_item(error), module.joint))
            continue
        reported.append(info.name)
        item = CheckItem("module answers", True, identity(info), "the one that is meant")
        found.items.append(_named(item, module.joint))
    joints = [module.joint for module in modules]
    problem = names_problem(reported, joints)
    found.items.append(
        CheckItem(
            "modules are those of the joints",
            not problem,
            f"{', '.join(reported) or 'none'}{f' ({problem})' if problem else ''}",
            ", ".join(joints),
            "an effort would act on another joint: set names and order of the modules right before anything else",
        )
    )
    return not problem


def _check(
    module: Module,
    index: int,
    parameters: PlantParameters,
    window: tuple[float, float],
    found: Checklist,
    host: Punctuality,
    progress: Callable[[str], None],
) -> None:
    joint, settings, monitor = parameters.coordinates.joints[index], module.settings, module.monitor
    driven = module if isinstance(module, DrivenModule) else None
    progress(f"{joint.name}: setting and reading back")
    if driven is not None:
        found.items += setting_items(driven.port, settings, driven.mapping)
    else:
        rate = module.port.set_feedback_rate(settings.feedback_rate)
        right = math.isclose(rate, settings.feedback_rate, rel_tol=1e-3)
        wanted = f"{settings.feedback_rate:g} Hz"
        found.items.append(CheckItem("feedback rate reads back", right, f"{rate:g} Hz", wanted))
    records = listen(module.port, settings, monitor.limits, host, found, lambda text: progress(f"{joint.name}: {text}"))
    if driven is not None:
        found.items.append(acknowledgement_item(driven.port, settings, found))
    if records:
        found.items += state_items(records, monitor.limits, joint, "joint")
        if not found.host_busy:
            fresh = SafetyMonitor(monitor.limits, monitor.period, monitor.drivetrain, joint)
            found.items.append(monitor_item(records, fresh))
        found.items += _rest_items(module, records, index, parameters, window)
    if driven is None:
        found.items.append(CheckItem("passive joint is only read", True, "no way to give it an effort", "no motor"))
        return
    progress(f"{joint.name}: trying the strategy at no effort")
    mapping = driven.mapping
    found.items.append(strategy_item(driven.port, mapping.strategy, "the loop of effort can be set"))


def _rest_items(
    module: Module, records: Sequence[Feedback], index: int, parameters: PlantParameters, window: tuple[float, float]
) -> list[CheckItem]:
    """Check position and effort of a joint at rest."""
    joint, own = parameters.coordinates.joints[index], parameters.joints[index]
    position, _, effort = (float(value) for value in np.mean([module.state(record) for record in records], axis=0))
    items = [
        CheckItem(
            "position is inside its window",
            window[0] <= position <= window[1],
            f"{position:.3f} {joint.unit}",
            f"{window[0]:g} to {window[1]:g} {joint.unit}",
        )
    ]
    weight = _largest_weight(parameters, index, joint)
    if weight > 0.0:
        tolerance = max(_LEAST_ZERO_TOLERANCE, math.asin(min(1.0, own.breakaway / weight)))
        items.append(
            CheckItem(
                "hanging is zero",
                abs(position) <= tolerance,
                f"{position:.3f} {joint.unit}",
                f"0 within {tolerance:.2f} {joint.unit}",
                "either it does not hang, or the plant file is another machine's",
            )
        )
    room = _EFFORT_TOLERANCE * own.actuator.effort_limit if own.actuator is not None else 0.0
    items.append(
        CheckItem(
            "nothing drives it",
            abs(effort) <= room,
            f"{effort:.3f} {joint.effort_unit}",
            f"0 within {room:g} {joint.effort_unit}",
            "a drive that is off gives an effort, or its sensor needs a tare",
        )
    )
    return items


def _largest_weight(parameters: PlantParameters, index: int, joint: Joint) -> float:
    """Return the largest gravity torque about a hinge, other joints at 0; 0 for a slide [N m]."""
    if joint.unit == "m":
        return 0.0
    step, packed, potential = 1e-4, parameters.packed, parameters.mechanism.potential

    def energy(angle: float) -> float:
        return float(potential(tuple(angle * (k == index) for k in range(len(parameters.joints))), packed))

    turns = np.linspace(0.0, math.tau, 73)
    largest = max(abs(energy(turn + step) - energy(turn - step)) / (2.0 * step) for turn in turns.tolist())
    return largest if largest > 1e-6 else 0.0


def _named(item: CheckItem, joint: str) -> CheckItem:
    return item if item.name == HOST_ITEM else replace(item, name=f"{joint}: {item.name}")


def _add(found: Checklist, part: Checklist, joint: str) -> None:
    found.items += [_named(item, joint) for item in part.items]
    found.figures.update({f"{joint}.{name}": value for name, value in part.figures.items()})
    found.host_busy = found.host_busy or part.host_busy


def _judge_host_once(found: Checklist) -> None:
    """Reduce the items on this computer to one: the first failed, else the first."""
    lines = [item for item in found.items if item.name == HOST_ITEM]
    if lines:
        kept = next((line for line in lines if not line.passed), lines[0])
        found.items = [item for item in found.items if item.name != HOST_ITEM or item is kept]
