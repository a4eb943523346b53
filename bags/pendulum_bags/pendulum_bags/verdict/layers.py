"""The answer to "is the simulation good enough to design a controller on?" as the sum of four layers of evidence.

Each layer is a :class:`LayerResult` with its own question, mark, sentence, evidence with intervals, and next steps;
:func:`sum_up` combines those that were measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pendulum_bags.runs.case import UNKNOWN, Case
from pendulum_bags.runs.run_folder import write_json
from pendulum_bags.verdict.naming import name_in
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.json_values import without_nan

__all__ = ["HOW", "Answer", "Evidence", "Layer", "LayerResult", "Mark", "read_layers", "sum_up", "write_layer"]

FOLDER = "layers"
"""Folder within a run folder for the layers, each in a file ``<key>.json``."""


class Mark(str, Enum):
    """The result of a layer, or of one row of its evidence."""

    YES = "yes"
    NO = "no"
    UNDECIDED = "undecided"
    NOT_MEASURED = "not measured"


class Layer(Enum):
    """The four questions, from the narrowest to the widest."""

    key: str
    title: str
    question: str

    SAME_RUN = ("same_run", "same run", "Do both move alike under one controller and one disturbance?")
    SAME_PLANT = (
        "same_plant",
        "same for feedback",
        "Are both plants close enough for feedback, and where in frequency do they differ?",
    )
    WHICH_CONTROLLERS = ("which_controllers", "which controllers", "Which designs are safe to carry over?")
    SAME_CHOICE = ("same_choice", "same choice", "Would the simulation have picked the right controller?")

    def __init__(self, key: str, title: str, question: str) -> None:
        self.key, self.title, self.question = key, title, question

    @classmethod
    def of(cls, key: str) -> Layer:
        """Return the layer of a key; a DataError if there is none."""
        for layer in cls:
            if layer.key == key:
                return layer
        raise DataError(f"layer is {key!r}; expected one of {', '.join(layer.key for layer in cls)}")


@dataclass(frozen=True)
class Evidence:
    """One measured quantity of a layer.

    Args:
        unit: Its unit; empty for none.
        estimate: Its value, or None.
        low: Lower end of its interval, or None.
        expected: The criterion as text, such as ``within ±0.3 deg``; empty for mere information.
    """

    quantity: str
    unit: str
    estimate: float | None
    low: float | None = None
    high: float | None = None
    expected: str = ""
    mark: Mark = Mark.UNDECIDED
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values; missing numbers are None."""
        return without_nan({**asdict(self), "mark": self.mark.value})

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Evidence:
        """Return the evidence in JSON values."""
        return cls(**{**content, "mark": Mark(content["mark"])})


@dataclass(frozen=True)
class LayerResult:
    """The result of one layer.

    Args:
        next_steps: One sentence or command each, or empty.
        reason: Clause for the whole answer: why it is no or undecided, such as "the spread of the velocity is 31 %
            smaller on the hardware".
        holds: Clause with what is reliable although another layer is no, such as "designs with a margin above 0.21
            stabilise the hardware too", or empty.
    """

    layer: Layer
    mark: Mark
    sentence: str
    evidence: Sequence[Evidence] = ()
    next_steps: Sequence[str] = ()
    reason: str = ""
    holds: str = ""
    case: Case = UNKNOWN

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "layer": self.layer.key,
            "name": self.layer.title,
            "question": self.layer.question,
            "mark": self.mark.value,
            "sentence": self.sentence,
            "evidence": [row.to_json() for row in self.evidence],
            "next_steps": list(self.next_steps),
            "reason": self.reason,
            "holds": self.holds,
            "case": asdict(self.case),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> LayerResult:
        """Return the result in JSON values; a DataError if they hold none."""
        try:
            return cls(
                Layer.of(content["layer"]),
                Mark(content["mark"]),
                str(content["sentence"]),
                tuple(Evidence.from_json(row) for row in content["evidence"]),
                tuple(map(str, content["next_steps"])),
                str(content["reason"]),
                str(content["holds"]),
                Case(**content.get("case", {})),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"the content is no result of a layer: {error}") from error


@dataclass(frozen=True)
class Answer:
    """The sum of all layers.

    Args:
        decides: Sentence on which of two contradicting tests takes precedence, or empty.
        holds: Clause with what remains true although the answer is not yes, or empty.
        text: The answer as text if it is more than the sum of these.
    """

    mark: Mark
    reasons: str
    layers: Sequence[LayerResult]
    next_steps: Sequence[str]
    decides: str = ""
    holds: str = ""
    missing: Sequence[str] = ()
    text: str = ""

    @property
    def sentence(self) -> str:
        """The answer as text."""
        return self.text or f"{self.mark.value.capitalize()}: {self.reasons}.{self.remarks()}"

    def remarks(self, of: str = "") -> str:
        """Return the sentences after the reasons, each behind a space; ``of`` names the plant if there are several."""
        holds = f"What holds{f' with {of}' if of else ''}: {self.holds}." if self.holds else ""
        missing = f"Not measured: {_listed([f'“{title}”' for title in self.missing])}." if self.missing else ""
        return "".join(f" {one}" for one in (self.decides, holds, missing) if one)

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "mark": self.mark.value,
            "sentence": self.sentence,
            "layers": [result.to_json() for result in self.layers],
            "next_steps": list(self.next_steps),
        }


HOW = {
    Layer.SAME_RUN: "make experiment",
    Layer.SAME_PLANT: "python -m pendulum_bags experiment frequency_response",
    Layer.WHICH_CONTROLLERS: "python -m pendulum_bags experiment frequency_response",
    Layer.SAME_CHOICE: "python -m pendulum_bags experiment ranking",
}
"""The command that measures each layer."""


def sum_up(
    results: Iterable[LayerResult], *, emulated: bool = False, how: Mapping[Layer, str] = MappingProxyType({})
) -> Answer:
    """Return one answer from the layers that were measured.

    One no makes it no: each layer covers something that a design needs. It is yes if all measured layers (at least one)
    are; the sentence names the others.

    Args:
        results: At most one for each layer; the others count as not measured.
        emulated: Whether the hardware was emulated; the text then says so.
        how: The command that measures a layer of these plants, if it is not that of :data:`HOW`.

    Raises:
        DataError: A layer was given twice.
    """
    given: dict[Layer, LayerResult] = {}
    for result in results:
        if result.layer in given:
            raise DataError(f"layer {result.layer.title!r} was given twice; expected each once")
        given[result.layer] = name_in(result, emulated=emulated)
    layers = tuple(given.get(layer) or _not_measured(layer, how.get(layer, HOW[layer])) for layer in Layer)
    by_mark = {mark: [result for result in layers if result.mark is mark] for mark in Mark}
    measured = [result for result in layers if result.mark is not Mark.NOT_MEASURED]
    mark = Mark.NO if by_mark[Mark.NO] else Mark.UNDECIDED if by_mark[Mark.UNDECIDED] or not measured else Mark.YES
    decides = ""
    holds = [result.holds for result in layers if result.holds]
    certified = given[Layer.WHICH_CONTROLLERS].mark if Layer.WHICH_CONTROLLERS in given else Mark.NOT_MEASURED
    others = {given[layer].mark for layer in (Layer.SAME_RUN, Layer.SAME_PLANT) if layer in given}
    if (certified is Mark.YES and Mark.NO in others) or (certified is Mark.NO and Mark.YES in others):
        decides = (
            f"For the stability of a design, test 3 ({Layer.WHICH_CONTROLLERS.title}) decides; for how closely the "
            f"motion matches, test 1 ({Layer.SAME_RUN.title})."
        )
    # Remedies of a no come first, then steps that decide, then those for missing layers.
    order = (*by_mark[Mark.NO], *by_mark[Mark.UNDECIDED], *by_mark[Mark.YES])
    steps = dict.fromkeys(step for result in order for step in result.next_steps)
    for command in dict.fromkeys(result.reason for result in by_mark[Mark.NOT_MEASURED] if result.reason):
        titles = [f"“{result.layer.title}”" for result in by_mark[Mark.NOT_MEASURED] if result.reason == command]
        steps[f"Measure {_listed(titles)}: {command}"] = None
    return Answer(
        mark,
        _reasons(by_mark[mark]) or "nothing was measured",
        layers,
        tuple(steps),
        decides,
        "; ".join(holds) if mark is not Mark.YES else "",
        tuple(result.layer.title for result in by_mark[Mark.NOT_MEASURED]) if mark is Mark.YES else (),
    )


def _not_measured(layer: Layer, how: str) -> LayerResult:
    return LayerResult(layer, Mark.NOT_MEASURED, f"Not measured yet; to measure it: {how}.", reason=how)


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def write_layer(folder: Path, result: LayerResult) -> Path:
    """Store a layer's result in a run folder, where the report finds it; return the file."""
    path = folder / FOLDER / f"{result.layer.key}.json"
    write_json(path, result.to_json())
    return path


def read_layers(folder: Path, case: Case = UNKNOWN) -> list[LayerResult]:
    """Return a run folder's layers in order; a DataError if one is invalid or of other plants than ``case``."""
    found = []
    for layer in Layer:
        path = folder / FOLDER / f"{layer.key}.json"
        if path.is_file():
            try:
                found.append(LayerResult.from_json(json.loads(path.read_text(encoding="utf-8"))))
            except (ValueError, DataError) as error:
                raise DataError(f"{path} holds no result of a layer: {error}") from error
            case.require_same(found[-1].case, f"“{layer.title}” in {folder}")
    return found


def _reasons(results: Sequence[LayerResult]) -> str:
    return "; ".join(result.reason or result.sentence.rstrip(".") for result in results)
