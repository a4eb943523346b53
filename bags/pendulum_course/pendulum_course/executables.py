"""The programs of this package: name and entry point, read by ``setup.py`` and ``python -m``."""

__all__ = ["EXECUTABLES"]

EXECUTABLES: dict[str, str] = {"course": "pendulum_course.course_cli:main"}
