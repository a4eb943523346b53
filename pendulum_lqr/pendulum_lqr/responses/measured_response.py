"""A measured frequency response with its error estimate, as an object and as a file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special
from numpy.typing import NDArray

from pendulum_msgs_py.atomic_write import write_atomically, writing
from pendulum_msgs_py.errors import DataError, ParameterError

__all__ = ["FORMAT", "MeasuredResponse", "read_response", "write_response"]

FORMAT = "pendulum_frequency_response/1"

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class MeasuredResponse:
    """Sampled plant from torque (held over a period) to angle and velocity, measured in closed loop.

    A plant of k joints, one of them driven, has 2 k outputs: all positions, then all velocities. The error is circular
    complex: ``|measured - true|^2 / deviation^2`` follows F(2, 2 (blocks - 1)).

    Attributes:
        label: Of the plant, such as ``hw``.
        period: Sampling period [s].
        frequency: Shape (n,), increasing [Hz].
        response: Angle and velocity per torque, shape (2, n) [rad/(N m), rad/s/(N m)].
        deviation: Standard deviation of both, shape (2, n), in their units.
        coherence: Share of the output's power explained by the excitation, shape (2, n), 0 to 1.
        sensitivity: Torque at the plant per torque of excitation, 1/(1 + K P), shape (n,).
        blocks: Number of independent periods (or segments).
        distortion: Angle and velocity on unexcited lines, relative to excited ones, shape (2,); NaN if not measured
            [-].
        facts: Source, excitation, duration, largest angle and torque.
        joints: Names of the k joints; none for a plant of one.
        driven: Index of the driven joint.
    """

    label: str
    period: float
    frequency: Array
    response: Complex
    deviation: Array
    coherence: Array
    sensitivity: Complex
    blocks: float
    distortion: tuple[float, float] = (float("nan"), float("nan"))
    facts: Mapping[str, Any] = field(default_factory=dict)
    joints: tuple[str, ...] = ()
    driven: int = 0

    def __post_init__(self) -> None:
        n = self.frequency.size
        outputs = (self.outputs, n)
        for name, shape in (
            ("frequency", (n,)),
            ("response", outputs),
            ("deviation", outputs),
            ("coherence", outputs),
            ("sensitivity", (n,)),
        ):
            found = getattr(self, name)
            if found.shape != shape or not np.all(np.isfinite(found)):
                raise DataError(f"response of {self.label}: {name} has shape {found.shape}; expected {shape}, finite")
        if n == 0 or not (self.period > 0.0 and self.blocks > 1.0 and np.all(np.diff(self.frequency) > 0.0)):
            raise DataError(
                f"response of {self.label} has {n} lines, a period of {self.period} s and {self.blocks} blocks; "
                "expected increasing frequencies, a period > 0 and at least 2 blocks"
            )

    @property
    def outputs(self) -> int:
        """Number of outputs: 2 of one joint, 2 k of k."""
        return 2 * max(1, len(self.joints))

    @property
    def driven_velocity(self) -> int:
        """Index of the output that is the driven joint's velocity."""
        return self.outputs // 2 + self.driven

    def radius(self, *, joint: bool = True) -> Array:
        """Return the radius of each 95 % disc, shape (outputs, n); ``joint``: for all together (Bonferroni)."""
        tail = (1.0 - 0.95) / (self.response.size if joint else 1)
        # scipy.stats gives the same number, but takes a third of a second to import.
        quantile = float(scipy.special.fdtri(2.0, 2.0 * (self.blocks - 1.0), 1.0 - tail))
        return np.sqrt(quantile) * self.deviation

    def to_json(self) -> dict[str, Any]:
        """Return JSON values; complex numbers as two lists."""
        return {
            "format": FORMAT,
            "label": self.label,
            "period": self.period,
            "blocks": self.blocks,
            "frequency": self.frequency.tolist(),
            **{
                name: {"real": getattr(self, name).real.tolist(), "imag": getattr(self, name).imag.tolist()}
                for name in ("response", "sensitivity")
            },
            "deviation": self.deviation.tolist(),
            "coherence": self.coherence.tolist(),
            "distortion": [value if np.isfinite(value) else None for value in self.distortion],
            "facts": dict(self.facts),
            **({"joints": list(self.joints), "driven": self.driven} if self.joints else {}),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> MeasuredResponse:
        """Return the response in JSON values; DataError if there is none."""
        if not isinstance(content, Mapping) or content.get("format") != FORMAT:
            found = content.get("format") if isinstance(content, Mapping) else type(content).__name__
            raise DataError(f"format is {found!r}; expected {FORMAT!r}")
        try:
            first, second = content["distortion"]
            return cls(
                str(content["label"]),
                float(content["period"]),
                np.array(content["frequency"], dtype=np.float64),
                _complex(content["response"]),
                np.array(content["deviation"], dtype=np.float64),
                np.array(content["coherence"], dtype=np.float64),
                _complex(content["sensitivity"]),
                float(content["blocks"]),
                (np.nan if first is None else float(first), np.nan if second is None else float(second)),
                dict(content["facts"]),
                tuple(map(str, content.get("joints", ()))),
                int(content.get("driven", 0)),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"the content is no measured response: {error}") from error


def _complex(content: Mapping[str, Any]) -> Complex:
    return np.array(content["real"], dtype=np.float64) + 1j * np.array(content["imag"], dtype=np.float64)


def write_response(path: str | os.PathLike[str], response: MeasuredResponse) -> Path:
    """Write a response to a JSON file and return its path; ParameterError if it cannot be written."""
    target = Path(path)
    text = json.dumps(response.to_json(), allow_nan=False) + "\n"
    with writing(f"response {target}", ParameterError):
        write_atomically(target, text)
    return target


def read_response(path: str | os.PathLike[str]) -> MeasuredResponse:
    """Return the response in a JSON file, or in ``hw_response.json`` of a run folder; DataError if there is none."""
    source = Path(path)
    if source.is_dir():
        source = source / "hw_response.json"
    try:
        return MeasuredResponse.from_json(json.loads(source.read_text(encoding="utf-8")))
    except OSError as error:
        raise DataError(f"measured response {source} cannot be read: {error.strerror or error}") from error
    except (ValueError, DataError) as error:
        raise DataError(f"measured response {source}: {error}") from error
