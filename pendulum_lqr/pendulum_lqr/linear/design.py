"""Optimal gains in continuous time (LQR, LQI, output feedback), the Kalman filter, and checks of a design.

scipy solves the Riccati equations. python-control is imported only for margins and plots (:mod:`.analysis`), because it
imports matplotlib, which a controller on a robot does not need.
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
    "kalman_gain",
    "no_solution",
    "output_lqr",
    "require_controllable",
    "require_observable",
    "with_integrals",
]

Matrix = NDArray[np.float64]

_RANK_TOLERANCE = 1e-9
"""Smallest singular value, relative to the norm, of a reachable mode."""


_DISCOUNTS = 60
"""Largest number of discounts tried until an output feedback is stable."""


class DesignError(ParameterError):
    """A controller cannot be designed as requested; the message names the weight or mode at fault."""


@dataclass(frozen=True, slots=True)
class Gain:
    """State feedback u = -K x and its proof.

    Attributes:
        K: Gain, shape (n,) of one input, (m, n) of several [N m/rad, N m s/rad, ...].
        S: Solution of the Riccati equation, shape (n, n); x' S x is the cost to go and a Lyapunov function.
        poles: Closed-loop eigenvalues, slowest first, shape (n,) [1/s], or on the z-plane for a discrete design.
    """

    K: Matrix
    S: Matrix
    poles: NDArray[np.complex128]

    @property
    def rows(self) -> Matrix:
        """K with a row for each input, shape (m, n)."""
        return np.atleast_2d(self.K)


@dataclass(frozen=True, slots=True)
class KalmanGain:
    """Stationary Kalman filter: correction gain L, shape (n, outputs), and prediction covariance P, shape (n, n)."""

    L: Matrix
    P: Matrix


def cost_matrices(q: ArrayLike, r: ArrayLike, size: int = 2, inputs: int = 1) -> tuple[Matrix, Matrix]:
    """Return the checked cost matrices Q (size, size) and R (inputs, inputs).

    Args:
        q: Diagonal of Q, shape (size,), or the whole symmetric matrix, shape (size, size).
        r: Cost of effort, > 0, one for all inputs or one for each [1/(N m)^2].
        size: Number of states.
        inputs: Number of inputs, m.

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
    costs = np.asarray(r, dtype=np.float64)
    if costs.size not in {1, inputs} or not (np.isfinite(costs).all() and costs.min() > 0.0):
        expected = "a finite weight > 0" if inputs == 1 else f"one finite weight > 0, or {inputs}"
        raise DesignError(f"r is {costs.tolist()} 1/(N m)^2; expected {expected}")
    return weights, np.diag(np.broadcast_to(costs, inputs))


def continuous_lqr(model: LinearModel, q: ArrayLike, r: ArrayLike) -> Gain:
    """Return the gain on the whole state that minimises the integral of x' Q x + u' R u.

    Args:
        model: Linear model, without its delay; the margins show how much of it the loop tolerates.
        q: Weights of the measured states, as in :func:`cost_matrices`; hidden states cost nothing.
        r: Weight of the efforts, > 0: one for all, or m.

    Raises:
        DesignError: Weights out of domain, or a mode that is uncontrollable or not in the cost.

    Source:
        Thesis, section 6.1; Anderson and Moore, Optimal Control, 1990, section 3.2.
    """
    Q, R = cost_matrices(q, r, *model.outputs_and_inputs)
    require_controllable(model.A, model.B)
    try:
        S = scipy.linalg.solve_continuous_are(model.A, model.B, model.C.T @ Q @ model.C, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DesignError(no_solution(Q, float(R[0, 0]), error)) from error
    K = model.B.T @ S / np.diag(R)[:, None]
    poles = sort_poles(np.linalg.eigvals(model.A - model.B @ K))
    if np.max(poles.real) >= 0.0:
        raise DesignError(no_solution(Q, float(R[0, 0]), "the closed loop is not stable"))
    return Gain(_of_inputs(K), S, poles)


def output_lqr(model: LinearModel, q: ArrayLike, r: ArrayLike) -> Gain:
    """Return the best gain on the measured states, u = -K [theta, theta_dot] of one joint.

    Without hidden states it is the LQR. With motor, spring or lags as hidden states, it minimises the average cost over
    releases of the resting plant from all positions and velocities: no such gain is optimal for every start or has the
    LQR's guaranteed margins.

    Args:
        model: Linear model, without its delay.
        q: Weights of the k measured states.
        r: Weight of the efforts, > 0: one for all, or m.

    Returns:
        K on the measured states, shape (k,) or (m, k); S (k, k) gives the cost to go, y' S y, from a release at y.

    Raises:
        DesignError: As :func:`continuous_lqr`; or no gain on the measurements stabilises the plant.

    Source:
        Levine and Athans, On the determination of the optimal constant output feedback gains, IEEE TAC 15(1), 1970.
    """
    full = continuous_lqr(model, q, r)
    return _output_feedback(model, *cost_matrices(q, r, *model.outputs_and_inputs), full) if model.hidden else full


def with_integrals(model: LinearModel, outputs: Sequence[int] = (0,)) -> LinearModel:
    """Return the model with the integrals of some measured states (by index) appended to the measured ones."""
    k, more = model.C.shape[0], len(outputs)
    size = model.A.shape[0] + more
    old = [*range(k), *range(k + more, size)]
    A = np.zeros((size, size))
    A[np.ix_(old, old)] = model.A
    A[range(k, k + more), list(outputs)] = 1.0
    B, E = np.zeros((size, model.B.shape[1])), np.zeros((size, model.E.shape[1]))
    B[old], E[old] = model.B, model.E
    names = (*model.measured, *(f"integral of {model.states[output]}" for output in outputs), *model.hidden)
    return replace(model, A=A, B=B, C=np.eye(k + more, size), E=E, states=names)


def kalman_gain(A: Matrix, C: Matrix, process: ArrayLike, measurement: ArrayLike) -> KalmanGain:
    """Return the stationary Kalman filter of ``x[k+1] = A x[k] + w``, ``y[k] = C x[k] + v``.

    Shapes: A (n, n), C (m, n), covariances of w (n, n) and of v (m, m), which is positive definite.

    Raises:
        DesignError: A driven mode is unobservable, or a covariance is out of domain.
    """
    A = np.asarray(A, dtype=np.float64)
    C = np.atleast_2d(np.asarray(C, dtype=np.float64))
    W = np.atleast_2d(np.asarray(process, dtype=np.float64))
    V = np.atleast_2d(np.asarray(measurement, dtype=np.float64))
    for name, covariance in (("process", W), ("measurement", V)):
        if np.all(np.isfinite(covariance)):
            variances = np.linalg.eigvalsh(covariance)
        # Covariances of few causes have zero eigenvalues, which rounding makes small numbers of either sign.
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
    """Raise DesignError for an unstable mode that the input does not reach (Hautus test)."""
    pole = _unreached_mode(A, B, discrete=discrete)
    if pole is not None:
        raise DesignError(f"mode at {_number(pole)} is not controllable: no torque reaches it; expected B = [0, 1/M]")


def require_observable(A: Matrix, C: Matrix) -> None:
    """Raise DesignError for an unstable mode of a sampled system that the outputs do not show (Hautus test)."""
    # By duality.
    pole = _unreached_mode(A.T, C.T, discrete=True)
    if pole is not None:
        raise DesignError(
            f"mode at {_number(pole)} is not observable: no measurement shows it; expected theta among the outputs"
        )


def _unreached_mode(A: Matrix, B: Matrix, *, discrete: bool) -> complex | None:
    """Return a mode that neither decays nor is reached by the input, by the rank of [s I - A, B]."""
    for pole in np.linalg.eigvals(A):
        if not _decays(pole, discrete) and _deficient(np.hstack([pole * np.eye(A.shape[0]) - A, B])):
            return complex(pole)
    return None


def _lift(model: LinearModel) -> Matrix:
    """Return the states at each value of the k measured ones when the motor follows the link, shape (n, k)."""
    k, size = model.C.shape
    lift = np.eye(size, k)
    for name, measured in (("motor_angle", 0), ("motor_velocity", 1)):
        if name in model.states:
            lift[model.states.index(name), measured] = 1.0
    return lift


def _output_feedback(model: LinearModel, Q: Matrix, R: Matrix, full: Gain) -> Gain:
    """Return u = -K C x of least tr(P X0), X0 = lift lift', by quasi-Newton on Levine and Athans' gradient."""
    A, B, C, lift = model.A, model.B, model.C, _lift(model)
    start, cost, unit = lift @ lift.T, C.T @ Q @ C, np.eye(len(A))

    def abscissa(K: Matrix) -> float:
        return float(np.max(np.linalg.eigvals(A - B @ K @ C).real))

    def solve(K: Matrix, discount: float = 0.0) -> tuple[float, Matrix, Matrix]:
        if abscissa(K) >= discount - 1e-9:
            return math.inf, np.zeros_like(K), np.zeros_like(A)
        closed = A - B @ K @ C - discount * unit
        P = scipy.linalg.solve_continuous_lyapunov(closed.T, -(cost + C.T @ K.T @ R @ K @ C))
        L = scipy.linalg.solve_continuous_lyapunov(closed, -start)
        return float(np.trace(P @ start)), 2.0 * (R @ K @ C - B.T @ P) @ L @ C.T, P

    def improved(K: Matrix, discount: float = 0.0, most: int | None = None) -> Matrix:
        value = solve(K, discount)[0]

        def objective(relative: Matrix) -> tuple[float, Matrix]:
            found, gradient, _ = solve(relative.reshape(scale.shape) * scale, discount)
            return found / value, (gradient * scale / value).ravel()

        options = {"gtol": 1e-9, "maxiter": most}
        found = scipy.optimize.minimize(objective, (K / scale).ravel(), jac=True, method="BFGS", options=options)
        return np.asarray(found.x.reshape(scale.shape) * scale)

    # The full gain's effect if hidden states followed; smaller multiples in case it excites them.
    follow = full.rows @ lift
    scale = np.maximum(np.abs(follow), 1e-3 * float(np.max(np.abs(follow))))
    best = min((share * follow for share in (1.0, 0.7, 0.5, 0.3, 0.2, 0.1)), key=abscissa)
    # A cost discounted by exp(-2 discount t) is finite for a loop that grows more slowly; reducing the discount with
    # every gain found leads to a stable one.
    for _ in range(_DISCOUNTS):
        if (growth := abscissa(best)) < -1e-9:
            break
        best = improved(best, growth + 0.1 * max(growth, 0.1), 30)
    else:
        raise DesignError(
            f"no gain on {', '.join(model.measured)} found that stabilises the plant, whose other states are not "
            "measured; expected larger r, smaller q, or lqg, which estimates them"
        )
    for _ in range(3):
        best = improved(best)
    return Gain(_of_inputs(best), lift.T @ solve(best)[2] @ lift, sort_poles(np.linalg.eigvals(A - B @ best @ C)))


def _of_inputs(K: Matrix) -> Matrix:
    """Return a gain in the shape of ``Gain.K``: without its only row for one input."""
    return K[0] if len(K) == 1 else K


def no_solution(Q: Matrix, r: float, reason: object) -> str:
    """Return why weights q and r give no gain, as one sentence."""
    return f"no stabilising gain for q = {_plain(Q)}, r = {r:g}: {reason}; expected weights that see every slow mode"


def _decays(pole: complex, discrete: bool) -> bool:
    return abs(pole) < 1.0 - 1e-12 if discrete else pole.real < 0.0


def _deficient(pencil: NDArray[np.complex128]) -> bool:
    # Rows of different units (rad and rad/s) are scaled first, else the fast pole hides the slow one.
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
