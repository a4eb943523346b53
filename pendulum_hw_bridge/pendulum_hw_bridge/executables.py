"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "bridge": "pendulum_hw_bridge.nodes.bridge_node:main",
    "check": "pendulum_hw_bridge.checks.check_cli:main",
    "convert": "pendulum_hw_bridge.lab.convert_cli:main",
    "emulator": "pendulum_hw_bridge.lab.emulator_cli:main",
    "emulator_fault": "pendulum_hw_bridge.lab.emulator_cli:fault_main",
    "emulator_hand": "pendulum_hw_bridge.lab.emulator_cli:hand_main",
    "lab": "pendulum_hw_bridge.lab.lab_cli:main",
    "procedure": "pendulum_hw_bridge.nodes.procedure_node:main",
    "scan": "pendulum_hw_bridge.lab.scan_cli:main",
}
