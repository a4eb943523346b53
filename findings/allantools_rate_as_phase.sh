#!/usr/bin/env bash
# Expected: the Allan deviation of samples of a rate sensor, with its sampling rate given, is that of the sensor: white
# noise of standard deviation s gives s / sqrt(n) over n samples.
# Happens: samples are taken as phase, the integral of what was measured, unless data_type="freq" says otherwise: the
# result is too large by 390 at 10 ms, and falls as 1/n, which is read as quantisation noise.
# Seen with: allantools 2024.6, numpy 2.2.6, scipy 1.15.3; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    allantools==2024.6 numpy==2.2.6 scipy==1.15.3
env/bin/python - <<'PY'
import allantools
import numpy as np

rate, sigma = 500.0, 1e-3
velocity = np.random.default_rng(0).normal(scale=sigma, size=100_000)
taus = np.array([0.01, 0.1, 1.0])
default = allantools.oadev(velocity, rate=rate, taus=taus)[1]
as_rate = allantools.oadev(velocity, rate=rate, data_type="freq", taus=taus)[1]
white = sigma / np.sqrt(taus * rate)
print("tau [s]         ", taus)
print("white noise     ", white)
print("data_type=freq  ", as_rate)
print("default         ", default)
assert np.allclose(as_rate, white, rtol=0.1)
assert default[0] > 300 * white[0]
assert np.allclose(default[:-1] / default[1:], 10, rtol=0.1)
PY
