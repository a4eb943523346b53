"""From one or two recordings to responses, difference, certificates, layers of the verdict and figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from pendulum_bags.figures.render_files import write_figures
from pendulum_bags.frequency_response.compare import compare_responses
from pendulum_bags.frequency_response.designs import DesignResult, certify_designs, design_text, policies_of
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.figures import response_figures
from pendulum_bags.frequency_response.layers import GAP_MARGIN, same_plant, which_controllers
from pendulum_bags.frequency_response.page import write_page
from pendulum_bags.frequency_response.record import record_of_run
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_bags.verdict import LayerResult, write_layer
from pendulum_lqr.certificate import Certifier
from pendulum_lqr.gap_metric import DEFAULT_SCALING, Scaling
from pendulum_lqr.machine_response import Machine
from pendulum_lqr.measured_response import MeasuredResponse, read_response, write_response
from pendulum_lqr.model import linearise
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import load_plant

__all__ = [
    "analyse_machine",
    "analyse_responses",
    "find_machine",
    "read_responses",
    "write_analysis",
]


MACHINE = "hw_response.json"
"""File in which a run folder keeps the measured response of its hardware."""
NUMBERS = "frequency_response.json"
"""File in which it keeps what was found."""


def read_responses(paths: Sequence[Path]) -> tuple[list[MeasuredResponse], str, list[str]]:
    """Return the measured responses of bags or of a run folder, simulation first, and the plant they were designed on.

    Args:
        paths: One or two bags, or a folder that holds ``sim`` and ``hw``.

    Raises:
        BagError: A bag cannot be read.
        DataError: It holds no excited plant, or both are of one side.
    """
    # Late: it needs a reader, which the rest of this room does not.
    from pendulum_bags.comparison import compare_runs  # noqa: F401
    from pendulum_bags.runs.run_data import read_run

    if len(paths) == 1 and (paths[0] / "sim").is_dir() and (paths[0] / "hw").is_dir():
        paths = [paths[0] / "sim", paths[0] / "hw"]
    if len(paths) not in {1, 2}:
        raise DataError(f"got {len(paths)} bags; expected one, a simulation and a hardware bag, or a run folder")
    runs = [read_run(path) for path in paths]
    found = []
    plant = "thesis"
    policies: dict[str, None] = {}
    for i, run in enumerate(runs):
        facts = run_record(run.metadata)
        side = str(facts.get("side") or str(facts.get("namespace", "")).strip("/"))
        label = side if side in {"sim", "hw"} else ("hw" if len(runs) == 1 or i else "sim")
        plant = str(facts.get("design_plant") or plant)
        policies |= dict.fromkeys(policies_of(facts))
        measured = estimate(record_of_run(run))
        found.append(_labelled(measured, label))
    if len(found) == 2 and found[0].label == found[1].label:
        # Two of one kind: the order in which they were given tells which is held against which.
        found = [_labelled(found[0], "sim"), _labelled(found[1], "hw")]
    return sorted(found, key=lambda response: response.label, reverse=True), plant, list(policies)


def _labelled(measured: MeasuredResponse, label: str) -> MeasuredResponse:
    return MeasuredResponse.from_json({**measured.to_json(), "label": label})


def analyse_responses(
    responses: Sequence[MeasuredResponse],
    plant: str,
    designs: Sequence[str] = (),
    *,
    scaling: Scaling = DEFAULT_SCALING,
    margin: float = GAP_MARGIN,
    recorded: bool = False,
) -> Analysis:
    """Return what responses tell.

    Args:
        responses: Simulation first.
        plant: Preset or file of the plant that designs are made on.
        designs: As :func:`pendulum_bags.frequency_response.designs.certify_designs` reads them.
        scaling: Units of the gap.
        margin: Gap between the plants that does not matter.
        recorded: Whether the designs come from a recording, not from who asks now.
    """
    parameters = load_plant(plant)
    model = linearise(parameters)
    by_label = {response.label: response for response in responses}
    difference = certifier = None
    results: list[DesignResult] = []
    layers: list[LayerResult] = []
    if "sim" in by_label and "hw" in by_label:
        difference = compare_responses(by_label["sim"], by_label["hw"], model, scaling)
        layers.append(same_plant(by_label["sim"], by_label["hw"], difference, margin))
    if "hw" in by_label:
        certifier = Certifier(model, Machine.of(by_label["hw"]), scaling)
        results = certify_designs(designs, parameters, model, certifier, recorded=recorded)
        layers.append(which_controllers(certifier, results))
    return Analysis(responses, model, plant, difference, certifier, results, layers, scaling)


def find_machine(folders: Sequence[Path]) -> Path | None:
    """Return the first folder that keeps the measured response of a machine, None where none does."""
    return next((folder for folder in folders if (folder / MACHINE).is_file()), None)


def analyse_machine(machine: Path, plant: str, designs: Sequence[str] = (), ran: Sequence[str] = ()) -> Analysis:
    """Return which designs carry over to a machine that was measured before.

    Args:
        machine: Measured response, or the folder that keeps it.
        plant: Preset or file of the plant that designs are made on.
        designs: As :func:`pendulum_bags.frequency_response.designs.certify_designs` reads them; by default those that
            were certified when it was measured, and else the four combinations of the thesis.
        ran: Policy files that ran in the recording; they are asked about too, unless ``designs`` says of what.

    Raises:
        DataError: The file holds no response.
        ParameterError: A text is no design.
    """
    measured = replace(read_response(machine), label="hw")
    kept = _kept(machine)
    return analyse_responses(
        [measured],
        plant,
        designs or list(dict.fromkeys([*kept.designs, *ran])),
        scaling=kept.scaling,
        recorded=not designs,
    )


class _Kept(NamedTuple):
    """With what a machine was judged when it was measured."""

    designs: Sequence[str] = ()
    scaling: Scaling = DEFAULT_SCALING


def _kept(machine: Path) -> _Kept:
    """Return what lies beside a measured response; defaults where nothing does."""
    path = (machine if machine.is_dir() else machine.parent) / NUMBERS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return _Kept(
            [one.get("text") or design_text(one["name"]) for one in content["designs"]], Scaling(**content["scaling"])
        )
    except (OSError, ValueError, KeyError, TypeError):
        return _Kept()


def write_analysis(
    folder: Path,
    analysis: Analysis,
    formats: Sequence[str] = ("png", "pdf"),
    step: Callable[[str], None] = lambda _: None,
) -> Path:
    """Write responses, layers, numbers, figures and a page into a folder; return the page.

    Args:
        folder: Where to.
        analysis: What to write.
        formats: Of the figures.
        step: Called with what is written next.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for response in analysis.responses:
        write_response(folder / f"{response.label}_response.json", response)
    for layer in analysis.layers:
        write_layer(folder, layer)
    write_json(folder / NUMBERS, analysis.to_json())
    step("drawing")
    # Thousands of small matrices: threads of the linear algebra would only get into each other's way.
    with threadpool_limits(1):
        figures = response_figures(
            analysis.responses, analysis.model, analysis.difference, analysis.certifier, analysis.designs
        )
    write_figures(figures, folder / "figures", formats)
    return write_page(folder / "frequency_response.html", analysis, figures)
