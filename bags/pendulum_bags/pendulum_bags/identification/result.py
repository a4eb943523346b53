"""The outcome of an identification: figures, words, a plant file that everything else loads."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.figures.table import Table
from pendulum_bags.identification.covariance import FREQUENCY
from pendulum_bags.identification.explained import REFUSED, Explained
from pendulum_bags.identification.geometry import CONTRADICTION, GeometryCheck
from pendulum_bags.identification.joint_fit import JointFit, Score
from pendulum_bags.identification.joint_model import JointModel
from pendulum_bags.identification.joint_recordings import JointRecording
from pendulum_bags.identification.model import FRICTION_MODELS, PLANT_FRICTION_MODELS, UNITS, FitModel, to_plant
from pendulum_bags.identification.motion_model import MotionModel
from pendulum_bags.identification.notes import Interval
from pendulum_bags.identification.output_error import OutputErrorFit
from pendulum_bags.identification.residual_tests import INCOMPLETE, ResidualTests
from pendulum_bags.identification.selection import CHOICE, Candidate
from pendulum_bags.identification.uncertainty import Uncertainty
from pendulum_bags.identification.window_score import WindowScore
from pendulum_bags.runs.datasets import INPUT_KINDS, Recording, data_notes, distinct_names
from pendulum_bags.runs.next_test import next_test_of, question_of
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.runs.run_record import run_record
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, write_plant

__all__ = [
    "ALARMS",
    "IdentificationResult",
    "PendulumResult",
    "check_distinct",
    "data_sentences",
    "fingerprint",
    "held_sentence",
    "load_fit_model",
    "looks_held",
]

FORMAT = "pendulum_identification/1"

ALARMS = (CONTRADICTION, REFUSED, INCOMPLETE)
"""How alarming sentences begin."""


@dataclass(frozen=True)
class IdentificationResult:
    """Values, intervals, scores and verdict of one identification, of one joint or several.

    Args:
        fit: The chosen fit.
        choice: Which candidate it is.
        candidates: Held-out error of each candidate and its error in training, by name; None where there is none.
        uncertainty: Intervals and what cannot be determined.
        explained: How much of the motion the fit explains.
        training: Scores of the recordings of the fit, by name; of one joint ``explained`` has their error.
        held_out: Scores on recordings that took no part in the fit, by name.
        window: Length of the windows [s]; None for whole recordings.
        created: Date, ISO 8601.
        data: Fingerprints of the recordings.
        notes: What is to be known of the recordings and of how they were fitted, in sentences.
        excluding: That the recordings are of two machines, in a sentence; None where they may be of one.
        motors: The plant in volts whose motors were given; None without.
    """

    fit: OutputErrorFit | JointFit
    choice: str
    candidates: Mapping[str, tuple[float | None, float | None]]
    uncertainty: Uncertainty
    explained: Explained
    training: Mapping[str, Score]
    held_out: Mapping[str, Score | WindowScore]
    window: float | None
    created: str
    data: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]
    excluding: str | None
    motors: PlantParameters | None = field(default=None, kw_only=True)

    @property
    def model(self) -> FitModel | MotionModel:
        """The fitted model."""
        return self.fit.model

    @property
    def intervals(self) -> Mapping[str, Interval]:
        """95 % intervals by name."""
        return self.uncertainty.intervals

    @property
    def refusal(self) -> str | None:
        """Sentence that the fit is no model of the recorded motion; None where it is one."""
        return self.explained.refusal

    @property
    def refused(self) -> bool:
        """Whether the fit is no model of the recorded motion: it is written to no plant file."""
        return self.explained.refusal is not None

    @property
    def incomplete(self) -> bool:
        """Whether the machine does something that no candidate model has, or that the fit does not explain."""
        return self.explained.incomplete is not None

    @property
    def verdict(self) -> str:
        """Whether the fit is a model of the motion, in one sentence."""
        lacks = "; the model is incomplete, see below" if self.incomplete else ""
        return self.explained.refusal or f"{self.explained.sentence}{self._apart}{lacks}."

    @property
    def _apart(self) -> str:
        return ""

    def sentences(self) -> list[str]:
        """Return what there is to say about the fit, most important first."""
        if self.explained.refusal is not None:
            return [self.explained.refusal, *self.notes]
        return [*self._warnings(), *self.notes, *self._remarks(), *self.uncertainty.sentences]

    def _warnings(self) -> list[str]:
        return [one for one in (self.excluding, self.explained.incomplete) if one is not None]

    def _remarks(self) -> list[str]:
        return []

    def plant(self, name: str = "identified") -> PlantParameters:
        """Return the plant that simulator, bridge and controller load.

        Raises:
            ParameterError: No body has the masses and inertias that were found.
        """
        assert isinstance(self.fit.model, JointModel)
        found = self.fit.model.identified(self.fit.free, name)
        return found if self.motors is None else found.with_motors(self.motors)

    def next_step(self, plant: str) -> tuple[str, str]:
        """Return what the plant file, written, is to be tested by, in words and as a command."""
        command = next_test_of(self._records(), plant)
        unseen = "under noise" if command else "on a recording"
        command = command or f"python -m pendulum_bags replay RECORDING --params {shlex.quote(plant)}"
        incomplete = "The model is incomplete. " if self.incomplete else ""
        apart = "Apart from the windows named above, it" if self._apart else "It"
        sentence = (
            f"{incomplete}{apart} misses {100.0 * self.explained.share:.2g} % of what straight lines through the "
            "windows miss; whether that is good enough to design a controller on, no fit can say. Test it "
            f"{unseen} that it was not fitted to.{question_of(command)}"
        )
        return f"{sentence.removesuffix('.')}:", command

    def _records(self) -> list[Mapping[str, Any]]:
        assert isinstance(self.fit, JointFit)
        return [run_record(data.recording.meta) for data in self.fit.data]

    def tables(self) -> list[Table]:
        """Return parameters, candidates and recordings, for terminal and page."""
        predicted = self.predicted
        head = ("parameter", "value", "95 % interval", *(["predicted"] if predicted else []), "unit")
        rows = []
        for name in dict.fromkeys((*self.fit.free, *(n for n in self.intervals if n == FREQUENCY))):
            interval = self.intervals.get(name)
            value = interval.value if interval else self.model[name]
            cells = [name, f"{value:.5g}", interval.text if interval else "at the edge of its domain"]
            if predicted:
                cells.append(f"+-{predicted[name]:.2g}" if name in predicted else "-")
            rows.append((*cells, self.model.unit(name)))
        one, by_angle = len(self.explained.joints) == 1, isinstance(self.fit, OutputErrorFit)
        unit, scale = ("mrad", 1e3) if by_angle else ("% of the motion", 100.0)
        errors = [
            (name, *("-" if each is None else f"{scale * each:.3f}" for each in pair), "chosen" * (name == self.choice))
            for name, pair in self.candidates.items()
        ]
        joints = [f"{'rms' if one else joint.name} [m{joint.unit}]" for joint in self.explained.joints]
        scores = [
            (f"{label}{name}", *(f"{1e3 * each:.3f}" for each in np.ravel(score.rms)), f"{100.0 * score.share:.1f} %")
            for label, found in (("", self.training), ("held out ", self.held_out))
            for name, score in found.items()
        ]
        window = "the whole recording" if self.window is None else f"windows of {self.window:.3g} s"
        rule = CHOICE if by_angle and len(errors) > 1 else ""
        return [
            Table(f"Identified by output error: {self.choice}", "", head, rows),
            Table("Candidates", rule, ("model", f"held-out rms [{unit}]", f"training rms [{unit}]", ""), errors),
            Table(f"Free run over {window}", "", ("recording", *joints, "of straight lines"), scores),
        ]

    @property
    def predicted(self) -> dict[str, float]:
        """Half widths of the intervals that the design of the excitation predicted; empty for other recordings."""
        return {}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON values."""
        found, names = self.uncertainty, [joint.name for joint in self.explained.joints]

        def by_joint(values: Sequence[float] | Array) -> Any:
            return float(values[0]) if len(names) == 1 else dict(zip(names, map(float, values), strict=True))

        def table(scores: Mapping[str, Score | WindowScore]) -> dict[str, Any]:
            return {
                name: {
                    "window_rms": by_joint(np.ravel(one.rms)),
                    "straight_lines": by_joint(np.ravel(one.lines)),
                    **({"mean_absolute": one.mean_absolute} if isinstance(one, WindowScore) else {}),
                }
                for name, one in scores.items()
            }

        return {
            "format": FORMAT,
            "created": self.created,
            "method": "output_error",
            "choice": self.choice,
            "window": self.window,
            "parameters": {name: self.model[name] for name in self.model.names},
            "units": {name: self.model.unit(name) for name in self.model.names},
            "fitted": list(self.fit.free),
            "intervals": {name: one.to_json() for name, one in found.intervals.items()},
            "covariance": {"names": list(found.names), "matrix": found.covariance.tolist()},
            "correlation": found.correlation.tolist(),
            "condition_number": found.condition_number,
            "interval_basis": found.basis,
            "candidates": [
                {"name": name, "held_out_rms": held, "training_rms": own}
                for name, (held, own) in self.candidates.items()
            ],
            "training": table(self.training),
            "held_out": table(self.held_out),
            "explained": {
                "rms": by_joint(self.explained.rms),
                "straight_lines_rms": by_joint(self.explained.lines),
                "share": self.explained.share,
                "refused": self.refused,
            },
            "incomplete": self.incomplete,
            "sentences": self.sentences(),
            "data": list(self.data),
            **self._own_values(),
        }

    def _own_values(self) -> dict[str, Any]:
        assert isinstance(self.fit, JointFit)
        own = dict(zip(self.fit.own, self.fit.offsets.T.tolist(), strict=True))
        assert isinstance(self.fit.model, JointModel)
        return {"mechanism": self.fit.model.plant.mechanism.model, "own_offsets": own}

    def write(self, path: str | Path, *, name: str = "identified") -> Path:
        """Write the plant file, ``*.yaml``, with intervals and provenance, and all the rest as JSON of the same name.

        Raises:
            DataError: The fit is refused, or the name has another suffix.
            ParameterError: No body has the masses and inertias that were found.
        """
        return self._write(path, self.plant(name) if not self.refused else None)

    def _write(self, path: str | Path, plant: PlantParameters | None) -> Path:
        if plant is None:
            raise DataError(f"{self.refusal} No plant file is written.")
        target = Path(path)
        if target.suffix not in {".yaml", ".yml"}:
            raise DataError(f"plant file is {target.name!r}; expected a name that ends in .yaml")
        intervals, facts, remarks = self._of_the_file(plant)
        provenance = {
            "method": "output error, multiple shooting",
            "date": self.created,
            "data": list(self.data),
            "python": platform.python_version(),
            **facts,
            "remarks": [*remarks, *self.sentences()],
        }
        write_plant(target, plant, provenance=provenance, intervals=intervals)
        write_json(target.with_suffix(".json"), self.to_dict())
        return target

    def _of_the_file(self, plant: PlantParameters) -> tuple[dict[str, tuple[float, float]], dict[str, Any], list[str]]:
        """Return the intervals of what the plant file holds, facts on the fit, and remarks on what is left out."""
        model, known = self.model, plant.specs
        intervals = {n: (one.low, one.high) for n, one in self.intervals.items() if n in known and one.low < one.high}
        left_out = {f"{n} [{model.unit(n)}]": model[n] for n in self.fit.free if n not in known}
        for joint, own in zip(plant.coordinates.names, plant.joints, strict=True):
            name, braking = f"{joint}.damping" if len(plant.joints) > 1 else "damping", own.total_damping - own.damping
            if braking and name in intervals:
                low, high = intervals[name]
                intervals[name] = (max(0.0, low - braking), high - braking)
        scale = {} if self.motors is None else {"scale": "ratios only: fixed by the gain of the given motors"}
        return intervals, {**scale, "not_in_the_plant": left_out}, []


@dataclass(frozen=True)
class PendulumResult(IdentificationResult):
    """The result of one joint, which is judged by its residuals, by rulers and scales, and recording by recording too.

    Args:
        tests: Of the residuals.
        geometry: Comparison with mass and length, None where they are unknown.
        moved_zeros: Held-out recordings whose zero lies elsewhere: by how much [rad], and their rms with it [rad].
    """

    fit: OutputErrorFit
    tests: ResidualTests
    geometry: GeometryCheck | None
    moved_zeros: Mapping[str, tuple[float, float]]

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
    def incomplete(self) -> bool:
        """Whether the pendulum does something that no candidate model has, or that the fit does not explain."""
        return self.tests.incomplete or super().incomplete

    @property
    def _apart(self) -> str:
        return ", apart from the windows named below" if self.tests.outliers else ""

    def _warnings(self) -> list[str]:
        geometry = () if self.geometry is None else self.geometry.sentences
        return [*geometry, *super()._warnings(), *self.tests.sentences[: self.tests.incomplete]]

    def _remarks(self) -> list[str]:
        said = [
            f"Held out, {name}: its zero lies {offset:+.4f} rad from that of the fit (homing?); with a zero of its "
            f"own the parameters miss it by {1e3 * own:.3g} mrad."
            for name, (offset, own) in self.moved_zeros.items()
        ]
        if self.score is None:
            said.append("There is one window only: no held-out score; give a longer recording or a shorter --window.")
        return [*said, *self._calibration(), *self.tests.sentences[self.tests.incomplete :]]

    @property
    def predicted(self) -> dict[str, float]:
        """Those widths, where there is one recording."""
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

    def _records(self) -> list[Mapping[str, Any]]:
        records = [run_record(piece.recording.meta) for piece in self.fit.pieces]
        if any(record.get("plant") == "emulator" for record in records):
            records.append({"command": "python -m pendulum_bags experiment thesis"})
        return records

    def _own_values(self) -> dict[str, Any]:
        chosen, zeros = self.fit.chosen, self.fit.zeros
        return {
            "input_kind": self.model.input_kind,
            "duty_gain": self.model.duty_gain,
            "friction": chosen.friction,
            "held_out_rms": self.score,
            "training_rms": chosen.training_rms,
            "natural_frequency": self.model.natural_frequency,
            "sign_flipped": self.fit.sign_flipped,
            "own_zeros": None if zeros is None else {"name": zeros.names[0], "values": zeros.values[:, 0].tolist()},
            "profiles": {n: list(p) for n, p in self.uncertainty.profiles.items()},
            "predicted_half_widths": self.predicted,
            "candidate_parameters": {c.label: {n: c.solution.model[n] for n in c.free} for c in self.fit.candidates},
            "residuals": {
                "white": self.tests.white,
                "white_p": self.tests.white_p,
                "independent_of_input": self.tests.independent,
                "worst_cross_correlation": self.tests.worst_cross,
            },
            "geometry": None
            if self.geometry is None
            else {"contradicts": self.geometry.contradicts, "rows": [list(r) for r in self.geometry.rows]},
        }

    def write(self, path: str | Path, *, name: str = "identified", effort_limit: float = 13.0) -> Path:
        """Write as :meth:`IdentificationResult.write`, with the actuator's limit [N m], which no recording shows."""
        return self._write(path, None if self.refused else self.plant(name, effort_limit))

    def _of_the_file(self, plant: PlantParameters) -> tuple[dict[str, tuple[float, float]], dict[str, Any], list[str]]:
        candidate = self.plant_candidate
        facts = {
            "friction": candidate.friction,
            "held_out_rms_rad": candidate.score,
            "training_rms_rad": candidate.training_rms,
            "input_gain": candidate.solution.model["input_gain"],
        }
        intervals, remarks = self._file_intervals(plant)
        if candidate is not self.fit.chosen:
            best = f"the best fit has friction {self.fit.chosen.friction}, which a plant file cannot hold; see the JSON"
            intervals, remarks = {}, [best]
        if self.model.input_kind not in {"effort", "position_goal"} and not self.fit.options.fix_scale:
            remarks.insert(0, "torques are per unit of inertia: the recording does not fix their scale")
        return intervals, facts, remarks

    def _file_intervals(self, plant: PlantParameters) -> tuple[dict[str, tuple[float, float]], list[str]]:
        """Return the intervals of what the plant file holds, and remarks on those that are of something else."""
        intervals: dict[str, tuple[float, float]] = {}
        remarks = []
        for name, interval in self.uncertainty.intervals.items():
            if name not in plant.numbers:
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


def looks_held(recording: Recording | JointRecording, delay: Interval) -> bool:
    """Return whether an input read as straight lines is late by half a sample, as one that is held would be."""
    if "linear" not in recording.hold or not recording.meta.get("hold_assumed"):
        return False
    half = 0.5 * recording.period
    return abs(delay.value - half) < 0.2 * half and delay.low > 0.25 * half and delay.high < 1.75 * half


def held_sentence(name: str, delay: Interval, recording: Recording | JointRecording) -> str:
    """Return what a delay of half a sampling period means."""
    return (
        f"{name}: the delay is {1e3 * delay.value:.3g} ms, half of the sampling period of "
        f"{1e3 * recording.period:.3g} ms. The torque was read as a measurement that varies between its samples; if "
        "it is a command that is held until the next one, this delay is none: say `--hold zero`, or `hold: zero` in a "
        "mapping file."
    )


def data_sentences(fit: OutputErrorFit, delay: Interval | None, *, refused: bool) -> list[str]:
    """Return what was done to the recordings of a fit, and what they seem to be, in words."""
    named = list(zip(distinct_names([p.recording for p in fit.pieces]), fit.pieces, strict=True))
    said = [f"{name}: {note}" for name, piece in named for note in data_notes(piece.recording)]
    if delay is not None:
        said += [held_sentence(name, delay, p.recording) for name, p in named if looks_held(p.recording, delay)]
    if fit.zeros is not None:
        said.append(fit.zeros.sentence([name for name, _ in named], fit.model.unit))
    if fit.sign_flipped and not refused:
        said.append(
            "The recorded effort has the opposite sign of the motion that it causes: the fit counts it with sign "
            "-1; `sign: -1` of `input` in a mapping file says so."
        )
    return said


_DIFFERENCES = {
    "transport_delay": "an input stamped late, which is no delay of the plant",
    "damping": "that of the drive, switched on, is added",
}


_LARGEST_VALUE = 1e300


def load_fit_model(path: str | Path) -> FitModel:
    """Return the fit model from the JSON that :meth:`IdentificationResult.write` wrote next to the plant file."""
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


def fingerprint(recording: Recording | JointRecording) -> dict[str, Any]:
    """Return what a recording is known by: source, samples, duration [s] and a hash of its samples."""
    digest = hashlib.sha256()
    for values in (recording.time, recording.position, recording.input):
        digest.update(np.ascontiguousarray(values).tobytes())
    return {
        "source": recording.source,
        "samples": int(recording.time.size),
        "duration_s": round(recording.duration, 6),
        "sha256": digest.hexdigest()[:16],
    }


def check_distinct(
    recordings: Sequence[Recording | JointRecording], held_out: Sequence[Recording | JointRecording]
) -> None:
    """Refuse data that count twice: intervals would be too narrow, a held-out score too good."""
    prints = [fingerprint(recording)["sha256"] for recording in (*recordings, *held_out)]
    names = distinct_names([*recordings, *held_out])
    for i, own in enumerate(prints):
        j = prints.index(own)
        if j == i or j >= len(recordings):
            continue
        if i < len(recordings):
            raise DataError(f"{names[i]} has the same samples as {names[j]}; expected each recording once")
        raise DataError(f"{names[i]} took part in the fit as {names[j]}; expected another recording to hold out")
