#!/usr/bin/env bash
# Expected: a logical array of a .mat file comes as bool, so x[ok] picks the samples where ok is true.
# Happens: loadmat gives uint8, and x[ok] picks samples 0 and 1 again and again: same length as the recording,
# plausible values. mat_dtype=True gives bool.
# Seen with: scipy 1.15.3, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    scipy==1.15.3 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from scipy.io import loadmat, savemat

savemat("run.mat", {"ok": np.array([False, True, True, False]), "angle": np.array([0.1, 0.2, 0.3, 0.4])})
run = loadmat("run.mat", squeeze_me=True)
typed = loadmat("run.mat", squeeze_me=True, mat_dtype=True)
print(run["ok"].dtype, run["angle"][run["ok"]], "with mat_dtype:", typed["ok"].dtype, typed["angle"][typed["ok"]])
assert run["ok"].dtype == np.uint8
assert list(run["angle"][run["ok"]]) == [0.1, 0.2, 0.2, 0.1]
assert typed["ok"].dtype == np.bool_
assert list(typed["angle"][typed["ok"]]) == [0.2, 0.3]
PY
