"""Measure a plant of several joints and the surrogate of its machine, by one multisine at the driven joint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pendulum_bags.experiments.host_pool import HostPool
from pendulum_bags.experiments.joint_run import JointSettings, record_joints
from pendulum_bags.frequency_response.analyse import LONGER_OF_JOINTS, analyse_responses, read_responses
from pendulum_bags.frequency_response.result import Analysis
from pendulum_bags.frequency_response.write import write_analysis
from pendulum_bags.verdict import write_layer

__all__ = ["FOLDER", "JointMultisine", "measure_joints"]

FOLDER = "frequency_response"
"""Folder within a run folder that holds the recordings under the multisine, and their analysis."""
_HIGHEST = 100.0
"""End of the band [Hz]. The loops of all presets are small there, and there are no lines beyond."""
_LINES = 48


@dataclass(frozen=True)
class JointMultisine:
    """A multisine in place of the noise, whole periods of it.

    Attributes:
        settings: The run.
        periods: Periods that are averaged; one more settles.
        signal_period: Length of one [s]; its inverse is the lowest frequency.
    """

    settings: JointSettings
    periods: int = 8
    signal_period: float = 4.0

    @property
    def run(self) -> JointSettings:
        """The settings of the run, as long as its periods, under an LQR: a response is that of a linear loop."""
        return replace(self.settings, controller="lqr", duration=self.signal_period * (self.periods + 1) + 0.1)

    @property
    def excitation(self) -> dict[str, Any]:
        """Parameters of the disturbance."""
        return {
            "kind": "multisine",
            "signal_period": self.signal_period,
            "frequency": 1.0 / self.signal_period,
            "frequency_end": _HIGHEST,
            "lines": _LINES,
            "hold_time": self.settings.period,
        }


def measure_joints(
    folder: Path,
    multisine: JointMultisine,
    machine: Path,
    designs: Sequence[str] = (),
    *,
    hosts: HostPool | None = None,
    on_side: Callable[[str], None] = lambda side: None,
    on_analysis: Callable[[str], None] = lambda what: None,
) -> Analysis:
    """Record both sides under the multisine, and store the analysis: two layers of the run folder's answer.

    Args:
        folder: The run folder; the recordings, numbers, figures and the page go to its ``frequency_response``.
        multisine: What to run.
        machine: Plant file of the surrogate of the machine.
        designs: As :func:`pendulum_bags.frequency_response.designs.certify_designs` reads them.
        hosts: As for :func:`pendulum_bags.experiments.lockstep.record_run`.
        on_side: Called with each side's name when it starts.
        on_analysis: Called with the next step's text afterwards.

    Raises:
        BagError: A bag exists, or cannot be written.
        DataError: A plant was not excited enough.
        FaultError: A program ended or did not respond, or a plant fell or faulted.
        ParameterError: A text is no design.
    """
    place = folder / FOLDER
    place.mkdir(parents=True, exist_ok=True)
    record_joints(
        place,
        multisine.run,
        machine,
        excitation=multisine.excitation,
        hosts=hosts,
        on_side=on_side,
    )
    on_analysis("analysing")
    responses, plant, _ = read_responses([place])
    longer = f"{LONGER_OF_JOINTS} --plant {multisine.settings.plant}"
    analysis = analyse_responses(responses, plant, designs, longer=longer)
    write_analysis(place, analysis, step=on_analysis)
    for layer in analysis.layers:
        write_layer(folder, layer)
    return analysis
