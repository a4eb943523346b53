"""Fixtures for every test of the repository, beside a package or under ``tests/``: one definition for all."""

pytest_plugins = ["tests.fixtures"]
