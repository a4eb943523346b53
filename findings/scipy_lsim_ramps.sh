#!/usr/bin/env bash
# Expected: lsim holds an input until its next sample, as a controller's torque is held.
# Happens: it draws a line between samples: a step begins one sample early as a ramp, which is half a sample of lead.
# interp=False holds.
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
from scipy.signal import lsim

time = np.arange(10) / 10
torque = np.where(np.arange(10) >= 5, 1.0, 0.0)
integral = ([1.0], [1.0, 0.0])
drawn, held = lsim(integral, torque, time)[1], lsim(integral, torque, time, interp=False)[1]
print("torque", torque)
print("default     ", drawn.round(3))
print("interp=False", held.round(3))
assert abs(drawn[5] - 0.05) < 1e-12
assert abs(held[5]) < 1e-12
assert np.allclose((drawn - held)[5:], 0.05)
PY
