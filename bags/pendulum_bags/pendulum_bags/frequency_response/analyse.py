"""From one or two recordings to responses, difference, certificates, layers of the verdict and figures."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pendulum_bags.experiments.run_spec import PERIODS
from pendulum_bags.frequency_response.compare import compare_responses
from pendulum_bags.frequency_response.designs import DesignResult, certify_designs, policies_of
from pendulum_bags.frequency_response.estimate import estimate
from pendulum_bags.frequency_response.layers import GAP_MARGIN, LONGER, same_plant, which_controllers
from pendulum_bags.frequency_response.record import INPUT_UNIT, Record, record_of_joints, record_of_run
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.identification.joint_recordings import matched_joints
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.case import IDENTITY, Case
from pendulum_bags.runs.run_record import is_surrogate, run_record
from pendulum_bags.verdict import LayerResult, name_in
from pendulum_lqr.linear.design import output_lqr
from pendulum_lqr.linear.model import linearise
from pendulum_lqr.responses.certificate import Certifier
from pendulum_lqr.responses.gap_metric import DEFAULT_SCALING, JointScaling, Scaling, SignalScaling
from pendulum_lqr.responses.machine_response import Machine
from pendulum_lqr.responses.measured_response import MeasuredResponse, read_response
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_mechanism, load_plant

__all__ = ["analyse_machine", "analyse_responses", "find_machine", "read_responses"]


MACHINE = "hw_response.json"
"""Measured response of the hardware, in a run folder."""
NUMBERS = "frequency_response.json"
"""Results, in a run folder."""


def read_responses(
    paths: Sequence[Path | Reading], names: Sequence[str] = ()
) -> tuple[list[MeasuredResponse], str, list[str]]:
    """Return the responses of one or two recordings or of a folder with ``sim`` and ``hw``, and the designs' plant."""
    readings = [Reading.of(path) for path in paths]
    if len(readings) == 1 and all((readings[0].path / side).is_dir() for side in ("sim", "hw")):
        readings = [replace(readings[0], path=readings[0].path / side, _cache={}) for side in ("sim", "hw")]
    if len(readings) not in {1, 2}:
        raise DataError(
            f"got {len(readings)} recordings; expected one, those of simulation and hardware, or a run folder"
        )
    found: list[MeasuredResponse] = []
    plant = "thesis"
    policies: dict[str, None] = {}
    for i, reading in enumerate(readings):
        record, facts = _read(reading, found[0].joints if found else names)
        side = str(facts.get("side") or str(facts.get("namespace", "")).strip("/"))
        label = side if side in {"sim", "hw"} else ("hw" if len(readings) == 1 or i else "sim")
        plant = _design_plant(reading.path, facts) or plant
        policies |= dict.fromkeys(policies_of(facts))
        measured = estimate(record)
        added = {"emulated": label == "hw" and is_surrogate(facts), IDENTITY: facts.get(IDENTITY, "")}
        found.append(replace(measured, label=label, facts={**measured.facts, **added}))
    if len(found) == 2 and found[0].label == found[1].label:
        # Two of one kind: their order decides which is the reference.
        found = [replace(one, label=label) for one, label in zip(found, ("sim", "hw"), strict=True)]
    return sorted(found, key=lambda response: response.label, reverse=True), plant, list(policies)


def _read(path: Reading, names: Sequence[str]) -> tuple[Record, Mapping[str, Any]]:
    from pendulum_bags.runs.cached_bags import CachedBags
    from pendulum_bags.runs.run_data import joints_of, read_run

    with CachedBags() as bags:
        joints = joints_of(path, open_bag=bags)
        joints = tuple(names) if sorted(names) == sorted(joints) else joints
        if not joints:
            run = read_run(path, or_all=not path.is_bag, open_bag=bags)
            return record_of_run(run), run_record(run.metadata)
        runs = {joint: read_run(path, joint=joint, or_all=not path.is_bag, open_bag=bags) for joint in joints}
    facts = run_record(runs[joints[0]].metadata)
    disturbed = (facts.get("disturbance") or {}).get("joints") or []
    if runs[joints[0]].of_file:
        excited = {joint: run.disturbance or run.followed for joint, run in runs.items()}
        disturbed = [joint for joint, signal in excited.items() if signal is not None and np.ptp(signal.value) > 0.0]
    if len(disturbed) != 1:
        found = ", ".join(disturbed) or "no recorded joint"
        raise DataError(f"{path} has {found} disturbed; expected one joint, so that excitation and response are known")
    return record_of_joints(runs, disturbed[0]), facts


def _design_plant(bag: Path, facts: Mapping[str, Any]) -> str:
    """Return the plant file or preset of a run's design, perhaps next to its bag, or ""."""
    controller = facts.get("controller")
    linearised = controller.get("linearised") if isinstance(controller, Mapping) else None
    if isinstance(linearised, str) and (bag.parent / linearised).is_file():
        return str(bag.parent / linearised)
    return str(facts.get("design_plant") or "")


def analyse_responses(
    responses: Sequence[MeasuredResponse],
    plant: str,
    designs: Sequence[str] = (),
    *,
    scaling: SignalScaling | None = None,
    margin: float | None = None,
    recorded: bool = False,
    longer: str = "",
) -> Analysis:
    """Return the analysis of responses.

    Args:
        designs: As for :func:`pendulum_bags.frequency_response.designs.certify_designs`.
        scaling: Units of the gap; None for the thesis's task, or for several joints those of the LQR weights.
        margin: Acceptable gap between the plants; None for 0.2, or for several joints the margin of the plant's own
            LQR.

    Raises:
        ParameterError: An invalid design; or the plant has other joints than the responses, or several motors.
        DataError: A policy file cannot be read.
    """
    by_label = {response.label: response for response in responses}
    own: PlantParameters
    if responses[0].joints:
        own = mechanism = load_mechanism(plant)
        measured = responses[0]
        matched = matched_joints(measured.joints, [measured.joints[measured.driven]], own.coordinates)
        if matched and tuple(matched[0]) == measured.joints:
            responses = [replace(response, joints=own.coordinates.names) for response in responses]
            by_label = {response.label: response for response in responses}
        _refuse_other_joints(mechanism, responses[0])
        model, (q, r) = linearise(mechanism), mechanism.weights
        scaling = scaling or JointScaling.of_plant(mechanism, model.measured)
        machine = Machine.relative_to(by_label["hw"], model) if "hw" in by_label else None
        longer = longer or f"python -m pendulum_bags experiment joints --plant {plant} --periods 40"
    else:
        own = load_plant(plant)
        model = linearise(own)
        scaling, margin = scaling or DEFAULT_SCALING, GAP_MARGIN if margin is None else margin
        machine = Machine.of(by_label["hw"]) if "hw" in by_label else None
        longer = longer or LONGER
    certifier = Certifier(model, machine, scaling) if machine is not None else None
    difference = None
    results: list[DesignResult] = []
    layers: list[LayerResult] = []
    if certifier is not None and "sim" in by_label:
        if margin is None:  # several joints only
            margin = certifier.gain(output_lqr(model, q, r).K).margin
        difference = compare_responses(by_label["sim"], by_label["hw"], model, scaling)
        layers.append(same_plant(by_label["sim"], by_label["hw"], difference, margin, longer=longer))
    if certifier is not None:
        period = by_label["sim"].period if "sim" in by_label else PERIODS["sim"]
        results = certify_designs(designs, own, certifier, recorded=recorded, period=period)
        layers.append(which_controllers(certifier, results, longer=longer))
    case = Case(*(str(by_label[side].facts.get(IDENTITY, "")) if side in by_label else "" for side in ("sim", "hw")))
    layers = [replace(layer, case=case) for layer in layers]
    found = Analysis(responses, model, plant, difference, certifier, results, layers, scaling)
    return replace(found, layers=name_in(layers, emulated=found.is_emulated))


def _refuse_other_joints(parameters: PlantParameters, measured: MeasuredResponse) -> None:
    coordinates, joints = parameters.coordinates, measured.joints
    driven = joints[measured.driven]
    if coordinates.names != joints or coordinates.driven_names != (driven,):
        raise ParameterError(
            f"plant {parameters.name} has joints {', '.join(coordinates.names)}, driven: "
            f"{', '.join(coordinates.driven_names) or 'none'}; expected {', '.join(joints)}, driven: {driven} alone, "
            "as they were measured"
        )
    if (measured.facts.get(INPUT_UNIT) == "V") != coordinates.volts:
        raise ParameterError(
            f"plant {parameters.name} is driven in {coordinates.drive_unit}; expected one driven "
            f"{'by an effort' if coordinates.volts else 'in V'}, as the input was measured"
        )


def find_machine(folders: Sequence[Path]) -> Path | None:
    """Return the first folder with the measured response of a machine, or None."""
    return next((folder for folder in folders if (folder / MACHINE).is_file()), None)


def analyse_machine(machine: Path, plant: str, designs: Sequence[str] = (), ran: Sequence[str] = ()) -> Analysis:
    """Return which designs carry over to a machine that was measured before.

    Args:
        designs: As for :func:`pendulum_bags.frequency_response.designs.certify_designs`; by default those certified
            with the measurement, else the thesis's four combinations.
        ran: Policy files that ran in the recording, certified too unless ``designs`` are given.

    Raises:
        DataError: The file holds no response.
        ParameterError: An invalid design.
    """
    measured = replace(read_response(machine), label="hw")
    stored = _stored(machine)
    return analyse_responses(
        [measured],
        plant,
        designs or list(dict.fromkeys([*stored.designs, *ran])),
        scaling=stored.scaling,
        recorded=not designs,
    )


class _Stored(NamedTuple):
    designs: Sequence[str] = ()
    scaling: SignalScaling = DEFAULT_SCALING


def _stored(machine: Path) -> _Stored:
    path = (machine if machine.is_dir() else machine.parent) / NUMBERS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return _Stored([one["text"] or one["name"] for one in content["designs"]], Scaling(**content["scaling"]))
    except (OSError, ValueError, KeyError, TypeError):
        return _Stored()
