"""Pytest plugin of ``tests.suite``: tells through a pipe what was collected and how each test went, without dots."""

from __future__ import annotations

import json
import os
from collections.abc import Generator
from typing import Any

import pytest

__all__ = ["PIPE"]

PIPE = "PENDULUM_SUITE_PIPE"
"""Environment variable with the number of the pipe's file."""


def _tell(event: dict[str, Any]) -> None:
    try:
        os.write(int(os.environ[PIPE]), (json.dumps(event) + "\n").encode())
    except BrokenPipeError:
        pytest.exit("the suite that started this part has ended", returncode=int(pytest.ExitCode.INTERRUPTED))


def _reports() -> bool:
    return PIPE in os.environ and "PYTEST_XDIST_WORKER" not in os.environ


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(ids: list[str]) -> None:
    """Tell how many tests there are; each worker finds the same."""
    if _reports():
        _tell({"collected": len(ids)})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Tell how a test went, in its three steps."""
    if _reports():
        _tell({"test": report.nodeid, "when": report.when, "outcome": report.outcome, "duration": report.duration})


@pytest.hookimpl(wrapper=True)
def pytest_report_teststatus(report: pytest.TestReport) -> Generator[None, Any, Any]:
    """Count as always, and leave progress to the suite."""
    category, letter, word = yield
    return (category, "", "") if _reports() else (category, letter, word)
