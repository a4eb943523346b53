"""Disturbances: pure functions of seed and time, with the statistics and spectra that they promise."""

import math

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS, DISTURBANCES, from_bag, make_disturbance, torques
from pendulum_lqr.disturbances.disturbing import DisturbanceLoop
from pendulum_lqr.disturbances.multisine import multisine_harmonics
from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import DataError, ParameterError
from pendulum_msgs_py.parameters import validate

MS = 1_000_000
SECOND = 1_000_000_000


@pytest.mark.parametrize("kind", DISTURBANCES)
def test_the_torque_depends_on_time_alone_whatever_was_asked_before(kind):
    times = np.arange(0, 3 * SECOND, 7 * MS)
    first = torques(make_disturbance({"kind": kind, "seed": 5}), times)
    other = make_disturbance({"kind": kind, "seed": 5})
    shuffled = np.random.default_rng(0).permutation(len(times))
    backwards = np.empty_like(first)
    backwards[shuffled] = [other(int(times[k])) for k in shuffled]
    np.testing.assert_array_equal(first, backwards)
    assert np.any(first != 0.0)
    assert other(-1) == 0.0


@given(st.integers(0, 2**40), st.integers(0, 10**12), st.floats(0.001, 1.0))
@settings(deadline=None)
def test_a_random_sample_is_held_for_the_hold_time(seed, elapsed_ns, hold_time):
    signal = make_disturbance({"seed": seed, "hold_time": hold_time})
    hold_ns = round(hold_time * SECOND)
    start = elapsed_ns - elapsed_ns % hold_ns
    assert signal(elapsed_ns) == signal(start) == signal(start + hold_ns - 1)
    assert signal(elapsed_ns) == noise.uniform(seed, elapsed_ns // hold_ns, 2.5)


def test_uniform_fills_its_interval_and_is_white():
    values = torques(make_disturbance({"seed": 2, "amplitude": 2.5, "hold_time": 0.002}), np.arange(20000) * 2 * MS)
    assert -2.5 <= values.min() < -2.49
    assert 2.49 < values.max() < 2.5
    assert values.std() == pytest.approx(2.5 / math.sqrt(3.0), rel=0.02)
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.03


def test_gaussian_has_its_deviation_and_its_bandwidth():
    values = torques(
        make_disturbance({"kind": "gaussian", "seed": 2, "amplitude": 0.7, "hold_time": 0.005, "bandwidth": 10.0}),
        np.arange(12000) * 5 * MS,
    )
    assert values.std() == pytest.approx(0.7, rel=0.05)
    frequencies, power = scipy.signal.welch(values, fs=200.0, nperseg=512)
    level = power[(frequencies > 0.5) & (frequencies < 3.0)].mean()
    at_cut = power[(frequencies > 9.0) & (frequencies < 11.0)].mean()
    assert at_cut / level == pytest.approx(0.5, abs=0.12)
    assert power[frequencies > 40.0].mean() < 1e-3 * level


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_the_bandwidth_of_gaussian_noise_is_its_3_db_point_up_to_the_largest_that_is_taken(share):
    values = torques(make_disturbance({"kind": "gaussian", "bandwidth": 100.0 * share}), np.arange(10000) * 10 * MS)
    frequencies, power = scipy.signal.welch(values, fs=1.0, nperseg=512)
    level = power[(frequencies > 0.004) & (frequencies < 0.3 * share)].mean()
    at_cut = power[np.abs(frequencies - share) < 0.1 * share].mean()
    assert at_cut / level == pytest.approx(0.5, abs=0.12)


def test_a_sine_keeps_its_amplitude_up_to_the_largest_frequency_that_is_taken():
    for frequency in (1.0, 20.0, 49.0):
        values = torques(make_disturbance({"kind": "sine", "frequency": frequency}), np.arange(1000) * 10 * MS)
        assert values.std() == pytest.approx(2.5 / math.sqrt(2.0), rel=0.01)


def test_gaussian_without_bandwidth_is_white_and_one_too_narrow_is_refused():
    values = torques(make_disturbance({"kind": "gaussian", "bandwidth": 0.0}), np.arange(5000) * 10 * MS)
    assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 0.05
    with pytest.raises(ParameterError, match="expected a longer hold_time"):
        make_disturbance({"kind": "gaussian", "bandwidth": 0.001, "hold_time": 0.001})


@pytest.mark.parametrize("order", range(2, 17))
def test_prbs_of_every_order_has_full_length_and_is_balanced(order):
    length = 2**order - 1
    signal = make_disturbance({"kind": "prbs", "order": order, "amplitude": 1.0, "hold_time": 0.01})
    values = torques(signal, np.arange(length) * 10 * MS)
    assert set(values) == {-1.0, 1.0}
    assert values.sum() == 1.0
    # Two-valued autocorrelation is what makes a sequence one of maximum length: N at zero, -1 everywhere else.
    spectrum = np.abs(np.fft.fft(values)) ** 2
    correlation = np.fft.ifft(spectrum).real
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-6)
    assert signal(length * 10 * MS) == values[0]


def test_seeds_give_different_noise_and_shift_the_binary_sequence():
    times = np.arange(100) * 10 * MS
    for kind in ("uniform", "gaussian", "prbs"):
        one, two = (torques(make_disturbance({"kind": kind, "seed": seed}), times) for seed in (1, 2))
        assert np.any(one != two)


def test_sine_and_its_held_samples():
    smooth = make_disturbance({"kind": "sine", "amplitude": 2.0, "frequency": 0.5, "hold_time": 0.0})
    assert smooth(500 * MS) == pytest.approx(2.0)
    held = make_disturbance({"kind": "sine", "amplitude": 2.0, "frequency": 0.5, "hold_time": 0.4})
    assert held(799 * MS) == smooth(400 * MS)


def test_chirp_passes_every_octave_in_the_same_time():
    signal = make_disturbance(
        {
            "kind": "chirp",
            "frequency": 1.0,
            "frequency_end": 16.0,
            "sweep_time": 8.0,
            "hold_time": 0.0,
            "amplitude": 1.0,
        }
    )
    values = torques(signal, np.arange(0, 8 * SECOND, MS))
    # Two seconds an octave: f integrates to (2^k - 2^(k-1)) 2 / ln 2 turns in octave k.
    for octave in range(4):
        piece = values[octave * 2000 : (octave + 1) * 2000]
        crossings = np.count_nonzero(np.diff(np.sign(piece)) != 0)
        assert crossings == pytest.approx(2 * 2**octave * 2 / math.log(2.0), abs=1.5)
    assert signal(8 * SECOND + 100 * MS) == pytest.approx(signal(100 * MS), abs=1e-9)


def test_step_and_pulses_begin_at_their_time():
    step = make_disturbance({"kind": "step", "amplitude": 1.5, "start_time": 1.0, "hold_time": 0.0})
    assert (step(SECOND - 1), step(SECOND)) == (0.0, 1.5)
    pulses = make_disturbance(
        {
            "kind": "pulse_train",
            "amplitude": 1.5,
            "frequency": 2.0,
            "pulse_width": 0.1,
            "start_time": 1.0,
            "hold_time": 0.0,
        }
    )
    got = [pulses(t * MS) for t in (999, 1000, 1099, 1101, 1499, 1500, 1599, 1601, 2000)]
    assert got == [0.0, 1.5, 1.5, 0.0, 0.0, -1.5, -1.5, 0.0, 1.5]


def test_a_recording_is_replayed_at_the_same_times():
    signal = from_bag([0, 10 * MS, 20 * MS], [0.1, -0.2, 0.3])
    got = [signal(t) for t in (-1, 0, 10 * MS - 1, 10 * MS, 25 * MS, 30 * MS - 1, 30 * MS)]
    assert got == [0.0, 0.1, 0.1, -0.2, 0.3, 0.3, 0.0]
    assert make_disturbance({"kind": "from_bag"}, signal) is signal


@pytest.mark.parametrize(
    ("times", "values", "message"),
    [
        ([0, 1], [0.0], "expected equal"),
        ([], [], "expected equal"),
        ([0, 0], [0.0, 1.0], "time 0 ns follows 0 ns; expected increasing"),
        ([0, 1], [0.0, math.nan], "not finite"),
    ],
)
def test_a_bad_recording_is_refused(times, values, message):
    with pytest.raises(DataError, match=message):
        from_bag(times, values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"kind": "uniform", "hold_time": 0.0}, "hold_time is 0 s; expected > 0 for the random kind uniform"),
        ({"kind": "sine", "hold_time": 1e-12}, "expected 0 or at least 1e-9 s"),
        ({"kind": "from_bag"}, "without a recording"),
        ({"kind": "pulse_train", "pulse_width": 2.0}, "expected at most 1/frequency = 1 s"),
        ({"kind": "brown"}, "kind is 'brown'; expected one of uniform"),
        ({"amplitude": math.inf}, "expected a finite number"),
        ({"kind": "gaussian", "bandwidth": 40.0}, "would be white; expected at most 0.25/hold_time = 25 Hz"),
        ({"kind": "sine", "frequency": 100.0}, "frequency is 100 Hz .* expected less than 0.5/hold_time = 50 Hz"),
        ({"kind": "sine", "frequency": 50.0}, "expected less than 0.5/hold_time = 50 Hz, or hold_time 0"),
        ({"kind": "chirp", "frequency_end": 60.0}, "frequency_end is 60 Hz with hold_time 0.01 s"),
        ({"kind": "chirp", "frequency": 60.0, "frequency_end": 1.0}, "frequency is 60 Hz with hold_time 0.01 s"),
        ({"kind": "multisine", "frequency_end": 60.0, "lines": 500}, "highest line is 59.75 Hz with hold_time 0.01 s"),
        ({"kind": "pulse_train", "pulse_width": 0.005}, "between whose samples a pulse may"),
    ],
)
def test_a_bad_disturbance_is_refused_with_its_reason(values, message):
    with pytest.raises(ParameterError, match=message):
        make_disturbance(values)


def test_the_table_of_kinds_and_the_choices_of_the_parameter_agree():
    assert {*DISTURBANCES, "from_bag"} == set(DISTURBANCE_SPECS[0].choices)


# --- when it acts --------------------------------------------------------------------------------------------------


def test_the_signal_starts_with_the_first_state_after_the_start_and_ends_with_zero():
    loop = DisturbanceLoop(make_disturbance({"kind": "step", "amplitude": 1.0}), duration=0.03)
    answers = [loop.answer(k * 10 * MS) for k in range(3)]
    assert [a.torque for a in answers] == [0.0] * 3
    assert loop.start()
    assert not loop.start()
    answers = [loop.answer(k * 10 * MS) for k in range(3, 9)]
    assert [a.torque for a in answers] == [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert [a.event for a in answers] == ["noise_start", "", "", "noise_end", "", ""]
    assert not loop.running


def test_time_counts_from_the_state_that_started_it_even_if_states_are_missed():
    noise_signal = make_disturbance({"seed": 9})
    loop = DisturbanceLoop(noise_signal)
    for k in range(3):
        loop.answer(100 * MS + 10 * k * MS)
    loop.start()
    assert loop.answer(130 * MS).torque == noise_signal(0)
    assert loop.answer(200 * MS).torque == noise_signal(70 * MS)


@given(
    st.lists(st.integers(-2 * MS, 2 * MS), min_size=50, max_size=50),
    st.lists(st.integers(0, 49), max_size=6, unique=True),
    st.lists(st.integers(-12, 40), max_size=3, unique=True),
)
@settings(deadline=None)
def test_stamps_that_jitter_stall_or_come_in_pairs_read_the_signal_that_exact_ones_read(jitter, lost, short):
    noise_signal = make_disturbance({"seed": 9})
    loop = DisturbanceLoop(noise_signal)
    start = 100 * MS
    for k in range(-10, 0):
        loop.answer(start + 10 * k * MS)
        if k in short:
            loop.answer(start + 10 * k * MS + MS // 20)
    loop.start()
    got, expected = [loop.answer(start).torque], [noise_signal(0)]
    for k, offset in enumerate(jitter, start=1):
        if k in lost:
            continue
        stamp = start + 10 * k * MS + offset
        got.append(loop.answer(stamp).torque)
        expected.append(noise_signal(10 * k * MS))
        if k in short:
            # A state 50 us after another, as after a stall.
            loop.answer(stamp + MS // 20)
    assert got == expected


def test_one_short_interval_does_not_spoil_the_rest_of_the_life_of_the_node():
    noise_signal = make_disturbance({"seed": 9})
    loop = DisturbanceLoop(noise_signal)
    rng = np.random.default_rng(3)
    for stamp in (0, MS // 20, *(10 * k * MS for k in range(1, 10))):
        loop.answer(stamp)
    loop.start()
    stamps = 100 * MS + 10 * MS * np.arange(2000)
    stamps[1:] += rng.normal(0.0, 0.3 * MS, 1999).round().astype(np.int64)
    got = np.array([loop.answer(int(stamp)).torque for stamp in stamps])
    wanted = np.array([noise_signal(10 * k * MS) for k in range(2000)])
    assert np.corrcoef(got, wanted)[0, 1] > 0.9999


def test_a_stop_ends_with_one_event_and_zero():
    loop = DisturbanceLoop(make_disturbance({"kind": "step", "amplitude": 1.0}))
    assert not loop.stop()
    loop.start()
    loop.answer(0)
    assert loop.stop()
    assert loop.answer(1) == (0.0, "noise_end")
    assert loop.answer(2) == (0.0, "")


def test_a_start_right_after_a_stop_tells_the_end_before_the_new_beginning():
    signal = make_disturbance({"kind": "step", "amplitude": 1.0})
    loop = DisturbanceLoop(signal)
    loop.start()
    loop.answer(0)
    loop.stop()
    assert loop.start()
    answers = [loop.answer(k) for k in range(1, 4)]
    assert answers == [(0.0, "noise_end"), (1.0, "noise_start"), (1.0, "")]


def test_an_answered_or_overtaken_state_gets_no_second_answer():
    loop = DisturbanceLoop(make_disturbance({}))
    assert loop.answer(5) is not None
    assert loop.answer(5) is None
    assert loop.answer(4) is None
    assert loop.refused == 2


@pytest.mark.parametrize("duration", [0.004, 0.6, 5.0])
@pytest.mark.parametrize("kind", ["uniform", "sine"])
def test_a_simulation_that_begins_anew_gets_what_the_first_one_got(kind, duration):
    """However short the first one was; in lockstep a refused state would hang it for ever."""
    loop = DisturbanceLoop(
        make_disturbance({"kind": kind, "hold_time": 0.0 if kind == "sine" else 0.01}),
        simulated_time=True,
        autostart=True,
    )
    stamps = [SECOND + 2 * k * MS for k in range(round(duration / 0.002))]
    first = [loop.answer(stamp) for stamp in stamps]
    assert [loop.answer(stamp) for stamp in stamps] == first
    assert first[0].event == "noise_start"
    assert loop.refused == 0


def test_a_disturbance_that_was_started_by_hand_ends_with_its_simulation():
    loop = DisturbanceLoop(make_disturbance({"kind": "step", "amplitude": 1.0}), simulated_time=True)
    loop.start()
    assert [loop.answer(SECOND + k * MS).torque for k in range(3)] == [1.0, 1.0, 1.0]
    assert loop.answer(SECOND) == (0.0, "noise_end")
    # Started between the two runs, it begins with the second.
    loop.start()
    assert loop.answer(SECOND - MS) == (1.0, "noise_start")


# --- multisine -----------------------------------------------------------------------------------------------------

MULTISINE = {"kind": "multisine", "signal_period": 2.0, "frequency": 0.5, "frequency_end": 40.0, "hold_time": 0.0}


@pytest.mark.parametrize("seed", [1, 7, 2**40])
def test_a_multisine_has_power_on_its_lines_alone_repeats_and_peaks_at_its_amplitude(seed):
    values = {**MULTISINE, "seed": seed, "amplitude": 1.5}
    raster = torques(make_disturbance(values), np.arange(0, 4 * SECOND, MS))
    np.testing.assert_allclose(raster[:2000], raster[2000:], atol=1e-12)
    spectrum = np.abs(np.fft.rfft(raster[:2000]))
    lines = multisine_harmonics(validate(DISTURBANCE_SPECS, values))
    assert np.all(lines % 2 == 1)
    assert (lines[0], lines[-1]) == (1, 79)
    np.testing.assert_allclose(spectrum[lines], spectrum[lines[0]], rtol=1e-9)
    assert np.delete(spectrum, lines).max() < 1e-9 * spectrum[lines[0]]
    assert 1.4 < np.abs(raster).max() <= 1.5
    # Random phases alone peak at 3 to 4 times the effective value.
    assert np.abs(raster).max() / raster.std() < 2.9


def test_a_multisine_without_a_line_in_its_band_is_refused():
    with pytest.raises(ParameterError, match=r"no odd multiple of 1/signal_period = 1 Hz lies between 1\.2 and 2\.8"):
        make_disturbance({**MULTISINE, "signal_period": 1.0, "frequency": 1.2, "frequency_end": 2.8})
    with pytest.raises(ParameterError, match="expected >= frequency = 3 Hz"):
        make_disturbance({**MULTISINE, "frequency": 3.0, "frequency_end": 2.0})
