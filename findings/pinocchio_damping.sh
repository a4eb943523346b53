#!/usr/bin/env bash
# Expected: a joint's damping, read from its URDF, acts in the forward dynamics.
# Happens: the model holds it (model.damping), and aba computes the acceleration without it: torque for the same
# motion is too small, an identified damping written into the URDF changes nothing.
# Seen with: pin (Pinocchio) 4.1.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pin==4.1.0 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
import pinocchio

TEXT = """<robot name="pendulum"><link name="base"/><link name="arm"><inertial>
<origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="2" velocity="9"/><dynamics damping="0.1" friction="0.05"/></joint></robot>"""
model = pinocchio.buildModelFromXML(TEXT)
hanging, zero, moving = np.zeros(1), np.zeros(1), np.array([2.0])
acceleration = pinocchio.aba(model, model.createData(), hanging, moving, zero)
torque = pinocchio.rnea(model, model.createData(), hanging, moving, zero)
print("damping", model.damping, "friction", model.friction, "at 2 rad/s: acceleration", acceleration, "torque", torque)
assert model.damping[0] == 0.1
assert abs(acceleration[0]) < 1e-12
assert abs(torque[0]) < 1e-12
PY
