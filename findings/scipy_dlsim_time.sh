#!/usr/bin/env bash
# Expected: dlsim with the times of its inputs, t = 0, T, 2T, ..., gives one output for each of them.
# Happens: the number of outputs is floor(t[-1] / dt) + 1. Where that quotient is rounded down, one output is missing
# and the others are spread over the same duration: with T = 0.1 s, four inputs give outputs at 0, 0.15 and 0.3 s, and
# the inputs are interpolated there. By that formula 640 of the lengths up to 5000 samples at 1 kHz are hit. Without t
# all is well.
# Seen with: scipy 1.15.3, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    scipy==1.15.3 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from scipy import signal


def simulate(period, count, with_times):
    """Outputs and their times of y[k+1] = 0.5 y[k] + u[k] for a ramp u[k] = k."""
    inputs = np.arange(float(count))
    times = np.arange(count) / round(1 / period) if with_times else None
    stamps, outputs = signal.dlsim(signal.dlti([1], [1, -0.5], dt=period), inputs, t=times)
    return stamps, outputs.ravel()


stamps, outputs = simulate(0.1, 4, with_times=True)
plain = simulate(0.1, 4, with_times=False)
print("with times:", stamps, outputs, "without:", *plain)
np.testing.assert_allclose(stamps, [0, 0.15, 0.3])
np.testing.assert_allclose(outputs, [0, 0, 1.5])
np.testing.assert_allclose(plain[1], [0, 0, 1, 2.5])

stamps, _ = simulate(0.001, 44, with_times=True)
print("1 kHz, 44 samples:", stamps.size, "outputs,", 1e3 * stamps[1], "ms apart")
assert stamps.size == 43
short = sum(int(np.floor(count / 1000 / 0.001)) < count for count in range(1, 5000))
print(short, "of 4999 lengths lose a sample")
assert short == 640
PY
