"""The disturbance's random numbers: one function of (seed, index), whoever computes it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pendulum_msgs_py.contract import noise
from pendulum_msgs_py.errors import ParameterError

_SEEDS = st.integers(0, noise.MAX_SEED)


def test_scramble_matches_the_published_splitmix64_sequence() -> None:
    # First outputs of the reference C implementation (prng.di.unimi.it/splitmix64.c) for state 1234567.
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert [noise.scramble(1234567, index) for index in (1, 2, 3, 4)] == expected


@given(seed=_SEEDS, start=st.integers(0, 2**40), amplitude=st.floats(0.0, 1e3))
def test_array_equals_single_samples_bit_for_bit(seed: int, start: int, amplitude: float) -> None:
    block = noise.uniform_array(seed, start, 5, amplitude)
    assert [noise.uniform(seed, start + offset, amplitude) for offset in range(5)] == block.tolist()


@given(seed=_SEEDS, index=st.integers(0, noise.MAX_SEED), amplitude=st.floats(0.0, 1e6))
def test_samples_stay_inside_the_amplitude(seed: int, index: int, amplitude: float) -> None:
    assert -amplitude <= noise.uniform(seed, index, amplitude) <= amplitude


def test_compiled_samples_equal_the_interpreted_ones() -> None:
    numba = pytest.importorskip("numba")
    scramble, unit = numba.njit(noise.scramble), numba.njit(noise.unit_interval)
    for seed, index in [(0, 0), (1, 5), (2**63 + 12345, 10**12), (noise.MAX_SEED, noise.MAX_SEED)]:
        key = noise.stream_key(seed)
        assert unit(scramble(np.uint64(key), np.uint64(index))) == noise.uniform(seed, index, 1.0)


def test_samples_are_uniform_and_streams_are_independent() -> None:
    samples = np.stack([noise.uniform_array(seed, 0, 20_000, 2.5) for seed in range(20)])
    assert stats.kstest(samples.ravel(), "uniform", args=(-2.5, 5.0)).pvalue > 1e-3
    assert samples.var() == pytest.approx(2.5**2 / 3.0, rel=0.01)
    between_seeds = np.corrcoef(samples) - np.eye(20)
    assert np.abs(between_seeds).max() < 5.0 / np.sqrt(20_000)
    along_time = np.corrcoef(samples[:, 1:].ravel(), samples[:, :-1].ravel())[0, 1]
    assert abs(along_time) < 5.0 / np.sqrt(400_000)


@pytest.mark.parametrize(("seed", "index"), [(-1, 0), (2**64, 0), (0, -1)])
def test_a_seed_or_index_out_of_range_is_refused(seed: int, index: int) -> None:
    with pytest.raises(ParameterError, match="expected an integer from 0 to 2\\^64 - 1"):
        noise.uniform(seed, index, 1.0)
