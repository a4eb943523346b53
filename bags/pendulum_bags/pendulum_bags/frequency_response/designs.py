"""Designs to be certified: as text, and the result of each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_lqr.design_command.design_cli import THESIS_WEIGHTS
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.policies.policy_file import POLICY_SUFFIX, load_policy
from pendulum_lqr.responses.certificate import Certificate, Certifier
from pendulum_lqr.responses.controller_response import controller_response
from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = ["DesignResult", "certify_designs", "design_rows", "design_text", "designs_table", "policies_of"]

_NUMBER = r"[-+0-9.eE]+"
_WEIGHTS = re.compile(rf"q=({_NUMBER}),({_NUMBER})(?:[ ;]+r=({_NUMBER}))?")
_LARGER = 10.0
"""A law is linear near upright if it responds to disturbances of this size as to those of size 1 ..."""
_NOT_LINEAR = 0.1
"""... within this share at each frequency, angle and velocity counted in units of the task."""
_GAIN = re.compile(rf"k=({_NUMBER}),({_NUMBER})")


@dataclass(frozen=True)
class DesignResult:
    """One design and its certificate.

    Attributes:
        name: As in tables.
        K: Gain on [theta, theta_dot] [N m/rad, N m s/rad], or on those of k joints; None for a controller that is no
            gain.
        certificate: Its certificate.
        unknown: Why it has no certificate, as text; empty where there is a certificate.
        text: What :func:`certify_designs` reads for it, where that is not the name.
    """

    name: str
    K: tuple[float, ...] | None
    certificate: Certificate
    unknown: str = ""
    text: str = ""

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


def certify_designs(
    texts: Sequence[str], plant: PlantParameters, model: LinearModel, certifier: Certifier, *, recorded: bool = False
) -> list[DesignResult]:
    """Return the certificates of designs that were made on a plant.

    Args:
        texts: ``q=100,0.01 r=0.1`` for LQR, ``k=33,0.2`` for a gain, a controller's name or a policy file; none for the
            four combinations of the thesis.
        plant: The plant.
        model: Its linear model.
        certifier: Of the model and the measured machine.
        recorded: Whether they are from an earlier run: a policy file that cannot be read any more is then unknown.

    Raises:
        ParameterError: A text is no design, or a policy is not for the plant.
        DataError: A policy file cannot be read.
    """
    asked = list(texts) or [f"q={q[0]:g},{q[1]:g} r={r:g}" for q, r in THESIS_WEIGHTS]
    found = []
    for text in map(str.strip, asked):
        if text.endswith(POLICY_SUFFIX):
            found.append(_policy(text, plant, certifier, recorded=recorded))
        else:
            found.append(_one(text, plant, model, certifier))
    return found


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


def design_text(name: str) -> str:
    """Return the text that :func:`certify_designs` reads for a design of a name in a table."""
    return re.sub(r"^K=", "k=", re.sub(r"\(([^()]+), ([^()]+)\)", r"\1,\2", name.removeprefix("LQR ")))


def policies_of(record: Mapping[str, Any]) -> list[str]:
    """Return the policy file that ran in a recorded run, as a list; empty for any other controller.

    Args:
        record: A bag's metadata of its run.
    """
    controller = record.get("controller")
    file = controller.get("policy") if isinstance(controller, Mapping) else None
    return [file] if isinstance(file, str) and file.endswith(POLICY_SUFFIX) else []


def _policy(path: str, plant: PlantParameters, certifier: Certifier, *, recorded: bool) -> DesignResult:
    """Return the certificate of a learned policy around upright, by its responses to disturbances of two sizes."""
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
                f"it answers every {own:g} s, and the hardware was measured every {machine.period:g} s",
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
            f"it is no linear law near upright: its answer to disturbances {_LARGER:g} times as large differs by "
            f"{100.0 * change:.0f} %"
        )
    return DesignResult(name, None, certifier.feedback(answers[0][0], stable=True), unknown, text)


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
