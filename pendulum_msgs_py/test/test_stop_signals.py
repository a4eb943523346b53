"""Stop signals of a node, on the socket in which they come: an echo is no second wish."""

from __future__ import annotations

import signal
import socket

import pytest

from pendulum_msgs_py.ros import runner


def _watched(monkeypatch: pytest.MonkeyPatch, *numbers: int) -> tuple[int, list[int]]:
    """Return how often a node was asked to stop, and the codes with which its process was ended, after signals.

    The first is noted, so that the death of the starter does not count as a second.
    """
    reader, writer = socket.socketpair()
    writer.send(bytes(numbers))
    writer.close()
    stops, codes = [], []
    noted: list[int] = []
    monkeypatch.setattr(runner.os, "_exit", codes.append)
    monkeypatch.setattr(runner, "stops", noted)
    runner._watch_signals(reader, lambda: stops.append(1))
    reader.close()
    assert noted == [number for number in numbers if number in runner._STOP_SIGNALS][:1]
    return len(stops), codes


@pytest.mark.parametrize("echoes", [0, 1, 5])
def test_the_launchers_echo_of_a_signal_does_not_end_a_node_before_it_has_released(
    monkeypatch: pytest.MonkeyPatch, echoes: int
) -> None:
    monkeypatch.setattr(runner, "_ECHO_TIME", 1e6)
    assert _watched(monkeypatch, *[signal.SIGINT] * (1 + echoes)) == (1, [])


def test_a_later_signal_is_a_second_wish(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(runner, "_ECHO_TIME", 0.0)
    assert _watched(monkeypatch, signal.SIGTERM, signal.SIGINT) == (1, [128 + signal.SIGTERM])
    assert capfd.readouterr().err == "second SIGINT: leaving at once\n"


def test_other_signals_and_the_end_of_the_node_stop_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _watched(monkeypatch, signal.SIGCHLD, signal.SIGUSR1) == (0, [])
    assert _watched(monkeypatch) == (0, [])
