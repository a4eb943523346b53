#!/usr/bin/env bash
# Expected: a table of channels with different rates repeats each channel's last value, or leaves blanks.
# Happens: it depends on the channel's type: integers are repeated, floats are joined by lines. A torque in floats that
# steps at 0.5 s rises from 0.4 s on, while the flag that was recorded with it steps at 0.5 s.
# MDF.configure(float_interpolation=0) repeats floats too.
# Seen with: asammdf 8.8.28, numpy 2.2.6, pandas 2.3.3; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    asammdf==8.8.28 numpy==2.2.6 pandas==2.3.3
env/bin/python - <<'PY'
import numpy as np
from asammdf import MDF, Signal

slow, fast = np.arange(10) / 10, np.arange(50) / 50
stepped = slow >= 0.5


def table(mdf):
    mdf.append([Signal(stepped.astype(float), slow, name="torque", unit="N m")])
    mdf.append([Signal(stepped.astype("u1"), slow, name="enabled")])
    mdf.append([Signal(np.sin(fast), fast, name="angle", unit="rad")])
    return mdf.to_dataframe().loc[0.39:0.51]


default, held = MDF(), MDF()
held.configure(float_interpolation=0)
first, second = table(default), table(held)
print(first.round(3))
print("float_interpolation=0:", second["torque"].round(3).tolist())
assert np.allclose(first["torque"], [0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
assert first["enabled"].tolist() == [0, 0, 0, 0, 0, 1]
assert np.allclose(second["torque"], [0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
PY
