#!/usr/bin/env bash
# Expected: in a sparse CSV, as PlotJuggler exports it, a column of nanosecond stamps keeps its digits: blanks are
# missing values.
# Happens: blanks make read_csv choose 64-bit floats for whole numbers, and stamps of today are rounded to multiples
# of 256 ns; the column without blanks in the same file stays exact. pyarrow reads both exactly; so does
# dtype='Int64'.
# Seen with: pandas 2.3.3, pyarrow 21.0.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pandas==2.3.3 pyarrow==21.0.0 numpy==2.2.6
env/bin/python - <<'PY'
import io

import pandas as pd
from pyarrow import csv

stamps = [1764230400123456789 + 1000003 * row for row in range(8)]
lines = ["received,/imu/stamp,/joint/position"]
lines += [f"{stamp},{stamp if row % 2 else ''},{'' if row % 2 else 0.5}" for row, stamp in enumerate(stamps)]
text = "\n".join(lines)
frame = pd.read_csv(io.StringIO(text))
off = [int(frame["/imu/stamp"][row]) - stamps[row] for row in range(1, 8, 2)]
print("pandas:", dict(frame.dtypes.astype(str)), "off by", off, "ns")
table = csv.read_csv(io.BytesIO(text.encode()))
kept = [table["/imu/stamp"][row].as_py() for row in range(1, 8, 2)]
print("pyarrow:", table["/imu/stamp"].type)
named = pd.read_csv(io.StringIO(text), dtype={"/imu/stamp": "Int64"})
assert list(frame["received"]) == stamps
assert str(frame["/imu/stamp"].dtype) == "float64"
assert all(off)
assert max(map(abs, off)) <= 128
assert kept == stamps[1::2]
assert [int(named["/imu/stamp"][row]) for row in range(1, 8, 2)] == stamps[1::2]
PY
