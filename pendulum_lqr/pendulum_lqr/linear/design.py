"""Optimal gains in continuous time: LQR, LQI, output feedback; the Kalman filter; and what refuses to be designed.

Riccati equations are solved by scipy. python-control enters only where margins and plots are asked for
(:mod:`pendulum_lqr.linear.analysis`), because it brings matplotlib with it, and a controller on a robot should start
without.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from pendulum_lqr.linear.model import LinearModel, sort_poles
from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "DesignError",
    "Gain",
    "KalmanGain",
    "continuous_lqr",
    "cost_matrices",
    "integral_lqr",
    "kalman_gain",
    "no_solution",
    "output_lqr",
    "require_controllable",
    "require_observable",
    "riccati_gain",
]

Matrix = NDArray[np.float64]

_RANK_TOLERANCE = 1e-9
"""Smallest singular value, relative to the norm, under which a mode counts as out of reach."""


class DesignError(ParameterError):
    """A controller cannot be designed for what was asked; the sentence says which weight or mode is to blame."""


@dataclass(frozen=True, slots=True)
class Gain:
    """State feedback u = -K x and the proof that came with it.

    Attributes:
        K: Gain, shape (n,) [N m/rad, N m s/rad, ...].
        S: Solution of the Riccati equation, shape (n, n); x' S x is the cost to go and a Lyapunov function.
        poles: Closed-loop eigenvalues, slowest first, shape (n,) [1/s], or on the z-plane for a discrete design.
    """

    K: Matrix
    S: Matrix
    poles: NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class KalmanGain:
    """Stationary Kalman filter.

    Attributes:
        L: Filter gain that corrects a prediction, shape (n, outputs).
        P: Covariance of the prediction, shape (n, n).
    """

    L: Matrix
    P: Matrix


def cost_matrices(q: ArrayLike, r: float, size: int = 2) -> tuple[Matrix, Matrix]:
    """Return the checked cost matrices Q (size, size) and R (1, 1).

    Args:
        q: Diagonal of Q, shape (size,), or the whole symmetric matrix, shape (size, size).
        r: Cost of torque, > 0 [1/(N m)^2].
        size: Number of states.

    Raises:
        DesignError: A weight is not finite, negative, not symmetric, or of the wrong shape.
    """
    weights = np.asarray(q, dtype=np.float64)
    if weights.shape == (size,):
        weights = np.diag(weights)
    if weights.shape != (size, size):
        raise DesignError(f"q has the shape {weights.shape}; expected ({size},) for a diagonal or ({size}, {size})")
    if not np.all(np.isfinite(weights)):
        raise DesignError(f"q is {_plain(q)}; expected finite weights")
    if not np.allclose(weights, weights.T, rtol=1e-12, atol=0.0):
        raise DesignError(f"q is {_plain(q)}; expected a symmetric matrix")
    lowest = float(np.linalg.eigvalsh(weights)[0])
    if lowest < -1e-12 * max(1.0, float(np.abs(weights).max())):
        raise DesignError(f"q is {_plain(q)}, with the eigenvalue {lowest:.6g}; expected no negative weight")
    if not (math.isfinite(r) and r > 0.0):
        raise DesignError(f"r is {r} 1/(N m)^2; expected a finite weight > 0")
    return weights, np.array([[float(r)]])


def continuous_lqr(model: LinearModel, q: ArrayLike, r: float) -> Gain:
    """Return the gain on the whole state that minimises the integral of x' Q x + u' R u.

    Args:
        model: Linear model; its delay is not counted, the margins say how much of it the loop bears.
        q: Weights of [theta, theta_dot]; states that are not measured cost nothing. See :func:`cost_matrices`.
        r: Weight of the torque, > 0.

    Raises:
        DesignError: Weights out of domain, or a mode that torque cannot reach or that the cost does not see.

    Source:
        Thesis, section 6.1; Anderson and Moore, Optimal Control, 1990, section 3.2.
    """
    Q, R = cost_matrices(q, r)
    gain = riccati_gain(model.A, model.B, model.C.T @ Q @ model.C, R[0])
    return replace(gain, K=gain.K[0])


def output_lqr(model: LinearModel, q: ArrayLike, r: float) -> Gain:
    """Return the best gain on what is measured, u = -K [theta, theta_dot].

    Where that is the whole state, it is the LQR. Where motor, spring or lag have states of their own, it is the gain
    that costs least on average over releases of the resting pendulum from all angles and velocities: no gain on two
    measurements can be optimal for every start, and none has the LQR's guaranteed margins.

    Args:
        model: Linear model; its delay is not counted.
        q: Weights of [theta, theta_dot].
        r: Weight of the torque, > 0.

    Returns:
        K of shape (2,); S (n, n) gives the cost to go of this gain, x' S x.

    Raises:
        DesignError: As :func:`continuous_lqr`; or no gain on the measurements stabilises the plant.

    Source:
        Levine and Athans, On the determination of the optimal constant output feedback gains, IEEE TAC 15(1), 1970.
    """
    if not model.hidden:
        return continuous_lqr(model, q, r)
    Q, R = cost_matrices(q, r)
    full = continuous_lqr(model, q, r)
    return _output_feedback(model.A, model.B, model.C, model.C.T @ Q @ model.C, float(R[0, 0]), full.K, _lift(model))


def integral_lqr(model: LinearModel, q: ArrayLike, r: float) -> Gain:
    """Return the LQI gain on [theta, theta_dot, integral of (theta - set-point)], which leaves no offset.

    With states that are not measured it is the best gain on these three, as in :func:`output_lqr`.

    Args:
        model: Linear model.
        q: Weights of the three, shape (3,) or (3, 3); the third > 0.
        r: Weight of the torque, > 0.

    Raises:
        DesignError: As :func:`output_lqr`; in particular if the integral carries no weight.
    """
    Q, R = cost_matrices(q, r, 3)
    if not Q[2, 2] > 0.0:
        raise DesignError(f"weight of the integral is {Q[2, 2]:g}; expected > 0, or use plain LQR")
    n = model.A.shape[0]
    A = np.zeros((n + 1, n + 1))
    A[:n, :n] = model.A
    A[n, 0] = 1.0
    B = np.vstack([model.B, [[0.0]]])
    C = scipy.linalg.block_diag(model.C, [[1.0]])
    full = riccati_gain(A, B, C.T @ Q @ C, R[0])
    full = replace(full, K=full.K[0])
    if not model.hidden:
        return full
    lift = scipy.linalg.block_diag(_lift(model), [[1.0]])
    return _output_feedback(A, B, C, C.T @ Q @ C, float(R[0, 0]), full.K, lift)


def kalman_gain(A: Matrix, C: Matrix, process: ArrayLike, measurement: ArrayLike) -> KalmanGain:
    """Return the stationary Kalman filter of ``x[k+1] = A x[k] + w``, ``y[k] = C x[k] + v``.

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix, shape (m, n).
        process: Covariance of w, shape (n, n).
        measurement: Covariance of v, shape (m, m), positive definite.

    Raises:
        DesignError: The outputs do not show every mode that the noise drives, or a covariance is out of domain.
    """
    A = np.asarray(A, dtype=np.float64)
    C = np.atleast_2d(np.asarray(C, dtype=np.float64))
    W = np.atleast_2d(np.asarray(process, dtype=np.float64))
    V = np.atleast_2d(np.asarray(measurement, dtype=np.float64))
    for name, covariance in (("process", W), ("measurement", V)):
        if np.all(np.isfinite(covariance)):
            variances = np.linalg.eigvalsh(covariance)
        # A covariance of few causes has zeros, of which rounding makes small numbers of either sign.
        if not np.all(np.isfinite(covariance)) or variances[0] < -1e-12 * np.abs(variances).max():
            raise DesignError(f"{name} noise covariance is {covariance.tolist()}; expected finite, not negative")
    if not float(np.linalg.eigvalsh(V)[0]) > 0.0:
        raise DesignError(f"measurement noise covariance is {V.tolist()}; expected every variance > 0")
    require_observable(A, C)
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, W, V)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(f"no stationary Kalman filter for the given noise: {error}") from error
    L = scipy.linalg.solve(C @ P @ C.T + V, C @ P, assume_a="pos").T
    return KalmanGain(L, P)


def require_controllable(A: Matrix, B: Matrix, *, discrete: bool = False) -> None:
    """Refuse a system with an unstable mode that the input does not reach (Hautus test).

    Args:
        A: State matrix, shape (n, n).
        B: Input matrix, shape (n, m).
        discrete: Whether stability is meant on the z-plane.

    Raises:
        DesignError: Names the mode.
    """
    pole = _unreached_mode(A, B, discrete=discrete)
    if pole is not None:
        raise DesignError(f"mode at {_number(pole)} is not controllable: no torque reaches it; expected B = [0, 1/M]")


def require_observable(A: Matrix, C: Matrix) -> None:
    """Refuse a sampled system with an unstable mode that the outputs do not show (Hautus test).

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix, shape (m, n).

    Raises:
        DesignError: Names the mode.
    """
    # The dual of controllability: what A' and C' do not reach, A and C do not show.
    pole = _unreached_mode(A.T, C.T, discrete=True)
    if pole is not None:
        raise DesignError(
            f"mode at {_number(pole)} is not observable: no measurement shows it; expected theta among the outputs"
        )


def _unreached_mode(A: Matrix, B: Matrix, *, discrete: bool) -> complex | None:
    """Return a mode that neither decays by itself nor is reached by the input, by the rank of [s I - A, B]."""
    for pole in np.linalg.eigvals(A):
        if not _decays(pole, discrete) and _deficient(np.hstack([pole * np.eye(A.shape[0]) - A, B])):
            return complex(pole)
    return None


def _lift(model: LinearModel) -> Matrix:
    """Return the states of a plant at ease at each measured angle and velocity, shape (n, 2): the motor follows."""
    follows = {"theta": (1.0, 0.0), "theta_dot": (0.0, 1.0), "motor_angle": (1.0, 0.0), "motor_velocity": (0.0, 1.0)}
    return np.array([follows.get(name, (0.0, 0.0)) for name in model.states])


def _output_feedback(A: Matrix, B: Matrix, C: Matrix, Q: Matrix, r: float, full: Matrix, lift: Matrix) -> Gain:
    """Return u = -K C x of least tr(P X0), X0 = lift lift', by quasi-Newton on Levine and Athans' gradient."""
    start = lift @ lift.T

    def solve(K: Matrix) -> tuple[float, Matrix, Matrix]:
        closed = A - B @ K[None, :] @ C
        if float(np.max(np.linalg.eigvals(closed).real)) >= -1e-9:
            return math.inf, np.zeros_like(K), np.zeros_like(A)
        P = scipy.linalg.solve_continuous_lyapunov(closed.T, -(Q + r * C.T @ np.outer(K, K) @ C))
        L = scipy.linalg.solve_continuous_lyapunov(closed, -start)
        gradient = 2.0 * ((r * K[None, :] @ C - B.T @ P) @ L @ C.T)[0]
        return float(np.trace(P @ start)), gradient, P

    # What the full gain would do if the hidden states followed; smaller, should it excite what they really do.
    follow = full @ lift
    scale = np.maximum(np.abs(follow), 1e-3 * float(np.max(np.abs(follow))))
    guesses = [f * follow * mask for f in (1.0, 0.7, 0.5, 0.3, 0.2, 0.1) for mask in (1.0, _without_rate(follow))]
    guess = min(guesses, key=lambda K: solve(K)[0])
    if not math.isfinite(solve(guess)[0]):
        raise DesignError(
            "no gain on angle and velocity found that stabilises the plant, whose other states are not measured; "
            "expected larger r, smaller q, or lqg, which estimates them"
        )
    best, value = guess, solve(guess)[0]

    def objective(relative: Matrix) -> tuple[float, Matrix]:
        cost, gradient, _ = solve(relative * scale)
        return cost / value, gradient * scale / value

    for _ in range(3):
        found = scipy.optimize.minimize(objective, best / scale, jac=True, method="BFGS", options={"gtol": 1e-9})
        best = found.x * scale
    _, _, P = solve(best)
    return Gain(best, P, sort_poles(np.linalg.eigvals(A - B @ best[None, :] @ C)))


def _without_rate(gain: Matrix) -> Matrix:
    mask = np.ones_like(gain)
    mask[1] = 0.0
    return mask


def riccati_gain(A: Matrix, B: Matrix, Q: Matrix, costs: Matrix) -> Gain:
    """Return the gain, its K of shape (m, n), for a cost Q of the states and costs of each input, shape (m,)."""
    require_controllable(A, B)
    try:
        S = scipy.linalg.solve_continuous_are(A, B, Q, np.diag(costs))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(no_solution(Q, float(costs[0]), error)) from error
    K = B.T @ S / costs[:, None]
    poles = sort_poles(np.linalg.eigvals(A - B @ K))
    if np.max(poles.real) >= 0.0:
        raise DesignError(no_solution(Q, float(costs[0]), "the closed loop is not stable"))
    return Gain(K, S, poles)


def no_solution(Q: Matrix, r: float, reason: object) -> str:
    """Return why weights q and r give no gain, as one sentence."""
    return f"no stabilising gain for q = {_plain(Q)}, r = {r:g}: {reason}; expected weights that see every slow mode"


def _decays(pole: complex, discrete: bool) -> bool:
    return abs(pole) < 1.0 - 1e-12 if discrete else pole.real < 0.0


def _deficient(pencil: NDArray[np.complex128]) -> bool:
    # Rows of different units (rad against rad/s) are brought to one size first, else the fast pole hides the slow one.
    scaled = pencil / np.maximum(np.linalg.norm(pencil, axis=1, keepdims=True), 1e-300)
    scaled = scaled / np.maximum(np.linalg.norm(scaled, axis=0, keepdims=True), 1e-300)
    values = np.linalg.svd(scaled, compute_uv=False)
    return bool(values[-1] < _RANK_TOLERANCE * values[0])


def _plain(values: ArrayLike) -> object:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 2 and np.count_nonzero(array - np.diag(np.diagonal(array))) == 0:
        array = np.diagonal(array)
    plain: Sequence[object] = array.tolist()
    return plain


def _number(pole: complex) -> str:
    return f"{pole.real:.6g}" if abs(pole.imag) < 1e-12 else f"{pole:.6g}"
