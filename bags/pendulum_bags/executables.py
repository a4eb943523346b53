"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "record": "pendulum_bags.record_cli:main",
    "analyse": "pendulum_bags.analyse_cli:main",
    "compare": "pendulum_bags.compare_cli:main",
    "replay": "pendulum_bags.replay_cli:main",
    "experiment": "pendulum_bags.experiment_cli:main",
    "excite": "pendulum_bags.excite_cli:main",
    "identify": "pendulum_bags.identify_cli:main",
    "report": "pendulum_bags.report_cli:main",
    "export": "pendulum_bags.export_cli:main",
    "play": "pendulum_bags.topic_replay_node:main",
    "console": "pendulum_bags.console_cli:main",
    "info": "pendulum_bags.info_cli:main",
    "repair": "pendulum_bags.repair_cli:main",
}
