"""The answer as the sum of its layers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pendulum_bags.runs.case import IDENTITY, Case
from pendulum_bags.verdict import Evidence, Layer, LayerResult, Mark, read_layers, sum_up, write_layer
from pendulum_msgs_py.errors import DataError


def result(layer: Layer, mark: Mark, **more: Any) -> LayerResult:
    row = Evidence("spread of angle", "rad", 1.2, 1.1, float("nan"), "within ±25 %", mark)
    steps = (f"mend {layer.title}",) if mark is not Mark.YES else ()
    return LayerResult(layer, mark, f"{layer.title} says {mark.value}.", (row,), steps, **more)


def test_one_layer_that_says_no_makes_it_no_and_what_another_certifies_is_still_reported() -> None:
    answer = sum_up(
        [
            result(
                Layer.WHICH_CONTROLLERS,
                Mark.YES,
                holds="designs with a margin above 0.21 stabilise the hardware",
            ),
            result(Layer.SAME_RUN, Mark.NO, reason="the hardware moves 31 % less"),
        ],
        emulated=True,
    )
    assert answer.mark is Mark.NO
    assert answer.sentence == (
        "No: the emulated hardware moves 31 % less. "
        "For the stability of a design, test 3 (which controllers) decides; for how closely the motion matches, test 1 "
        "(same run). What holds: designs with a margin above 0.21 stabilise the emulated hardware."
    )
    assert [one.layer for one in answer.layers] == list(Layer)
    assert answer.next_steps[0] == "mend same run"


def test_yes_needs_all_measured_layers_and_names_those_that_were_not() -> None:
    answer = sum_up([result(Layer.SAME_RUN, Mark.YES), result(Layer.SAME_PLANT, Mark.YES)])
    assert answer.mark is Mark.YES
    assert answer.sentence.endswith("Not measured: “which controllers” and “same choice”.")
    assert "Measure “same choice”: python -m pendulum_bags experiment ranking" in answer.next_steps
    one = sum_up([result(Layer.SAME_RUN, Mark.YES)])
    assert one.sentence.endswith("Not measured: “same for feedback”, “which controllers” and “same choice”.")
    assert sum_up([result(layer, Mark.YES) for layer in Layer]).sentence.count("Not measured") == 0


def test_undecided_is_neither_and_nothing_measured_is_undecided() -> None:
    assert sum_up([result(Layer.SAME_RUN, Mark.YES), result(Layer.SAME_PLANT, Mark.UNDECIDED)]).mark is Mark.UNDECIDED
    nothing = sum_up([])
    assert nothing.mark is Mark.UNDECIDED
    assert nothing.next_steps[0] == "Measure “same run”: make experiment"


def test_a_layer_given_twice_is_refused() -> None:
    with pytest.raises(DataError, match="layer 'same run' was given twice"):
        sum_up([result(Layer.SAME_RUN, Mark.YES), result(Layer.SAME_RUN, Mark.NO)])


def test_layers_kept_in_a_run_folder_are_read_back(tmp_path: Path) -> None:
    kept = result(Layer.SAME_CHOICE, Mark.NO, reason="the pick costs 12 % more")
    write_layer(tmp_path, kept)
    (back,) = read_layers(tmp_path)
    assert back.evidence[0].high is None
    assert back.to_json() == kept.to_json()
    (tmp_path / "layers" / "same_run.json").write_text("{}")
    with pytest.raises(DataError, match=r"same_run.json holds no result of a layer"):
        read_layers(tmp_path)


def test_a_layer_of_other_plants_does_not_join_an_answer_and_the_sentence_names_both(tmp_path: Path) -> None:
    ours = Case("thesis (12ab34cd)", "emulator of thesis (12ab34cd), direct_pwm")
    kept = replace(result(Layer.SAME_CHOICE, Mark.YES), case=ours)
    write_layer(tmp_path, kept)
    assert [one.case for one in read_layers(tmp_path, ours)] == [ours]
    for other, side in (
        (replace(ours, simulation="x5_9 (0)"), "simulation"),
        (replace(ours, hardware="hebi (0)"), "hardware"),
    ):
        with pytest.raises(DataError) as refused:
            read_layers(tmp_path, other)
        theirs, wanted = getattr(ours, side), getattr(other, side)
        assert str(refused.value) == (
            f"“same choice” in {tmp_path} is of {side} {theirs}; expected that of the compared recordings, {wanted}"
        )
    # Recordings of others, and results of earlier versions, do not say which plants they are of.
    assert len(read_layers(tmp_path, Case(ours.simulation))) == 1
    write_layer(tmp_path, replace(kept, case=Case()))
    assert len(read_layers(tmp_path, ours)) == 1


def test_runs_of_two_plants_on_one_side_are_no_case() -> None:
    one, two = {IDENTITY: "a (1)"}, {IDENTITY: "b (2)"}
    assert Case.of([one, {}, one], [two]) == Case("a (1)", "b (2)")
    with pytest.raises(DataError, match=r"hardware is a \(1\) in one run and b \(2\) in another; expected one plant"):
        Case.of([one], [two, one])


@pytest.mark.parametrize(
    ("first", "second", "third", "says"),
    [
        (Mark.NO, Mark.YES, Mark.YES, True),
        (Mark.YES, Mark.YES, Mark.NO, True),
        (Mark.YES, Mark.NO, Mark.YES, True),
        (Mark.NO, Mark.NO, Mark.NO, False),
        (Mark.YES, Mark.NO, Mark.UNDECIDED, False),
        (Mark.YES, Mark.YES, Mark.YES, False),
    ],
)
def test_where_layers_disagree_one_sentence_names_the_one_that_decides(
    first: Mark, second: Mark, third: Mark, says: bool
) -> None:
    layers = (Layer.SAME_RUN, Layer.SAME_PLANT, Layer.WHICH_CONTROLLERS)
    answer = sum_up(LayerResult(layer, mark, "s") for layer, mark in zip(layers, (first, second, third), strict=True))
    assert ("For the stability of a design, test 3 (which controllers) decides" in answer.sentence) is says
