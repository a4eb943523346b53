"""The analysis of measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pendulum_bags.frequency_response.compare import Difference
from pendulum_bags.frequency_response.designs import DesignResult
from pendulum_bags.verdict import LayerResult
from pendulum_lqr.linear.model import LinearModel
from pendulum_lqr.responses.certificate import Certifier
from pendulum_lqr.responses.gap_metric import DEFAULT_SCALING, SignalScaling
from pendulum_lqr.responses.measured_response import MeasuredResponse

__all__ = ["Analysis"]


@dataclass(frozen=True)
class Analysis:
    """The analysis of responses with the designs' plant; ``difference`` needs both, ``certifier`` the hardware."""

    responses: Sequence[MeasuredResponse]
    model: LinearModel
    plant: str
    difference: Difference | None
    certifier: Certifier | None
    designs: Sequence[DesignResult]
    layers: Sequence[LayerResult]
    scaling: SignalScaling = DEFAULT_SCALING

    @property
    def is_emulated(self) -> bool:
        """Whether an emulator, or a second simulation, replaced the hardware."""
        return any(response.facts.get("emulated") for response in self.responses)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        return {
            "plant": self.plant,
            "scaling": self.scaling.to_json(),
            "responses": {response.label: response.facts for response in self.responses},
            "difference": self.difference.to_json() if self.difference else None,
            "gap_to_model": None
            if self.certifier is None
            else {
                "nu_gap": self.certifier.profile.value,
                "upper": self.certifier.profile.value_upper,
                "at_hz": self.certifier.profile.at,
            },
            "designs": [design.to_json() for design in self.designs],
            "layers": [layer.to_json() for layer in self.layers],
        }
