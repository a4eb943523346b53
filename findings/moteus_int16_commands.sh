#!/usr/bin/env bash
# Expected: a command that does not fit the chosen 16-bit resolution is refused, and one that fits is rounded to the
# nearest step.
# Happens: it is clipped without a word (5 turns become 3.2767) and truncated towards zero (0.29 N m become 0.28).
# Seen with: moteus 1.1.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    moteus==1.1.1
env/bin/python - <<'PY'
import struct

import moteus

small = moteus.PositionResolution()
small.position = small.velocity = small.feedforward_torque = moteus.INT16
motor = moteus.Controller(id=1, position_resolution=small)


def sent(**command):
    """Return the 16-bit number at the end of the frame."""
    return struct.unpack("<h", motor.make_position(**command).data[-2:])[0]


turns, speed, torque = sent(position=5.0), sent(velocity=20.0), sent(feedforward_torque=0.29)
print("5 turns ->", turns * 1e-4, "  20 turns/s ->", speed * 2.5e-4, "  0.29 N m ->", torque * 0.01)
assert turns == 32767
assert speed == 32767
assert torque == 28
assert sent(position=1.25) == 12500
PY
