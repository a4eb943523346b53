"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "bridge": "pendulum_hw_bridge.bridge_node:main",
    "check": "pendulum_hw_bridge.check_cli:main",
    "convert": "pendulum_hw_bridge.convert_cli:main",
    "emulator": "pendulum_hw_bridge.emulator_cli:main",
    "emulator_fault": "pendulum_hw_bridge.emulator_cli:fault_main",
    "emulator_hand": "pendulum_hw_bridge.emulator_cli:hand_main",
    "lab": "pendulum_hw_bridge.lab_cli:main",
    "procedure": "pendulum_hw_bridge.procedure_node:main",
    "scan": "pendulum_hw_bridge.scan_cli:main",
}
