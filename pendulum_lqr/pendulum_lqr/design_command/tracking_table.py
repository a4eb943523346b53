"""Output of ``design`` for a moving reference: gain, frozen margins and torque along it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from rich.console import Console

from pendulum_lqr.controller_interface.controller import controller_parameters, make_controller
from pendulum_lqr.controller_interface.sampling import ASSUMED_PERIOD
from pendulum_lqr.controllers.lqr_tracking import LqrTracking
from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import suggestion
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.terminal import WholeTable

__all__ = ["design_tracking", "print_tracking", "tracking_document"]

_PERIOD = "period"
_ELSEWHERE = ("q", "r", "effort_limit", "velocity", "start_time")
"""Parameters that other options set, or that do not affect the output."""


def design_tracking(
    texts: Sequence[str], plant: PlantParameters, weights: tuple[Sequence[float], float], effort_limit: float
) -> LqrTracking:
    """Return the controller ``lqr_tracking`` of a command line.

    Args:
        texts: Its parameters, each as ``amplitude=0.3``.
        plant: Plant parameters.
        weights: Diagonal of Q and r.
        effort_limit: Largest torque [N m].

    Raises:
        ParameterError: No such parameter, a value out of domain, or a reference that cannot be followed.
    """
    specs = {spec.name: spec for spec in controller_parameters("lqr_tracking") if spec.name not in _ELSEWHERE}
    values: dict[str, object] = {"q": [*weights[0]], "r": weights[1], "effort_limit": effort_limit}
    period = ASSUMED_PERIOD
    for text in texts:
        name, _, given = text.partition("=")
        if name != _PERIOD and name not in specs:
            raise ParameterError(f"--tracking is {text!r}; {suggestion(name, [*specs, _PERIOD])}, as amplitude=0.3")
        value: object = given
        if name == _PERIOD or isinstance(specs[name].default, float):
            try:
                value = float(given)
            except ValueError as error:
                raise ParameterError(f"--tracking is {text!r}; expected a number, as {name}=0.3") from error
        if name == _PERIOD:
            period = cast("float", value)
        else:
            values[name] = value
    return cast("LqrTracking", make_controller("lqr_tracking", plant, period, values))


def print_tracking(console: Console, controller: LqrTracking, chosen: int) -> None:
    """Print gain and frozen margins of a checked controller over the angle, and the torque of the reference."""
    document = tracking_document(controller)
    table = WholeTable(title="Gain along the reference (lqr_tracking)", title_justify="left", header_style="bold")
    for heading in ("angle \\[rad]", "K", "largest pole, sampled", "modulus"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in document["frozen"]:
        gain = ", ".join(f"{value:.6f}" for value in row["K"])
        table.add_row(f"{row['angle']:.3f}", gain, f"{row['radius']:.4f}", f"{row['modulus']:.3f}")
    console.print(table)
    console.print(
        f"combination {chosen} along {document['reference']} of {document['amplitude']:g} rad at "
        f"{document['frequency']:g} Hz: takes up to {document['effort']:.4g} of {document['effort_limit']:g} N m; a "
        f"deviation dies out with {document['time_constant']:.3g} s (no frozen loop tells that)"
    )


def tracking_document(controller: LqrTracking) -> dict[str, Any]:
    """Return the same as plain values for JSON."""
    margins, reference = controller.margins, controller.reference
    assert margins is not None
    return {
        "reference": reference.shape,
        "set_point": reference.centre,
        "amplitude": reference.amplitude,
        "frequency": reference.frequency,
        "effort": controller.needed,
        "effort_limit": controller.effort_limit,
        "time_constant": margins.time_constant,
        "frozen": [
            {"angle": angle, "K": list(controller.schedule.gain(angle)), "radius": radius, "modulus": modulus}
            for angle, radius, modulus in zip(margins.angles, margins.radii, margins.moduli, strict=True)
        ],
    }
