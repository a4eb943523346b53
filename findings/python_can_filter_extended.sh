#!/usr/bin/env bash
# Expected: a filter with an 11-bit id and mask lets standard frames with that id through.
# Happens: without 'extended' the frame's kind is not compared: a 29-bit frame whose low bits are equal passes too,
# for example a host's own command to a motor, taken as its reply.
# Seen with: python-can 4.6.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    python-can==4.6.1
env/bin/python - <<'PY'
import can

REPLY = {"can_id": 0x101, "can_mask": 0x7FF}


def heard(filters):
    ours, other = can.Bus("drives", interface="virtual", can_filters=filters), can.Bus("drives", interface="virtual")
    with ours, other:
        other.send(can.Message(arbitration_id=0x101, is_extended_id=False))
        other.send(can.Message(arbitration_id=0x8101, is_extended_id=True))
        other.send(can.Message(arbitration_id=0x102, is_extended_id=False))
        return [hex(message.arbitration_id) for message in iter(lambda: ours.recv(0.5), None)]


plain, explicit = heard([REPLY]), heard([{**REPLY, "extended": False}])
print("without 'extended':", plain, "with extended=False:", explicit)
assert plain == ["0x101", "0x8101"]
assert explicit == ["0x101"]
PY
