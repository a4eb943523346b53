"""Checklist before arming: every item is measured or read back, none assumed.

It uses the settings and limits with which the bridge would drive, and the bridge's own checks of feedback.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import IntEnum

import numpy as np

from pendulum_hw_bridge.checks.check_item import HOST_ITEM, CheckItem, Checklist, error_item
from pendulum_hw_bridge.checks.check_rest import rest_items, sign_item
from pendulum_hw_bridge.checks.check_timing import PULSE, HostWatch, Punctuality, TimingFigures, measure
from pendulum_hw_bridge.checks.nudge import Hand
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.port.actuator import (
    ActuatorError,
    ActuatorInfo,
    ActuatorPort,
    CommandLock,
    EncoderPort,
    Feedback,
    MStopAction,
    Strategy,
    TemperatureState,
)
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.joints import ONE_JOINT, Joint
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = [
    "acknowledgement_item",
    "identity",
    "listen",
    "monitor_item",
    "run_checklist",
    "setting_items",
    "state_items",
    "strategy_item",
]

_LISTEN = 1.0
_LISTEN_TO_LOSSES = 5.0
"""Listening time after losses: one of 98 records is more than 1 %, but a poor estimate [s]."""
_STRETCHES = 5
"""Attempts to find a stretch in which this computer is punctual [-]."""
_AT_REST = 0.05
_MAX_JITTER = 0.25
_MAX_LOST = 0.01
_LOSS_ITEM = "no feedback gets lost"
_PUNCTUAL = (0.25, 1.0)
"""Lateness of this computer up to which the actuator is judged: 99th percentile and largest, in periods [-]."""
_ACKNOWLEDGEMENTS = 20


def run_checklist(
    port: ActuatorPort,
    settings: BridgeSettings,
    limits: SafetyLimits,
    plant: PlantParameters,
    *,
    window: tuple[float, float] = (-math.inf, math.inf),
    hand: Hand | None = None,
    hangs: bool = True,
    strategy: Strategy = Strategy.DIRECT_PWM,
    m_stop: bool = True,
    host: Punctuality | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Checklist:
    """Run the checklist; the duty is always zero, and the motor is off at the end.

    The port is not connected yet. ``window`` has the allowed joint angles [rad]; without ``hand`` the sign stays
    untried; ``hangs`` is False for a pendulum that lies flat; ``strategy`` is tried without torque;
    without ``m_stop`` there is no motion stop; ``host`` measures this computer's lateness.
    """
    found = Checklist()
    items = found.items
    try:
        progress("connecting")
        info = port.connect()
        items.append(CheckItem("actuator answers", True, identity(info), "the one that is meant"))
        progress("setting and reading back")
        mapping = None
        if plant.drivetrain is not None:
            mapping = EffortMapping(EffortStrategy.DIRECT_PWM, plant.drivetrain, effort_limit=settings.limits.effort)
        items += setting_items(port, settings, mapping, m_stop=m_stop)
        records = listen(port, settings, limits, host or HostWatch(), found, progress)
        items.append(acknowledgement_item(port, settings, found))
        if records:
            items += state_items(records, limits)
            if not found.host_busy:
                items.append(
                    monitor_item(records, SafetyMonitor(limits, 1.0 / settings.feedback_rate, plant.drivetrain))
                )
            items += rest_items(records, settings, plant, window, hangs)
        progress("trying the strategy at zero torque")
        name = "direct PWM" if strategy is Strategy.DIRECT_PWM else "loop of torque"
        items.append(strategy_item(port, strategy, f"{name} can be set"))
        items.append(sign_item(port, settings, hand, progress))
    except PendulumError as error:
        items.append(error_item(error))
    finally:
        try:
            port.close()
        except ActuatorError as error:
            items.append(error_item(error))
    return found


def identity(info: ActuatorInfo) -> str:
    """Return the actuator's identity as text."""
    serial = f", serial {info.serial}" if info.serial else ""
    firmware = f", firmware {info.firmware}" if info.firmware else ""
    return f"{info.backend} {info.family}/{info.name}{serial}{firmware}"


def setting_items(
    port: ActuatorPort, settings: BridgeSettings, mapping: EffortMapping | None, *, m_stop: bool = True
) -> list[CheckItem]:
    """Write all settings and check that each reads back; with the mapping, report the torque at the limit.

    Without ``m_stop`` the actuator has no input for a motion stop.
    """
    lifetime = port.set_command_lifetime(settings.command_lifetime)
    rate = port.set_feedback_rate(settings.feedback_rate)
    limits, joint = port.set_limits(settings.limits), settings.limits.joint
    effort = _equal("effort limit reads back", limits.effort, settings.limits.effort, joint.effort_unit)
    most = 0.0 if mapping is None else mapping.largest_effort(speed := settings.limits.velocity)
    if most > settings.limits.effort:
        beside = f"up to {most:.1f} {joint.effort_unit} where the motor brakes at {speed:g} {joint.velocity_unit}"
        effort = replace(effort, seen=f"{effort.seen}, {beside}")
    acts, none = settings.limits.m_stop, MStopAction.DISABLED
    items = [
        _equal("command lifetime reads back", lifetime, settings.command_lifetime, "s"),
        _equal("feedback rate reads back", rate, settings.feedback_rate, "Hz"),
        effort,
        _equal("velocity limit reads back", limits.velocity, settings.limits.velocity, joint.velocity_unit),
        CheckItem(
            "motion stop does what it should",
            limits.m_stop is acts is not none if m_stop else None,
            limits.m_stop.value if m_stop else "the actuator has none: keep a hand on the switch of its supply",
            acts.value if acts is not none else "an action",
        ),
    ]
    if settings.gains is not None:
        gains = port.set_gains(settings.gains)
        items.append(
            _equal("position gain reads back", gains.position.kp, settings.gains.position.kp, f"1/{joint.unit}")
        )
    off = port.set_strategy(Strategy.OFF)
    items.append(CheckItem("strategy off reads back", off is Strategy.OFF, off.name, "OFF"))
    return items


def acknowledgement_item(port: ActuatorPort, settings: BridgeSettings, found: Checklist) -> CheckItem:
    """Check how long the module takes to acknowledge that it is off."""
    times = []
    for _ in range(_ACKNOWLEDGEMENTS):
        start = port.now_ns()
        port.set_strategy(Strategy.OFF)
        times.append((port.now_ns() - start) / NANOSECONDS)
    median, high = float(np.median(times)), float(np.percentile(times, 90.0))
    found.figures.update(acknowledgement_median_s=median, acknowledgement_p90_s=high)
    return CheckItem(
        "acknowledgements come in time",
        None if found.host_busy else high <= settings.command_lifetime,
        f"{1e3 * median:.1f} ms (median), {1e3 * high:.1f} ms (90 %) of {_ACKNOWLEDGEMENTS}",
        f"at most {1e3 * settings.command_lifetime:g} ms (90 %)",
    )


def listen(
    port: EncoderPort,
    settings: BridgeSettings,
    limits: SafetyLimits,
    host: Punctuality,
    found: Checklist,
    progress: Callable[[str], None],
) -> list[Feedback]:
    """Listen until this computer is punctual during a stretch, and check the timing of that one.

    If losses are the only failure, a longer stretch is added before judging their share.
    """
    period, seconds, again = 1.0 / settings.feedback_rate, _LISTEN, ""
    before: TimingFigures | None = None
    for _ in range(_STRETCHES):
        progress(f"listening for {seconds:g} s{again}")
        records, lateness = _stretch(port, host, seconds)
        if len(records) < 2:
            seen = f"{len(records)} records in {seconds:g} s"
            found.items.append(CheckItem("feedback flows", False, seen, f"{settings.feedback_rate:g} Hz"))
            return records
        figures = measure(records, period, lateness)
        if before is not None:
            figures = replace(
                figures, records=before.records + figures.records, missing=before.missing + figures.missing
            )
        lines = _timing(figures, settings, limits)
        late = figures.host_p99 > _PUNCTUAL[0] * period or figures.host_worst > _PUNCTUAL[1] * period
        refused = [line.name for line in lines if not line.passed]
        # On a late computer, regular feedback is still regular; only irregular feedback cannot be judged.
        found.host_busy = late and bool(refused)
        if found.host_busy:
            again = " again: this computer was busy"
        elif refused == [_LOSS_ITEM] and before is None:
            seconds, again, before = _LISTEN_TO_LOSSES, " more: records got lost", figures
        else:
            break
    found.items.append(_host(figures, period, busy=found.host_busy))
    found.items += [replace(line, passed=None) for line in lines] if found.host_busy else lines
    found.figures.update(
        rate_hz=figures.rate,
        jitter_s=figures.jitter,
        longest_gap_s=figures.longest_gap,
        lost=figures.lost,
        way_p99_s=figures.way_p99,
        way_worst_s=figures.way_worst,
        host_p99_s=figures.host_p99,
        host_worst_s=figures.host_worst,
    )
    return records


def _stretch(port: EncoderPort, host: Punctuality, seconds: float) -> tuple[list[Feedback], Sequence[float]]:
    records: list[Feedback] = []
    host.start()
    try:
        end = port.now_ns() + round(seconds * NANOSECONDS)
        while port.now_ns() < end:
            record = port.read(PULSE)
            host.poll()
            if record is not None:
                records.append(record)
    finally:
        lateness = host.stop()
    # The first record waited since before the stretch.
    return records[1:], lateness


def _host(figures: TimingFigures, period: float, *, busy: bool) -> CheckItem:
    return CheckItem(
        HOST_ITEM,
        not busy,
        f"wakes {1e3 * figures.host_p99:.1f} ms late (99 %), at worst {1e3 * figures.host_worst:.1f} ms",
        f"{1e3 * _PUNCTUAL[0] * period:.1f} ms (99 %), at worst {1e3 * _PUNCTUAL[1] * period:.0f} ms",
        f"too late in each of {_STRETCHES} stretches to judge the actuator: close other programs and check again",
    )


def _timing(figures: TimingFigures, settings: BridgeSettings, limits: SafetyLimits) -> list[CheckItem]:
    period = 1.0 / settings.feedback_rate
    jitter, gap = figures.jitter / period, figures.longest_gap / period
    cycles = limits.feedback_cycles
    return [
        CheckItem(
            "feedback flows",
            abs(figures.rate / settings.feedback_rate - 1.0) < 0.05,
            f"{figures.rate:.1f} Hz",
            f"{settings.feedback_rate:g} Hz within 5 %",
        ),
        CheckItem(
            "feedback is regular",
            jitter < _MAX_JITTER and gap < cycles,
            f"jitter {100.0 * jitter:.0f} % of the period, longest gap {gap:.1f} periods",
            f"below {100.0 * _MAX_JITTER:.0f} %, no gap of {cycles} periods",
            "by the module's own clock: look at cable, switch and supply, not at this computer",
        ),
        CheckItem(
            _LOSS_ITEM,
            figures.lost <= _MAX_LOST,
            f"{100.0 * figures.lost:.1f} % of {figures.records} records",
            f"at most {100.0 * _MAX_LOST:g} %",
            "use a cable and a switch of its own, no wireless network",
        ),
        CheckItem(
            "feedback comes in time",
            figures.way_worst < cycles * period,
            f"{1e3 * figures.way_p99:.1f} ms behind the fastest (99 %), at worst {1e3 * figures.way_worst:.1f} ms",
            f"less than {1e3 * cycles * period:g} ms",
        ),
    ]


def monitor_item(records: Sequence[Feedback], monitor: SafetyMonitor) -> CheckItem:
    """Check that the bridge's own monitor finds no fault in the records."""
    for record in records:
        fault = monitor.check(record) if monitor.is_new(record) else None
        if fault is not None:
            return CheckItem("the bridge finds no fault", False, f"{fault.name}: {fault.message}", "none")
    return CheckItem("the bridge finds no fault", True, f"none in {len(records)} records", "none")


def state_items(
    records: list[Feedback], limits: SafetyLimits, joint: Joint = ONE_JOINT.joints[0], name: str = "pendulum"
) -> list[CheckItem]:
    """Check the state of a module at rest; ``joint`` gives the units, ``name`` is what is at rest."""
    last = records[-1]
    finite = all(
        math.isfinite(value) for record in records for value in (record.position, record.velocity, record.effort)
    )
    speed, unit = max(abs(record.velocity) for record in records), joint.velocity_unit
    return [
        CheckItem(
            "position, velocity, effort are numbers", finite, "all finite" if finite else "not all", "all finite"
        ),
        CheckItem(f"{name} is at rest", speed <= _AT_REST, f"{speed:.3f} {unit}", f"at most {_AT_REST:g} {unit}"),
        CheckItem("motion stop is released", not last.m_stop, "pressed" if last.m_stop else "released", "released"),
        CheckItem(
            "no other commander",
            last.lock != CommandLock.LOCKED_BY_OTHER,
            _name(CommandLock, last.lock),
            "not locked_by_other",
        ),
        CheckItem(
            "supply voltage",
            limits.voltage_min <= last.voltage <= limits.voltage_max,
            f"{last.voltage:.1f} V",
            f"{limits.voltage_min:g} to {limits.voltage_max:g} V",
        ),
        CheckItem(
            "winding temperature",
            last.winding_temperature <= limits.winding_temperature,
            f"{last.winding_temperature:.0f} degC",
            f"at most {limits.winding_temperature:g} degC",
        ),
        CheckItem(
            "firmware's temperature state",
            last.temperature_state == TemperatureState.NORMAL,
            _name(TemperatureState, last.temperature_state),
            "normal",
        ),
    ]


def strategy_item(port: ActuatorPort, strategy: Strategy, name: str) -> CheckItem:
    """Check that a strategy can be set without torque, and switch it off again."""
    reads = port.set_strategy(strategy)
    port.stop()
    return CheckItem(name, reads is strategy, reads.name, strategy.name)


def _name(kind: type[IntEnum], number: int) -> str:
    """Return a state in words; unknown ones of newer firmware as a number."""
    return kind(number).name.lower() if number in [int(state) for state in kind] else f"unknown ({number})"


def _equal(name: str, seen: float, wanted: float, unit: str) -> CheckItem:
    return CheckItem(name, abs(seen - wanted) <= 1e-3 * max(1.0, abs(wanted)), f"{seen:g} {unit}", f"{wanted:g} {unit}")
