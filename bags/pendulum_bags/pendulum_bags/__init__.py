"""Recordings: writing, reading, identification, replay, comparison and reports."""

__version__ = "0.1.0"
