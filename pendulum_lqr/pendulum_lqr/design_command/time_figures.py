"""Time response of a closed loop: rise, overshoot, settling and torque of a step; effect of a push and dry friction.

The linear model has no torque limit: ``step_torque`` gives the step that reaches it.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.model import LinearModel, low_frequency
from pendulum_msgs_py.dynamics.rigid import gravity_torque
from pendulum_msgs_py.json_values import without_nan
from pendulum_msgs_py.plants.equilibrium import RigidPlant, drivetrain_of, offset_of
from pendulum_msgs_py.plants.friction_terms import friction_of_terms

__all__ = ["TimeFigures", "friction_band", "time_figures"]

Array = NDArray[np.float64]

_SAMPLES = 2000
"""Samples of a response; exact without delay, else with feedback linear between samples."""
_PER_DELAY = 20
_SETTLED = 0.002
"""Relative tolerance of the final value at which a response ends."""


@dataclass(frozen=True, slots=True)
class TimeFigures:
    """Linear time response of the closed loop, including the plant's delay.

    Attributes:
        rise_time: From 10 % to 90 % of a step of the set-point, with feedforward of the holding torque [s].
        settling_time: Until the angle stays within 2 % of the step [s].
        overshoot: Beyond the step, as a share of it [-].
        step_torque: Largest torque of the step, per step [N m/rad].
        push_rest: Final deflection under a constant torque on the link [rad/(N m)].
        push_peak: Largest deflection after its beginning [rad/(N m)].
        friction_band: Deviation up to which dry friction holds the pendulum at rest [rad]; nan if unknown.
    """

    rise_time: float
    settling_time: float
    overshoot: float
    step_torque: float
    push_rest: float
    push_peak: float
    friction_band: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; unknown ones as None."""
        return without_nan(asdict(self))


def time_figures(model: LinearModel, K: ArrayLike, plant: RigidPlant | None = None) -> TimeFigures | None:
    """Return the time response of a gain (2,) on angle and velocity; None for a loop that does not come to rest.

    Args:
        model: Linear model, including its delay.
        K: Gain.
        plant: Plant of the model, for its dry friction.

    Source:
        Astrom and Murray, Feedback Systems, 2nd ed., 2021, section 6.3 (step response: rise time, overshoot, settling).
    """
    # Imported late: python-control imports matplotlib, which controller nodes do not need.
    import control

    gain = np.asarray(K, dtype=np.float64)
    slowest = float(np.max(np.linalg.eigvals(model.A - model.B @ gain[None, :] @ model.C).real))
    if slowest >= 0.0:
        return None
    forward = float(gain[0]) + low_frequency(model)[2]
    step = _response(model, gain, -slowest, forward, 0.0)
    push = _response(model, gain, -slowest, 0.0, 1.0)
    if step is None or push is None:
        return None
    times, angle, torque = step
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = control.step_info(angle, timepts=times, final_output=1.0)
    return TimeFigures(
        rise_time=float(found["RiseTime"]),
        settling_time=float(found["SettlingTime"]),
        overshoot=max(float(np.max(angle)) - 1.0, 0.0),
        step_torque=float(np.max(np.abs(torque))),
        push_rest=_rest(model, gain, model.E),
        push_peak=max(float(np.max(np.abs(push[1]))), abs(_rest(model, gain, model.E))),
        friction_band=math.nan if plant is None else friction_band(plant, model, gain),
    )


def friction_band(plant: RigidPlant, model: LinearModel, K: ArrayLike) -> float:
    """Return the deviation from the set-point up to which static friction holds the pendulum at rest [rad]."""
    gain = np.asarray(K, dtype=np.float64)
    weight = abs(gravity_torque(model.theta - offset_of(plant, "angle_offset"), plant.gravity))
    static = offset_of(plant, "static_friction") + friction_of_terms(plant, weight)
    band = static * abs(_rest(model, gain, model.E))
    drive = drivetrain_of(plant)
    if drive is not None:
        at_motor = np.zeros_like(model.E)
        at_motor[model.states.index("motor_velocity"), 0] = 1.0 / drive.reflected_inertia
        band += drive.motor_static_friction * abs(_rest(model, gain, at_motor))
    return float(band)


def _rest(model: LinearModel, gain: Array, entry: Array) -> float:
    """Return the final angle under a constant unit torque at an input [rad/(N m)]."""
    closed = model.A - model.B @ gain[None, :] @ model.C
    return float(-np.linalg.solve(closed, entry)[0, 0])


def _response(
    model: LinearModel, gain: Array, rate: float, forward: float, push: float
) -> tuple[Array, Array, Array] | None:
    """Return times [s], angle [rad] and torque [N m] under a constant command and push from rest, or None."""
    horizon = max(8.0 / rate, 10.0 * model.delay)
    for _ in range(6):
        times, angle, torque = _simulate(model, gain, horizon, forward, push)
        if not np.all(np.isfinite(angle)) or float(np.max(np.abs(angle))) > 1e6 * (1.0 + abs(push)):
            return None
        tail = angle[-len(angle) // 10 :]
        if float(np.ptp(tail)) <= _SETTLED * float(np.max(np.abs(angle))):
            return times, angle, torque
        horizon *= 2.0
    return None


def _simulate(
    model: LinearModel, gain: Array, horizon: float, forward: float, push: float
) -> tuple[Array, Array, Array]:
    n = model.A.shape[0]
    late = 0 if model.delay <= 0.0 else max(_PER_DELAY, math.ceil(_SAMPLES * model.delay / horizon))
    dt = model.delay / late if late else horizon / _SAMPLES
    count = math.ceil(horizon / dt) + 1
    on_measured = gain @ model.C
    # Without delay the feedback acts within the step, exactly; with one, as sent that long ago.
    A = model.A if late else model.A - model.B @ on_measured[None, :]
    drive = model.E[:, 0] * push + (0.0 if late else model.B[:, 0] * forward)
    # Linear interpolation: held samples would act half a sample late, which matters near the delay margin.
    block = np.zeros((n + 3, n + 3))
    block[:n, :n], block[:n, n], block[:n, n + 1], block[n + 1, n + 2] = A, drive, model.B[:, 0], 1.0 / dt
    step = scipy.linalg.expm(block * dt)
    phi, gamma, through, rise = step[:n, :n], step[:n, n], step[:n, n + 1], step[:n, n + 2]
    x = np.zeros(n)
    angle, torque = np.zeros(count), np.zeros(count)
    sent = np.zeros(late + 1)
    for k in range(count):
        angle[k] = x[0]
        torque[k] = sent[k % (late + 1)] = forward - on_measured @ x
        x = phi @ x + gamma
        if late and k >= late:
            first, last = sent[(k - late) % (late + 1)], sent[(k - late + 1) % (late + 1)]
            x = x + through * first + rise * (last - first)
        if not abs(x[0]) < 1e9:
            angle[k:] = np.inf
            break
    return dt * np.arange(count, dtype=np.float64), angle, torque
