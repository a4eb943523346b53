"""Tables keep every figure whole, at a terminal of any width and in a file."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from pendulum_msgs_py.programs.terminal import WholeTable, make_console

_PRINT = """
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
table = WholeTable("quantity", *(f"column {number}" for number in range(12)))
table.add_row("damping", *(f"11.{number:05d}" for number in range(12)))
make_console().print(table)
"""
_FIGURES = [f"11.{number:05d}" for number in range(12)]


def _table(rows: list[list[str]]) -> WholeTable:
    table = WholeTable("name", *(f"heading {number}" for number in range(len(rows[0]) - 1)), title="A table")
    for row in rows:
        table.add_row(*row)
    return table


def _printed(table: WholeTable, width: int) -> str:
    stream = io.StringIO()
    Console(file=stream, width=width).print(table)
    return stream.getvalue()


_WORDS = st.lists(st.floats(-1e5, 1e5).map(lambda value: f"{value:.5g}"), min_size=1, max_size=3)
_ROWS = st.integers(2, 9).flatmap(
    lambda count: st.lists(st.lists(_WORDS.map(" to ".join), min_size=count, max_size=count), min_size=1, max_size=4)
)


@settings(max_examples=60, deadline=None)
@given(rows=_ROWS, width=st.integers(40, 160))
def test_no_figure_is_cut_at_any_width(rows: list[list[str]], width: int) -> None:
    text = _printed(_table(rows), width)
    assert "…" not in text
    assert max(len(line) for line in text.splitlines()) <= width
    printed = text.replace("│", " ").split()
    for word in (word for row in rows for cell in row for word in cell.split()):
        assert word in printed


def test_a_table_that_fits_is_printed_as_one() -> None:
    rows = [["damping", "11.77", "11.65 to 11.88"]]
    assert _printed(_table(rows), 80).count("name") == 1
    assert "│ 11.65 to 11.88 │" in _printed(_table(rows), 80)


def test_what_does_not_fit_stands_below_with_the_first_column_repeated() -> None:
    text = _printed(_table([["damping", *_FIGURES]]), 60)
    assert text.count("damping") > 1
    assert text.count("A table") == 1


def test_a_word_wider_than_the_console_is_folded_and_not_cut() -> None:
    path = "/a/folder/whose/name/is/longer/than/the/terminal/is/wide"
    text = _printed(_table([["bag", path]]), 30)
    assert path in "".join(line.split("│")[2].strip() for line in text.splitlines() if line.startswith("│"))


def test_styles_and_sections_of_rows_survive() -> None:
    table = WholeTable("a", "b")
    table.add_row("[bold]1[/bold]", "2", style="red", end_section=True)
    table.add_row("3", "4")
    stream = io.StringIO()
    Console(file=stream, width=40, force_terminal=True, color_system="standard").print(table)
    assert "\x1b[1;31m1" in stream.getvalue()
    assert "├" in stream.getvalue()


def test_a_file_takes_a_wide_table_as_one(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    make_console().print(_table([["damping", *_FIGURES * 3]]))
    lines = [line for line in capsys.readouterr().out.splitlines() if "damping" in line]
    assert len(lines) == 1
    assert all(figure in lines[0] for figure in _FIGURES)


def test_columns_of_the_environment_choose_the_width(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "72")
    assert make_console().width == 72


def test_a_terminal_of_80_columns_shows_every_figure() -> None:
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in {"COLUMNS", "LINES"}}
    environment["TERM"] = "xterm"
    with subprocess.Popen(
        [sys.executable, "-c", _PRINT], stdin=follower, stdout=follower, stderr=follower, env=environment
    ) as process:
        os.close(follower)
        text = b""
        try:
            while piece := os.read(leader, 65536):
                text += piece
        except OSError:  # the last writer has gone
            pass
        assert process.wait(30) == 0
    os.close(leader)
    lines = text.decode().splitlines()
    assert max(len(line) for line in lines if line.startswith("└")) <= 80
    assert all(figure in text.decode() for figure in _FIGURES)
    assert "…" not in text.decode()
