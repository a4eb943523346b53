"""Judges the result of each exercise, by the project's own model, analysis and emulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.recordings.contract_bags import find_prefix
from pendulum_course.tasks import HOLD_STEP, Tasks
from pendulum_lqr.linear.analysis import closed_loop_poles, delayed_spectral_radius, loop_margins
from pendulum_lqr.linear.design import continuous_lqr
from pendulum_lqr.linear.model import LinearModel, linearise
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.values import NANOSECONDS
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PLANT_SPECS, PlantParameters, load_plant
from pendulum_rosbag.reader import read_bag

__all__ = [
    "PLANT_TOLERANCES",
    "WEIGHTS",
    "Judgement",
    "check_delay",
    "check_fault",
    "check_gains",
    "check_noise",
    "check_plant",
    "critical_delay",
    "noise_ratio",
    "std_under_held_noise",
    "time_constant",
]

WEIGHTS = (100.0, 0.01)
"""Q of every loop of which only R is given."""
PERIOD = {"sim": HOLD_STEP, "hw": 0.01}
PLANT_TOLERANCES = {"inertia": 0.03, "gravity": 0.03, "damping": 0.15, "coulomb_friction": 0.15}
"""Relative tolerance of each parameter of the hidden plant."""
_TIME_TOLERANCE = 0.05
_DELAY_TOLERANCE = 0.05
_RATIO_TOLERANCE = 0.2
"""Two runs of a minute each leave the ratio uncertain by 8 % (one standard deviation)."""
_STOPPED_WITHIN = 0.06
"""Time from the bridge's fault to zero torque [s], as its README promises."""
_WATCHED = 0.5
"""Required recording after the fault, to show that the torque stays zero [s]."""
_LONGEST_GAP = 0.12
"""Longest time without a torque in the recording around the fault [s].  A bridge at 100 Hz publishes one each 10 ms; on
two busy cores gaps of 66 ms occurred."""
_LEAST_RATE = 30.0
"""Fewest torques per second [Hz]: a third of the bridge's, since a busy computer skips periods."""


@dataclass(frozen=True)
class Judgement:
    """Whether a result is right, and a sentence with the reason, which does not reveal the solution."""

    right: bool
    reason: str

    def __str__(self) -> str:
        return f"{'right' if self.right else 'wrong'}: {self.reason}"


def check_gains(tasks: Tasks, q: Sequence[float], r: float) -> Judgement:
    """Judge LQR weights, Q's diagonal [1/rad^2, s^2/rad^2] and R [1/(N m)^2], by their loop's time constant."""
    found = time_constant(q, r)
    asked = tasks.time_constant
    near = abs(found / asked - 1.0) <= _TIME_TOLERANCE
    return Judgement(
        near,
        f"the time constant of this loop is {found:.3g} s; expected {asked:g} s within {_percent(_TIME_TOLERANCE)}",
    )


def check_plant(truth: PlantParameters, found: PlantParameters) -> Judgement:
    """Judge an identified plant by the hidden one, without revealing it."""
    units = {spec.name: spec.unit for spec in PLANT_SPECS}
    off = [
        name
        for name, share in PLANT_TOLERANCES.items()
        if abs(getattr(found, name) / getattr(truth, name) - 1.0) > share
    ]
    limits = ", ".join(f"{name} {_percent(share)}" for name, share in PLANT_TOLERANCES.items())
    if not off:
        return Judgement(True, f"every parameter is within its tolerance ({limits})")
    words = ", ".join(f"{name} ({getattr(found, name):.4g} {units[name]})" for name in off)
    good = [name for name in PLANT_TOLERANCES if name not in off]
    within = f"; within tolerance: {', '.join(good)}" if good else ""
    return Judgement(False, f"outside of the tolerance: {words}{within}; the tolerances are {limits}")


def check_delay(tasks: Tasks, delay: float) -> Judgement:
    """Judge the delay [s] at which the loop at 100 Hz becomes unstable."""
    _require_positive("delay", delay, "s")
    edge = critical_delay(tasks)
    stands = "still stands" if delay < edge else "has fallen"
    right = abs(delay / edge - 1.0) <= _DELAY_TOLERANCE
    near = f"is the stability limit, within {_percent(_DELAY_TOLERANCE)}"
    far = f"is not the stability limit: with it the pendulum {stands}"
    return Judgement(right, f"a delay of {delay:g} s {near if right else far}")


def check_noise(tasks: Tasks, ratio: float, cause: str) -> Judgement:
    """Judge the factor by which longer hold times of noise increase theta's standard deviation, and its cause.

    The factor is relative to 2 ms [-]; a ParameterError if the cause is not a, b, c or d.
    """
    _require_positive("ratio", ratio, "")
    letters = "abcd"[: len(tasks.causes)]
    if len(cause) != 1 or cause not in letters:
        raise ParameterError(f"cause is {cause!r}; expected one of {', '.join(letters)}")
    near = abs(ratio / noise_ratio(tasks) - 1.0) <= _RATIO_TOLERANCE
    explained = tasks.causes[letters.index(cause)] == "power"
    words = (
        f"the factor {ratio:g} is {'within' if near else 'off by more than'} {_percent(_RATIO_TOLERANCE)}, and "
        f"explanation {cause} is {'correct' if explained else 'not correct'}"
    )
    return Judgement(near and explained, words)


def check_fault(tasks: Tasks, bag: Path) -> Judgement:
    """Judge a recording of the bridge's fault; a BagError if unreadable, a DataError without plant or torque."""
    with read_bag(bag) as content:
        space = find_prefix(content)
        events = [event for event in content.events() if event["topic"].startswith(f"{space}/")]
        topic = f"{space}/{names.APPLIED_EFFORT}"
        if topic not in content.topics:
            raise DataError(f"bag {bag} has no topic {topic}; expected it, since it shows the torque")
        applied = content.array(topic)
        states = content.array(f"{space}/{names.JOINT_STATES}")["stamp_ns"]
    modes = [event for event in events if event["name"] == names.Event.PLANT_MODE]
    index = next((i for i, event in enumerate(modes) if event.get("mode") == "fault"), None)
    if index is None:
        seen = ", ".join(str(event.get("mode")) for event in modes) or "none"
        return Judgement(False, f"the bridge never went into fault; its states were: {seen}")
    reason = str(modes[index].get("reason", ""))
    if not any(str(event.get("mode", "")).startswith("armed") for event in modes[:index]):
        return Judgement(False, f"the bridge was not armed before its fault ({reason}); arm it, and break it then")
    if reason.split(":", maxsplit=1)[0] != tasks.fault:
        return Judgement(False, f"the fault is {reason!r}; expected {tasks.fault}")
    since = (applied["stamp_ns"] - int(modes[index]["stamp_ns"])) / NANOSECONDS
    rearmed = next((e for e in modes[index:] if str(e.get("mode", "")).startswith("armed")), None)
    until = math.inf if rearmed is None else (rearmed["stamp_ns"] - modes[index]["stamp_ns"]) / NANOSECONDS
    if until < _WATCHED:
        words = f"the bridge was armed again {until:.2g} s after the fault; leave it in fault for {_WATCHED:g} s"
        return Judgement(False, words)
    later = (since > _STOPPED_WITHIN) & (since < until)
    if not later.any() or float(since[later].max()) < _WATCHED:
        return Judgement(False, f"the recording ends too early; let it run for {_WATCHED:g} s after the fault")
    untold = np.setdiff1d(states, applied["stamp_ns"])
    if lacking := _what_is_missing(since, (untold - int(modes[index]["stamp_ns"])) / NANOSECONDS, until):
        return Judgement(False, f"{lacking}; record all of {topic}, and leave nothing out")
    worst = float(np.max(np.abs(applied["effort"][later])))
    if not math.isfinite(worst):
        return Judgement(False, f"the torque later than {1e3 * _STOPPED_WITHIN:.0f} ms after the fault is not a number")
    if worst > 0.0:
        return Judgement(False, f"{worst:.3g} N m acted later than {1e3 * _STOPPED_WITHIN:.0f} ms after the fault")
    return Judgement(True, f"{reason}; from {1e3 * _STOPPED_WITHIN:.0f} ms after it no torque acted")


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _what_is_missing(since: Any, untold: Any, until: float) -> str:
    """Return which torques a recording lacks around a fault, or "": missing ones may have acted.

    Times of torques (``since``), of states without one (``untold``) and of the next arming (``until``) [s].
    """
    start, end = -_STOPPED_WITHIN, min(until, _WATCHED)
    watched = np.sort(since[(since > start) & (since <= end)])
    lacking = int(np.count_nonzero((untold > start) & (untold <= end)))
    if lacking:
        return f"{lacking} states near the fault have no torque at their time"
    longest = float(np.max(np.diff(watched, prepend=start, append=end)))
    if longest > _LONGEST_GAP:
        allowed = f"expected one at least every {1e3 * _LONGEST_GAP:.0f} ms"
        return f"no torque was recorded for {1e3 * longest:.0f} ms near the fault; {allowed}"
    rate = len(watched) / (end - start)
    if rate < _LEAST_RATE:
        return f"only {rate:.0f} torques a second were recorded near the fault; expected at least {_LEAST_RATE:.0f}"
    return ""


def time_constant(q: Sequence[float], r: float) -> float:
    """Return the time constant of an LQR's loop around the thesis's plant [s]; weights as in :func:`check_gains`."""
    model = _thesis_model()
    return float(-1.0 / closed_loop_poles(model, continuous_lqr(model, list(q), r).K).real.max())


@lru_cache(maxsize=8)
def critical_delay(tasks: Tasks) -> float:
    """Return the delay at which the sampled loop at 100 Hz becomes unstable [s]."""
    model, gain = _thesis_model(), _gain(tasks.delay_weight)
    # Continuous control tolerates slightly more; every step costs the eigenvalues of a loop with that many delays.
    low, high = 0.5 * (margin := loop_margins(model, gain).delay), 1.1 * margin
    for _ in range(10):
        middle = 0.5 * (low + high)
        stable = delayed_spectral_radius(model, gain, PERIOD["hw"], middle) < 1.0
        low, high = (middle, high) if stable else (low, middle)
    return 0.5 * (low + high)


def noise_ratio(tasks: Tasks) -> float:
    """Return the standard deviation of theta under noise of the longer hold, over that under noise held for 2 ms."""
    long = std_under_held_noise(tasks.hold_time)
    return long / std_under_held_noise(PERIOD["sim"])


def std_under_held_noise(hold_time: float) -> float:
    """Return the standard deviation of theta of the thesis's loop under endless uniform noise of 2.5 N m [rad].

    The covariance when the noise changes solves P = A P A' + B B' var; in between it is propagated and averaged.
    ``hold_time`` of a noise sample is a multiple of 2 ms [s].
    """
    import scipy.linalg

    period = PERIOD["sim"]
    sampled = discretise(_thesis_model(), period)
    closed = sampled.A - sampled.B @ np.atleast_2d(_gain(0.1))
    variance = 2.5**2 / 3.0
    steps = round(hold_time / period)
    powers = [np.eye(2)]
    inputs = [np.zeros((2, 1))]
    for _ in range(steps):
        powers.append(closed @ powers[-1])
        inputs.append(closed @ inputs[-1] + sampled.B)
    last = inputs[-1]
    P = scipy.linalg.solve_discrete_lyapunov(powers[-1], variance * last @ last.T)
    between = [
        (power @ P @ power.T + variance * b @ b.T)[0, 0] for power, b in zip(powers[1:], inputs[1:], strict=True)
    ]
    return float(np.sqrt(np.mean(between)))


def _thesis_model() -> LinearModel:
    return linearise(load_plant("thesis"))


def _gain(r: float) -> Any:
    return continuous_lqr(_thesis_model(), list(WEIGHTS), r).K


def _require_positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise ParameterError(f"{name} is {value:g} {unit}".rstrip() + "; expected > 0")
