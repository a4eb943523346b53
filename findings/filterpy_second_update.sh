#!/usr/bin/env bash
# Expected: two sensors read in one period are two calls of update after one predict, as with the KalmanFilter of the
# same library.
# Happens: UnscentedKalmanFilter.update takes the sigma points of predict, also the second time: the measurement that
# it compares with does not know the first update. Two encoders that both read 1 rad give 1.82 rad, and a negative
# variance.
# Seen with: filterpy 2.0.0, numpy 2.2.6, scipy 1.15.3; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    filterpy==2.0.0 numpy==2.2.6 scipy==1.15.3
env/bin/python - <<'PY'
import numpy as np
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

points = MerweScaledSigmaPoints(1, alpha=0.1, beta=2.0, kappa=2.0)
unscented = UnscentedKalmanFilter(1, 1, dt=0.01, hx=lambda x: x, fx=lambda x, dt: x, points=points)
linear = KalmanFilter(1, 1)
linear.F, linear.H = np.eye(1), np.eye(1)
for kalman in (unscented, linear):
    kalman.x, kalman.P = np.zeros(1), np.eye(1)  # rad, rad2
    kalman.Q, kalman.R = 1e-9 * np.eye(1), 0.1 * np.eye(1)
    kalman.predict()
    for angle in (1.0, 1.0):
        kalman.update(np.array([angle]))
        print(type(kalman).__name__, "angle", kalman.x[0], "variance", kalman.P[0, 0])
np.testing.assert_allclose((linear.x[0], linear.P[0, 0]), (0.952, 0.0476), rtol=1e-3)
np.testing.assert_allclose((unscented.x[0], unscented.P[0, 0]), (1.818, -0.818), rtol=1e-3)
PY
