"""Compiled simulation of the fit model over many windows, with exact sensitivities of the discrete solution.

The model, in measured coordinates (theta as the encoder says, u as recorded):

    J th'' = e (k m - k_b th') + tau_0 + t(th - th_0) - b th' - G sin(th - th_0) - F(th', th) sgn th'
    m = u(t - d)                                  for a torque or a voltage
    m = V clip(g (u(t - d) - th), -1, 1)          for a servo that follows a set point u
    F = c + s z + (1 + l_s z) |l G sin(th - th_0) + l_m e k m| + q th'^2 + a(|th'|, |G sin(th - th_0)|),
    z = exp(-(th'/v_s)^2)

a is the sum of further friction terms (:mod:`pendulum_msgs_py.plants.friction_terms`), t the periodic torque and q the
quadratic drag of :mod:`pendulum_msgs_py.dynamics.joint_torques`.

Integrator: second-order leapfrog; the linear damping is exact (exponential), dry friction is a set-valued law
with true standstill, and a reversal inside a step is split at its instant, so that the solution and its
derivatives stay continuous in the parameters. Quadratic drag, whose flow is known, acts by half steps before and after
(Strang splitting). A step uses the mean of the input over the step, shifted by the
delay: exact for both holds, and differentiable in a fractional delay.

Source: leapfrog with an exponential damping factor as in Hairer, Lubich, Wanner, "Geometric Numerical
Integration", ch. I.1 and XIII; saltation at the reversal as in Leine and Nijmeijer, "Dynamics and Bifurcations
of Non-Smooth Mechanical Systems", ch. 7. The equation and its friction are those of `pendulum_msgs_py.dynamics.rigid`.
"""

from __future__ import annotations

import cmath
import math
from typing import Any

import numpy as np
from numba import njit

from pendulum_bags.arrays import Array
from pendulum_msgs_py.dynamics import rigid
from pendulum_msgs_py.dynamics.arithmetic import in_arithmetic
from pendulum_msgs_py.dynamics.joint_torques import JOINT_TORQUES
from pendulum_msgs_py.dynamics.rigid import friction_magnitude, rigid_acceleration
from pendulum_msgs_py.plants import friction_terms
from pendulum_msgs_py.plants.friction_terms import TERM_PARAMETERS, added_friction
from pendulum_msgs_py.programs.kernel_cache import drop_stale_code
from pendulum_sim.stepping.dry_friction import LAG, PACKED

__all__ = ["PARAMETER_NAMES", "cumulative_input", "simulate_windows"]

PARAMETER_NAMES = (
    # Those of a plant but its lag, which a fit counts as delay; of static friction what exceeds the sliding one.
    *(name.replace("static_friction", "stribeck_excess") for name in PACKED[:LAG]),
    "input_gain",
    "transport_delay",
    "drive_damping",
    "drive_load_friction",
    "load_stribeck",
    "load_friction",
    *JOINT_TORQUES,
    *(name for name in TERM_PARAMETERS if name != "load_friction"),
)
"""Order of the parameter vector, that of ``PACKED``; the constants below are its indices, further terms follow."""
J, B, G, C, S, VS, T0, TH0, K, D, KB, LM, LS, LG, Q, A2, B2, A3, B3 = range(19)
_OWN = 19
_FURTHER = len(PARAMETER_NAMES) - _OWN
# The load's term stands below, where it also knows the load of the drive.
_OF_TERMS = ("", *PARAMETER_NAMES[1:LG], *[""] * (_OWN - LG), *PARAMETER_NAMES[_OWN:])
_acceleration, _friction_magnitude = njit(rigid_acceleration), njit(friction_magnitude)
_added_friction = njit(added_friction(_OF_TERMS, njit))
_added_friction_complex = njit(added_friction(_OF_TERMS, lambda magnitude: njit(in_arithmetic(magnitude, cmath))))
_STEP = 2.0**-64
"""Imaginary step of their derivatives, which are exact."""


@njit
def _derivatives_of_terms(speed: float, weight: float, p: Array, f: Array) -> tuple[float, float]:
    """Write the derivatives of the further friction terms with respect to their parameters into f.

    Returns:
        Those with respect to the speed [N m s/rad] and to the torque of gravity that is carried [-].
    """
    at = p.astype(np.complex128)
    for i in range(_OWN, at.size):
        at[i] += 1j * _STEP
        f[i] = (_added_friction_complex(complex(speed), complex(weight), at) + 0j).imag / _STEP
        at[i] = p[i]
    by_speed = (_added_friction_complex(complex(speed, _STEP), complex(weight), at) + 0j).imag / _STEP
    return by_speed, (_added_friction_complex(complex(speed), complex(weight, _STEP), at) + 0j).imag / _STEP


@njit(cache=True)
def cumulative_input(stamps: Array, values: Array, linear: bool) -> Array:
    """Return the integral of the input from its first stamp to each stamp, shape (m,)."""
    total = np.zeros(stamps.size)
    for i in range(1, stamps.size):
        level = 0.5 * (values[i] + values[i - 1]) if linear else values[i - 1]
        total[i] = total[i - 1] + level * (stamps[i] - stamps[i - 1])
    return total


@njit(cache=True)
def _input_at(
    t: float, j: int, stamps: Array, values: Array, integral: Array, linear: bool
) -> tuple[int, float, float]:
    """Return (index, input, integral of the input) at a time; constant beyond both ends; j is a hint <= index."""
    last = stamps.size - 1
    if t <= stamps[0]:
        return 0, values[0], values[0] * (t - stamps[0])
    if t >= stamps[last]:
        return last, values[last], integral[last] + values[last] * (t - stamps[last])
    while stamps[j + 1] <= t:
        j += 1
    since = t - stamps[j]
    if not linear:
        return j, values[j], integral[j] + values[j] * since
    slope = (values[j + 1] - values[j]) / (stamps[j + 1] - stamps[j])
    return j, values[j] + slope * since, integral[j] + (values[j] + 0.5 * slope * since) * since


@njit(cache=True)
def _slowed(w: float, h: float, p: Array, columns: Any, dw: Array) -> float:
    """Return a velocity after a time under quadratic drag alone, and its derivatives in place."""
    inv = 1.0 / p[J]
    slow = 1.0 / (1.0 + p[Q] * inv * abs(w) * h)
    lost = w * abs(w) * h * inv
    for c in range(dw.size):
        if c < columns.size and columns[c] == Q:
            dw[c] -= lost
        if c < columns.size and columns[c] == J:
            dw[c] += lost * p[Q] * inv
        dw[c] *= slow * slow
    return w * slow


@njit(cache=True)
def simulate_windows(
    p: Array,
    columns: Any,
    windows: Any,
    states: Array,
    time: Array,
    stamps: Array,
    values: Array,
    integral: Array,
    enabled: Array,
    linear: bool,
    servo: bool,
    servo_gain: float,
    supply: float,
    longest_step: float,
    theta: Array,
    omega: Array,
    jacobian: Array,
) -> None:
    """Simulate each window from its own initial state; write theta, omega and d theta / d(parameters, state).

    Args:
        p: Parameter vector in the order of ``PARAMETER_NAMES``.
        columns: Indices of the parameters to differentiate, shape (k,), int64.
        windows: First and one past last sample of each window, shape (w, 2), int64.
        states: Initial angle [rad] and velocity [rad/s] of each window, shape (w, 2).
        time: Sample stamps, shape (n,) [s].
        stamps: Of the input, shape (m,) [s].
        values: The input, shape (m,).
        integral: Of the input up to each stamp, shape (m,).
        enabled: Drive switch at each stamp, 0 or 1, shape (m,).
        linear: Whether the input varies linearly between its stamps.
        servo: Whether the input is a set point [rad].
        servo_gain: Duty cycle per set-point error [1/rad].
        supply: Voltage at full duty [V].
        longest_step: Integration steps are at most this long [s].
        theta: Output: angle, shape (n,); samples outside the windows are left alone.
        omega: Output: velocity, shape (n,).
        jacobian: Output, shape (n, k + 2), or (0, 0) for none.
    """
    want = jacobian.shape[0] > 0
    k = columns.size
    width = k + 2
    dth = np.zeros(width)
    dw = np.zeros(width)
    # Direct derivatives of smooth torque, friction and damping rate with respect to each parameter.
    f_p = np.zeros(p.size)
    fr_p = np.zeros(p.size)
    l_p = np.zeros(p.size)
    inertia, gravity = p[J], p[G]
    inv = 1.0 / inertia
    # The same of each column; an initial state is in none of them.
    by_force, by_friction, by_rate, by_inverse = np.zeros(width), np.zeros(width), np.zeros(width), np.zeros(width)
    slows = p[S] > 0.0 or p[LS] > 0.0
    dragged = p[Q] > 0.0
    turned = p[A2] != 0.0 or p[B2] != 0.0 or p[A3] != 0.0 or p[B3] != 0.0
    for c in range(k):
        if columns[c] == J:
            by_inverse[c] = -inv * inv
        dragged = dragged or columns[c] == Q
        turned = turned or A2 <= columns[c] <= B3
        slows = slows or columns[c] == S or columns[c] == LS
    for n in range(windows.shape[0]):
        first, stop = windows[n, 0], windows[n, 1]
        th, w = states[n, 0], states[n, 1]
        dth[:] = 0.0
        dw[:] = 0.0
        dth[k] = 1.0
        dw[k + 1] = 1.0
        theta[first], omega[first] = th, w
        if want:
            jacobian[first, :] = dth
        start = time[first] - p[D]
        index = max(np.searchsorted(stamps, start, side="right") - 1, 0)
        index, u0, area0 = _input_at(start, index, stamps, values, integral, linear)
        for i in range(first + 1, stop):
            gap = time[i] - time[i - 1]
            substeps = max(1, math.ceil(gap / longest_step - 1e-9))
            h = gap / substeps
            for sub in range(substeps):
                index, u1, area1 = _input_at(
                    time[i - 1] + (sub + 1) * h - p[D], index, stamps, values, integral, linear
                )
                mean = (area1 - area0) / h
                mean_d = -(u1 - u0) / h
                on = enabled[index]
                u0, area0 = u1, area1
                if dragged:
                    w = _slowed(w, 0.5 * h, p, columns, dw)
                middle = th + 0.5 * h * w
                sine = math.sin(middle - p[TH0])
                drive_u, drive_th, level = p[K] * on, 0.0, mean
                if servo:
                    duty = servo_gain * (mean - middle)
                    if duty > 1.0 or duty < -1.0:
                        level = supply if duty > 0.0 else -supply
                        drive_u = 0.0
                    else:
                        level = supply * duty
                        drive_u = p[K] * on * supply * servo_gain
                        drive_th = -drive_u
                drive = p[K] * on * level
                rate = (p[B] + on * p[KB]) * inv
                # The torque behind a velocity that does not decay: what the damping takes is exact below.
                smooth = _acceleration(middle - p[TH0], 0.0, drive + p[T0], 1.0, 0.0, gravity)
                s_2 = c_2 = s_3 = c_3 = 0.0
                if turned:
                    cosine = math.cos(middle - p[TH0])
                    s_2, c_2 = 2.0 * sine * cosine, cosine * cosine - sine * sine
                    s_3, c_3 = s_2 * cosine + c_2 * sine, c_2 * cosine - s_2 * sine
                    smooth += p[A2] * c_2 + p[B2] * s_2 + p[A3] * c_3 + p[B3] * s_3
                speed = abs(w)
                bump = math.exp(-((speed / p[VS]) ** 2)) if slows else 0.0
                # What the gears carry: drive and gravity press the teeth together when they oppose each other.
                carried = p[LG] * gravity * sine + p[LM] * drive
                raise_load = 1.0 + p[LS] * bump
                friction = _friction_magnitude(speed, p[C], p[C] + p[S], p[VS]) + raise_load * abs(carried)
                if _FURTHER > 0:
                    friction += _added_friction(speed, abs(gravity * sine), p)
                x = rate * h
                if x > 1e-4:
                    decay = math.exp(-x)
                    phi = (1.0 - decay) / rate
                    phi_l = (h * decay - phi) / rate
                else:
                    decay = 1.0 - x + 0.5 * x * x
                    phi = h * (1.0 - 0.5 * x + x * x / 6.0)
                    phi_l = -h * h * (0.5 - x / 3.0)
                # At rest, friction opposes the motion that is about to begin.
                moving = w if w != 0.0 else smooth
                sign = 1.0 if moving > 0.0 else -1.0
                stuck = w == 0.0 and abs(smooth) <= friction
                net = smooth - sign * friction
                w1 = 0.0 if stuck else decay * w + phi * net * inv
                crossing = not stuck and w != 0.0 and w1 * sign < 0.0
                rest = crossing and abs(smooth) <= friction
                ratio, share, w2 = 1.0, 1.0, w1
                if crossing:
                    share = w / (w - w1)
                    ratio = 0.0 if rest else (smooth + sign * friction) / net
                    w2 = ratio * w1
                if want:
                    cosine = math.cos(middle - p[TH0])
                    f_p[T0] = 1.0
                    f_p[G] = -sine
                    f_p[TH0] = gravity * cosine
                    f_p[K] = on * level
                    f_p[D] = drive_u * mean_d
                    l_p[B] = inv
                    l_p[KB] = on * inv
                    l_p[J] = -rate * inv
                    side = raise_load if carried > 0.0 else -raise_load
                    peak = p[S] + p[LS] * abs(carried)
                    s_drive = p[LM] * side
                    s_load = p[LG] * side
                    fr_p[C] = 1.0
                    fr_p[S] = bump
                    fr_p[VS] = peak * bump * 2.0 * speed * speed / p[VS] ** 3
                    fr_p[LG] = side * gravity * sine
                    fr_p[LM] = side * drive
                    fr_p[LS] = bump * abs(carried)
                    fr_p[G] = s_load * sine
                    fr_p[TH0] = -s_load * gravity * cosine
                    fr_p[K] = s_drive * f_p[K]
                    fr_p[D] = s_drive * f_p[D]
                    f_th = drive_th - gravity * cosine
                    fr_th = s_load * gravity * cosine + s_drive * drive_th
                    fr_w = -peak * bump * 2.0 * speed / p[VS] ** 2 * sign
                    if turned:
                        f_p[A2], f_p[B2], f_p[A3], f_p[B3] = c_2, s_2, c_3, s_3
                        slope = 2.0 * (p[B2] * c_2 - p[A2] * s_2) + 3.0 * (p[B3] * c_3 - p[A3] * s_3)
                        f_p[TH0] -= slope
                        f_th += slope
                    if _FURTHER > 0:
                        by_speed, by_weight = _derivatives_of_terms(speed, abs(gravity * sine), p, fr_p)
                        fr_w += by_speed * sign
                        side = by_weight if gravity * sine > 0.0 else -by_weight
                        fr_p[G] += side * sine
                        fr_p[TH0] -= side * gravity * cosine
                        fr_th += side * gravity * cosine
                    if stuck:
                        for c in range(width):
                            dth[c] += 0.5 * h * dw[c]
                            dw[c] = 0.0
                    else:
                        for c in range(k):
                            q = columns[c]
                            by_force[c] = f_p[q]
                            by_friction[c] = fr_p[q]
                            by_rate[c] = l_p[q]
                        for c in range(width):
                            d_mid = dth[c] + 0.5 * h * dw[c]
                            d_f = f_th * d_mid + by_force[c]
                            d_fr = fr_th * d_mid + fr_w * dw[c] + by_friction[c]
                            d_w1 = (
                                decay * (dw[c] - w * h * by_rate[c])
                                + phi * inv * (d_f - sign * d_fr)
                                + net * (phi_l * by_rate[c] * inv + phi * by_inverse[c])
                            )
                            if not crossing:
                                dth[c] += 0.5 * h * (dw[c] + d_w1)
                                dw[c] = d_w1
                                continue
                            d_share = (dw[c] - share * (dw[c] - d_w1)) / (w - w1)
                            d_w2 = 0.0
                            if not rest:
                                d_ratio = (d_f + sign * d_fr - ratio * (d_f - sign * d_fr)) / net
                                d_w2 = ratio * d_w1 + d_ratio * w1
                            dth[c] += 0.5 * h * (share * dw[c] + (1.0 - share) * d_w2 + d_share * (w - w2))
                            dw[c] = d_w2
                th += 0.5 * h * (share * w + ((1.0 - share) * w2 if crossing else w2))
                w = _slowed(w2, 0.5 * h, p, columns, dw) if dragged else w2
            theta[i], omega[i] = th, w
            if want:
                jacobian[i, :] = dth


for _kernel in (cumulative_input, simulate_windows):
    drop_stale_code(_kernel, [*friction_terms.modules(), rigid])
