"""Which friction model, which offsets: by held-out windows first, by parsimony among those that predict as well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.cross_validation import CrossValidation
from pendulum_bags.identification.model import BOUNDS, FRICTION_MODELS, TORQUES
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.solver import Solution

__all__ = [
    "CHOICE",
    "Candidate",
    "admissible",
    "akaike_weights",
    "at_bounds",
    "by_window",
    "choose",
    "effective_samples",
    "implausible_rival",
    "is_plausible",
]

CHOICE = (
    "Chosen: of the models whose held-out error is the least or within one standard error of it, the one of least "
    "information criterion (Akaike)."
)
"""The rule of :func:`choose` in words."""

_CLEARLY = 20.0
"""Lead in the information criterion (a weight of e^-10 for the other) that noise and luck do not explain."""


@dataclass(frozen=True)
class Candidate:
    """One friction model, perhaps with torques of angle and velocity, fitted to all data and cross-validated.

    ``gains`` are the shares by which torques that were tried lower the held-out rms, in words.
    """

    friction: str
    free: tuple[str, ...]
    solution: Solution
    training_rms: float
    validation: CrossValidation | None
    mean_cost: float
    effective: float
    searched: Solution | None = None
    gains: Mapping[str, float] = field(default_factory=dict)

    @property
    def torques(self) -> tuple[str, ...]:
        """Names in words of its torques of angle and velocity."""
        return tuple(words for words, names in TORQUES.items() if set(names) <= set(self.free))

    @property
    def label(self) -> str:
        """Friction model and torques."""
        return ", ".join((self.friction, *self.torques))

    @property
    def as_searched(self) -> Solution:
        """The fit by coarse integration steps, as comparable with the other candidates."""
        return self.solution if self.searched is None else self.searched

    @property
    def score(self) -> float:
        """Held-out rms where there is one, else the training rms [rad]."""
        return self.training_rms if self.validation is None else self.validation.rms


def by_window(parts: Sequence[Array], pieces: Sequence[Piece]) -> list[Array]:
    """Return the residuals of each window of some pieces."""
    return [part[a:b] for part, piece in zip(parts, pieces, strict=True) for a, b in piece.windows]


def effective_samples(windows: Sequence[Array]) -> float:
    """Return how many independent samples carry as much as the correlated residuals do, N / (1 + 2 sum rho)."""
    total, products = 0, np.zeros(min(max(r.size for r in windows), 2000))
    for r in windows:
        total += r.size
        spectrum = np.abs(np.fft.rfft(r, 2 * r.size)) ** 2
        products[: r.size] += np.fft.irfft(spectrum)[: min(r.size, products.size)]
    if products[0] <= 0.0:
        return float(total)
    rho = products / products[0]
    # Sum up to the first zero crossing: beyond it an estimate of rho is noise.
    end = int(np.argmax(rho <= 0.0)) or rho.size
    return float(max(total / (1.0 + 2.0 * np.sum(rho[1:end])), 8.0))


def choose(candidates: Sequence[Candidate], *, strict: bool = False) -> Candidate:
    """Return the candidate of least information criterion among those that predict as well as the best.

    Held-out windows rule out what predicts worse than the best by more than one standard error of the paired
    difference (at least 2 %, the accuracy of the fits without a fold, and at most 25 %, since few folds give no
    honest error); among the rest the training data decide by Akaike's criterion on effective samples, or by Schwarz's
    if ``strict``. Static friction beyond three times the sliding one is left out: it stands for other faults.
    """
    criterion = _criterion(candidates, strict=strict)
    return min(admissible(candidates), key=lambda c: criterion[id(c)])


def akaike_weights(candidates: Sequence[Candidate]) -> dict[int, float]:
    """Return how far the data speak for each candidate, by ``id``; 0 for those that held-out windows rule out.

    Source:
        Burnham and Anderson, Model Selection and Multimodel Inference, 2002, sec. 2.9.
    """
    criterion = _criterion(candidates)
    among = admissible(candidates)
    least = min(criterion[id(c)] for c in among)
    weights = {id(c): 0.0 for c in candidates}
    weights.update({id(c): float(np.exp(-0.5 * (criterion[id(c)] - least))) for c in among})
    total = sum(weights.values())
    return {key: weight / total for key, weight in weights.items()}


def _criterion(candidates: Sequence[Candidate], *, strict: bool = False) -> dict[int, float]:
    # One count for all: what a poor model leaves correlated is its own fault, not a lack of data.
    count = max(candidate.effective for candidate in candidates)

    def penalty(free: int) -> float:
        # With few effective samples a parameter costs more than 2 (Hurvich and Tsai, Biometrika 76, 1989).
        corrected = 2.0 * free * count / max(count - free - 1.0, 1.0)
        return max(float(np.log(count)) * free, corrected) if strict else corrected

    return {id(c): float(count * np.log(max(c.mean_cost, 1e-18)) + penalty(len(c.free))) for c in candidates}


def admissible(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the candidates that held-out windows do not rule out; see :func:`choose`."""
    # A term that ended at nothing leaves a simpler model, which is a candidate of its own.
    candidates = [c for c in candidates if not _is_idle(c)] or list(candidates)
    if any(candidate.validation is None for candidate in candidates):
        return list(candidates)
    candidates = [c for c in candidates if is_plausible(c)] or list(candidates)
    losses = {id(c): c.validation.losses for c in candidates if c.validation is not None}
    best = min(candidates, key=lambda c: float(losses[id(c)].sum()))
    least = float(losses[id(best)].sum())
    found = []
    for candidate in candidates:
        difference = losses[id(candidate)] - losses[id(best)]
        error = float(np.std(difference, ddof=1) * np.sqrt(difference.size)) if difference.size > 1 else 0.0
        if float(difference.sum()) <= np.clip(error, 0.02 * least, 0.25 * least):
            found.append(candidate)
    return found


def _is_idle(candidate: Candidate) -> bool:
    own = {*FRICTION_MODELS[candidate.friction], "quadratic_drag"} & set(candidate.free) - {"coulomb_friction"}
    return any(BOUNDS[name][0] == 0.0 and candidate.solution.model[name] <= 0.0 for name in own)


def is_plausible(candidate: Candidate) -> bool:
    """Return whether static friction is at most three times the sliding one."""
    model = candidate.solution.model
    return model["stribeck_excess"] <= 2.0 * model["coulomb_friction"] + 1e-9


def implausible_rival(candidates: Sequence[Candidate], chosen: Candidate) -> Candidate | None:
    """Return the candidate left out for its static friction that the data clearly speak for, or None.

    The chosen one compensates for it, and no interval of that counts the error.
    """
    rivals = [candidate for candidate in candidates if not is_plausible(candidate)]
    if not rivals or not is_plausible(chosen):
        return None
    criterion = _criterion(candidates)
    best = min(rivals, key=lambda c: criterion[id(c)])
    own = criterion.get(id(chosen), np.inf)
    return best if criterion[id(best)] < own - _CLEARLY else None


def at_bounds(candidate: Candidate) -> list[str]:
    """Return the fitted parameters that ended at the edge of their domain."""
    model = candidate.solution.model
    return [n for n in candidate.free if model[n] <= BOUNDS[n][0] or model[n] >= BOUNDS[n][1]]
