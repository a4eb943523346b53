#!/usr/bin/env bash
# Expected: ctrlrange in a class's <position> default belongs to its position servos; a <motor> of that class has no
# limit.
# Happens: a class has one actuator default: the range in radians is the motor's limit in newton metres, and 5 N m
# become 0.5 without a word. kp, in the same tag, is not inherited.
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

BODY = """<worldbody><body><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>"""

model = mujoco.MjModel.from_xml_string(f"""<mujoco>
<default><default class="arm"><position kp="10" ctrlrange="-0.5 0.5"/></default></default>{BODY}
<actuator><position class="arm" joint="j"/><motor class="arm" name="torque" joint="j"/></actuator></mujoco>""")
data = mujoco.MjData(model)
data.ctrl[1] = 5.0
mujoco.mj_forward(model, data)
print("motor: ctrlrange", model.actuator_ctrlrange[1], "limited", bool(model.actuator_ctrllimited[1]))
print("commanded 5 N m, applied", data.actuator_force[1], "N m, gain", model.actuator_gainprm[1, 0])
assert model.actuator_ctrllimited[1]
assert data.actuator_force[1] == 0.5
assert data.ctrl[1] == 5.0  # the command that a log shows
assert model.actuator_gainprm[1, 0] == 1.0
PY
