#!/usr/bin/env bash
# Expected: the filters of one library, given the same samples, agree on the attitude; another filter is another
# choice of noise, not of convention.
# Happens: AQUA gives the rotation from the world to the sensor, the others from the sensor to the world: an arm
# raised by 30 degrees is at -30 degrees. The conjugate of AQUA's quaternion agrees with the others.
# Seen with: ahrs 0.4.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    ahrs==0.4.0 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from ahrs.filters import AQUA, AngularRate, Complementary, Madgwick, Mahony

RATE, FREQUENCY = 0.5, 100.0  # rad/s, Hz
angle = RATE * np.arange(106) / FREQUENCY  # about the y axis of a level sensor, to 30 degrees
gyroscope = np.outer(np.full(angle.size, RATE), [0, 1, 0])
accelerometer = 9.81 * np.column_stack([-np.sin(angle), 0 * angle, np.cos(angle)])

pitch = {}
for kind in (AngularRate, Complementary, Madgwick, Mahony, AQUA):
    reading = {} if kind is AngularRate else {"acc": accelerometer}
    w, x, y, z = kind(gyr=gyroscope, frequency=FREQUENCY, **reading).Q[-1]
    pitch[kind.__name__] = round(float(np.degrees(np.arcsin(2 * (w * y - z * x)))), 1)
print("true pitch:", np.degrees(angle[-1]), "degrees; estimates:", pitch)
aqua = pitch.pop("AQUA")
np.testing.assert_allclose(list(pitch.values()), np.degrees(angle[-1]), atol=1)
np.testing.assert_allclose(aqua, -np.degrees(angle[-1]), atol=1)
PY
