"""Which designs carry over to the machine of a comparison whose frequency response was measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pendulum_bags.comparison import Comparison
from pendulum_bags.frequency_response.analyse import analyse_machine, find_machine
from pendulum_bags.frequency_response.designs import policies_of
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import Layer, LayerResult
from pendulum_bags.verdict.same_run import case_of
from pendulum_msgs_py.errors import DataError

__all__ = ["carry_over", "layers_of"]


def carry_over(
    comparison: Comparison, folders: Sequence[Path], machine: Path | None = None, designs: Sequence[str] = ()
) -> Analysis | None:
    """Return the certificates of designs on the simulated plant for a comparison's machine, or None without a response.

    The response is ``machine`` (file or folder), or that of the first of ``folders`` with one.

    Raises:
        DataError: Designs are given without a response, it cannot be read, or it is of another machine.
        ParameterError: An invalid design.
    """
    place = machine or find_machine(folders)
    if place is None:
        if designs:
            places = ", ".join(map(str, folders)) or "no folder"
            raise DataError(
                f"--design needs the measured response of the machine, and {places} has none; expected --machine or "
                "--layers with the folder of python -m pendulum_bags experiment frequency_response"
            )
        return None
    facts = run_record(comparison.pairs[0].simulation.metadata)
    found = analyse_machine(place, str(facts.get("plant") or "thesis"), designs, policies_of(facts))
    case = case_of(comparison)
    for layer in found.layers:
        case.require_same(layer.case, f"the response in {place}")
    return found


def layers_of(analysis: Analysis | None) -> list[LayerResult]:
    """Return the layer of the verdict from certificates, none without them."""
    return [one for one in (analysis.layers if analysis else ()) if one.layer is Layer.WHICH_CONTROLLERS]
