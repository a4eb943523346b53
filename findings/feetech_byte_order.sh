#!/usr/bin/env bash
# Expected: two packet handlers, one for STS servos (low byte first) and one for SCS servos (high byte first), each
# keep their byte order: both families sit on one bus.
# Happens: the order is a variable of the module. Making the second handler turns the first one's words round too: a
# goal of 1024 goes out as 4, and 260 of 4096 steps as 1025.
# Seen with: feetech-servo-sdk 1.0.0, pyserial 3.5; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    feetech-servo-sdk==1.0.0 pyserial==3.5
env/bin/python - <<'PY'
import os
import tty

from scservo_sdk import COMM_SUCCESS, PacketHandler, PortHandler

GOAL_POSITION = 42
servos, host = os.openpty()
tty.setraw(host)
port = PortHandler(os.ttyname(host))
assert port.openPort()


def sent(handler, goal):
    """The two bytes of the goal in the packet FF FF, id, length, instruction, address, goal, check sum."""
    assert handler.write2ByteTxOnly(port, 1, GOAL_POSITION, goal) == COMM_SUCCESS
    packet = b""
    while len(packet) < 9:
        packet += os.read(servos, 9 - len(packet))
    return packet[6:8]


sts = PacketHandler(0)
before = [sent(sts, goal) for goal in (1024, 260)]
scs = PacketHandler(1)
after = [sent(sts, goal) for goal in (1024, 260)]
read = [int.from_bytes(goal, "little") for goal in after]
print("STS alone:", before, "with an SCS handler beside it:", after, "which an STS servo reads as", read)
assert before == [b"\x00\x04", b"\x04\x01"]
assert read == [4, 1025]
assert sent(scs, 1024) == b"\x04\x00"
PY
