#!/usr/bin/env bash
# Expected: the B of mjd_transitionFD is the zero-order-hold B of the joint's equation, up to O(h) of each entry.
# Happens: the velocity row is, the position row is twice that: the default integrator is semi-implicit, so a torque
# moves the angle by h^2/M in its first step instead of h^2/(2M), however small h is. RK4, which has the right row, is
# refused.
# Seen with: mujoco 4.0.0, scipy 1.15.3, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    --no-deps mujoco==4.0.0 mujoco-core==4.0.0 scipy==1.15.3 numpy==2.2.6
env/bin/python - <<'PY'
import mujoco
import numpy as np
from scipy.signal import cont2discrete

BODY = """<worldbody><body><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>"""


def model_of(step, integrator="Euler"):
    text = f"""<mujoco><option timestep="{step}" gravity="0 0 0" integrator="{integrator}"/>{BODY}
    <actuator><motor joint="j"/></actuator></mujoco>"""
    return mujoco.MjModel.from_xml_string(text)


for step in (0.01, 0.0001):
    model = model_of(step)
    a, b = np.zeros((2, 2)), np.zeros((2, 1))
    mujoco.mjd_transitionFD(model, mujoco.MjData(model), 1e-6, True, a, b, None, None)
    plant = (np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1 / model.dof_M0[0]]]), np.eye(2), np.zeros((2, 1)))
    exact = cont2discrete(plant, step)[1]
    ratio = (b / exact).ravel()
    print("step", step, "s: B / exact B =", ratio)
    assert np.allclose(ratio, [2.0, 1.0], rtol=1e-3)
model = model_of(0.01, "RK4")
try:
    mujoco.mjd_transitionFD(model, mujoco.MjData(model), 1e-6, True, a, b, None, None)
except mujoco.FatalError as error:
    print("RK4:", error)
else:
    raise SystemExit("RK4 is taken now")
PY
