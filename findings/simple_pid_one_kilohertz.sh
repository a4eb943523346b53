#!/usr/bin/env bash
# Expected: called with dt=0.001, the controller computes once per call.
# Happens: sample_time is 0.01 s by default, a shorter dt returns the output before, and the shorter times are not
# added up: at 1 kHz the first output is held for ever. sample_time=None computes each time.
# Seen with: simple-pid 2.0.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    simple-pid==2.0.1
env/bin/python - <<'PY'
from simple_pid import PID

angles = [0.1 * step for step in range(1, 1001)]
fast, every = PID(Kp=1.0), PID(Kp=1.0, sample_time=None)
fast_outputs = {fast(angle, dt=0.001) for angle in angles}
all_outputs = {every(angle, dt=0.001) for angle in angles}
print("1 s at 1 kHz: different outputs", len(fast_outputs), "with sample_time=None", len(all_outputs))
assert fast_outputs == {-0.1}
assert len(all_outputs) == 1000
PY
