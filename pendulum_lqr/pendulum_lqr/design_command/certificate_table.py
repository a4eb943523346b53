"""Output of ``design --machine``: certificates of a design table's rows for a measured machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from pendulum_lqr.design_command.design_tables import RowTable
from pendulum_lqr.linear.design import Gain
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.certificate import Certificate, Certifier
from pendulum_lqr.responses.gap_metric import JointScaling
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import read_response
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters

__all__ = ["certificate_document", "certify_rows", "print_certificates"]


def certify_rows(
    path: Path, plant: PlantParameters, model: LinearModel, gains: Sequence[Gain]
) -> tuple[Certifier, list[Certificate]]:
    """Return the certificates of a table's gains of one motor, for a model of the plant at the upright position.

    Raises:
        ParameterError: The designs are not for upright, or the response is of other joints.
        DataError: The file, or run folder, holds no response.
    """
    if tuple(model.position) != plant.coordinates.goal:
        raise ParameterError(
            f"--machine was measured upright and the design is for theta = {model.theta:.4f} rad; expected pi"
        )
    measured = read_response(path)
    ours = () if plant.is_pendulum else plant.coordinates.names
    if measured.joints != ours:
        raise ParameterError(
            f"--machine {path} was measured on {', '.join(measured.joints) or 'a plant of one joint'}; expected "
            f"{', '.join(ours) or 'one joint'}, as {plant.name}"
        )
    if plant.is_pendulum:
        certifier = Certifier(model, Machine.of(measured))
    else:
        scaling = JointScaling.of_plant(plant, model.measured)
        certifier = Certifier(model, Machine.relative_to(measured, model), scaling)
    return certifier, [certifier.gain(gain.K) for gain in gains]


def print_certificates(console: Console, certifier: Certifier, found: Sequence[Certificate], chosen: int) -> None:
    """Print one line per row with the chosen one marked, and the meaning of certificates."""
    profile, machine = certifier.profile, certifier.machine
    headings = ("#", "margin b", "loop distance", "modulus there", "certified")
    table = RowTable("Certified for this machine", headings)
    for index, one in enumerate(found, start=1):
        how = "by its margin" if one.by_gap else "by frequency"
        table.add(
            index,
            f"{one.margin:.3f}",
            f"{one.distance:.3f} at {one.at:.2g} Hz" if one.stable_on_model else "unstable on the model",
            f"{one.worst_modulus:.3f}",
            f"yes, {how}" if one.certified else "measure longer" if one.undecided else "no",
            chosen=chosen,
        )
    console.print(table)
    console.print(
        f"The nu-gap between model and machine is {profile.value:.3f}, at most {profile.value_upper:.3f} with "
        f"{100.0 * machine.confidence:g} % confidence, largest at {profile.at:.2g} Hz: a margin b above it, or a loop "
        f"distance below 1 at each frequency, stabilises the machine at its {1.0 / machine.period:g} Hz. "
        f"{profile.scaling.sentence()} Torque limits and dry friction at rest are outside the certificate."
    )


def certificate_document(certifier: Certifier, found: Sequence[Certificate]) -> dict[str, Any]:
    """Return the certificates as JSON values."""
    profile = certifier.profile
    return {
        "nu_gap": profile.value,
        "nu_gap_upper": profile.value_upper,
        "at_hz": profile.at,
        "scaling": profile.scaling.to_json(),
        "rows": [
            {
                "combination": index,
                "certified": one.certified,
                "by_gap": one.by_gap,
                "by_frequency": one.by_frequency,
                "margin": one.margin,
                "loop_distance": one.distance,
                "loop_distance_at_hz": one.at,
                "worst_modulus": one.worst_modulus,
            }
            for index, one in enumerate(found, start=1)
        ],
    }
