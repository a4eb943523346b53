"""Time constant, damping, margins and largest sampling period of a gain.

Margins are those of the loop cut at the plant's input, L(s) = K (s I - A)^-1 B exp(-s delay). Gains have shape (k,) on
the k measured states or (n,) on all; of several inputs one row each.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.model import LinearModel, sort_poles
from pendulum_lqr.linear.sampled_design import closed_loop, discretise
from pendulum_msgs_py.json_values import without_nan

__all__ = [
    "Feedback",
    "LoopReport",
    "Margins",
    "analyse",
    "bears_its_delay",
    "closed_loop_poles",
    "delayed_spectral_radius",
    "largest_stable_period",
    "last_to_hold",
    "loop_margins",
    "loop_transfer",
]

Array = NDArray[np.float64]

_PERIOD_LIMIT = 1e3


class Feedback(NamedTuple):
    """Sampled law u = -K [y; sums of the outputs ``summed``, including this sample].

    K has shape (k + sums,) or (m, k + sums), and without sums may act on the whole state.
    """

    K: Array
    summed: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Margins:
    """Robustness of a loop.

    Attributes:
        gain_up: Largest stable factor on the gain, or inf [-].
        gain_down: Smallest stable factor on the gain, or 0 [-].
        phase: Smallest phase margin, nan if the loop never crosses 1 [rad].
        crossover: Angular frequency of that margin [rad/s].
        delay: Largest stable extra delay, or inf [s].
        modulus: Smallest distance of L(j w) from -1; at least 1 for a continuous LQR [-].
    """

    gain_up: float
    gain_down: float
    phase: float
    crossover: float
    delay: float
    modulus: float


@dataclass(frozen=True, slots=True)
class LoopReport:
    """Row of the design table.

    Attributes:
        K: Gain (theta, theta_dot, ...), of several inputs row by row [N m/rad, N m s/rad, ...].
        poles: Closed-loop eigenvalues without the plant's delay, slowest first [1/s].
        stable: Whether the loop is stable, including the plant's delay.
        time_constant: -1 / (largest real part), inf if unstable [s].
        damping_ratio: Smallest damping ratio of the poles [-]; 1 for real stable ones.
        natural_frequency: Magnitude of the slowest pole [rad/s].
        margins: None without feedback, and for several inputs.
        largest_period: Largest stable sampling period under zero-order hold [s]; None without feedback.
    """

    K: tuple[float, ...]
    poles: tuple[complex, ...]
    stable: bool
    time_constant: float
    damping_ratio: float
    natural_frequency: float
    margins: Margins | None
    largest_period: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; complex poles as [re, im], infinities as None."""
        plain = asdict(self)
        plain["poles"] = [[pole.real, pole.imag] for pole in self.poles]
        return without_nan(plain)


def closed_loop_poles(model: LinearModel, K: ArrayLike) -> NDArray[np.complex128]:
    """Return the eigenvalues of A - B K, slowest first [1/s]."""
    return sort_poles(np.linalg.eigvals(model.A - model.B @ _on_state(model, K)))


def analyse(model: LinearModel, K: ArrayLike | None) -> LoopReport:
    """Return the report of a gain; None means the plant without feedback."""
    k, m = model.outputs_and_inputs
    gain = np.zeros((m, k)) if K is None else np.asarray(K, dtype=np.float64)
    poles = closed_loop_poles(model, gain)
    slowest = float(poles[0].real)
    period = math.nan if K is None else largest_stable_period(model, gain)
    ratios = [-pole.real / abs(pole) if abs(pole) > 0.0 else 0.0 for pole in poles]
    return LoopReport(
        K=tuple(float(value) for value in gain.ravel()),
        poles=tuple(complex(pole) for pole in poles),
        stable=slowest < 0.0 and (K is None or model.delay == 0.0 or period > 0.0),
        time_constant=-1.0 / slowest if slowest < 0.0 else math.inf,
        damping_ratio=float(min(ratios)),
        natural_frequency=float(abs(poles[0])),
        margins=None if K is None or m > 1 else loop_margins(model, gain),
        largest_period=None if K is None else period,
    )


def loop_transfer(model: LinearModel, K: ArrayLike, omega: ArrayLike) -> NDArray[np.complex128]:
    """Return L(j omega) at angular frequencies of shape (n,) [rad/s]."""
    s = 1j * np.asarray(omega, dtype=np.float64)
    pencil = s[:, None, None] * np.eye(model.A.shape[0]) - model.A
    states = np.linalg.solve(pencil, np.broadcast_to(model.B, (s.size, *model.B.shape)))[:, :, 0]
    loop = (states @ _on_state(model, K)[0]) * np.exp(-s * model.delay)
    return np.asarray(loop, dtype=np.complex128)


def loop_margins(model: LinearModel, K: ArrayLike) -> Margins:
    """Return the margins of a stabilising gain, including the plant's delay."""
    gain = _on_state(model, K)
    gains, phases, crossovers = (_rational_crossings if model.delay == 0.0 else _delayed_crossings)(model, gain)
    # Gain margin at zero frequency: an unstable plant needs |L(0)| > 1.
    rest = -float((gain @ np.linalg.lstsq(model.A, model.B, rcond=None)[0])[0, 0])
    down = [g for g in gains if g < 1.0] + ([-1.0 / rest] if rest < -1.0 else [])
    up = [g for g in gains if g > 1.0]
    if phases.size:
        index = int(np.argmin(np.abs(phases)))
        phase, crossover = float(phases[index]), float(crossovers[index])
    else:
        phase, crossover = math.nan, math.nan
    grid = np.logspace(-4, 6, 4001)
    modulus = float(np.min(np.abs(1.0 + loop_transfer(model, gain[0], grid))))
    return Margins(
        gain_up=float(min(up)) if up else math.inf,
        gain_down=float(max(down)) if down else 0.0,
        phase=phase,
        crossover=crossover,
        delay=_delay_margin(phases, crossovers),
        modulus=modulus,
    )


def _rational_crossings(model: LinearModel, gain: Array) -> tuple[Array, Array, Array]:
    """Return gain margins [-], phase margins [rad] and their frequencies [rad/s] of a loop without delay."""
    # Imported late: python-control imports matplotlib, which controller nodes do not need.
    import control

    # det(sI - A + B K) = det(sI - A) (1 + L)
    open_loop = np.poly(model.A)
    loop = control.tf(np.poly(model.A - model.B @ gain) - open_loop, open_loop)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gains, phases, _, _, crossovers, _ = control.stability_margins(loop, returnall=True)
    return np.asarray(gains, float), np.radians(np.asarray(phases, float)), np.asarray(crossovers, float)


def _delayed_crossings(model: LinearModel, gain: Array) -> tuple[Array, Array, Array]:
    """Return the same for a loop with delay, whose transfer function is not rational.

    Crossings are bracketed on a grid and refined one by one: python-control's spline takes a thousand times as long.
    """
    omega = np.logspace(-4, math.log10(_last_frequency(model, gain)), 20_001)
    loop = loop_transfer(model, gain[0], omega)

    def refined(values: Array, of: Callable[[complex], float], keep: NDArray[np.bool_]) -> Array:
        edges = np.flatnonzero((values[:-1] * values[1:] < 0.0) & keep)
        return np.array(
            [
                scipy.optimize.brentq(lambda w: of(complex(loop_transfer(model, gain[0], [w])[0])), *omega[i : i + 2])
                for i in edges
            ]
        )

    everywhere = np.ones(omega.size - 1, dtype=bool)
    crossovers = refined(np.abs(loop) - 1.0, lambda value: abs(value) - 1.0, everywhere)
    negative = (loop.real[:-1] < 0.0) & (loop.real[1:] < 0.0)
    turns = refined(loop.imag, lambda value: value.imag, negative)
    phases = np.angle(-loop_transfer(model, gain[0], crossovers)) if crossovers.size else crossovers
    gains = 1.0 / np.abs(loop_transfer(model, gain[0], turns)) if turns.size else turns
    return gains, phases, crossovers


def delayed_spectral_radius(
    model: LinearModel, K: ArrayLike, period: float, delay: float = 0.0, summed: Sequence[int] = ()
) -> float:
    """Return the largest |pole| of the sampled loop; stable if < 1.

    Args:
        model: Linear model, with its lags and delay.
        K: Gain, shape (k,), (n,) or (m, n); with sums as in :class:`Feedback`.
        period: Sampling period [s].
        delay: Time from state to torque, in addition to the model's [s].
        summed: Indices of the outputs whose sums the last columns of K act on.
    """
    sampled = discretise(model, period, delay)
    gain, sums = np.array(np.atleast_2d(K), dtype=np.float64), len(summed)
    of_sums = gain[:, gain.shape[1] - sums :]
    gain = gain[:, : gain.shape[1] - sums]
    gain[:, list(summed)] += of_sums
    loop = closed_loop(sampled, gain)
    if sums:
        loop = np.block([[loop, -sampled.B @ of_sums], [np.eye(len(loop))[list(summed)], np.eye(sums)]])
    return float(np.max(np.abs(np.linalg.eigvals(loop))))


def largest_stable_period(model: LinearModel, K: ArrayLike) -> float:
    """Return the first sampling period at which the held loop loses stability [s]; 0 if it is never stable."""

    def stable(period: float) -> bool:
        return delayed_spectral_radius(model, K, period) < 1.0

    fastest = float(np.max(np.abs(model.poles)))
    # A delay of very many periods makes very many states, and is hardly sampled any more.
    low = max(1e-3 / max(fastest, 1e-3), model.delay / 40.0)
    if not stable(low):
        return 0.0
    # Steps of 2 %, so that no unstable band is skipped, then refinement.
    while low < _PERIOD_LIMIT:
        if not stable(1.02 * low):
            return last_to_hold(stable, low, 1.02 * low)[0]
        low *= 1.02
    return math.inf


def last_to_hold(holds: Callable[[float], bool], low: float, high: float) -> tuple[float, float]:
    """Return neighbouring numbers between ``low``, which has a property, and ``high``, which has not, by bisection."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low, high


def _on_state(model: LinearModel, K: ArrayLike) -> NDArray[np.float64]:
    """Return the gain on the whole state, shape (m, n)."""
    gain = np.atleast_2d(np.asarray(K, dtype=np.float64))
    return gain if gain.shape[1] == model.A.shape[0] else np.asarray(gain @ model.C)


def bears_its_delay(model: LinearModel, K: ArrayLike) -> bool:
    """Return whether a loop that is stable without the plant's delay is stable with it."""
    return model.delay < loop_margins(replace(model, delay=0.0), K).delay


def _last_frequency(model: LinearModel, gain: NDArray[np.float64]) -> float:
    """Return a frequency beyond which the loop gain is below 1/100 [rad/s]."""
    omega = np.logspace(0, 7, 400)
    loud = np.abs(loop_transfer(model, gain[0], omega)) > 0.01
    return float(omega[min(int(np.max(np.nonzero(loud)[0], initial=0)) + 1, omega.size - 1)])


def _delay_margin(phases: NDArray[np.float64], crossovers: NDArray[np.float64]) -> float:
    """Return the smallest (phase to -180 degrees) / frequency over all crossovers [s]."""
    if not phases.size:
        return math.inf
    positive = np.where(phases > 0.0, phases, phases + 2.0 * math.pi)
    return float(np.min(positive / crossovers))
