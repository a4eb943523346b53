"""Whether a plant moves as its equation predicts: both run from equal starts under equal efforts, joint by joint.

Only the plant's states are read, so the check shares no assumption with the source of the equation. A cause is named
only if it was tested: by a copy of the plant with it switched off, or by the shape of the residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pendulum_msgs_py.contract.angles import wrap
from pendulum_msgs_py.contract.joints import Vector
from pendulum_msgs_py.errors import FaultError
from pendulum_sim.stepping.plants import JointPlant

__all__ = ["TOLERANCE", "EquationCheck", "Switches", "check_equation", "check_recording"]

Array = NDArray[np.float64]

TOLERANCE = 0.05
"""Largest error of angle and velocity, relative to the largest motion of the same kind.

First-order integrators at usual timesteps and MuJoCo's regularised friction stay below it; an error of that size
changes the spread of a balanced pendulum within the margins of the verdict.
"""
_WINDOW, _LEAST_PERIODS, _MOST_PERIODS = 0.2, 5, 200
"""Length of a run [s], and its bounds in periods."""
_ANGLES = 25
"""Start angles over a full turn."""
_RANDOM_STARTS = 24
_SLIDE = 0.1
"""Start distance of a sliding joint from the middle [m]."""
_SMALL = 0.1
"""Small effort, relative to the limit."""
_FINE = (0.02, 0.005)
"""Efforts near a controller's goal, relative to the limit: they show a dead zone."""
_FLOOR = 0.02
"""Differences below this share of the motion under full effort are ignored."""
_ABRUPT = 0.5
"""Error right behind a stop; other causes grow with the angle."""
_OUTSIDE = 3.0
"""Error of a run that ended with a fault."""
_HELPS = 0.7
"""Largest remaining share of the error after a cause is switched off."""
_EXPLAINS = 0.9
"""Share of the residual's power that one term must explain."""
_MOST_CAUSES = 4
_WORST = 16
"""Runs on which causes are tested."""
_JUMP = 4.0
"""An angle jumps if it moves more than this times its velocity in a period."""
_LAGS = 40
_LEAST = 1e-3
"""Smallest dead zone, relative to the limit."""
_DEAD = 0.02
"""Smallest response, relative to the equation's."""
_CLOSE = 0.05
"""Relative residual up to which two responses are the same."""
_LOST = 0.3
"""Largest share of a start's velocity a period later if the start ignored it."""
_SAME_TURN = 0.99
"""Mean of unit vectors from which angles differ by a constant."""
_LEAST_JUMP = 0.5
"""Smallest jump [rad or m]."""
_OTHER_PERIOD = 0.2
"""Relative difference of two periods, above that of first-order integrators."""
_FREE, _FINE_STEP, _SMALL_STEP, _FULL, _MOVING = "free swing", "fine step", "small step", "full step", "moving"
_OWN = ("another scale of the effort", "another damping", "another weight")
_FEW = 4
"""Too few runs for a conclusion."""
_TERMS = (
    "another scale of the effort", "another damping", "quadratic damping", "dry friction", "a spring",
    "a constant torque", "another weight", "another zero of the angle", "a weight that is no sine of the angle",
    "a weight that is no sine of the angle",
)  # fmt: skip
"""Terms of an acceleration: u, v, v |v|, sign v, q, 1, sin q, cos q, sin 2 q, cos 2 q."""


class Switches(NamedTuple):
    """Causes that can be switched off in a copy of a plant, and ``without``, which returns such a copy."""

    causes: tuple[str, ...]
    without: Callable[[tuple[str, ...]], JointPlant]


@dataclass(frozen=True)
class EquationCheck:
    """Result of the check.

    Attributes:
        joints: Names of the joints.
        errors: Largest error of each joint, relative to the largest motion of the same kind [-].
        runs: Number of runs.
        where: The run with the largest error, as text.
        causes: Confirmed causes, as text.
        left: Largest error without these causes; None if none was switched off [-].
    """

    joints: tuple[str, ...]
    errors: tuple[float, ...]
    runs: int
    where: str = ""
    causes: tuple[str, ...] = ()
    left: float | None = None

    @property
    def agrees(self) -> bool:
        """Whether every joint is within :data:`TOLERANCE`."""
        return max(self.errors) <= TOLERANCE

    def __str__(self) -> str:
        """Return one sentence."""
        percent = 100.0 * TOLERANCE
        worst = int(np.argmax(self.errors))
        if self.agrees:
            return (
                f"moves as its equation within {100.0 * self.errors[worst]:.2g} % in {self.runs} free swings and "
                f"torque steps (at most {percent:g} %)"
            )
        error = self.errors[worst]
        size = "more than 100" if error > 1.0 else f"{100.0 * error:.2g}"
        text = f"does not move as its equation: joint {self.joints[worst]} differs by {size} % of its motion "
        text += f"(at most {percent:g} %), most in {self.where}"
        if not self.causes:
            return f"{text}; the cause is none of those that can be tested"
        text += f"; cause: {' and '.join(self.causes)}"
        return text if self.left is None else f"{text} (without: {100.0 * self.left:.2g} %)"


class _Probe(NamedTuple):
    kind: str
    position: Vector
    velocity: Vector
    effort: Vector


@dataclass
class _Trace:
    """States of one run, shape (periods + 1, joints), until a fault."""

    position: Array
    velocity: Array
    fault: str = ""


@dataclass
class _Runs:
    """Probes, the equation's traces by two integrators, and the largest motion of each kind."""

    probes: list[_Probe] = field(default_factory=list)
    traces: list[_Trace] = field(default_factory=list)
    coarse: list[_Trace] = field(default_factory=list)
    scales: dict[str, tuple[Array, Array]] = field(default_factory=dict)


def check_equation(
    plant: JointPlant,
    equation: JointPlant,
    *,
    coarse: JointPlant | None = None,
    switches: Switches | None = None,
    reseeded: JointPlant | None = None,
) -> EquationCheck:
    """Return how far a plant deviates from an equation, and why.

    Args:
        plant: The plant; reset it afterwards.
        equation: Basis of a controller's design, with the same period and joints.
        coarse: The equation by a first-order integrator with that period, whose error is tolerated.
        switches: Switchable causes, tried only if the two differ.
        reseeded: The plant with other random numbers, if it has any.
    """
    count = max(_LEAST_PERIODS, min(_MOST_PERIODS, math.ceil(_WINDOW / plant.dt)))
    runs = _plan(equation, coarse, count)
    traces = [_run(plant, probe, count) for probe in runs.probes]
    table = np.array([_error(runs, i, trace) for i, trace in enumerate(traces)])
    per_joint, errors = table.max(axis=0), table.max(axis=1)
    joint = int(np.argmax(per_joint))
    causes: tuple[str, ...] = ()
    left = None
    if per_joint[joint] > TOLERANCE:
        causes, left = _causes(_Case(plant, equation, runs, traces, errors, joint, count), switches, reseeded)
    where = _describe(runs.probes[int(np.argmax(errors))], plant)
    names = plant.parameters.coordinates.names
    return EquationCheck(names, tuple(map(float, per_joint)), len(traces), where, causes, left)


def check_recording(position: Array, velocity: Array, effort: Array, equation: JointPlant) -> Array:
    """Return the errors, shape (pieces, joints), of a recorded plant, relative to the largest motion of a piece [-].

    Args:
        position: At the equation's period, shape (n, joints) [rad or m].
        velocity: Shape (n, joints) [rad/s or m/s].
        effort: Held from each state on, shape (n, driven joints) [N m or N].
        equation: Basis of a controller's design.
    """
    count = max(_LEAST_PERIODS, min(_MOST_PERIODS, math.ceil(_WINDOW / equation.dt)))
    runs, traces = _Runs(), []
    none = (0.0,) * position.shape[1]
    for first in range(0, len(position) - count, count):
        state = equation.reset(tuple(position[first]), tuple(velocity[first]))
        rows = [(state.position, state.velocity)]
        for k in range(first, first + count):
            _, *moved, _ = equation.step(tuple(effort[k]), none)
            rows.append((moved[0], moved[1]))
        table = np.array(rows, dtype=float)
        piece = slice(first, first + count + 1)
        runs.probes.append(_Probe(_FULL, rows[0][0], rows[0][1], tuple(effort[first])))
        runs.traces.append(_Trace(table[:, 0], table[:, 1]))
        traces.append(_Trace(position[piece], velocity[piece]))
    runs.coarse = runs.traces
    if not traces:
        return np.empty((0, position.shape[1]))
    runs.scales[_FULL] = _motion(traces)
    return np.array([_error(runs, i, trace) for i, trace in enumerate(traces)])


# --- runs ------------------------------------------------------------------------------------------------------


def _plan(equation: JointPlant, coarse: JointPlant | None, count: int) -> _Runs:
    """Return runs with the equation's results: from rest first, then at the speeds that these reached."""
    runs = _Runs()
    limits, joints = equation.parameters.effort_limits, len(equation.parameters.coordinates.joints)
    still, none = (0.0,) * joints, (0.0,) * len(limits)
    starts = _starts(equation)
    some = starts if joints > 1 else starts[::4]
    rest = [_Probe(_FREE, q, still, none) for q in starts]
    for share, kind in ((_SMALL, _SMALL_STEP), (1.0, _FULL)):
        for sign in (1.0, -1.0):
            for i in range(len(limits)):
                effort = tuple(sign * share * limit if j == i else 0.0 for j, limit in enumerate(limits))
                rest += [_Probe(kind, q, still, effort) for q in some]
    for share in _FINE:
        for i, limit in enumerate(limits):
            effort = tuple(share * limit if j == i else 0.0 for j in range(len(limits)))
            # From 0 at rest: elsewhere gravity would hide such small efforts.
            rest += [_Probe(_FINE_STEP, still, still, tuple(sign * u for u in effort)) for sign in (1.0, -1.0)]
    _add(runs, equation, coarse, rest, count)
    fastest = np.max([runs.scales[kind][1] for kind in (_FREE, _SMALL_STEP)], axis=0)
    moving = []
    for share in (1.0, -1.0, 0.5, -0.5):
        moving += [_Probe(_MOVING, q, tuple(float(v) for v in share * fastest), none) for q in some]
    _add(runs, equation, coarse, moving, count)
    return runs


def _starts(plant: JointPlant) -> list[Vector]:
    joints = plant.parameters.coordinates.joints
    if len(joints) == 1 and joints[0].turns:
        return [(float(q),) for q in np.linspace(-math.pi, math.pi, _ANGLES)]
    generator = np.random.default_rng(0)
    reach = np.array([math.pi if joint.turns else _SLIDE for joint in joints])
    low, high = (np.array([stop[side] for stop in plant.parameters.stops]) for side in (0, 1))
    drawn = [plant.parameters.coordinates.goal, (0.0,) * len(joints)]
    drawn += [tuple(float(q) for q in generator.uniform(-reach, reach)) for _ in range(_RANDOM_STARTS)]
    return [tuple(float(x) for x in np.clip(q, low, high)) for q in drawn]


def _add(runs: _Runs, equation: JointPlant, coarse: JointPlant | None, probes: Sequence[_Probe], count: int) -> None:
    traces = [_run(equation, probe, count) for probe in probes]
    runs.probes += probes
    runs.traces += traces
    runs.coarse += traces if coarse is None else [_run(coarse, probe, count) for probe in probes]
    for kind in dict.fromkeys(probe.kind for probe in probes):
        runs.scales[kind] = _motion([t for probe, t in zip(probes, traces, strict=True) if probe.kind == kind])


def _motion(traces: Sequence[_Trace]) -> tuple[Array, Array]:
    return (
        np.max([np.max(np.abs(t.position - t.position[0]), axis=0) for t in traces], axis=0),
        np.max([np.max(np.abs(t.velocity - t.velocity[0]), axis=0) for t in traces], axis=0),
    )


def _run(plant: JointPlant, probe: _Probe, count: int) -> _Trace:
    none = (0.0,) * len(probe.position)
    rows = [(probe.position, probe.velocity)]
    fault = ""
    try:
        plant.reset(probe.position, probe.velocity)
        for _ in range(count):
            _, position, velocity, _ = plant.step(probe.effort, none)
            rows.append((position, velocity))
    except FaultError as error:
        fault = str(error)
    table = np.array(rows, dtype=float)
    return _Trace(table[:, 0], table[:, 1], fault)


def _error(runs: _Runs, i: int, trace: _Trace) -> Array:
    """Return the error of each joint; a state may be a period early or late, as with first-order integrators."""
    if trace.fault:
        return np.full(trace.position.shape[1], _OUTSIDE)
    errors = []
    for values, scale in zip(("position", "velocity"), _scales(runs, i), strict=True):
        theirs, mine, rough = (getattr(each, values) for each in (trace, runs.traces[i], runs.coarse[i]))
        early = np.vstack([mine[1:], 2.0 * mine[-1:] - mine[-2:-1]])
        late = np.vstack([2.0 * mine[:1] - mine[1:2], mine[:-1]])
        around = np.stack([early, mine, late])
        off = np.maximum(around.min(axis=0) - theirs, theirs - around.max(axis=0)) - np.abs(rough - mine)
        errors.append(np.max(np.maximum(off, 0.0), axis=0) / scale)
    return np.minimum(np.maximum(*errors), _OUTSIDE)


def _scales(runs: _Runs, i: int) -> tuple[Array, Array]:
    """Return the motions that a run's errors are relative to: position and velocity of each joint."""
    of_kind, full = runs.scales[runs.probes[i].kind], runs.scales[_FULL]
    position, velocity = (np.maximum(np.maximum(a, _FLOOR * b), 1e-12) for a, b in zip(of_kind, full, strict=True))
    return position, velocity


def _describe(probe: _Probe, plant: JointPlant) -> str:
    joints, driven = plant.parameters.coordinates.joints, plant.parameters.coordinates.driven
    at = ", ".join(f"{q:.2f} {joint.unit}" for q, joint in zip(probe.position, joints, strict=True))
    speeds = ", ".join(f"{v:.2g} {joint.velocity_unit}" for v, joint in zip(probe.velocity, joints, strict=True))
    efforts = ", ".join(f"{u:.2g} {joints[j].effort_unit}" for u, j in zip(probe.effort, driven, strict=True))
    what = f"a step of {efforts}" if any(probe.effort) else "a free swing"
    return f"{what} from {at}{f' at {speeds}' if any(probe.velocity) else ''}"


# --- causes ----------------------------------------------------------------------------------------------------


@dataclass
class _Case:
    """A plant that differs from its equation; ``errors`` is the largest of each run, ``joint`` the worst."""

    plant: JointPlant
    equation: JointPlant
    runs: _Runs
    traces: list[_Trace]
    errors: Array
    joint: int
    count: int

    def whole(self, kind: str = "") -> list[tuple[_Probe, _Trace, _Trace]]:
        """Return the runs without fault, of one kind or all: start, the plant's trace, the equation's."""
        every = zip(self.runs.probes, self.traces, self.runs.traces, strict=True)
        return [each for each in every if not each[1].fault and kind in {"", each[0].kind}]


def _causes(
    case: _Case, switches: Switches | None, reseeded: JointPlant | None
) -> tuple[tuple[str, ...], float | None]:
    worst = [int(i) for i in np.argsort(-case.errors)[:_WORST]]
    if reseeded is not None and (cause := _noise(case, reseeded, worst)):
        return (cause,), None
    if cause := _reset(case) or _period(case) or _wrap(case):
        return (cause,), None
    if switches is not None:
        causes, left = _switched(case, switches, worst)
        if causes:
            return causes, left
    if faults := [case.traces[i].fault for i in worst if case.traces[i].fault]:
        return (faults[0],), None
    for test in (_dead, _clipped, _late, _stop, _shape):
        if cause := test(case):
            return (cause,), None
    return (), None


def _switched(case: _Case, switches: Switches, worst: Sequence[int]) -> tuple[tuple[str, ...], float | None]:
    """Return the causes that must be switched off, one after another, for the plant to move as its equation."""
    off: tuple[str, ...] = ()
    traces = {i: case.traces[i] for i in worst}
    size, left = _size(case.errors[list(worst)]), float(np.max(case.errors))
    while left > TOLERANCE and len(off) < _MOST_CAUSES:
        tried = []
        for cause in switches.causes:
            if cause in off:
                continue
            plant, runs = switches.without((*off, cause)), {}
            for i in worst:
                runs[i] = _run(plant, case.runs.probes[i], case.count)
                if len(runs) == _FEW and all(np.array_equal(runs[k].velocity, traces[k].velocity) for k in runs):
                    break  # without effect
            else:
                errors = np.array([_error(case.runs, i, runs[i]).max() for i in worst])
                tried.append((_size(errors), float(errors.max()), cause, runs))
        best = min(tried, default=(math.inf, left, "", traces), key=lambda each: each[0])
        if best[0] > _HELPS * size:
            break
        size, left, cause, traces = best
        off = (*off, cause)
    return off, left if off else None


def _size(errors: Array) -> float:
    """Return one figure for the errors of runs, each counted up to all of its motion [-]."""
    return float(np.sqrt(np.mean(np.minimum(errors, 1.0) ** 2)))


def _noise(case: _Case, reseeded: JointPlant, worst: Sequence[int]) -> str:
    def differs(plant: JointPlant) -> float:
        largest = 0.0
        for i in worst:
            again = _run(plant, case.runs.probes[i], case.count)
            if not (again.fault or case.traces[i].fault):
                off = np.abs(again.velocity - case.traces[i].velocity) / _scales(case.runs, i)[1]
                largest = max(largest, float(off.max()))
        return largest

    # With the same seed a run differs only by what came before it.
    if (size := differs(case.plant)) > TOLERANCE:
        return f"a reset that leaves something behind (with the same seed a run differs by {100.0 * size:.2g} %)"
    size = differs(reseeded)
    return f"noise (with another seed a run differs by {100.0 * size:.2g} %)" if size > TOLERANCE else ""


def _reset(case: _Case) -> str:
    """Name a start that the plant does not take."""
    swings, j = case.whole(_FREE), case.joint
    if not swings:
        return ""
    asked = np.array([probe.position[j] for probe, _, _ in swings])
    came = np.array([theirs.position[1, j] for _, theirs, _ in swings])
    there = np.array([mine.position[1, j] for _, _, mine in swings])
    unit = case.plant.parameters.coordinates.joints[j].unit
    far = np.abs(came - there)
    if len(swings) > _FEW and np.median(far) > 0.2 * np.std(asked):
        for sign, what in ((1.0, "another zero"), (-1.0, "another sign, or swapped sine and cosine,")):
            if abs(np.mean(np.exp(1j * (came - sign * there)))) > _SAME_TURN:
                return (
                    f"{what} of the angle that is read than of the start (put at {asked[0]:.2f} {unit}, it is read as "
                    f"{wrap(float(came[0])):.2f} {unit})"
                )
        scale = float(np.dot(came, there) / np.dot(there, there))
        if np.std(came - scale * there) < 0.1 * np.std(came):
            return (
                f"another unit of the angle that is read than of the start (put at {asked[0]:.2f} {unit}, it is read "
                f"as {came[0]:.2f} {unit})"
            )
        i = int(np.argmax(far))
        at = wrap(float(came[i])) if case.plant.parameters.coordinates.joints[j].turns else float(came[i])
        return f"a reset that is ignored (put at {asked[i]:.2f} {unit}, it is at {at:.2f} {unit} a period later)"
    moving = case.whole(_MOVING)
    asked = np.array([probe.velocity[j] for probe, _, _ in moving])
    power = float(np.dot(asked, asked))
    if power > 0.0:
        kept = float(np.dot([theirs.velocity[1, j] for _, theirs, _ in moving], asked)) / power
        ours = float(np.dot([mine.velocity[1, j] for _, _, mine in moving], asked)) / power
        # With another unit of velocity the angle moves all the same.
        went = float(np.dot([np.diff(theirs.position[:2, j])[0] for _, theirs, _ in moving], asked)) / power
        if max(kept, went / case.plant.dt) < _LOST and ours > 1.0 - _LOST:
            return "a reset that ignores the velocity (it starts at rest)"
    return ""


def _wrap(case: _Case) -> str:
    dt, j = case.plant.dt, case.joint
    found = []
    for _, theirs, _ in case.whole():
        change, speed = np.diff(theirs.position[:, j]), np.abs(theirs.velocity[:, j])
        jumps = np.abs(change) - _JUMP * dt * np.maximum(speed[1:], speed[:-1]) > _LEAST_JUMP
        found += [(float(change[k]), float(theirs.position[k, j])) for k in np.flatnonzero(jumps) if k > 0]
    sizes = np.abs([change for change, _ in found])
    if not found or np.std(sizes) > 0.1 * np.mean(sizes):
        return ""
    unit = case.plant.parameters.coordinates.joints[j].unit
    return f"an angle that jumps by {found[0][0]:.3g} {unit} at {found[0][1]:.3g} {unit} (a wrap)"


def _period(case: _Case) -> str:
    dt, j = case.plant.dt, case.joint
    ratios = []
    for _, theirs, _ in case.whole(_MOVING):
        moved, speeds = float(np.diff(theirs.position[1:3, j])[0]), theirs.velocity[1:3, j]
        # Integrators use any velocity between a step's first and last.
        period = moved if speeds.min() <= moved / dt <= speeds.max() else dt * float(speeds.mean())
        if period:
            ratios.append(moved / period)
    if len(ratios) <= _FEW:
        return ""
    low, ratio, high = (float(value) for value in np.quantile(ratios, (0.25, 0.5, 0.75)))
    if abs(ratio - 1.0) < _OTHER_PERIOD or high - low > _OTHER_PERIOD * abs(ratio):
        return ""
    return (
        f"a period of {1e3 * ratio * dt:.3g} ms instead of {1e3 * dt:.3g} ms (frame skip), or a unit of velocity: "
        f"its angle moves {ratio:.3g} times as far as its velocity says"
    )


def _response(case: _Case, plant: JointPlant, driven: int, effort: float, speed: float = 0.0) -> Array | None:
    """Return the velocity that a step of effort adds to its joint, from 0 at rest or at a velocity."""
    coordinates = plant.parameters.coordinates
    still, none = (0.0,) * len(coordinates.joints), (0.0,) * len(coordinates.driven)
    moving = tuple(speed if i == coordinates.driven[driven] else 0.0 for i in range(len(still)))
    with_it = tuple(effort if i == driven else 0.0 for i in range(len(none)))
    one, other = (_run(plant, _Probe(_FULL, still, moving, u), case.count) for u in (with_it, none))
    if one.fault or other.fault:
        return None
    j = coordinates.driven[driven]
    added: Array = one.velocity[:, j] - other.velocity[:, j]
    return added


def _dead(case: _Case) -> str:
    """Name an effort below which a moving joint, not held by friction, does not respond."""
    for i, limit in enumerate(case.plant.parameters.effort_limits):
        speed = float(case.runs.scales[_FREE][1][case.plant.parameters.coordinates.driven[i]])
        speed = speed or float(case.runs.scales[_SMALL_STEP][1][case.plant.parameters.coordinates.driven[i]])

        def answers(effort: float, i: int = i, speed: float = speed) -> bool:
            theirs, mine = (_response(case, plant, i, effort, speed) for plant in (case.plant, case.equation))
            return theirs is None or mine is None or bool(np.ptp(theirs) > _DEAD * np.ptp(mine))

        low, high = _LEAST * limit, limit
        if answers(low) or not answers(high):
            continue
        while high - low > 0.02 * high:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if answers(middle) else (middle, high)
        unit = case.plant.parameters.coordinates.joints[case.plant.parameters.coordinates.driven[i]].effort_unit
        return (
            f"a dead zone of the action (below about {high:.2g} {unit} it does nothing; the limit is {limit:.3g} "
            f"{unit})"
        )
    return ""


def _clipped(case: _Case) -> str:
    """Name an effort beyond which more has no effect, or a largest speed."""
    j, joints = case.joint, case.plant.parameters.coordinates.joints
    speeds = [float(np.max(np.abs(theirs.velocity[1:, j]))) for _, theirs, _ in case.whole()]
    fastest = max(speeds, default=0.0)
    # A start and its mirror image reach equal speeds, under efforts both ways.
    if sum(speed > (1.0 - 1e-6) * fastest for speed in speeds) > 2 * _FEW:
        return f"a limit of its speed (nothing is faster than {fastest:.3g} {joints[j].velocity_unit})"
    for i, limit in enumerate(case.plant.parameters.effort_limits):
        for sign in (1.0, -1.0):
            answers = [_response(case, case.plant, i, sign * share * limit) for share in (1.0, 0.8, _SMALL)]
            full, less, little = (np.zeros(1) if answer is None else answer for answer in answers)
            k = int(np.argmax(np.abs(full) > 0.02 * abs(full[-1])))
            if full[k] != 0.0 and abs(full[k] - less[k]) < 0.02 * abs(full[k]) and little[k] != 0.0:
                unit = joints[case.plant.parameters.coordinates.driven[i]].effort_unit
                return (
                    f"an action that is clipped (beyond about {abs(full[k] / little[k]) * _SMALL * limit:.2g} {unit} "
                    f"more does nothing; the limit is {limit:.3g} {unit})"
                )
    return ""


def _late(case: _Case) -> str:
    """Name a delayed effort, if the equation with that delay responds alike."""
    dt = case.plant.dt
    for i, limit in enumerate(case.plant.parameters.effort_limits):
        theirs, mine = (_response(case, plant, i, _SMALL * limit) for plant in (case.plant, case.equation))
        if theirs is None or mine is None or not np.any(mine):
            continue
        if not np.any(theirs):
            return f"an effort that does nothing within {1e3 * dt * case.count:.3g} ms (a longer delay?)"
        tried = [(_unlike(theirs, mine), "")]
        for k in range(2, case.count // 2):
            late = np.concatenate([np.zeros(k), mine[:-k]])
            tried.append((_unlike(theirs, late), f"a delay (an effort acts {1e3 * k * dt:.3g} ms later)"))
        for lag in np.geomspace(dt, dt * case.count, _LAGS):
            weights = np.exp(-dt / lag * np.arange(len(mine))) * (1.0 - math.exp(-dt / lag))
            late = np.convolve(mine, weights)[: len(mine)]
            tried.append((_unlike(theirs, late), f"a lag of the effort (of about {1e3 * lag:.1g} ms)"))
        error, cause = min(tried)
        if cause and error < _CLOSE < tried[0][0]:
            return cause
    return ""


def _unlike(theirs: Array, mine: Array) -> float:
    power = float(np.dot(mine, mine))
    if power == 0.0:
        return 1.0
    scale = float(np.dot(theirs, mine)) / power
    return float(np.linalg.norm(theirs - scale * mine) / np.linalg.norm(theirs))


def _stop(case: _Case) -> str:
    """Name a range of angles with another torque, such as a stop, if free swings elsewhere match."""
    j = case.joint
    swings = [(p.position[j], e) for p, e in zip(case.runs.probes, case.errors, strict=True) if p.kind == _FREE]
    swings.sort()
    bad = [e > TOLERANCE for _, e in swings]
    inside = [q for (q, _), wrong in zip(swings, bad, strict=True) if not wrong]
    if len(case.plant.parameters.coordinates.joints) > 1 or len(inside) == len(bad) or len(inside) < _ANGLES // 4:
        return ""
    low, high = inside[0], inside[-1]
    if not any(e > _ABRUPT for q, e in swings if min(abs(q - low), abs(q - high)) < 2.1 * math.pi / (_ANGLES - 1)):
        return ""
    if any(wrong and low < q < high for (q, _), wrong in zip(swings, bad, strict=True)):
        return ""
    return f"a stop or a contact (free swings are right from {low:.2f} to {high:.2f} rad only)"


def _shape(case: _Case) -> str:
    """Name the one term that explains the residual of the accelerations."""
    j, dt, w = case.joint, case.plant.dt, max(2, case.count // 6)
    driven = case.plant.parameters.coordinates.driven
    rows, left = [], []
    for i, (probe, theirs, mine) in enumerate(zip(case.runs.probes, case.traces, case.runs.traces, strict=True)):
        if theirs.fault or probe.kind == _FINE_STEP:
            # A joint held by friction has no sign of velocity.
            continue
        scale = _scales(case.runs, i)[1][j]
        q, v = float(np.mean(theirs.position[: w + 1, j])), float(np.mean(theirs.velocity[: w + 1, j]))
        u = probe.effort[driven.index(j)] if j in driven else 0.0
        terms = (
            u, v, v * abs(v), math.copysign(1.0, v) if v else 0.0, q, 1.0, math.sin(q), math.cos(q), math.sin(2 * q),
            math.cos(2 * q),
        )  # fmt: skip
        rows.append(np.array(terms) / scale)
        left.append((theirs.velocity[w, j] - mine.velocity[w, j]) / (w * dt) / scale)
    table, over = np.array(rows), np.array(left)
    power = float(np.dot(over, over))
    if power == 0.0:
        return ""

    def explained(*columns: int) -> float:
        found, *_ = np.linalg.lstsq(table[:, columns], over, rcond=None)
        return 1.0 - float(np.sum((over - table[:, columns] @ found) ** 2)) / power

    own = [_TERMS.index(name) for name in _OWN]
    alone = [(explained(i), i) for i in own]
    # A fitted equation has absorbed part of a missing term.
    share, best = max(alone) if max(alone)[0] >= _EXPLAINS else max((explained(*own, i), i) for i in range(len(_TERMS)))
    return f"{_TERMS[best]} (explains {100.0 * share:.0f} % of what is left over)" if share >= _EXPLAINS else ""
