#!/usr/bin/env bash
# Expected: after mj_step, sensordata belongs to the state in qpos and qvel, at data.time.
# Happens: it belongs to the state before the step: a log that takes a joint's sensor beside qpos holds two angles
# that are one step apart under one time. mj_forward, or mj_step1 after mj_step2, brings them together.
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

model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.01"/>
<worldbody><body><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>
<sensor><jointpos joint="j"/></sensor></mujoco>""")
data = mujoco.MjData(model)
data.qpos[0] = before = 1.0
for _ in range(3):
    mujoco.mj_step(model, data)
    print("time", round(data.time, 3), "qpos", data.qpos[0], "sensor", data.sensordata[0])
    assert data.sensordata[0] == before
    assert data.qpos[0] < before
    before = float(data.qpos[0])
mujoco.mj_forward(model, data)
assert data.sensordata[0] == data.qpos[0]
PY
