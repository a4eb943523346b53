#!/usr/bin/env bash
# Expected: two readers of one bag agree on its end, and reading from its start to its end gives every message.
# Happens: rosbags counts the end one nanosecond past the last message and excludes it; mcap says the last message's
# time, and excludes that too: the same loop loses the last message.
# Seen with: mcap 1.6.0, rosbags 0.11.9; 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    mcap==1.6.0 rosbags==0.11.9
env/bin/python - <<'PY'
import warnings
from pathlib import Path

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

warnings.simplefilter("ignore", DeprecationWarning)  # mcap: end_time has a newer name that says "before"
types = get_typestore(Stores.ROS2_JAZZY)
with Writer(Path("bag"), version=9, storage_plugin=StoragePlugin.MCAP) as bag:
    topic = bag.add_connection("/angle", "std_msgs/msg/Float64", typestore=types)
    message = types.serialize_cdr(types.types["std_msgs/msg/Float64"](1.0), "std_msgs/msg/Float64")
    for stamp in (1000, 2000, 3000):
        bag.write(topic, stamp, message)
with Reader(Path("bag")) as bag:
    rosbags_end = bag.end_time
    by_rosbags = [stamp for _, stamp, _ in bag.messages(start=bag.start_time, stop=bag.end_time)]
with Path("bag/bag.mcap").open("rb") as stream:
    reader = make_reader(stream)
    known = reader.get_summary().statistics
    span = {"start_time": known.message_start_time, "end_time": known.message_end_time}
    by_mcap = [message.log_time for _, _, message in reader.iter_messages(**span)]
print("rosbags: end", rosbags_end, "messages", by_rosbags)
print("mcap:    end", known.message_end_time, "messages", by_mcap)
assert (rosbags_end, by_rosbags) == (3001, [1000, 2000, 3000])
assert (known.message_end_time, by_mcap) == (3000, [1000, 2000])
PY
