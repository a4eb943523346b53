#!/usr/bin/env bash
# Expected: the gain margin of margin() is the factor by which the gain may rise, so more delay never makes it larger.
# Happens: it is the crossing nearest to 1 in decibels. A pendulum held upright has two, one for a falling gain and
# one for a rising gain: with 20 ms of delay 0.1 is returned and 11.8 is not, with 50 ms 5.1 is returned and 0.1 is
# not. stability_margins(returnall=True) gives both.
# Seen with: python-control 0.10.2, numpy 2.2.6, scipy 1.15.3; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    control==0.10.2 numpy==2.2.6 scipy==1.15.3
env/bin/python - <<'PY'
import control
import numpy as np

upright = control.tf([1], [1, 0, -1])
controller = control.tf([5, 10], [0.01, 1])
returned = {}
for delay in (0.02, 0.05):
    loop = controller * upright * control.tf(*control.pade(delay, 3))
    assert max(control.feedback(loop, 1).poles().real) < 0
    returned[delay] = float(control.margin(loop)[0])
    crossings = control.stability_margins(loop, returnall=True)[0]
    print("delay", delay, "s: margin", round(returned[delay], 3), "of", np.round(crossings, 3))
    assert np.isclose(crossings[0], 0.1)
    assert 5 < crossings[1] < 12
assert abs(returned[0.02] - 0.1) < 1e-6
assert abs(returned[0.05] - 5.13) < 0.01
PY
