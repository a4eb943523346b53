"""Replay of a voltage, a servo's set point, or nothing, which no plant file takes, through the fit behind it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pendulum_bags.arrays import Array
from pendulum_bags.identification.model import FitModel, from_plant, to_plant
from pendulum_bags.identification.problem import Piece, prepare, simulate
from pendulum_bags.identification.result import load_fit_model
from pendulum_bags.identification.window_score import free_run, window_score
from pendulum_bags.replay.result import HorizonError, InputReplay, horizon_errors
from pendulum_bags.runs.datasets import INPUT_KINDS, Recording
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters, load_plant

__all__ = ["replay_fit"]

_WORDS = {
    "effort": "the measured torque",
    "voltage": "the voltage",
    "position_goal": "the set point",
    "none": "nothing but the start",
}


def replay_fit(recording: Recording, plant: str | Path | PlantParameters, *, window: float = 1.0) -> InputReplay:
    """Drive the fit of an identification with a recording, in windows [s] and in free run.

    ``plant`` is a plant file with its identification's JSON next to it, or that JSON; for a free swing any rigid plant.
    A DataError if the recording has another input than the fit.
    """
    if not window > 0.0:
        raise DataError(f"window is {window} s; expected > 0")
    model, name = _model_of(recording, plant)
    score = window_score(model, recording, window)
    run = free_run(model, recording, fitted=model.input_kind != "position_goal")
    return InputReplay(
        name=recording.name,
        plant=replace(to_plant(model), name=name),
        window=window,
        rms=score.rms,
        lines=score.lines,
        by_window=score.by_window,
        window_time=score.time,
        window_angle=score.simulated,
        time=run.time,
        measured=run.measured,
        free_run=run.simulated,
        horizons=_horizons(model, recording, window),
        driven_by=_WORDS[recording.input_kind],
    )


def _model_of(recording: Recording, plant: str | Path | PlantParameters) -> tuple[FitModel, str]:
    kind = recording.input_kind
    if not isinstance(plant, PlantParameters):
        beside = Path(plant).with_suffix(".json")
        if Path(plant).suffix in {".yaml", ".yml", ".json"} and beside.is_file():
            model = load_fit_model(beside)
            if kind not in {model.input_kind, "none"}:
                raise DataError(
                    f"{recording.name} has the input {kind!r} [{INPUT_KINDS[kind]}], {beside} was identified with "
                    f"{model.input_kind!r} [{INPUT_KINDS[model.input_kind]}]; expected the same"
                )
            return model, Path(plant).stem
        if kind != "none":
            raise DataError(
                f"{recording.name} has the input {kind!r} [{INPUT_KINDS[kind]}], and a plant takes 'effort' [N m]; "
                f"expected {beside}, as `identify --out` writes it beside its plant file, with the gain of that input"
            )
    elif kind != "none":
        raise DataError(f"{recording.name} has the input {kind!r}; expected 'effort' [N m] to drive a plant")
    parameters = plant if isinstance(plant, PlantParameters) else load_plant(plant)
    # Nothing drives it: delay and lag of the actuator have nothing to delay.
    return from_plant(parameters), parameters.name


def _horizons(model: FitModel, recording: Recording, longest: float) -> tuple[HorizonError, ...]:
    """Return errors of predictions from measured states."""
    size = recording.time.size
    whole = prepare(recording, None, across_gaps=True)

    def error_from(first: int, steps: int) -> Array:
        tail = prepare(recording.rows(first), None, across_gaps=True) if size - first >= 3 else whole
        part = slice(first, first + steps + 1)
        window = np.array([[part.start, part.stop]], dtype=np.int64)
        piece = Piece(recording, window, tail.states, whole.integral, whole.enabled)
        return simulate(model, piece).theta[part] - recording.position[part]

    return horizon_errors(size, recording.period, longest, error_from)
