"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "record": "pendulum_rosbag.recorder.record_cli:main",
    "play": "pendulum_rosbag.player.player_node:main",
    "info": "pendulum_rosbag.reader.info_cli:main",
    "export": "pendulum_rosbag.reader.export_cli:main",
    "repair": "pendulum_rosbag.storage.repair_cli:main",
}
