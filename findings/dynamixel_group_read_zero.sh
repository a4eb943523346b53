#!/usr/bin/env bash
# Expected: a servo that does not answer a group read costs its own value; asking for that value raises or gives None.
# Happens: getData gives 0, an angle that a servo can have, for every servo of the group, also for those that
# answered; only the result code and isAvailable say so.
# Seen with: dynamixel-sdk 4.1.0, its servos on a pseudo-terminal; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    dynamixel-sdk==4.1.0
env/bin/python - <<'PY'
import os
import threading
import tty

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, GroupSyncRead, PacketHandler, PortHandler

POSITION, SIZE = 132, 4
packets = PacketHandler(2.0)
answering = {1, 2}
servos, host = os.openpty()
tty.setraw(host)


def answer():
    """Answer each group read (protocol 2.0) with one status packet per servo."""
    unread = b""
    while True:
        unread += os.read(servos, 256)
        while len(unread) >= 7 and len(unread) >= (size := 7 + int.from_bytes(unread[5:7], "little")):
            asked, unread = unread[12 : size - 2], unread[size:]
            for servo in answering.intersection(asked):
                status = bytes([0xFF, 0xFF, 0xFD, 0, servo, 8, 0, 0x55, 0]) + (1000 + servo).to_bytes(SIZE, "little")
                os.write(servos, status + packets.updateCRC(0, status, len(status)).to_bytes(2, "little"))


threading.Thread(target=answer, daemon=True).start()
port = PortHandler(os.ttyname(host))
port.setBaudRate(57600)
port.setPacketTimeout = lambda _: port.setPacketTimeoutMillis(2000)  # a busy machine is no silent servo
group = GroupSyncRead(port, packets, POSITION, SIZE)
for servo in (1, 2):
    group.addParam(servo)


def read():
    result = group.txRxPacket()
    return result, *(group.getData(servo, POSITION, SIZE) for servo in (1, 2))


both = read()
answering.discard(2)
one = read()
print("both answer:", both, "only servo 1 answers:", one)
assert both == (COMM_SUCCESS, 1001, 1002)
assert one == (COMM_RX_TIMEOUT, 0, 0)
assert not group.isAvailable(1, POSITION, SIZE)
PY
