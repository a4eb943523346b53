"""Designs to be certified: as a person writes them, and what was found of each."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pendulum_lqr.certificate import Certificate, Certifier
from pendulum_lqr.controller_response import controller_response
from pendulum_lqr.design import output_lqr
from pendulum_lqr.design_cli import THESIS_WEIGHTS
from pendulum_lqr.model import LinearModel
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["DesignResult", "certify_designs", "design_rows", "design_text"]

_NUMBER = r"[-+0-9.eE]+"
_WEIGHTS = re.compile(rf"q=({_NUMBER}),({_NUMBER})(?:[ ;]+r=({_NUMBER}))?")
_GAIN = re.compile(rf"k=({_NUMBER}),({_NUMBER})")


@dataclass(frozen=True)
class DesignResult:
    """One design and its certificate.

    Attributes:
        name: As in tables.
        K: Gain on [theta, theta_dot] [N m/rad, N m s/rad]; None for a controller that is no gain.
        certificate: What is known of it.
    """

    name: str
    K: tuple[float, float] | None
    certificate: Certificate

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        found = self.certificate
        return {
            "name": self.name,
            "K": list(self.K) if self.K is not None else None,
            "certified": found.certified,
            "by_gap": found.by_gap,
            "by_frequency": found.by_frequency,
            "margin": found.margin,
            "loop_distance": found.distance,
            "loop_distance_at_hz": found.at,
            "stable_on_model": found.stable_on_model,
            "modulus_on_hardware": found.worst_modulus,
        }


def certify_designs(
    texts: Sequence[str], plant: PlantParameters, model: LinearModel, certifier: Certifier
) -> list[DesignResult]:
    """Return the certificates of designs that were made on a plant.

    Args:
        texts: ``q=100,0.01 r=0.1`` for LQR, ``k=33,0.2`` for a gain, or a controller's name; none for the four
            combinations of the thesis.
        plant: The plant.
        model: Its linear model.
        certifier: Of the model and the measured machine.

    Raises:
        ParameterError: A text is no design.
    """
    asked = list(texts) or [f"q={q[0]:g},{q[1]:g} r={r:g}" for q, r in THESIS_WEIGHTS]
    return [_one(text.strip(), plant, model, certifier) for text in asked]


def design_rows(designs: Sequence[DesignResult]) -> list[tuple[str, ...]]:
    """Return the table of designs as text: row, design, margin, loop distance, modulus on the hardware, certified."""
    rows: list[tuple[str, ...]] = []
    for number, design in enumerate(designs, 1):
        found = design.certificate
        how = "by its margin" if found.by_gap else "by frequency" if found.by_frequency else "no"
        if found.undecided:
            how = "undecided: measure longer"
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


def design_text(name: str) -> str:
    """Return the text that :func:`certify_designs` reads for a design of a name in a table."""
    return re.sub(r"^K=", "k=", re.sub(r"\(([^()]+), ([^()]+)\)", r"\1,\2", name.removeprefix("LQR ")))


def _one(text: str, plant: PlantParameters, model: LinearModel, certifier: Certifier) -> DesignResult:
    try:
        if match := _WEIGHTS.fullmatch(text):
            q11, q22, r = (float(part) if part else 0.1 for part in match.groups())
            K = np.asarray(output_lqr(model, (q11, q22), r).K, dtype=np.float64)[:2]
            name = f"LQR q=({q11:g}, {q22:g}) r={r:g}"
        elif match := _GAIN.fullmatch(text):
            K = np.array([float(part) for part in match.groups()])
            name = f"K=({K[0]:g}, {K[1]:g})"
        else:
            machine = certifier.machine
            response, stable = controller_response(text, plant, machine.frequency, machine.period)
            return DesignResult(text, None, certifier.feedback(response, stable=stable))
    except ParameterError:
        raise
    except ValueError as error:
        raise ParameterError(
            f"design is {text!r}; expected 'q=100,0.01 r=0.1', 'k=33,0.2' or the name of a controller"
        ) from error
    return DesignResult(name, (float(K[0]), float(K[1])), certifier.gain(K))
