#!/usr/bin/env bash
# Expected: mj_setConst, to be called after a change of masses, works out a servo's damping for its dampratio again.
# Happens: dampratio is turned into a number when the file is compiled, and stays: with four times the inertia the
# same servo has half of the critical damping that its file asks for.
# Seen with: mujoco 4.0.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    --no-deps mujoco==4.0.0 mujoco-core==4.0.0 numpy==2.2.6
env/bin/python - <<'PY'
import math

import mujoco

BODY = """<worldbody><body><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/></body></worldbody>"""

model = mujoco.MjModel.from_xml_string(f"""<mujoco>{BODY}
<actuator><position joint="j" kp="100" dampratio="1"/></actuator></mujoco>""")
before, inertia = -float(model.actuator_biasprm[0, 2]), float(model.dof_M0[0])
model.body_mass *= 4
model.body_inertia *= 4
mujoco.mj_setConst(model, mujoco.MjData(model))
after = -float(model.actuator_biasprm[0, 2])
critical = 2 * math.sqrt(100 * model.dof_M0[0])
print("inertia", inertia, "->", float(model.dof_M0[0]), "kg m^2; kv", before, "->", after, "critical", critical)
assert abs(before - 2 * math.sqrt(100 * inertia)) < 1e-6 * before
assert abs(model.dof_M0[0] / inertia - 4) < 1e-9
assert after == before
assert abs(after / critical - 0.5) < 1e-6
PY
