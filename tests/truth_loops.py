"""Plants, multisine runs and loops by numpy and scipy alone: the certificate and its judge share no code."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pendulum_bags.distributions import Interval
from pendulum_bags.frequency_response.compare import compare_responses
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.record import Record
from pendulum_bags.ranking.contender import contenders_of
from pendulum_bags.ranking.ranking import rank
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.certificate import Certificate, Certifier
from pendulum_lqr.responses.gap_metric import DEFAULT_SCALING, JointScaling, SignalScaling
from pendulum_lqr.responses.machine_response import Machine

Array = NDArray[Any]
GRAVITY = 9.81
ERROR = 1e-5
"""Standard deviation of measured positions; of velocities 20 times as much [rad, m, rad/s, m/s]."""


@dataclass(frozen=True)
class Linear:
    """M q'' + D q' + S q = B u(t - late) around upright; a flexible part may hang on the driven coordinate.

    Args:
        inertia: M, shape (k, k).
        damping: D, shape (k, k).
        stiffness: S, shape (k, k).
        drive: B, shape (k,).
        late: Delay [s].
        period: Of the samples [s].
        flexible: Mass of the flexible part, its frequency [rad/s] and damping ratio, and the share of its motion in
            the first measured position; mass 0 for none.
        amplitude: Largest effort of the multisine.
    """

    inertia: Array
    damping: Array
    stiffness: Array
    drive: Array
    late: float = 0.0
    period: float = 0.002
    flexible: tuple[float, float, float, float] = (0.0, 1.0, 1.0, 0.0)
    amplitude: float = 1.0

    @property
    def joints(self) -> int:
        """Number of measured joints."""
        return len(self.drive)

    def equations(self) -> tuple[Array, Array]:
        """Return A and B of the state [q, flexible, q', flexible']."""
        M, D, S, B = self.inertia, self.damping, self.stiffness, self.drive
        mass, omega, zeta, _ = self.flexible
        if mass:
            d = (B != 0.0).astype(float)[:, None]
            M = np.block([[M + mass * d @ d.T, mass * d], [mass * d.T, np.array([[mass]])]])
            D = scipy.linalg.block_diag(D, 2.0 * zeta * omega * mass)
            S = scipy.linalg.block_diag(S, omega**2 * mass)
            B = np.append(B, 0.0)
        n = len(B)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, S), -np.linalg.solve(M, D)]])
        return A, np.concatenate([np.zeros(n), np.linalg.solve(M, B)])[:, None]

    @cached_property
    def sampled(self) -> tuple[Array, Array, Array]:
        """Return A, B and C of the plant under a zero-order hold, with its delay as states."""
        A, B = self.equations()
        n, (whole, part) = len(A), divmod(self.late, self.period)

        def held(t: float) -> tuple[Array, Array]:
            block = np.zeros((n + 1, n + 1))
            block[:n, :n], block[:n, n:] = A * t, B * t
            exact = scipy.linalg.expm(block)
            return exact[:n, :n], exact[:n, n:]

        F, _ = held(self.period)
        (late, new), (_, old) = held(self.period - part), held(part)
        k = int(whole) + 1
        Ad, Bd = np.zeros((n + k, n + k)), np.zeros((n + k, 1))
        Ad[:n, :n] = F
        # The oldest state of the line is the input before the newest that acts within this period.
        Ad[:n, n : n + 1] = late @ old
        if k == 1:
            Bd[:n] = new
        else:
            Ad[:n, n + 1 : n + 2] = new
        for i in range(k - 1):
            Ad[n + i, n + i + 1] = 1.0
        Bd[-1] = 1.0
        q = n // 2
        rows = [*range(self.joints), *range(q, q + self.joints)]
        C = np.eye(n + k)[rows]
        if self.flexible[0]:
            C[0, q - 1] = C[self.joints, n - 1] = self.flexible[3]
        return Ad, Bd, C

    @cached_property
    def response(self) -> Array:
        """Return the sampled response on a grid to the Nyquist frequency, shape (2 k, n)."""
        return self.at(np.geomspace(0.05, np.pi / self.period, 1500))

    def at(self, omega: Array) -> Array:
        """Return the sampled response at some frequencies [rad/s], shape (2 k, n)."""
        A, B, C = self.sampled
        points = np.exp(1j * self.period * omega)
        return (C @ np.linalg.solve(points[:, None, None] * np.eye(len(A)) - A, B[None].astype(complex)))[:, :, 0].T

    def costs(self, K: Array, noise: Array) -> tuple[Array, float]:
        """Return the mean of 100 e^2 + 0.01 v^2 + 0.1 u^2 in runs of one joint from rest, and what is expected of it.

        Args:
            K: Gain.
            noise: Torque that is added in each period, uniform in -1 to 1, shape (runs, n).
        """
        A, B, C = self.sampled
        loop, weight = A - B @ (K[None] @ C), C.T @ (np.diag([100.0, 0.01]) + 0.1 * np.outer(K, K)) @ C
        states, spread, found, expected = np.zeros((len(noise), len(A))), np.zeros_like(A), 0.0, 0.0
        for push in noise.T:
            found = found + np.einsum("ij,jk,ik->i", states, weight, states)
            expected += float(np.trace(weight @ spread))
            states = states @ loop.T + push[:, None] * B.T
            spread = loop @ spread @ loop.T + B @ B.T / 3.0
        return np.asarray(found) / noise.shape[1], expected / noise.shape[1]

    def modulus(self, K: Array, power: float = 1.0) -> float:
        """Return the largest eigenvalue of the sampled loop, its gain changed by a factor."""
        A, B, C = self.sampled
        return float(np.abs(np.linalg.eigvals(A - power * B @ (K[None] @ C))).max())

    def robust(self, K: Array) -> bool:
        """Return whether the loop stays stable 6 dB up and down, and 30 degrees behind at each crossover."""
        if any(self.modulus(K, g) >= 1.0 for g in (1.0, 2.0, 0.5)):
            return False
        L = K @ self.response
        crossing = np.abs(L[1:]) - 1.0, np.abs(L[:-1]) - 1.0
        at = np.flatnonzero(crossing[0] * crossing[1] < 0.0)
        return all(abs(np.angle(-L[i])) > np.deg2rad(30.0) for i in at)

    def regulator(self, q: Array, r: float) -> Array:
        """Return the gain of the LQR of the plant without its delay."""
        A, B = replace(self, flexible=(0.0, 1.0, 1.0, 0.0)).equations()
        return np.asarray((B.T @ scipy.linalg.solve_continuous_are(A, B, np.diag(q), [[r]]))[0] / r)

    def model(self) -> LinearModel:
        """Return what the product is given as the model."""
        A, B = self.equations()
        names = tuple(f"j{i}" for i in range(2 * self.joints))
        return LinearModel(A, B, C=np.eye(len(A)), delay=self.late, states=names)


def multisine(size: int, amplitude: float, seed: int, lines: Array) -> Array:
    """Return one period of a sum of cosines with random phases."""
    spectrum = np.zeros(size // 2 + 1, dtype=complex)
    spectrum[lines] = np.exp(1j * np.random.default_rng(seed).uniform(0, 2 * np.pi, len(lines)))
    wave = np.fft.irfft(spectrum, size)
    return amplitude * wave / np.abs(wave).max()


def measured(
    truth: Linear, K: Array, seed: int, *, periods: int = 8, length: float = 4.0, top: float = 100.0
) -> Record:
    """Return what a machine, held by a gain from noisy positions and velocities, records under a multisine."""
    A, B, C = truth.sampled
    size, k = round(length / truth.period), truth.joints
    lines = np.unique(
        2 * np.round((np.geomspace(1.0, 2 * math.floor((top * length - 1.0) / 2.0) + 1.0, 48) - 1.0) / 2.0).astype(int)
        + 1
    )
    r = np.tile(multisine(size, truth.amplitude, seed, lines), periods + 1)
    noise = ERROR * np.random.default_rng([5, seed]).standard_normal((r.size, 2 * k))
    noise[:, k:] *= 20.0
    outputs, torque, state = np.zeros((r.size, 2 * k)), np.zeros(r.size), np.zeros(len(A))
    for i in range(r.size):
        outputs[i] = C @ state + noise[i]
        torque[i] = r[i] - K @ outputs[i]
        state = A @ state + B[:, 0] * torque[i]
    wave = {"kind": "multisine", "amplitude": truth.amplitude, "signal_period": length, "frequency": 1.0 / length}
    facts = {**wave, "frequency_end": top, "lines": 48, "hold_time": truth.period}
    names = tuple(f"j{i}" for i in range(k)) if k > 1 else ()
    return Record("hw", truth.period, r, torque, outputs.T, facts, {}, names, 0)


@dataclass(frozen=True)
class Judged:
    """A controller that was made on the model, what the product says of it, and what the machine does.

    Args:
        product: The certificate.
        stable: Whether the machine's own loop is stable.
        robust: Whether it is with 6 dB and 30 degrees.
    """

    product: Certificate
    stable: bool
    robust: bool


def _task(truth: Linear, known: LinearModel, q: Array, r: float) -> tuple[float, SignalScaling]:
    """Return the highest frequency of a recording [Hz], and the units of the gap that the product takes."""
    if truth.joints == 1:
        return 0.95 * 0.5 / truth.period, DEFAULT_SCALING
    return 100.0, JointScaling.of_weights(known.measured, ["-"] * len(q), list(q), r, "-")


def judge(model: Linear, truth: Linear, q: Array, r: float, seed: int, cases: int, length: float = 4.0) -> list[Judged]:
    """Return cases of one pair: regulators of random weights, scaled and rotated.

    Args:
        model: The simulation's plant.
        truth: The machine.
        q: Weights of the recording's regulator, of positions and velocities.
        r: Weight of its effort.
        seed: Of noise and weights.
        cases: How many.
        length: Signal period [s].
    """
    held = model.regulator(q, r)
    if truth.modulus(held) >= 1.0:
        return []
    known = model.model()
    top, scaling = _task(truth, known, q, r)
    response = estimate(measured(truth, held, seed, length=length, top=top))
    machine = Machine.of(response) if truth.joints == 1 else Machine.relative_to(response, known)
    certifier = Certifier(known, machine, scaling)
    random, found = np.random.default_rng([9, seed]), []
    for _ in range(cases):
        weights = q * 10.0 ** random.uniform(-0.5, 1.5, len(q))
        K = model.regulator(weights, r * 10.0 ** random.uniform(-3.0, 0.0)) * 10.0 ** random.uniform(-0.3, 0.5)
        found.append(Judged(certifier.gain(K), truth.modulus(K) < 1.0, truth.robust(K)))
    return found


def pendulum(random: np.random.Generator) -> tuple[Linear, Linear, Array, float]:
    """Return a pendulum of one joint and a machine with errors to 40 %, a gain and a delay to 12 ms."""
    inertia, damping, gravity = np.array([0.055, random.choice([0.2, 1.3, 11.77]), 1.678])
    off = random.uniform(0.6, 1.4, 3)
    one = Linear(np.array([[inertia]]), np.array([[damping]]), np.array([[-gravity]]), np.ones(1), period=0.01)
    two = replace(
        one,
        inertia=one.inertia * off[0],
        damping=one.damping * off[1],
        stiffness=one.stiffness * off[2],
        drive=np.array([random.uniform(0.8, 1.2)]),
        late=random.uniform(0.0, 0.012),
    )
    return one, two, np.array([100.0, 0.01]), 0.1


def _two_joints(driven: float, coupling: float, passive: float, length: float, off: Array, weight: float) -> Linear:
    """Return a carried pendulum: mass of the carrier, m l, m l^2, damping of both."""
    M = np.array([[driven * off[0], coupling * off[1]], [coupling * off[1], passive * off[2]]])
    D = np.diag([0.1 * off[3], 0.002 * off[4]])
    return Linear(M, D, np.diag([0.0, -GRAVITY * coupling * off[1] * weight * length]), np.array([1.0, 0.0]))


def cart_pole(random: np.random.Generator, stiffness: float = 0.0) -> tuple[Linear, Linear, Array, float]:
    """Return a cart-pole, and one with errors to 15 %, a delay to 8 ms and a stiffness of the cart [1/s^2]."""
    one = _two_joints(1.2, 0.1, 0.055, 1.0, np.ones(5), 1.0)
    two = _two_joints(1.2, 0.1, 0.055, 1.0, random.uniform(0.85, 1.15, 5), 1.0)
    tilted = two.stiffness + np.diag([stiffness * two.inertia[0, 0], 0.0])
    return (
        one,
        replace(two, stiffness=tilted, amplitude=5.0, late=random.uniform(0.0, 0.008)),
        np.array([10.0, 100.0, 1.0, 1.0]),
        0.1,
    )


def furuta(random: np.random.Generator, zeta: float = 0.0) -> tuple[Linear, Linear, Array, float]:
    """Return a Furuta pendulum, and one with errors to 15 %, a delay to 8 ms and a flexible part in its arm.

    Args:
        random: Source of its errors.
        zeta: Damping ratio of the flexible part, whose frequency is between two lines; 0 for none.
    """
    one = _two_joints(0.0095, 0.0027, 0.0021, 1.0, np.ones(5) * [1, 1, 1, 0.02, 0.05], 1.0)
    two = _two_joints(0.0095, 0.0027, 0.0021, 1.0, random.uniform(0.85, 1.15, 5) * [1, 1, 1, 0.02, 0.05], 1.0)
    lines = np.unique(2 * np.round((np.geomspace(1.0, 399.0, 48) - 1.0) / 2.0).astype(int) + 1) * 0.25
    at = random.choice(np.flatnonzero((lines > 1.0) & (lines < 30.0)))
    between = lines[at] + random.uniform(0.3, 0.7) * (lines[at + 1] - lines[at])
    share, seen = 10.0 ** random.uniform(-4.0, -1.5), random.choice([-1.0, 1.0]) * 10.0 ** random.uniform(-4.0, -1.0)
    part = (share * 0.0095, 2.0 * np.pi * between, zeta, seen) if zeta else (0.0, 1.0, 1.0, 0.0)
    return one, replace(two, flexible=part, late=random.uniform(0.0, 0.008)), np.array([1.0, 10.0, 0.1, 0.1]), 1.0


FAMILIES: dict[str, Callable[[np.random.Generator], tuple[Linear, Linear, Array, float]]] = {
    "pendulum": pendulum,
    "cart-pole": cart_pole,
    "Furuta pendulum": furuta,
    "cart-pole, cart stiffness -0.3 to -1 1/s^2": lambda random: cart_pole(random, random.uniform(-1.0, -0.3)),
    "Furuta pendulum, resonance between lines": lambda random: furuta(random, random.uniform(0.001, 0.004)),
}
"""Families of pairs; the last two are hard: what fells a loop lies where no line is."""


def distance(name: str, seed: int) -> tuple[Interval, float] | None:
    """Return the nu-gap that the product measures of one pair of a family, and the true one at its frequencies.

    None where the recording's regulator does not hold the machine. The simulation runs at 2 ms.
    """
    model, truth, q, r = FAMILIES[name](np.random.default_rng([1, seed]))
    held = model.regulator(q, r)
    if truth.modulus(held) >= 1.0:
        return None
    known = model.model()
    top, scaling = _task(truth, known, q, r)
    simulation = replace(model, period=0.002, amplitude=truth.amplitude)
    both = [estimate(measured(one, held, at, top=top)) for one, at in ((simulation, seed + 10**6), (truth, seed))]
    found = compare_responses(both[0], both[1], known, scaling)
    graphs = []
    for one in (replace(model, period=truth.period), truth):
        P = one.at(2.0 * np.pi * found.frequency) * scaling.input / scaling.outputs
        graph = np.concatenate([np.ones((1, P.shape[1])), P])
        graphs.append(graph / np.linalg.norm(graph, axis=0))
    inner = np.abs(np.sum(graphs[0].conj() * graphs[1], axis=0))
    return found.nu_gap, float(np.sqrt(np.max(np.maximum(1.0 - inner**2, 0.0))))


def choice(seed: int, runs: int = 3, *, shared: bool = False, count: int = 6) -> tuple[Interval, float] | None:
    """Return the regret of a simulation's pick that the product measures, and the true one, as shares.

    None where a regulator does not hold the machine.

    Args:
        seed: Of plants, regulators and noise.
        runs: Of each regulator, on each side.
        shared: Whether the simulation has the machine's noise.
        count: Regulators.
    """
    model, truth, _, _ = pendulum(np.random.default_rng([1, seed]))
    random = np.random.default_rng([11, seed])
    noise, other = random.uniform(-1.0, 1.0, (2, runs, 500))
    costs: dict[str, dict[str, list[tuple[int, Any]]]] = {}
    expected = {}
    for i in range(count):
        K = model.regulator(np.array([100.0, 0.01]) * 10.0 ** random.uniform(-1.5, 1.5, 2), 0.1)
        if truth.modulus(K) >= 1.0 or model.modulus(K) >= 1.0:
            return None
        (own, _), (theirs, expected[f"{i}"]) = model.costs(K, noise if shared else other), truth.costs(K, noise)
        costs[f"{i}"] = {
            side: [(k, np.array([cost, 0.0, 0.0])) for k, cost in enumerate(side_costs, start=first)]
            for side, side_costs, first in (("sim", own, 0 if shared else runs), ("hw", theirs, 0))
        }
    found = rank(contenders_of(costs))
    return found.regret_share, expected[found.pick] / min(expected.values()) - 1.0


def certificates(name: str, seed: int, cases: int) -> Counter[str]:
    """Count cases of one pair of a family: all, certified, certified and falling, robust, robust and certified."""
    found = judge(*FAMILIES[name](np.random.default_rng([1, seed])), seed, cases)
    count = Counter(pairs=bool(found), cases=len(found))
    for one in found:
        certified = one.product.certified
        count["certified"] += certified
        count["failing"] += certified and not one.stable
        count["robust"] += one.robust
        count["robust certified"] += one.robust and certified
        count["refused for poles"] += bool(one.product.unseen)
        count["refused for a resonance"] += bool(one.product.resonance)
    return count
