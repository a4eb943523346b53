#!/usr/bin/env bash
# Expected: two logs of one machine, command and reply 0.9 ms apart, read with absolute times, are 0.9 ms apart.
# Happens: an ASC file holds its start in whole milliseconds (and in local time) and all else relative to its first
# message, so that each file is shifted by up to 1 ms: the reply is 0 ms late. BLF keeps the times.
# Seen with: python-can 4.6.1; 2026-11-28.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    python-can==4.6.1
env/bin/python - <<'PY'
import can

START = 1_760_000_000.0000


def lateness(ending, **reading):
    """Return how much later the reply's log begins than the command's [ms]."""
    begins = []
    for name, stamp in (("command", START + 0.0100), ("reply", START + 0.0109)):
        with can.Logger(f"{name}.{ending}") as log:
            log(can.Message(timestamp=stamp, arbitration_id=0x101, is_extended_id=False, data=[0] * 8))
        with can.LogReader(f"{name}.{ending}", **reading) as log:
            begins.append(next(iter(log)).timestamp)
    return round(1e3 * (begins[1] - begins[0]), 2)


found = {"asc": lateness("asc", relative_timestamp=False), "blf": lateness("blf")}
print("lateness of the reply, truly 0.9 ms:", found)
assert found == {"asc": 0.0, "blf": 0.9}
PY
