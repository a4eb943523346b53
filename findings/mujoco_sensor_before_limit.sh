#!/usr/bin/env bash
# Expected: actuator_force, and a sensor of it, is the torque that a motor puts on its joint.
# Happens: the effort limit of a URDF joint cuts the torque at the joint (actuatorfrcrange), after that: 20 N m are
# logged while 5 N m act, and an inertia identified from this log is four times too large. A jointactuatorfrc sensor
# and qfrc_actuator have 5 N m; a forcerange, at the motor, shows in all of them.
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

URDF = """<robot name="arm"><link name="base"/><link name="link"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
<limit effort="5" velocity="9"/></joint></robot>"""

spec = mujoco.MjSpec.from_string(URDF)
spec.add_actuator(name="motor", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="j").set_to_motor()
for name, kind, of, thing in (
    ("actuatorfrc", mujoco.mjtSensor.mjSENS_ACTUATORFRC, "motor", mujoco.mjtObj.mjOBJ_ACTUATOR),
    ("jointactuatorfrc", mujoco.mjtSensor.mjSENS_JOINTACTFRC, "j", mujoco.mjtObj.mjOBJ_JOINT),
):
    spec.add_sensor(name=name, type=kind, objname=of, objtype=thing)
model = spec.compile()
data = mujoco.MjData(model)
data.ctrl[:] = 20.0
mujoco.mj_forward(model, data)
sensors = {name: data.sensor(name).data[0] for name in ("actuatorfrc", "jointactuatorfrc")}
print("actuator_force", data.actuator_force, "sensors", sensors, "acceleration", data.qacc, "rad/s2")
assert data.actuator_force[0] == sensors["actuatorfrc"] == 20
assert data.qfrc_actuator[0] == sensors["jointactuatorfrc"] == 5
assert abs(data.qacc[0] - 5 / 0.1) < 1e-9
PY
