"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["COMMANDS", "EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "pendulum": "pendulum_bags.commands.pendulum_cli:main",
    "record": "pendulum_rosbag.recorder.record_cli:main",
    "analyse": "pendulum_bags.commands.analyse_cli:main",
    "compare": "pendulum_bags.commands.compare_cli:main",
    "frequency_response": "pendulum_bags.commands.frequency_response_cli:main",
    "ranking": "pendulum_bags.commands.ranking_cli:main",
    "study": "pendulum_bags.commands.public_study_cli:main",
    "replay": "pendulum_bags.commands.replay_cli:main",
    "experiment": "pendulum_bags.commands.experiment_cli:main",
    "move": "pendulum_bags.commands.move_cli:main",
    "excite": "pendulum_bags.commands.excite_cli:main",
    "identify": "pendulum_bags.commands.identify_cli:main",
    "report": "pendulum_bags.commands.report_cli:main",
    "export": "pendulum_rosbag.reader.export_cli:main",
    "play": "pendulum_rosbag.player.player_node:main",
    "info": "pendulum_rosbag.reader.info_cli:main",
    "repair": "pendulum_rosbag.repair.repair_cli:main",
}

COMMANDS: dict[str, str] = {
    "convert": "pendulum_rosbag.convert.convert_cli:convert_main",
    "merge": "pendulum_rosbag.convert.convert_cli:merge_main",
    "cut": "pendulum_rosbag.convert.convert_cli:cut_main",
    "filter": "pendulum_rosbag.convert.convert_cli:filter_main",
}
"""Offered by ``python -m`` only: as programs of an environment they would hide others of the same name (``cut``)."""
