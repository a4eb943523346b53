#!/usr/bin/env bash
# Expected: a gains file sets the gains that it names and leaves every other gain of the command as it was.
# Happens: read_gains unsets every gain that the file does not name (NaN: not sent), but keeps position and effort:
# limits and gains set before the file was read never reach the actuator.
# Seen with: hebi-py 2.16.1, numpy 1.26.4; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    hebi-py==2.16.1 numpy==1.26.4
env/bin/python - <<'PY'
from pathlib import Path

import hebi
import numpy as np

Path("gains.xml").write_text("<group_gains><position><kp>5</kp></position></group_gains>")
command = hebi.GroupCommand(1)
command.position_kp, command.velocity_kd, command.effort_max_output = 1.0, 3.0, 0.25
command.position, command.effort = 0.5, 0.1
command.read_gains("gains.xml")
gains = {name: float(getattr(command, name)[0]) for name in ("position_kp", "velocity_kd", "effort_max_output")}
print("gains after the file:", gains, "position", command.position, "effort", command.effort)
assert gains["position_kp"] == 5.0
assert np.isnan(gains["velocity_kd"])
assert np.isnan(gains["effort_max_output"])
assert command.position[0] == 0.5
assert abs(command.effort[0] - 0.1) < 1e-6
PY
