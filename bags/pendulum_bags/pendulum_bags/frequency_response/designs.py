"""Designs to be certified, as text, and their results."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pendulum_bags.experiments.run_spec import PERIODS
from pendulum_lqr.design_command.design_cli import THESIS_WEIGHTS
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.linear.sampled_design import discretise
from pendulum_lqr.policies.policy_file import POLICY_SUFFIX, load_policy
from pendulum_lqr.responses.certificate import Certificate, Certifier, is_stable
from pendulum_lqr.responses.controller_response import controller_response
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = [
    "Design",
    "DesignResult",
    "certify_designs",
    "design_rows",
    "designs_table",
    "lqr_name",
    "policies_of",
    "read_designs",
]

_NUMBERS = r"[-+0-9.eE]+(?:,[-+0-9.eE]+)*"
_WEIGHTS = re.compile(rf"q=({_NUMBERS})(?:[ ;]+r=({_NUMBERS}))?")
_GAIN = re.compile(rf"k=({_NUMBERS})")
_OTHER_COSTS = (1.0, 0.1, 10.0, 100.0)
"""Costs of the effort of the default designs of several joints, relative to the plant's own LQR."""
_LARGER = 10.0
"""A law is linear near upright if its response to disturbances of this size is that to size 1 ..."""
_NOT_LINEAR = 0.1
"""... within this share at each frequency, in units of the task."""


@dataclass(frozen=True)
class Design:
    """A static gain ``K`` on the measured states, shape (2 k,) for k joints."""

    name: str
    text: str
    K: NDArray[np.float64]


@dataclass(frozen=True)
class DesignResult:
    """One design and its certificate.

    Attributes:
        K: Gain on [theta, theta_dot] [N m/rad, N m s/rad], or on those of k joints; None if the controller is no gain.
        unknown: Why it has no certificate, as text, or empty.
        text: Its text for :func:`certify_designs`, if that is not the name.
        rejected: Whether the simulation rejects it: unstable on the model at the periods of both sides.
    """

    name: str
    K: tuple[float, ...] | None
    certificate: Certificate
    unknown: str = ""
    text: str = ""
    rejected: bool = False

    @property
    def certified(self) -> bool:
        """Whether it is certified for the measured machine."""
        return self.certificate.certified and not self.unknown

    @property
    def undecided(self) -> bool:
        """Whether it is neither certified nor refused."""
        return self.certificate.undecided or bool(self.unknown)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        found = self.certificate
        return {
            "name": self.name,
            "K": list(self.K) if self.K is not None else None,
            "certified": self.certified,
            "unknown": self.unknown,
            "text": self.text,
            "by_gap": found.by_gap,
            "by_frequency": found.by_frequency,
            "margin": found.margin,
            "loop_distance": found.distance,
            "loop_distance_at_hz": found.at,
            "stable_on_model": found.stable_on_model,
            "unseen_from_hz": found.unseen,
            "resonance_at_hz": found.resonance,
            "hidden_damping": found.hidden_damping,
            "modulus_on_hardware": found.worst_modulus,
        }


def read_designs(texts: Sequence[str], plant: PlantParameters, model: LinearModel) -> list[Design]:
    """Return LQRs and gains for one driven of several joints; a ParameterError if a text is no design."""
    cost = plant.weights[1]
    return [_static(text, cost, model) for text in _asked(texts, plant)]


def certify_designs(
    texts: Sequence[str],
    plant: PlantParameters,
    certifier: Certifier,
    *,
    recorded: bool = False,
    period: float = PERIODS["sim"],
) -> list[DesignResult]:
    """Return the certificates of designs that were made on a plant.

    Args:
        texts: ``q=100,0.01 r=0.1`` for LQR, positions before velocities, ``k=33,0.2`` for a gain; for one joint also a
            controller's name or a policy file. None for the thesis's four combinations, or for several joints the
            plant's own LQR and three with another cost of the effort.
        recorded: Whether they are from an earlier run: an unreadable policy file is then unknown.
        period: Of the simulation [s], which may stabilise what the hardware's longer one cannot.

    Raises:
        ParameterError: An invalid design, or a policy for another plant.
        DataError: A policy file cannot be read.
    """
    cost = plant.weights[1]
    simulated = discretise(certifier.plant, period)
    found = []
    for text in _asked(texts, plant):
        if not plant.is_pendulum or text.startswith(("q=", "k=")):
            one = _static(text, cost, certifier.plant)
            certificate = certifier.gain(one.K)
            rejected = not (certificate.stable_on_model or is_stable(simulated, one.K))
            gain = tuple(map(float, one.K))
            found.append(DesignResult(one.name, gain, certificate, text=text, rejected=rejected))
        elif text.endswith(POLICY_SUFFIX):
            found.append(_policy(text, plant, certifier, recorded=recorded))
        else:
            machine = certifier.machine
            response, stable = controller_response(text, plant, machine.frequency, machine.period)
            certificate = certifier.feedback(response, stable=stable)
            rejected = not (stable or controller_response(text, plant, machine.frequency[:1], period)[1])
            found.append(DesignResult(text, None, certificate, rejected=rejected))
    return found


def _asked(texts: Sequence[str], plant: PlantParameters) -> list[str]:
    usual: Sequence[tuple[tuple[float, ...], float]] = THESIS_WEIGHTS
    if not plant.is_pendulum:
        q, r = plant.weights
        usual = [(q, r * share) for share in _OTHER_COSTS]
    written = (f"q={','.join(f'{weight:g}' for weight in q)} r={r:g}" for q, r in usual)
    return [text.strip() for text in list(texts) or written]


def lqr_name(weights: Sequence[float], cost: float) -> str:
    """Return the name of an LQR in tables."""
    return f"LQR q=({', '.join(f'{value:g}' for value in weights)}) r={cost:g}"


def _static(text: str, own_cost: float, model: LinearModel) -> Design:
    size = len(model.measured)
    if match := _WEIGHTS.fullmatch(text):
        weights, costs = _numbers(match[1]), _numbers(match[2] or f"{own_cost}")
        if len(weights) == size and len(costs) == 1:
            K = np.asarray(output_lqr(model, weights, costs[0]).K, dtype=np.float64)
            return Design(lqr_name(weights, costs[0]), text, K)
    elif match := _GAIN.fullmatch(text):
        gain = _numbers(match[1])
        if len(gain) == size:
            return Design(f"K=({', '.join(f'{value:g}' for value in gain)})", text, np.array(gain))
    raise ParameterError(
        f"design is {text!r}; expected 'q=... r=...' or 'k=...' with {size} numbers for q or k, for "
        f"{', '.join(model.measured)}, and one for r"
    )


def _numbers(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def design_rows(designs: Sequence[DesignResult]) -> list[tuple[str, ...]]:
    """Return the table of designs as text: row, design, margin, loop distance, modulus on the hardware, certified."""
    rows: list[tuple[str, ...]] = []
    for number, design in enumerate(designs, 1):
        found = design.certificate
        if design.unknown:
            rows.append((str(number), design.name, "–", "–", "–", f"unknown: {design.unknown}"))
            continue
        how = "by its margin" if found.by_gap else "by frequency" if found.by_frequency else "no"
        if found.undecided:
            how = "undecided: error far too large" if found.far else "undecided: measure longer"
        if found.resonance and found.undecided:
            how = f"undecided: resonance near {found.resonance:.2g} Hz"
        if found.unseen:
            how = f"undecided: measure from {found.unseen:.2g} Hz"
        rows.append(
            (
                str(number),
                design.name,
                f"{found.margin:.3f}",
                f"{found.distance:.2f} at {found.at:.2g} Hz" if found.stable_on_model else "unstable on the model",
                f"{found.worst_modulus:.2f}",
                f"yes, {how}" if found.certified else how,
            )
        )
    return rows


def designs_table(designs: Sequence[DesignResult]) -> WholeTable:
    """Return the table of designs for the terminal."""
    headings = ("row", "design", "margin b", "loop distance", "modulus on hw", "certified")
    table = WholeTable(*headings, title="\nDesigns", title_justify="left")
    for row in design_rows(designs):
        table.add_row(*row)
    return table


def policies_of(record: Mapping[str, Any]) -> list[str]:
    """Return the policy file of a run, from its bag's metadata, as a list; empty for other controllers."""
    controller = record.get("controller")
    file = controller.get("policy") if isinstance(controller, Mapping) else None
    return [file] if isinstance(file, str) and file.endswith(POLICY_SUFFIX) else []


def _policy(path: str, plant: PlantParameters, certifier: Certifier, *, recorded: bool) -> DesignResult:
    machine = certifier.machine
    name, text = f"policy {Path(path).name}", str(Path(path).expanduser().resolve())
    nothing = certifier.feedback(np.zeros((2, machine.frequency.size), dtype=np.complex128), stable=False)
    try:
        own = load_policy(path).period
        if round(own / machine.period) != 1:
            return DesignResult(
                name,
                None,
                nothing,
                f"it commands every {own:g} s, and the hardware was measured every {machine.period:g} s",
                text,
            )
        values = {"policy": text}
        answers = [
            controller_response("policy", plant, machine.frequency, machine.period, values, size)
            for size in (1.0, _LARGER)
        ]
    except PendulumError as error:
        if not recorded:
            raise
        return DesignResult(name, None, nothing, str(error), text)
    if not all(stable for _, stable in answers):
        return DesignResult(
            name, None, nothing, "its loop with the model does not settle near upright, so it has no linear law", text
        )
    units = certifier.scaling.outputs
    small, large = (np.linalg.norm(units * K, axis=0) for K in (answers[0][0], answers[1][0] - answers[0][0]))
    change = float(np.max(large / small))
    unknown = ""
    if change > _NOT_LINEAR:
        unknown = (
            f"it is no linear law near upright: its response to disturbances {_LARGER:g} times as large differs by "
            f"{100.0 * change:.0f} %"
        )
    return DesignResult(name, None, certifier.feedback(answers[0][0], stable=True), unknown, text)
