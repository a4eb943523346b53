#!/usr/bin/env bash
# Expected: np.load opens an .npz once, and archive["angle"] is the array in memory, as of a dictionary.
# Happens: each archive["angle"] reads the whole array from the file: a loop over 100 samples reads it 100 times, and a
# value that was assigned to a sample is lost.
# Seen with: numpy 2.4.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    numpy==2.4.6
env/bin/python - <<'PY'
import numpy as np

angle = np.linspace(0.0, 1.0, 100_000)
np.savez("run.npz", angle=angle)


class Counted:
    """A file that counts the bytes that are read."""

    def __init__(self, path: str) -> None:
        self.file, self.total = open(path, "rb"), 0

    def read(self, size: int = -1) -> bytes:
        data = self.file.read(size)
        self.total += len(data)
        return data

    def __getattr__(self, name: str):
        return getattr(self.file, name)


counted = Counted("run.npz")
archive = np.load(counted)
total = sum(float(archive["angle"][row]) for row in range(100))
times = counted.total / angle.nbytes
print(f"100 samples of an array of {angle.nbytes} bytes: {counted.total} bytes read, {times:.0f} times the array")
archive["angle"][0] = 5.0
print("after archive['angle'][0] = 5.0:", archive["angle"][0])
assert 100.0 <= times < 102.0
assert archive["angle"][0] == 0.0
PY
