"""The first layer against plants whose difference is known."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pendulum_bags.comparison import (
    Comparison,
    EquivalenceTest,
    Looks,
    Margins,
    Outcome,
    RunData,
    Series,
    Signal,
    compare,
)
from pendulum_bags.comparison.same_run import paired_tests
from pendulum_bags.comparison.spectra import spectra_of
from pendulum_bags.comparison.statistics import Interval
from pendulum_bags.report.figures import comparison_figures
from pendulum_bags.report.tables import tests_table as table_of_tests
from pendulum_bags.verdict import Mark
from pendulum_bags.verdict.same_run import in_words, same_run_layer, seen_note
from pendulum_bags.verdict.terminal import print_tests
from pendulum_msgs_py.errors import DataError
from pendulum_msgs_py.plants.plant_parameters import PlantParameters
from pendulum_msgs_py.programs.terminal import make_console
from pendulum_testing.plant_pairs import MACHINE, SIMULATED, pair, record_compiled


def outcomes(comparison: Comparison) -> dict[str, Outcome]:
    return {test.quantity: test.outcome for test in comparison.verdict.tests}


def estimates(comparison: Comparison) -> dict[str, float]:
    return {test.quantity: test.interval.estimate for test in comparison.verdict.tests}


def test_one_plant_sampled_at_another_rate_is_the_same_plant() -> None:
    found = compare([pair(3)])
    assert found.verdict.outcome is Outcome.EQUIVALENT
    assert estimates(found)["spread of velocity (ratio)"] == pytest.approx(1.0, abs=0.025)
    assert estimates(found)["delay"] == pytest.approx(0.0, abs=0.6)


@pytest.mark.parametrize("late", [0.002, 0.005, 0.008, 0.04])
def test_a_pure_delay_is_measured_and_is_no_difference_in_spread(late: float) -> None:
    found = compare([pair(5, late=late)])
    # 40 ms in the loop do change how it moves.
    assert estimates(found)["delay"] == pytest.approx(1e3 * late, abs=0.8 if late < 0.01 else 4.0)
    tolerance = 0.05 if late < 0.01 else 0.2
    assert estimates(found)["spread of velocity (ratio)"] == pytest.approx(1.0, abs=tolerance)


def test_the_faster_side_may_be_either() -> None:
    simulation, hardware = pair(4, late=0.008)
    exchanged = compare([(hardware, replace(simulation, metadata={}))])
    assert estimates(exchanged)["delay"] == pytest.approx(-8.0, abs=0.8)
    assert estimates(exchanged)["spread of velocity (ratio)"] == pytest.approx(
        1.0 / estimates(compare([(simulation, hardware)]))["spread of velocity (ratio)"], rel=0.01
    )


def changed(run: RunData, **columns: np.ndarray) -> RunData:
    return replace(run, window=replace(run.window, **columns))


def test_every_test_can_fail_alone() -> None:
    """Motions made for the purpose: each differs in one thing, and the test of that thing finds it."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 10.0, 0.002)
    wave = sum(rng.normal() * np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.0)) for f in np.arange(0.5, 15.0, 0.23))
    wave, other = 0.02 * wave / wave.std(), np.roll(0.02 * wave / wave.std(), 2500)
    still = Series(t, math.pi + wave, 5.0 * wave, 30.0 * wave)

    def found(**columns: np.ndarray) -> set[str]:
        tests = paired_tests([(still, replace(still, **columns))], Margins.parse())
        return {test.quantity for test in tests if test.outcome is Outcome.DIFFERENT}

    assert found() == set()
    assert found(position=math.pi + wave + 0.01) == {"mean angle difference"}
    assert found(position=math.pi + 1.3 * wave) == {"spread of angle (ratio)"}
    assert found(velocity=5.0 * 1.3 * wave) == {"spread of velocity (ratio)"}
    assert found(effort=30.0 * 1.3 * wave) == {"spread of torque (ratio)"}
    mixed = 0.8 * wave + 0.6 * other
    assert found(velocity=5.0 * mixed) >= {"distance of velocities", "distance of velocities less the delay"}
    assert found(position=math.pi + mixed) >= {"distance of angles", "distance of angles less the delay"}
    late = replace(still, t=t + 0.02)
    tests = paired_tests([(still, late)], Margins.parse())
    assert {test.quantity for test in tests if test.outcome is Outcome.DIFFERENT} == {
        "delay",
        "distance of angles",
        "distance of velocities",
    }


@pytest.mark.parametrize("late", [0.3, -0.3])
def test_a_delay_beyond_all_that_is_looked_at_is_not_reported_as_the_last_of_it(late: float) -> None:
    """Where the likeness still grows at the end of the search there is no peak, and no delay that could be stated."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 40.0, 0.005)
    wave = sum(rng.normal() * np.sin(2.0 * math.pi * f * t + rng.uniform(0.0, 6.0)) for f in np.arange(0.1, 0.7, 0.03))
    slow = Series(t, math.pi + 0.02 * wave, 0.1 * np.gradient(wave, t), wave)
    tests = {test.quantity: test for test in paired_tests([(slow, replace(slow, t=t + late))], Margins.parse())}
    assert tests["delay"].outcome is Outcome.UNDECIDED
    assert (tests["delay"].interval.low, tests["delay"].interval.high) == (-100.0, 100.0)
    assert tests["delay"].sentence() == "delay: the motions are too dissimilar to measure it"
    # Nothing was taken out of the distances.
    assert not [name for name in tests if "less the delay" in name]


@pytest.mark.parametrize("late", [0.12, 0.2])
def test_a_machine_far_too_late_is_not_reported_to_be_early_by_a_chance_peak(late: float) -> None:
    found = compare([pair(5, late=late)])
    assert outcomes(found)["delay"] is Outcome.UNDECIDED
    assert found.verdict.outcome is Outcome.DIFFERENT
    reason = same_run_layer(found).reason
    assert "earlier" not in reason
    assert "later" not in reason


def test_no_delay_is_reported_as_none_in_every_place_and_lies_within_no_margin() -> None:
    found = compare([pair(3, late=0.09)], margin={"delay": "150 ms"})
    tested = next(test for test in found.verdict.tests if test.quantity == "delay")
    assert tested.outcome is Outcome.UNDECIDED
    assert math.isnan(found.delay)
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["verdict"]["tests"]
    figures = {figure.name: figure for figure in comparison_figures(found)}
    assert "cannot be determined: there is no peak" in figures["alignment"].sentence
    assert "nan" not in " ".join(figure.sentence for figure in figures.values())
    # A comparison that differs is told as such all the same.
    assert same_run_layer(found).mark is Mark.NO


def test_margins_in_units_are_those_of_the_signals() -> None:
    simulation, hardware = pair(3)
    stated = ["spread_angle=0.001 deg", "spread_torque=0.5 N m", "path_velocity=10 deg/s"]
    tests = {test.quantity: test for test in compare([(simulation, hardware)], margin=stated).verdict.tests}
    wider = hardware.window.position.std() - simulation.window.position.std()
    assert tests["spread of angle difference"].unit == "deg"
    assert tests["spread of angle difference"].interval.estimate == pytest.approx(math.degrees(wider), abs=0.004)
    assert tests["spread of torque difference"].outcome is Outcome.EQUIVALENT
    assert tests["distance of velocities"].unit == "deg/s"


def test_two_pendulums_that_hang_are_not_a_turn_apart() -> None:
    simulation, hardware = pair(6)
    down = changed(hardware, position=hardware.window.position + 2.0 * math.pi)
    assert compare([(simulation, down)]).verdict.outcome is Outcome.EQUIVALENT


# -- one disturbance ---------------------------------------------------------------------------------------------


def test_noise_twice_as_large_is_not_the_same_noise() -> None:
    simulation, hardware = pair(7)
    louder = record_compiled(SIMULATED, rate=100.0, seed=7, duration=5.0, amplitude=5.0, label="hardware")
    found = compare([(simulation, louder)])
    assert not found.is_paired
    assert "the hardware's is 2.00 times the simulation's" in found.paired["reason"]
    assert found.verdict.outcome is Outcome.UNDECIDED
    assert compare([(simulation, hardware)]).is_paired


def test_independent_noise_that_seldom_changes_is_hardly_ever_taken_for_one() -> None:
    from pendulum_bags.comparison.same_signal import compare_signals

    rng = np.random.default_rng(0)
    t = np.arange(0.0, 5.0, 0.01)
    taken = 0
    for _ in range(150):
        first, second = (Signal(t, np.repeat(rng.uniform(-2.5, 2.5, 5), 100)) for _ in range(2))
        shared = compare_signals(first, second, 0.01)
        assert shared is not None
        taken += shared.is_one
        same = compare_signals(first, first, 0.01)
        assert same is not None
        assert same.is_one
    assert taken <= 1


# -- pooling -----------------------------------------------------------------------------------------------------


def told(run: RunData, **changes: object) -> RunData:
    return replace(run, metadata={"pendulum.run": {**run.metadata["pendulum.run"], **changes}})


def test_one_run_or_one_seed_twice_and_unlike_runs_are_not_pooled(tmp_path: Path) -> None:
    first, second = pair(1, 1.0), pair(2, 1.0)
    assert compare([first, second]).pairs[1] is not None
    with pytest.raises(DataError, match="hold one and the same recording; expected independent runs to pool"):
        compare([first, first])
    with pytest.raises(DataError, match=r"have one seed \(1\), so one and the same noise"):
        compare([first, (told(second[0], seed=1), told(second[1], seed=1))])
    pid = {"kind": "pid"}
    lqr = {"kind": "lqr", "q": [100.0, 0.01]}
    ones = tuple(told(run, controller=lqr) for run in first)
    others = tuple(told(run, controller=pid) for run in second)
    with pytest.raises(DataError, match="runs with different controllers cannot be pooled: lqr"):
        compare([ones, others])  # type: ignore[list-item]
    with pytest.raises(DataError, match="simulation and hardware had different controllers"):
        compare([(ones[0], told(first[1], controller=pid))])
    noise = {"kind": "uniform", "amplitude": 2.5}
    quiet = tuple(told(run, disturbance=noise) for run in first)
    loud = tuple(told(run, disturbance={**noise, "amplitude": 5}) for run in second)
    with pytest.raises(DataError, match=r"different disturbances, in amplitude cannot be pooled: 2\.5"):
        compare([quiet, loud])  # type: ignore[list-item]
    waiting = tuple(told(run, clock="lockstep") for run in first)
    with pytest.raises(DataError, match=r"different clocks cannot be pooled: lockstep in .*, real time in"):
        compare([waiting, second])  # type: ignore[list-item]
    # Lists and tuples, whole and broken numbers are one in JSON.
    assert compare([ones, tuple(told(run, controller={"kind": "lqr", "q": (100, 0.01)}) for run in second)])  # type: ignore[list-item]


def test_simulation_and_hardware_the_wrong_way_round_are_refused() -> None:
    simulation, hardware = pair(1, 1.0)
    with pytest.raises(DataError, match="expected the simulation first"):
        compare([(told(hardware, namespace="/hw"), told(simulation, namespace="/sim"))])
    with pytest.raises(DataError, match="expected one of each plant"):
        compare([(simulation, simulation)])


# -- spectra -----------------------------------------------------------------------------------------------------


def test_a_tone_above_the_slower_plants_reach_is_not_folded_into_its_band() -> None:
    t = np.arange(0.0, 10.0, 0.002)
    slow = t[::5]
    rng = np.random.default_rng(1)
    fast = Series(t, np.zeros_like(t), np.sin(2.0 * np.pi * 70.0 * t), np.zeros_like(t))
    other = Series(slow, np.zeros_like(slow), 0.01 * rng.standard_normal(slow.size), np.zeros_like(slow))
    found = spectra_of(fast, other)
    near = np.abs(found.frequency - 30.0) < 3.0
    # Folded, the tone would have its whole power of 1/2 there.
    assert found.first[near].sum() * found.frequency[1] < 1e-4
    assert found.frequency[-1] == pytest.approx(50.0)


# -- words -------------------------------------------------------------------------------------------------------


def test_the_layer_says_what_differs_and_what_to_do() -> None:
    late = same_run_layer(compare([pair(5, late=0.01)]))
    assert late.mark is Mark.NO
    assert late.reason.startswith("the hardware responds 10")
    assert late.reason.split(";")[0].endswith("ms later than the simulation (5 ms allowed)")
    assert late.next_steps[0].startswith("Give the simulated plant 10")
    assert "ms more delay than now: transport_delay in its plant file" in late.next_steps[0]
    simulation, hardware = pair(5, late=0.01)
    early = same_run_layer(compare([(hardware, replace(simulation, metadata={}))]))
    assert "ms less delay than now" in early.next_steps[0]
    slack = same_run_layer(compare([pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))]))
    assert re.search(
        r"the hardware's spread of velocity is 4\d(\.\d)? % smaller \(13 % allowed; ratio 0\.5\d\d?\)", slack.reason
    )
    assert "identify" in slack.next_steps[0]
    fine = same_run_layer(compare([pair(5, plant=MACHINE)]))
    assert fine.mark is Mark.YES
    assert re.search(r"in all 9 tests; nearest to its margin, the .* is .* \(.* allowed", fine.reason)
    assert not fine.next_steps


def test_every_figure_of_the_headline_stands_in_the_table_of_tests_under_its_name() -> None:
    def told(comparison: Comparison) -> tuple[list[str], str]:
        layer = same_run_layer(comparison)
        assert layer.mark is Mark.NO
        rows = table_of_tests(comparison).rows
        said = [row for row in rows if row[4] == "not equivalent" and row[1].lstrip("−") in layer.sentence]
        return [row[0] for row in said], layer.sentence

    slack = compare([pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))])
    names, sentence = told(slack)
    assert {"spread of angle (ratio)", "spread of velocity (ratio)", "spread of torque (ratio)"} <= set(names)
    assert sentence.count(" allowed; ratio ") == 3
    assert all(f"spread of {what} is" in sentence for what in ("angle", "velocity", "torque"))
    # Twice and more is told as a factor, which is the ratio.
    simulation, hardware = pair(5, plant=SIMULATED.with_values(damping=3 * 11.77))
    names, sentence = told(compare([(hardware, replace(simulation, metadata={}))]))
    assert "spread of velocity (ratio)" in names
    assert re.search(r"spread of velocity is \d\.\d\d times as large \(1\.15 times allowed\)", sentence)
    # In a unit, in a narrower band.
    names, sentence = told(
        compare(
            [pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))],
            margin=["spread_angle=0.01deg", "spread_velocity=9rad/s", "spread_torque=9 N m", "band=5Hz"],
        )
    )
    assert "spread of angle difference [deg]" in names
    assert re.search(r"spread of angle is 0\.\d+ deg smaller \(0\.01 deg allowed\)", sentence)


@pytest.mark.parametrize(
    ("quantity", "unit", "value", "words"),
    [
        (
            "distance of velocities less the delay",
            "%",
            33.54,
            "the distance of velocities less the delay is 33.5 % of the hardware's spread (1.15 % allowed)",
        ),
        ("distance of angles", "deg", 0.1234, "the distance of angles is 0.123 deg (1.15 deg allowed)"),
        ("mean angle difference", "deg", -0.3456, "the hardware's mean angle is 0.346 deg lower (0.87 deg allowed)"),
        (
            "spread of angle (ratio)",
            "-",
            1.234,
            "the hardware's spread of angle is 23.4 % larger (15 % allowed; ratio 1.23)",
        ),
    ],
)
def test_the_headline_has_the_digits_of_the_table_and_the_margin_in_the_same_unit(
    quantity: str, unit: str, value: float, words: str
) -> None:
    interval = Interval(value, value, value, 0.9, 0.0, 9)
    test = EquivalenceTest(quantity, unit, interval, -0.87 if unit != "-" else 0.87, 1.15, Outcome.DIFFERENT, 0, 1.0)
    assert in_words(test) == words


def test_a_headline_of_unpaired_runs_does_not_speak_of_common_times() -> None:
    simulation, hardware = pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))
    apart = compare([(replace(simulation, disturbance=None), hardware)])
    assert not apart.is_paired
    assert apart.seen == "below 20 Hz"
    slow = replace(hardware, window=hardware.window.between(0.0, 1e9))
    assert compare([(simulation, slow)]).seen == "at the slower plant's sampling times and below 20 Hz"
    assert "sampling times" not in seen_note(apart)


def test_the_band_of_the_tests_is_that_of_the_slowest_plant_of_all_runs() -> None:
    simulation, _ = pair(6)
    fast = record_compiled(MACHINE, rate=200.0, seed=6, duration=5.0, label="hardware")
    both = compare([(simulation, fast), pair(5)], margin="band=60Hz")
    assert both.is_tested_in_pairs
    assert both.seen == "at the slower plant's sampling times and below 40 Hz"
    slow = record_compiled(MACHINE, rate=40.0, seed=6, duration=5.0, label="hardware")
    assert compare([pair(5), (simulation, slow)]).band == pytest.approx(16.0)
    assert compare([(slow, record_compiled(MACHINE, rate=100.0, seed=6, duration=5.0))]).band == pytest.approx(16.0)
    apart = compare([pair(5), (replace(simulation, disturbance=None), slow)])
    assert apart.seen == "below 16 Hz"


def test_without_pairs_the_note_tells_the_ratio_to_the_simulation_that_was_tested() -> None:
    simulation, hardware = pair(5)
    own = record_compiled(SIMULATED.with_values(damping=2 * 11.77), rate=500.0, seed=8, duration=5.0)
    apart = compare([(replace(simulation, disturbance=None), hardware)], own=[own])
    ratio = hardware.window.velocity.std(ddof=1) / own.window.velocity.std(ddof=1)
    assert f"and {ratio:.3g} (velocity)" in seen_note(apart)


def test_the_note_leaves_out_the_ratio_to_a_simulation_that_tells_no_velocity() -> None:
    comparison = compare([pair(5)])
    (one,) = comparison.pairs
    window = replace(one.simulation.window, velocity=np.zeros_like(one.simulation.window.velocity))
    still = replace(comparison, pairs=[replace(one, simulation=replace(one.simulation, window=window))])
    assert seen_note(still).endswith("(angle).")


def test_the_note_speaks_of_emulated_hardware_where_no_machine_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    simulation, hardware = pair(5)
    emulated = compare([(simulation, replace(hardware, metadata={"pendulum.run": {"plant": "emulator"}}))])
    print_tests(make_console(), emulated)
    assert "emulated hardware per simulation" in " ".join(capsys.readouterr().out.split())


def test_the_note_below_the_tests_tells_the_ratios_over_all_samples() -> None:
    comparison = compare([pair(5, plant=SIMULATED.with_values(damping=2 * 11.77))])
    simulation, hardware = comparison.pairs[0].simulation.window, comparison.pairs[0].hardware.window
    angle, velocity = (
        getattr(hardware, name).std(ddof=1) / getattr(simulation, name).std(ddof=1) for name in ("position", "velocity")
    )
    assert f"hardware per simulation, are {angle:.3g} (angle) and {velocity:.3g} (velocity)." in seen_note(comparison)
    assert "sampling times and below 20 Hz, since its velocity is seen at those phases" in seen_note(comparison)


@pytest.mark.parametrize("plant", [MACHINE, SIMULATED.with_values(damping=2 * 11.77)])
def test_what_to_do_about_a_simulation_of_others_is_done_in_it(plant: PlantParameters) -> None:
    simulation, hardware = pair(5, plant=plant, late=0.01)
    foreign = replace(simulation, metadata={"pendulum.run": {"simulation": {"name": "lab.xml"}}})
    for run, named in ((foreign, True), (simulation, False)):
        (step,) = same_run_layer(compare([(run, hardware)])).next_steps
        assert ("lab.xml" in step, "--plant" in step) == (named, not named)


def test_a_model_file_that_simulated_is_identified_itself() -> None:
    simulation, hardware = pair(5, plant=SIMULATED.with_values(damping=2 * 11.77), late=0.01)
    command = "pendulum experiment thesis --simulation 'my lab/arm.urdf' --mapping lab.yaml --out run"
    record = {"simulation": {"name": "arm.urdf"}, "command": f"python {command}"}
    foreign = replace(simulation, metadata={"pendulum.run": record})
    (step,) = same_run_layer(compare([(foreign, hardware)])).next_steps
    assert "--model 'my lab/arm.urdf' --model-mapping lab.yaml --out arm_identified.urdf)" in step
    assert step.endswith("measure again with --simulation arm_identified.urdf --mapping lab.yaml.")


def test_looking_again_widens_the_intervals_so_that_all_looks_together_err_no_more() -> None:
    spent = sum(1.0 - Looks(number).level for number in range(1, 60))
    assert spent == pytest.approx(0.1)
    assert Looks().level == pytest.approx(0.9)
    once, third = (compare([pair(5)], looks=Looks(number)).verdict.tests[1].interval for number in (0, 3))
    assert third.high - third.low > 1.3 * (once.high - once.low)


def test_the_compiled_pairs_are_the_interpreted_ones() -> None:
    hardware = {"late": 0.004, "gain": 1.1, "plant": MACHINE.with_values(torque_offset=0.05)}
    for plain, compiled in zip(pair(3, 1.0, compiled=False, **hardware), pair(3, 1.0, **hardware), strict=True):
        for name in ("t", "position", "velocity", "effort"):
            expected = getattr(plain.window, name)
            np.testing.assert_allclose(getattr(compiled.window, name), expected, rtol=1e-9, atol=1e-9)
        assert compiled.disturbance is not None
        assert plain.disturbance is not None
        np.testing.assert_array_equal(compiled.disturbance.value, plain.disturbance.value)
