"""What a gain does: time constant, damping, margins, and how slowly one may sample.

Margins are those of the loop cut at the plant's input, L(s) = K (s I - A)^-1 B, by python-control.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.design import DiscreteModel, discretise
from pendulum_lqr.model import LinearModel, sort_poles

__all__ = [
    "LoopReport",
    "Margins",
    "analyse",
    "closed_loop_poles",
    "delayed_spectral_radius",
    "largest_stable_period",
    "loop_margins",
    "loop_transfer",
]

_PERIOD_LIMIT = 1e3


@dataclass(frozen=True, slots=True)
class Margins:
    """Robustness of a loop.

    Attributes:
        gain_up: Factor by which the gain may grow, inf if by any [-].
        gain_down: Factor to which the gain may shrink, 0 if to nothing [-].
        phase: Smallest phase margin, nan if the loop never crosses 1 [rad].
        crossover: Angular frequency of that margin [rad/s].
        delay: Largest extra delay in the loop before it becomes unstable, inf if any [s].
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
    """Everything the design table shows about one gain.

    Attributes:
        K: Gain (theta, theta_dot) [N m/rad, N m s/rad].
        poles: Closed-loop eigenvalues, slowest first [1/s].
        time_constant: -1 / (largest real part), inf if unstable [s].
        damping_ratio: Smallest damping ratio of the poles [-]; 1 for real stable ones.
        natural_frequency: Magnitude of the slowest pole [rad/s].
        margins: Gain, phase, delay and modulus margins; None without feedback.
        largest_period: Largest sampling period under zero-order hold that stays stable [s]; None without feedback.
    """

    K: tuple[float, ...]
    poles: tuple[complex, ...]
    time_constant: float
    damping_ratio: float
    natural_frequency: float
    margins: Margins | None
    largest_period: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; complex poles as [re, im], infinities as None."""
        plain = asdict(self)
        plain["poles"] = [[pole.real, pole.imag] for pole in self.poles]
        return _finite(plain)


def closed_loop_poles(model: LinearModel, K: ArrayLike) -> NDArray[np.complex128]:
    """Return the eigenvalues of A - B K, slowest first [1/s].

    Args:
        model: Linear model.
        K: Gain, shape (2,).
    """
    return sort_poles(np.linalg.eigvals(model.A - model.B @ np.atleast_2d(np.asarray(K, dtype=np.float64))))


def analyse(model: LinearModel, K: ArrayLike | None) -> LoopReport:
    """Return the figures of one gain; ``None`` asks for the plant without feedback.

    Args:
        model: Linear model.
        K: Gain, shape (2,).
    """
    gain = np.zeros(2) if K is None else np.asarray(K, dtype=np.float64)
    poles = closed_loop_poles(model, gain)
    slowest = float(poles[0].real)
    ratios = [-pole.real / abs(pole) if abs(pole) > 0.0 else 0.0 for pole in poles]
    return LoopReport(
        K=tuple(float(value) for value in gain),
        poles=tuple(complex(pole) for pole in poles),
        time_constant=-1.0 / slowest if slowest < 0.0 else math.inf,
        damping_ratio=float(min(ratios)),
        natural_frequency=float(abs(poles[0])),
        margins=None if K is None else loop_margins(model, gain),
        largest_period=None if K is None else largest_stable_period(model, gain),
    )


def loop_transfer(model: LinearModel, K: ArrayLike, omega: ArrayLike) -> NDArray[np.complex128]:
    """Return L(j omega) = K (j omega I - A)^-1 B.

    Args:
        model: Linear model.
        K: Gain, shape (2,).
        omega: Angular frequencies, shape (n,) [rad/s].
    """
    k0, k1 = np.asarray(K, dtype=np.float64)
    s = 1j * np.asarray(omega, dtype=np.float64)
    b = float(model.B[1, 0])
    return np.asarray(b * (k0 + k1 * s) / (s * s - model.A[1, 1] * s - model.A[1, 0]), dtype=np.complex128)


def loop_margins(model: LinearModel, K: ArrayLike) -> Margins:
    """Return the margins of the loop cut at the plant's input.

    Args:
        model: Linear model.
        K: Gain, shape (2,), that stabilises the model.
    """
    # Imported late: python-control brings matplotlib, which a controller node has no use for.
    import control

    k0, k1 = (float(value) for value in np.asarray(K, dtype=np.float64))
    b = float(model.B[1, 0])
    loop = control.tf([b * k1, b * k0], [1.0, -float(model.A[1, 1]), -float(model.A[1, 0])])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gains, phases, _, _, crossovers, _ = control.stability_margins(loop, returnall=True)
    gains = np.asarray(gains, dtype=np.float64)
    # The gain margin at zero frequency: an unstable plant needs some gain at rest, |L(0)| > 1.
    dc = float(model.A[1, 0])
    down = [g for g in gains if g < 1.0] + ([dc / (b * k0)] if dc > 0.0 and b * k0 > dc else [])
    up = [g for g in gains if g > 1.0]
    phases = np.radians(np.asarray(phases, dtype=np.float64))
    crossovers = np.asarray(crossovers, dtype=np.float64)
    if phases.size:
        index = int(np.argmin(np.abs(phases)))
        phase, crossover = float(phases[index]), float(crossovers[index])
    else:
        phase, crossover = math.nan, math.nan
    grid = np.concatenate([[0.0], np.logspace(-4, 6, 4001)])
    modulus = float(np.min(np.abs(1.0 + loop_transfer(model, (k0, k1), grid))))
    return Margins(
        gain_up=float(min(up)) if up else math.inf,
        gain_down=float(max(down)) if down else 0.0,
        phase=phase,
        crossover=crossover,
        delay=_delay_margin(phases, crossovers),
        modulus=modulus,
    )


def delayed_spectral_radius(model: LinearModel, K: ArrayLike, period: float, delay: float = 0.0) -> float:
    """Return the largest |pole| of the sampled loop u[k] = -K x[k] that acts after a delay; stable if < 1.

    Args:
        model: Linear model.
        K: Gain on [theta, theta_dot], shape (2,).
        period: Sampling period [s].
        delay: Time from state to torque [s].
    """
    sampled: DiscreteModel = discretise(model, period, delay)
    feedback = np.zeros((1, sampled.A.shape[0]))
    feedback[0, :2] = np.asarray(K, dtype=np.float64)
    return float(np.max(np.abs(np.linalg.eigvals(sampled.A - sampled.B @ feedback))))


def largest_stable_period(model: LinearModel, K: ArrayLike) -> float:
    """Return the first sampling period at which the held loop loses stability [s]; 0 if it never has it.

    Args:
        model: Linear model.
        K: Gain on [theta, theta_dot], shape (2,).
    """
    return _first_unstable(lambda period: delayed_spectral_radius(model, K, period) < 1.0, model)


def _first_unstable(stable: Any, model: LinearModel) -> float:
    fastest = float(np.max(np.abs(model.poles)))
    low = 1e-3 / max(fastest, 1e-3)
    if not stable(low):
        return 0.0
    # Periods are tried in steps of 2 %, so that an unstable band is not jumped over, then refined.
    high = low
    while high < _PERIOD_LIMIT:
        high = low * 1.02
        if not stable(high):
            return _bisect(stable, low, high)
        low = high
    return math.inf


def _bisect(stable: Any, low: float, high: float) -> float:
    for _ in range(60):
        middle = 0.5 * (low + high)
        if stable(middle):
            low = middle
        else:
            high = middle
    return low


def _delay_margin(phases: NDArray[np.float64], crossovers: NDArray[np.float64]) -> float:
    """Return the smallest (phase to -180 degrees) / frequency over all crossovers [s]."""
    if not phases.size:
        return math.inf
    positive = np.where(phases > 0.0, phases, phases + 2.0 * math.pi)
    return float(np.min(positive / crossovers))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
