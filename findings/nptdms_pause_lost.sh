#!/usr/bin/env bash
# Expected: a channel that was written in two pieces, the second ten seconds later by its wf_start_time, has times with
# that gap.
# Happens: time_track counts on through the pause with wf_increment, and the one start time that is left is that of the
# second piece: the first piece is dated ten seconds late. A recording that stopped for a while looks uninterrupted.
# Seen with: npTDMS 1.10.0, numpy 2.2.6; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    npTDMS==1.10.0 numpy==2.2.6
env/bin/python - <<'PY'
import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter

began = np.datetime64("2026-11-27T10:00:00")
with TdmsWriter("angle.tdms") as writer:
    for pause in (0, 10):
        times = {"wf_increment": 0.5, "wf_start_offset": 0.0, "wf_start_time": began + np.timedelta64(pause, "s")}
        writer.write_segment([ChannelObject("arm", "angle", np.arange(4.0), properties=times)])

channel = TdmsFile.read("angle.tdms")["arm"]["angle"]
print("times", channel.time_track())
print("start", channel.properties["wf_start_time"])
print("first sample", channel.time_track(absolute_time=True)[0])
assert np.allclose(channel.time_track(), np.arange(8) * 0.5)
assert channel.time_track(absolute_time=True)[0] == began + np.timedelta64(10, "s")
PY
