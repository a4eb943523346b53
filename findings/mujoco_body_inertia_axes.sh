#!/usr/bin/env bash
# Expected: a URDF link with a diagonal inertia (ixx, iyy, izz) has these in body_inertia, in this order.
# Happens: they are sorted, the largest first, and body_iquat turns the axes with them, also where the matrix is
# diagonal already: an identified ixx written to body_inertia[body, 0] changes the inertia about the z axis.
# Seen with: mujoco 4.0.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    --no-deps mujoco==4.0.0 mujoco-core==4.0.0 numpy==2.2.6
env/bin/python - <<'PY'
import mujoco
import numpy as np

URDF = """<robot name="arm"><link name="base"/><link name="link"><inertial><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.025" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="ball" type="floating"><parent link="base"/><child link="link"/></joint></robot>"""


def about_axes(model):
    """Inertia about the x, y and z axis of the link, from the inertia matrix of its free joint."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    columns = np.zeros((6, 6))
    for column, unit in zip(columns, np.eye(6), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return np.diag(columns)[3:]


model = mujoco.MjModel.from_xml_string(URDF)
body = model.body("link").id
before = about_axes(model)
print("body_inertia", model.body_inertia[body], "about x, y, z:", before)
model.body_inertia[body, 0] = 0.011  # meant: ixx, 10 % more
mujoco.mj_setConst(model, mujoco.MjData(model))
after = about_axes(model)
print("after body_inertia[body, 0] = 0.011, about x, y, z:", after)
np.testing.assert_allclose(before, [0.01, 0.02, 0.025])
np.testing.assert_allclose(after, [0.01, 0.02, 0.011])
PY
