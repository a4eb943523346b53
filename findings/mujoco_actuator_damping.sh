#!/usr/bin/env bash
# Expected: the damping of an actuator is added to the joint's dof_damping, or shows in the actuator's force.
# Happens: the joint is braked, and both read 0; it is in actuator_damping and in qfrc_passive only. With the Euler
# integrator it is integrated implicitly, so one step brakes by 1/(1 + h b / M), not by 1 - h b / M.
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

model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.01" gravity="0 0 0"/>{BODY}
<actuator><motor joint="j" damping="0.5"/></actuator></mujoco>""")
data = mujoco.MjData(model)
data.qvel[0] = 1.0
mujoco.mj_forward(model, data)
passive, force = float(data.qfrc_passive[0]), float(data.actuator_force[0])
share = 0.01 * 0.5 / float(model.dof_M0[0])
mujoco.mj_step(model, data)
after = float(data.qvel[0])
print("dof_damping", model.dof_damping, "actuator_force", force, "qfrc_passive", passive)
print("velocity after a step", after, "implicit", 1 / (1 + share), "explicit", 1 - share)
assert model.dof_damping[0] == 0.0
assert force == 0.0
assert abs(passive + 0.5) < 1e-9
assert abs(after - 1 / (1 + share)) < 1e-6
assert abs(after - (1 - share)) > 1e-3
PY
