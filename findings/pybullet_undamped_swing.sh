#!/usr/bin/env bash
# Expected: a URDF joint with damping 0 and friction 0, its motor switched off, swings with constant amplitude.
# Happens: each link has a linear and an angular damping of 0.04 of its own, which the file cannot say: a swing of 1
# rad has 0.7 rad left after 10 s. changeDynamics with both at 0 keeps 1 rad.
# Seen with: pybullet 3.2.7, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pybullet==3.2.7 numpy==2.2.6
env/bin/python - <<'PY'
from pathlib import Path

import pybullet

Path("pendulum.urdf").write_text("""<robot name="pendulum"><link name="base"><inertial><mass value="0"/>
<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><origin xyz="0 0 -0.25"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<dynamics damping="0" friction="0"/></joint></robot>""")


def amplitude_after_ten_seconds(**dynamics):
    pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81)
    arm = pybullet.loadURDF("pendulum.urdf", useFixedBase=True)
    pybullet.setJointMotorControl2(arm, 0, pybullet.VELOCITY_CONTROL, force=0)
    if dynamics:
        pybullet.changeDynamics(arm, -1, **dynamics)
    pybullet.resetJointState(arm, 0, 1.0)
    angles = []
    for _ in range(2400):
        pybullet.stepSimulation()
        angles.append(pybullet.getJointState(arm, 0)[0])
    pybullet.disconnect()
    return max(angles[-600:])


left, kept = amplitude_after_ten_seconds(), amplitude_after_ten_seconds(linearDamping=0, angularDamping=0)
print("amplitude of 1 rad after 10 s:", left, "with both set to 0:", kept)
assert 0.6 < left < 0.8
assert abs(kept - 1) < 0.01
PY
