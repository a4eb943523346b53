#!/usr/bin/env bash
# Expected: write_gains followed by read_gains gives the gains back, at least in single precision.
# Happens: the file holds six decimals, not six digits: a gain of 1.2e-7 becomes 0, one of 4.321e-5 loses its last
# digits, with no warning.
# Seen with: hebi-py 2.16.1, numpy 1.26.4; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    hebi-py==2.16.1 numpy==1.26.4
env/bin/python - <<'PY'
import hebi

wanted = {"position_kp": 12.3456789, "velocity_kp": 4.321e-5, "effort_kp": 1.2e-7}
written = hebi.GroupCommand(1)
for name, value in wanted.items():
    setattr(written, name, value)
written.write_gains("gains.xml")
read = hebi.GroupCommand(1)
read.read_gains("gains.xml")
found = {name: float(getattr(read, name)[0]) for name in wanted}
for name, value in wanted.items():
    print(name, "set", value, "read back", found[name])
assert abs(found["position_kp"] - 12.345679) < 1e-5
assert abs(found["velocity_kp"] - 4.3e-5) < 1e-9
assert found["effort_kp"] == 0.0
PY
