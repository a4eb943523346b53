#!/usr/bin/env bash
# Expected: input_output_response is given the input at 1 kHz, with its times, and uses each of these samples.
# Happens: the times say where the input is known and the output wanted; the solver chooses its steps by the motion. At
# rest they grow, and a pulse of 50 ms and 1 N m falls between two of them: the pendulum stays at rest, with no
# warning. forced_response, for the linear system, is right; solve_ivp_kwargs={"max_step": 0.01} finds the pulse.
# Seen with: python-control 0.10.2, numpy 2.2.6, scipy 1.15.3; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    control==0.10.2 numpy==2.2.6 scipy==1.15.3
env/bin/python - <<'PY'
import control as ct
import numpy as np

INERTIA, DAMPING, GRAVITY = 0.1, 0.1, 1.0  # kg m2, N m s/rad, N m


def pendulum(_, state, inputs, params):
    angle, rate = state
    return [rate, (inputs[0] - DAMPING * rate - GRAVITY * np.sin(angle)) / INERTIA]


times = np.arange(10_000) / 1000
torque = np.where((times >= 5) & (times < 5.05), 1.0, 0.0)
plant = ct.nlsys(pendulum, None, inputs=1, states=2, outputs=2)
linear = ct.linearize(plant, 0, 0)


def largest(response):
    return abs(response.states[0]).max()


missed = largest(ct.input_output_response(plant, times, torque))
missed_linear = largest(ct.input_output_response(linear, times, torque))
found = largest(ct.input_output_response(plant, times, torque, solve_ivp_kwargs={"max_step": 0.01}))
exact = largest(ct.forced_response(linear, times, torque))
print("largest angle:", missed, "rad, linear:", missed_linear, "with max_step:", found, "forced_response:", exact)
assert missed == 0
assert missed_linear == 0
assert abs(found - exact) < 0.01
assert exact > 0.1
PY
