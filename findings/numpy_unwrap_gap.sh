#!/usr/bin/env bash
# Expected: one missing angle costs that sample and perhaps its neighbour.
# Happens: unwrap sums its corrections up, so every sample after one NaN is NaN, whatever its value.
# Seen with: numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np

angle = np.linspace(0, 20, 1000)
wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
wrapped[10] = np.nan
lost = np.isnan(np.unwrap(wrapped))
print("one sample of 1000 missing; missing after unwrap:", lost.sum())
assert np.isnan(wrapped).sum() == 1
assert lost[10:].all()
assert not lost[:10].any()
PY
