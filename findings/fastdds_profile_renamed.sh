#!/usr/bin/env bash
# Expected: a Fast DDS profile that works under ROS 2 Jazzy works under Kilted; an element that a release does not know
# costs that element alone.
# Happens: Fast DDS 3 (Kilted) renamed heartbeatPeriod to heartbeat_period. It refuses the old name, drops the whole file
# with it, logs that and goes on with its defaults: for the period of a writer the participant loses its transports,
# here UDP alone, and shared memory is in use again. Fast DDS 2 (Jazzy) does the same with the new name.
# Seen with: ros-kilted-rclpy 9.1.2 (Fast DDS 3.2.3), shown here, and ros-jazzy-rclpy 7.1.6 (Fast DDS 2.14.5);
# 2026-11-27.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
unset ROS_AUTOMATIC_DISCOVERY_RANGE ROS_LOCALHOST_ONLY ROS_STATIC_PEERS
export ROS_LOG_DIR="$work/log" RMW_IMPLEMENTATION=rmw_fastrtps_cpp
python3 -m venv --without-pip env
python3 -m pip -q --disable-pip-version-check --python env/bin/python install --no-compile \
    "ros-kilted-rclpy[fastrtps]==9.1.2"
cat > node.py <<'PY'
from pathlib import Path

import rclpy

rclpy.init()
node = rclpy.create_node("node")
print("the defaults" if "/dev/shm/fastdds" in Path("/proc/self/maps").read_text() else "the profile")
node.destroy_node()
rclpy.shutdown()
PY
for name in heartbeatPeriod heartbeat_period; do
  cat > "$name.xml" <<XML
<dds xmlns="http://www.eprosima.com"><profiles>
<transport_descriptors>
<transport_descriptor><transport_id>udp</transport_id><type>UDPv4</type></transport_descriptor>
</transport_descriptors>
<participant profile_name="participant" is_default_profile="true"><rtps>
<useBuiltinTransports>false</useBuiltinTransports>
<userTransports><transport_id>udp</transport_id></userTransports>
</rtps></participant>
<data_writer profile_name="writer" is_default_profile="true">
<times><$name><sec>0</sec><nanosec>200000000</nanosec></$name></times>
</data_writer>
</profiles></dds>
XML
  FASTDDS_DEFAULT_PROFILES_FILE="$PWD/$name.xml" env/bin/python node.py > "$name.log" 2>&1
  grep -o "Invalid element[^[:cntrl:]]*" "$name.log" || true
  echo "$name: transports of $(tail -n 1 "$name.log")"
done
[ "$(tail -n 1 heartbeatPeriod.log)" = "the defaults" ]
[ "$(tail -n 1 heartbeat_period.log)" = "the profile" ]
