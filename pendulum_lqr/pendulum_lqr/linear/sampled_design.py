"""Optimal gains of sampled loops: the model under zero-order hold and delay, its cost, and its LQR."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from pendulum_lqr.linear.design import DesignError, Gain, Matrix, cost_matrices, no_solution, require_controllable
from pendulum_lqr.linear.model import LinearModel, sort_poles

__all__ = ["DiscreteModel", "closed_loop", "discrete_lqr", "discretise", "sampled_cost"]


@dataclass(frozen=True, slots=True)
class DiscreteModel:
    """Sampled model ``z[k+1] = A z[k] + B u[k]`` whose state is [x; inputs in transit, oldest first].

    Attributes:
        A: Shape (n + p m, n + p m), of n states and m inputs.
        B: Shape (n + p m, m).
        period: Sampling period [s].
        delay: Time from measurement to the effect of the torque, including the plant's delay [s].
        pending: p, number of samples whose inputs are in transit.
    """

    A: Matrix
    B: Matrix
    period: float
    delay: float
    pending: int


def discretise(model: LinearModel, period: float, delay: float = 0.0) -> DiscreteModel:
    """Sample the model exactly under zero-order hold and any delay.

    With delay = (p - 1) period + rest, the input of sample k acts from rest on in interval k + p - 1, so that p past
    inputs join the state.

    Args:
        model: Linear model.
        period: Sampling period, > 0 [s].
        delay: Time from measurement to the command's arrival at the plant, in addition to the model's, >= 0 [s].

    Raises:
        DesignError: Period or delay out of domain.

    Source:
        Astrom and Wittenmark, Computer-Controlled Systems, 3rd ed., 1997, section 3.2 (eq. 3.11 to 3.17).
    """
    if not (math.isfinite(period) and period > 0.0):
        raise DesignError(f"period is {period} s; expected a finite value > 0")
    if not (math.isfinite(delay) and delay >= 0.0):
        raise DesignError(f"delay is {delay} s; expected a finite value >= 0")
    delay += model.delay
    pending, rest = _on_their_way(period, delay)
    # Split the interval where the newer input takes over: older input first, for ``rest``.
    phi_new, gamma_new = _hold(model, period - rest)
    phi_old, gamma_old = _hold(model, rest)
    n, m = model.B.shape
    size = n + pending * m
    A = np.zeros((size, size))
    B = np.zeros((size, m))
    A[:n, :n] = phi_new @ phi_old
    if pending == 0:
        B[:n] = gamma_new
        return DiscreteModel(A, B, period, delay, 0)
    shifted = (pending - 1) * m
    A[n : n + shifted, n + m :] = np.eye(shifted)
    B[-m:] = np.eye(m)
    if rest > 0.0:
        A[:n, n : n + m] = phi_new @ gamma_old
        if pending > 1:
            A[:n, n + m : n + 2 * m] = gamma_new
        else:
            B[:n] = gamma_new
    else:
        A[:n, n : n + m] = gamma_new
    return DiscreteModel(A, B, period, delay, pending)


def closed_loop(model: DiscreteModel, K: ArrayLike) -> Matrix:
    """Return A - B K of a gain (k,) or (m, k) on the first k states, shape (n + p m, n + p m)."""
    gain = np.atleast_2d(np.asarray(K, dtype=np.float64))
    feedback = np.zeros(model.B.T.shape)
    feedback[:, : gain.shape[1]] = gain
    return np.asarray(model.A - model.B @ feedback)


def discrete_lqr(model: DiscreteModel, q: ArrayLike, r: float | Matrix, cross: Matrix | None = None) -> Gain:
    """Return the gain that minimises the sum of x' Q x + 2 x' N u + u' R u, shape (n + p m,) or (m, n + p m).

    Args:
        model: Sampled model with m inputs.
        q: Weights of the leading states, shape (k,) or (k, k), or the matrix of :func:`sampled_cost`; others cost
            nothing.
        r: Weight of each input, > 0, or R of shape (m, m).
        cross: N, shape (k, m), or None.

    Raises:
        DesignError: As :func:`continuous_lqr`.
    """
    size, m = model.B.shape
    Q, R = _padded_cost(q, r, size, m)
    N = None
    if cross is not None:
        N = np.zeros((size, m))
        N[: cross.shape[0]] = cross
    require_controllable(model.A, model.B, discrete=True)
    try:
        S = scipy.linalg.solve_discrete_are(model.A, model.B, Q, R, s=N)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(no_solution(Q, float(R[0, 0]), error)) from error
    BS = model.B.T @ S
    K = np.linalg.solve(R + BS @ model.B, BS @ model.A + (0.0 if N is None else N.T))
    poles = sort_poles(np.linalg.eigvals(model.A - model.B @ K))
    if np.max(np.abs(poles)) >= 1.0:
        raise DesignError(f"closed loop has poles {poles} on or outside the unit circle; expected smaller weights")
    return Gain(K[0] if m == 1 else K, S, poles)


def sampled_cost(
    model: LinearModel, q: ArrayLike, r: float, period: float, delay: float = 0.0
) -> tuple[Matrix, Matrix, Matrix]:
    """Return the continuous cost of a period under hold: Q_d (n + p m, n + p m), R_d (m, m), N_d (n + p m, m).

    A discrete LQR with these weights minimises the continuous LQR's cost, at any sampling period and delay. A torque in
    transit costs where it moves the state, in Q_d; its own cost is counted when it is sent.

    Args:
        model: Linear model with n states and m inputs.
        q: Continuous weights of the measured states.
        r: Continuous weight of each input.
        period: Sampling period [s].
        delay: As in :func:`discretise`.

    Source:
        C. Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23(3), 1978, theorem 1;
        Astrom and Wittenmark, Computer-Controlled Systems, 3rd ed., 1997, section 11.1.
    """
    Q, R = cost_matrices(q, r, model.C.shape[0])
    if not (math.isfinite(period) and period > 0.0):
        raise DesignError(f"period is {period} s; expected a finite value > 0")
    pending, rest = _on_their_way(period, delay + model.delay)
    n, m = model.B.shape
    size = n + (pending + 1) * m
    state = np.eye(n, size)
    total = np.zeros((size, size))
    # The parts of the period with one acting input each: its index in [state; in transit; new], and the duration.
    older, newer = (n, n + m) if rest > 0.0 else (n, n)
    for column, time in ((older, rest), (newer, period - rest)):
        if time == 0.0:
            continue
        start = np.vstack([state, np.eye(size)[column : column + m]])
        total += start.T @ _collected(model, Q, time) @ start
        phi, gamma = _hold(model, time)
        state = phi @ state + gamma @ start[n:]
    total[-m:, -m:] += float(R[0, 0]) * period * np.eye(m)
    total = 0.5 * (total + total.T)
    return total[:-m, :-m], total[-m:, -m:], total[:-m, -m:]


def _collected(model: LinearModel, Q: Matrix, time: float) -> Matrix:
    """Return the cost of [x; u] over a time in which u is held, shape (n + m, n + m)."""
    n, m = model.B.shape
    size = n + m
    F = np.zeros((size, size))
    F[:n, :n] = model.A
    F[:n, n:] = model.B
    W = np.zeros((size, size))
    W[:n, :n] = model.C.T @ Q @ model.C
    # Long intervals would overflow exp(+214 s): sum over short pieces.
    pieces = max(1, math.ceil(float(np.abs(F).sum(axis=1).max()) * time / 2.0))
    step = time / pieces
    block = np.block([[-F.T, W], [np.zeros_like(F), F]])
    exponential = scipy.linalg.expm(block * step)
    forward = exponential[size:, size:]
    piece = forward.T @ exponential[:size, size:]
    total = np.zeros((size, size))
    transition = np.eye(size)
    for _ in range(pieces):
        total += transition.T @ piece @ transition
        transition = forward @ transition
    return total


def _on_their_way(period: float, delay: float) -> tuple[int, float]:
    """Return the number of inputs in transit during a delay, and the remaining fraction of a period [s]."""
    whole = math.floor(delay / period + 1e-9)
    rest = max(delay - whole * period, 0.0)
    if rest < 1e-9 * period:
        rest = 0.0
    return whole + (1 if rest > 0.0 else 0), rest


def _padded_cost(q: ArrayLike, r: float | Matrix, size: int, m: int) -> tuple[Matrix, Matrix]:
    """Return Q (size, size), zero beyond the states of q, and R (m, m)."""
    given, inputs = np.asarray(q, dtype=np.float64), np.asarray(r, dtype=np.float64)
    Q2, _ = cost_matrices(q, float(inputs.flat[0]), len(given))
    Q = np.zeros((size, size))
    Q[: Q2.shape[0], : Q2.shape[1]] = Q2
    return Q, inputs * np.eye(m) if inputs.ndim == 0 else inputs


def _hold(model: LinearModel, time: float) -> tuple[Matrix, Matrix]:
    """Return exp(A t) and the integral of exp(A s) B over [0, t]."""
    n, m = model.B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n] = model.A
    block[:n, n:] = model.B
    exponential = scipy.linalg.expm(block * time)
    return exponential[:n, :n], exponential[:n, n:]
