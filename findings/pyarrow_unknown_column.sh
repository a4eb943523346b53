#!/usr/bin/env bash
# Expected: a column that a Parquet file does not have is an error, as it is for read_table.
# Happens: ParquetFile.read and iter_batches leave it out: a misspelt torque gives a table of time and angle, and a
# list of misspelt names one without columns. read_table refuses the same list.
# Seen with: pyarrow 26.0.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pyarrow==26.0.1
env/bin/python - <<'PY'
import pyarrow
import pyarrow.parquet as parquet

rows = {"time": [0.0, 0.1, 0.2], "angle": [0.5, 0.4, 0.2], "torque": [1.0, 1.0, -1.0]}
parquet.write_table(pyarrow.table(rows), "run.parquet")
asked = ["time", "angle", "torqe"]
file = parquet.ParquetFile("run.parquet")
read = file.read(columns=asked)
batches = [batch.schema.names for batch in file.iter_batches(columns=asked)]
print("asked:", asked, "ParquetFile.read:", read.column_names, "iter_batches:", batches)
try:
    parquet.read_table("run.parquet", columns=asked)
except pyarrow.ArrowInvalid as error:
    print("read_table:", str(error).splitlines()[0])
else:
    raise SystemExit("read_table reads the list without the column now")
assert read.column_names == ["time", "angle"]
assert batches == [["time", "angle"]]
assert file.read(columns=["torqe"]).num_columns == 0
PY
