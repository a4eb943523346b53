#!/usr/bin/env bash
# Expected: the streaming CSV reader gives what read_csv gives, block by block.
# Happens: open_csv fixes the types by its first block (1 MB): a topic whose first value comes later is of type null,
# and the recording that read_csv reads fails half way with a conversion error.
# Seen with: pyarrow 21.0.0; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    pyarrow==21.0.0
env/bin/python - <<'PY'
import io

import pyarrow
from pyarrow import csv

early = "".join(f"{row * 0.001:.9f},{0.1:.12f},\n" for row in range(60000))
text = ("time,angle,torque\n" + early + "60.0,,0.25\n").encode()
whole = csv.read_csv(io.BytesIO(text))
print("read_csv:", whole.schema.field("torque").type, "last", whole["torque"][-1])
stream = csv.open_csv(io.BytesIO(text))
print("open_csv:", stream.schema.field("torque").type)
try:
    rows = sum(batch.num_rows for batch in stream)
except pyarrow.ArrowInvalid as error:
    print(error)
else:
    raise SystemExit(f"open_csv reads all {rows} rows now")
assert whole["torque"][-1].as_py() == 0.25
assert stream.schema.field("torque").type == pyarrow.null()
PY
