"""The outcome of an identification: figures, words, a plant file that everything else loads."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.identification.explained import REFUSED, Explained
from pendulum_bags.identification.geometry import CONTRADICTION, GeometryCheck
from pendulum_bags.identification.model import (
    FRICTION_MODELS,
    PLANT_FRICTION_MODELS,
    UNITS,
    FitModel,
    to_plant,
)
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.problem import Piece
from pendulum_bags.identification.residual_tests import INCOMPLETE, ResidualTests
from pendulum_bags.identification.selection import Candidate
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_bags.identification.window_score import WindowScore
from pendulum_bags.identification.wording import Interval
from pendulum_bags.runs.datasets import INPUT_KINDS, Recording, data_notes, distinct_names
from pendulum_bags.runs.next_test import next_test_of, question_of
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, write_plant

__all__ = ["ALARMS", "IdentificationResult", "fingerprint", "load_fit_model"]

FORMAT = "pendulum_identification/1"

ALARMS = (CONTRADICTION, REFUSED, INCOMPLETE)
"""How sentences begin that nobody should overlook."""


@dataclass(frozen=True)
class IdentificationResult:
    """Fit, intervals, tests and scores of one identification.

    Args:
        fit: Chosen and rejected candidates.
        uncertainty: Intervals and what cannot be determined.
        tests: Of the residuals.
        geometry: Comparison with mass and length, None where they are unknown.
        held_out: Scores on recordings that took no part in the fit, by name.
        created: Date, ISO 8601.
        explained: How much of the motion the fit explains.
        moved_zeros: Held-out recordings whose zero lies elsewhere: by how much [rad], and their rms with it [rad].
        excluding: That the recordings are of two machines, in a sentence; None where they may be of one.
    """

    fit: OutputErrorFit
    uncertainty: Uncertainty
    tests: ResidualTests
    geometry: GeometryCheck | None
    held_out: Mapping[str, WindowScore]
    created: str
    explained: Explained
    moved_zeros: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    excluding: str | None = None

    @property
    def model(self) -> FitModel:
        """The fitted model."""
        return self.fit.model

    @property
    def score(self) -> float | None:
        """Angle error on held-out windows (cross-validation) [rad]; None for a single window."""
        validation = self.fit.chosen.validation
        return None if validation is None else validation.rms

    @property
    def plant_candidate(self) -> Candidate:
        """The fit that a plant file can hold: the chosen one, or the best without load of the drive."""
        if self.fit.chosen.friction in PLANT_FRICTION_MODELS:
            return self.fit.chosen
        fits = [c for c in self.fit.candidates if c.friction in PLANT_FRICTION_MODELS]
        return min(fits, key=lambda c: c.score) if fits else self.fit.chosen

    def plant(self, name: str = "identified", effort_limit: float = 13.0) -> PlantParameters:
        """Return the plant that simulator, bridge and controller load."""
        return to_plant(self.plant_candidate.solution.model, name=name, effort_limit=effort_limit)

    @property
    def refused(self) -> bool:
        """Whether the fit is no model of the recorded motion: it is written to no plant file."""
        return self.explained.refusal is not None

    @property
    def incomplete(self) -> bool:
        """Whether the pendulum does something that no candidate model has, or that the fit does not explain."""
        return self.tests.incomplete or self.explained.doubt is not None

    @property
    def verdict(self) -> str:
        """Whether the fit is a model of the motion, in one sentence."""
        if self.explained.refusal is not None:
            return self.explained.refusal
        found = self.explained
        apart = ", apart from the windows named below" if self.tests.outliers else ""
        lacks = "; the model is incomplete, see below" if self.incomplete else ""
        return (
            f"Fits {100.0 * (1.0 - found.share):.3g} % of the motion: it misses {1e3 * found.rms:.3g} mrad rms where "
            f"straight lines miss {1e3 * found.lines:.3g} mrad{apart}{lacks}."
        )

    def sentences(self) -> list[str]:
        """Return what there is to say about the fit, most important first."""
        if self.explained.refusal is not None:
            return [self.explained.refusal, *self._of_the_data()]
        said = [self.excluding] if self.excluding is not None else []
        said += self.geometry.sentences if self.geometry is not None else []
        tests = list(self.tests.sentences)
        if self.explained.doubt is not None:
            said.append(self.explained.doubt)
        if self.tests.incomplete:
            said.append(tests.pop(0))
        said.extend(self._of_the_data())
        said.extend(
            f"Held out, {name}: its zero lies {offset:+.4f} rad from that of the fit (homing?); with a zero of its "
            f"own the parameters miss it by {1e3 * own:.3g} mrad."
            for name, (offset, own) in self.moved_zeros.items()
        )
        if self.score is None:
            said.append("There is one window only: no held-out score; give a longer recording or a shorter --window.")
        return [*said, *self._calibration(), *tests, *self.uncertainty.sentences]

    def next_step(self, plant: str) -> tuple[str, str]:
        """Return what a plant file is to be tested by, in words and as a command: a fit does not tell what it is for.

        Args:
            plant: The file, written.
        """
        records = [run_record(piece.recording.meta) for piece in self.fit.pieces]
        if any(record.get("plant") == "emulator" for record in records):
            records.append({"command": "python -m pendulum_bags experiment thesis"})
        command = next_test_of(records, plant)
        unseen = "under noise" if command else "on a recording"
        command = command or f"python -m pendulum_bags replay RECORDING --params {shlex.quote(plant)}"
        incomplete = "The model is incomplete. " if self.incomplete else ""
        apart = "Apart from the windows named above, it" if self.tests.outliers else "It"
        told = (
            f"{incomplete}{apart} misses {100.0 * self.explained.share:.2g} % of what straight lines through the "
            "windows miss; whether that is good enough to design a controller on, no fit can say. Test it "
            f"{unseen} that it was not fitted to.{question_of(command)}"
        )
        return f"{told.removesuffix('.')}:", command

    def _of_the_data(self) -> list[str]:
        said = [f"{name}: {note}" for name, piece in self._named() for note in data_notes(piece.recording)]
        said.extend(
            _held(name, self.uncertainty.intervals["transport_delay"], piece.recording)
            for name, piece in self._named()
            if _looks_held(piece.recording, self.uncertainty.intervals.get("transport_delay"))
        )
        zeros = self.fit.zeros
        if zeros is not None:
            listing = ", ".join(
                f"{name} {value:+.4f}" for (name, _), value in zip(self._named(), zeros.values, strict=True)
            )
            said.append(
                f"Each recording has a zero of its own (homing, or the tare of the torque): {zeros.name} is {listing} "
                f"{self.model.units[zeros.name]} beside the common one, which is their mean."
            )
        if self.fit.sign_flipped and not self.refused:
            said.append(
                "The recorded effort has the opposite sign of the motion that it causes: the fit counts it with sign "
                "-1; `sign: -1` of `input` in a mapping file says so."
            )
        return said

    def _named(self) -> list[tuple[str, Piece]]:
        pieces = self.fit.pieces
        return list(zip(distinct_names([p.recording for p in pieces]), pieces, strict=True))

    @property
    def predicted(self) -> dict[str, float]:
        """Half widths of the intervals that the design of the excitation predicted; empty for other recordings."""
        if len(self.fit.pieces) != 1:
            return {}
        design = self.fit.pieces[0].recording.meta.get("pendulum.excitation")
        values = design.get("predicted") if isinstance(design, Mapping) else None
        if not isinstance(values, Mapping):
            return {}
        return {
            name: float(width)
            for name, width in values.items()
            if isinstance(width, (int, float)) and 0.0 < width < np.inf and name in self.uncertainty.intervals
        }

    def _calibration(self) -> list[str]:
        ratios = {}
        for name, width in self.predicted.items():
            interval = self.uncertainty.intervals[name]
            ratios[name] = 0.5 * (interval.high - interval.low) / width
        if not ratios:
            return []
        listing = ", ".join(f"{name} {ratio:.2g}" for name, ratio in ratios.items())
        text = f"Half widths obtained over those that the design of the excitation predicted: {listing}; they are 1 "
        return [text + "where the prior plant and the sensor noise were true and the model misses nothing."]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON values."""
        chosen = self.fit.chosen
        return {
            "format": FORMAT,
            "created": self.created,
            "method": "output_error",
            "input_kind": self.model.input_kind,
            "duty_gain": self.model.duty_gain,
            "friction": chosen.friction,
            "window": self.fit.window,
            "held_out_rms": self.score,
            "training_rms": chosen.training_rms,
            "natural_frequency": self.model.natural_frequency,
            "sign_flipped": self.fit.sign_flipped,
            "own_zeros": None
            if self.fit.zeros is None
            else {"name": self.fit.zeros.name, "values": self.fit.zeros.values.tolist()},
            "parameters": {n: self.model[n] for n in UNITS},
            "units": dict(self.model.units),
            "fitted": list(chosen.free),
            "intervals": {name: found.to_json() for name, found in self.uncertainty.intervals.items()},
            "profiles": {n: list(p) for n, p in self.uncertainty.profiles.items()},
            "covariance": {
                "names": list(self.uncertainty.names),
                "matrix": self.uncertainty.covariance.tolist(),
            },
            "correlation": self.uncertainty.correlation.tolist(),
            "condition_number": self.uncertainty.condition_number,
            "interval_basis": self.uncertainty.basis,
            "predicted_half_widths": self.predicted,
            "candidates": [
                {
                    "friction": c.friction,
                    "held_out_rms": None if c.validation is None else c.validation.rms,
                    "training_rms": c.training_rms,
                    "parameters": {n: c.solution.model[n] for n in c.free},
                }
                for c in self.fit.candidates
            ],
            "residuals": {
                "white": self.tests.white,
                "white_p": self.tests.white_p,
                "independent_of_input": self.tests.independent,
                "worst_cross_correlation": self.tests.worst_cross,
            },
            "geometry": None
            if self.geometry is None
            else {"contradicts": self.geometry.contradicts, "rows": [list(r) for r in self.geometry.rows]},
            "held_out": {
                name: {"window_rms": score.rms, "mean_absolute": score.mean_absolute}
                for name, score in self.held_out.items()
            },
            "explained": {
                "rms": self.explained.rms,
                "straight_lines_rms": self.explained.lines,
                "share": self.explained.share,
                "refused": self.refused,
            },
            "incomplete": self.incomplete,
            "sentences": self.sentences(),
            "data": [fingerprint(recording) for recording in self.fit.recordings],
        }

    def write(self, path: str | Path, *, name: str = "identified", effort_limit: float = 13.0) -> Path:
        """Write the plant file with intervals and provenance, and everything else as JSON beside it.

        Args:
            path: Plant file to write, ``*.yaml``; the JSON gets the same name.
            name: Name of the plant.
            effort_limit: Of the actuator [N m]; a recording does not tell.

        Raises:
            DataError: for a fit that is refused, or another suffix.
        """
        if self.explained.refusal is not None:
            raise DataError(f"{self.explained.refusal} No plant file is written.")
        target = Path(path)
        if target.suffix not in {".yaml", ".yml"}:
            raise DataError(f"plant file is {target.name!r}; expected a name that ends in .yaml")
        candidate = self.plant_candidate
        same = candidate is self.fit.chosen
        plant = self.plant(name, effort_limit)
        intervals, remarks = self._file_intervals(plant) if same else ({}, [])
        torque = self.model.input_kind in {"effort", "position_goal"}
        remark = "torques are per unit of inertia: the recording does not fix their scale"
        provenance: dict[str, Any] = {
            "method": "output error, multiple shooting",
            "date": self.created,
            "data": [fingerprint(recording) for recording in self.fit.recordings],
            "friction": candidate.friction,
            "held_out_rms_rad": candidate.score,
            "training_rms_rad": candidate.training_rms,
            "input_gain": candidate.solution.model["input_gain"],
            "python": platform.python_version(),
            "remarks": [
                *([] if torque or self.fit.options.fix_scale else [remark]),
                *remarks,
                *self.sentences(),
            ],
        }
        if not same:
            provenance["remarks"].insert(
                0,
                f"the best fit has friction {self.fit.chosen.friction}, which a plant file cannot hold; see the JSON",
            )
        write_plant(target, plant, provenance=provenance, intervals=intervals)
        write_json(target.with_suffix(".json"), self.to_dict())
        return target

    def _file_intervals(self, plant: PlantParameters) -> tuple[dict[str, tuple[float, float]], list[str]]:
        """Return the intervals of what the plant file holds, and remarks on those that are of something else."""
        intervals: dict[str, tuple[float, float]] = {}
        remarks = []
        for name, interval in self.uncertainty.intervals.items():
            if name not in PlantParameters.__dataclass_fields__:
                continue
            value = float(getattr(plant, name))
            # A delay that may be 0 keeps the part of its interval that a plant can have.
            low = max(interval.low, 0.0) if name == "transport_delay" else interval.low
            if low <= value <= interval.high:
                if low < interval.high < np.inf:
                    intervals[name] = (low, interval.high)
            else:
                remarks.append(
                    f"{name} is {value:g} {UNITS[name]} here, and {interval.value:.5g} ({interval.low:.5g} to "
                    f"{interval.high:.5g}) {UNITS[name]} in the recording: {_DIFFERENCES.get(name, 'see the JSON')}"
                )
        return intervals, remarks


def _looks_held(recording: Recording, delay: Interval | None) -> bool:
    """Return whether an input read as straight lines is late by half a sample, as one that is held would be."""
    if delay is None or recording.hold != "linear" or not recording.meta.get("hold_assumed"):
        return False
    half = 0.5 * recording.period
    return abs(delay.value - half) < 0.2 * half and delay.low > 0.25 * half and delay.high < 1.75 * half


def _held(name: str, delay: Interval, recording: Recording) -> str:
    return (
        f"{name}: transport_delay is {1e3 * delay.value:.3g} ms, half of the sampling period of "
        f"{1e3 * recording.period:.3g} ms. The torque was read as a measurement that varies between its samples; if "
        "it is a command that is held until the next one, this delay is none: say `--hold zero`, or `hold: zero` in a "
        "mapping file."
    )


_DIFFERENCES = {
    "transport_delay": "an input stamped late, which is no delay of the plant",
    "damping": "that of the drive, switched on, is added",
}


_LARGEST_VALUE = 1e300


def load_fit_model(path: str | Path) -> FitModel:
    """Return the fit model from the JSON that :meth:`IdentificationResult.write` left beside the plant file."""
    source = Path(path)
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{source} cannot be read as an identification: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DataError(f"{source} is no identification; expected a JSON file with format {FORMAT!r}")
    for key in ("parameters", "input_kind", "friction", "duty_gain"):
        if key not in content:
            raise DataError(f"{source} has no {key!r}; expected the identification as it was written")
    values = content["parameters"]
    if not isinstance(values, dict):
        raise DataError(f"{source}: 'parameters' is {values!r}; expected numbers by name")
    for name, value in {**values, "duty_gain": content["duty_gain"]}.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST_VALUE:
            raise DataError(f"{source}: {name!r} is {str(value)[:40]}; expected a finite number")
    for key, known in (("input_kind", INPUT_KINDS), ("friction", FRICTION_MODELS)):
        if not isinstance(content[key], str) or content[key] not in known:
            raise DataError(f"{source}: {key!r} is {content[key]!r}; expected one of {', '.join(known)}")
    return FitModel(content["parameters"], content["input_kind"], content["friction"], content["duty_gain"])


def fingerprint(recording: Recording) -> dict[str, Any]:
    """Return what a recording is known by: source, samples, duration [s] and a hash of its samples."""
    digest = hashlib.sha256()
    for values in (recording.time, recording.position, recording.input):
        digest.update(np.ascontiguousarray(values).tobytes())
    return {
        "source": str(recording.meta.get("source", "")),
        "samples": int(recording.time.size),
        "duration_s": round(recording.duration, 6),
        "sha256": digest.hexdigest()[:16],
    }
