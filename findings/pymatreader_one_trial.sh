#!/usr/bin/env bash
# Expected: a struct array of trials comes as a list of trials, however many there are.
# Happens: two trials come as one dict of lists, one trial as a dict of arrays: trials['u'][0] is the first trial's
# signal, and for a file with one trial the first sample; the loop over it runs over samples. scipy's simplify_cells
# changes type likewise.
# Seen with: pymatreader 1.3.2, scipy 1.15.3, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pymatreader==1.3.2 scipy==1.15.3 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from pymatreader import read_mat
from scipy.io import savemat


def first(count):
    trials = np.zeros((1, count), dtype=[("u", "O"), ("name", "O")])
    for trial in range(count):
        trials[0, trial] = (np.arange(3.0) + trial, f"trial {trial}")
    savemat("trials.mat", {"trials": trials})
    return read_mat("trials.mat")["trials"]["u"][0]


two, one = first(2), first(1)
print("first of two trials:", two, " first of one trial:", one)
assert np.array_equal(two, [0.0, 1.0, 2.0])
assert np.ndim(one) == 0
assert one == 0.0
PY
