#!/usr/bin/env bash
# Expected: measurementStdDevs of a KalmanFilter is the standard deviation of the sensor's samples.
# Happens: it is taken as a continuous noise and divided by the root of the period: at 500 Hz a sensor with 0.01 rad
# counts as one with 0.22 rad, at 50 Hz as one with 0.07 rad. The filter believes its model instead, and more so at a
# higher rate. The sample's value times the root of the period is right.
# Seen with: robotpy-wpimath 2026.2.2, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    robotpy-wpimath==2026.2.2 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from wpimath.estimator import KalmanFilter_1_1_1
from wpimath.system import LinearSystem_1_1_1

SENSOR = 0.01  # rad
plant = LinearSystem_1_1_1(*(np.array([[value]]) for value in (-1.0, 1.0, 1.0, 0.0)))


def assumed(given, period):
    """Standard deviation of a sample that explains the gain of the filter's correction."""
    kalman = KalmanFilter_1_1_1(plant, (0.1,), (given,), period)
    kalman.predict(np.zeros((1, 1)), period)
    variance = np.ravel(kalman.P())[0]
    kalman.correct(np.zeros((1, 1)), np.ones((1, 1)))
    gain = np.ravel(kalman.xhat())[0]
    return np.sqrt(variance * (1 - gain) / gain)


for period in (0.002, 0.02):
    noise = assumed(SENSOR, period)
    print(f"period {period} s: {SENSOR} rad given, {noise:.3f} rad assumed")
    np.testing.assert_allclose(noise, SENSOR / np.sqrt(period), rtol=1e-3)
    np.testing.assert_allclose(assumed(SENSOR * np.sqrt(period), period), SENSOR, rtol=1e-3)
PY
