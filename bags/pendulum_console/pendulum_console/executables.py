"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {
    "console": "pendulum_console.commands.console_cli:main",
    "foxglove": "pendulum_console.commands.foxglove_cli:main",
}
