#!/usr/bin/env bash
# Expected: a torque of 0 is sent as the code nearest to 0, and commanding the angle that was just read holds that
# angle.
# Happens: codes are truncated: 0 N m goes out as -7 mN m, and a loop that commands what it read walks down, for 5016
# of the 65536 angles, by up to 0.25 rad.
# Seen with: damiao-motor 1.0.6, python-can 4.6.1; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    damiao-motor==1.0.6 python-can==4.6.1
env/bin/python - <<'PY'
from damiao_motor import DaMiaoMotor

motor = DaMiaoMotor(1, 0, None, motor_type="4340")


def sent(position=0.0, torque=0.0):
    """Return the codes of angle and torque in the frame of an MIT-mode command."""
    frame = motor.encode_cmd_msg(position, 0.0, torque, 0.0, 0.0)
    return int.from_bytes(frame[:2], "big"), int.from_bytes(frame[6:8], "big") & 0xFFF


def read(angle, torque=2048):
    """Return what the package reads when a motor reports these codes."""
    low = bytes([128, torque >> 8, torque & 255, 20, 20])
    return motor.decode_sensor_feedback(bytes([1]) + angle.to_bytes(2, "big") + low)


def hold(code):
    while (again := sent(read(code)["pos"])[0]) != code:
        code = again
    return code


zero = read(*sent())["torq"]
moved = [code for code in range(65536) if sent(read(code)["pos"])[0] != code]
farthest = max(read(code)["pos"] - read(hold(code))["pos"] for code in moved[-50:])
print("torque 0 is sent as", zero, "N m;", len(moved), "of 65536 angles are not held, by up to", farthest, "rad")
assert abs(zero + 28 / 4095) < 1e-9
assert len(moved) == 5016
assert 0.2 < farthest < 0.3
PY
