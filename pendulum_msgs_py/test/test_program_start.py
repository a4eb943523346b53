"""How programs start and end: one table, one sentence, one exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
import types
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Annotated

import psutil
import pytest
import typer

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.programs.executables import (
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    cli_main,
    report_error,
    run_package,
)


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make a package ``arm`` whose program ``node`` is the given function."""

    def make(main: Callable[[list[str]], int | None]) -> None:
        table = types.ModuleType("arm.executables")
        table.EXECUTABLES = {"node": "arm.node:main", "design": "arm.node:main"}
        node = types.ModuleType("arm.node")
        node.main = main
        arm = types.ModuleType("arm")
        arm.__spec__ = ModuleSpec("arm", None)
        for name, module in {"arm": arm, "arm.executables": table, "arm.node": node}.items():
            monkeypatch.setitem(sys.modules, name, module)

    return make


def test_a_program_gets_its_arguments_and_gives_its_exit_code(package: Callable[..., None]) -> None:
    seen: list[list[str]] = []
    package(lambda arguments: seen.append(arguments) or 7)
    assert run_package("arm", ["node", "--ros-args", "-p", "a:=1"]) == 7
    assert seen == [["--ros-args", "-p", "a:=1"]]


def test_no_exit_code_is_success(package: Callable[..., None]) -> None:
    package(lambda _: None)
    assert run_package("arm", ["node"]) == 0


def test_help_lists_the_programs(package: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    package(lambda _: 0)
    assert run_package("arm", ["--help"]) == 0
    assert run_package("arm", []) == EXIT_USAGE
    assert "  design\n  node\n" in capsys.readouterr().out


def test_an_unknown_program_names_the_nearest(package: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    package(lambda _: 0)
    assert run_package("arm", ["nod"]) == EXIT_USAGE
    error = capsys.readouterr().err
    assert error == "error: arm has no executable 'nod'; expected one of design, node; did you mean 'node'?\n"


def test_an_interrupt_while_loading_is_no_traceback(
    package: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def main(_: list[str]) -> int:
        raise KeyboardInterrupt

    package(main)
    assert run_package("arm", ["node"]) == EXIT_INTERRUPTED
    assert capsys.readouterr().err == "interrupted\n"


_DROPS = """
import ctypes, sys, time, types, weakref
from importlib.machinery import ModuleSpec
from pendulum_msgs_py.programs.executables import run_package

def wait(*_):
    print("waiting", flush=True)
    time.sleep(60.0)

class Thing:
    if sys.argv[1] == "destructor":
        __del__ = wait

def main(_):
    thing = Thing()
    reference = weakref.ref(thing, wait) if sys.argv[1] == "weak reference" else None
    if sys.argv[1] == "C":
        ctypes.CFUNCTYPE(None)(wait)()
    del thing
    print("went on", flush=True)
    time.sleep(60.0)
    return 0

table = types.ModuleType("arm.executables")
table.EXECUTABLES = {"node": "arm.node:main"}
node = types.ModuleType("arm.node")
node.main = main
arm = types.ModuleType("arm")
arm.__spec__ = ModuleSpec("arm", None)
sys.modules.update({"arm": arm, "arm.executables": table, "arm.node": node})
sys.exit(run_package("arm", ["node"]))
"""


@pytest.mark.parametrize("where", ["destructor", "weak reference", "C"])
def test_an_interrupt_is_not_lost_where_python_drops_what_is_raised(where: str) -> None:
    with subprocess.Popen([sys.executable, "-c", _DROPS, where], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        assert run.stdout is not None
        assert run.stdout.readline() == b"waiting\n"
        run.send_signal(signal.SIGINT)
        rest, error = run.communicate(timeout=50.0)
    assert run.returncode == EXIT_INTERRUPTED
    # It goes on for the hundredth of a second until it is interrupted once more; without a core, it says nothing in it.
    assert rest in {b"went on\n", b""}
    assert error == b"interrupted\n"


_STARTED_DEAF = """
import signal, subprocess, sys, time, types
import typer
from importlib.machinery import ModuleSpec
from pendulum_msgs_py.programs.executables import cli_main, run_package

app = typer.Typer()

@app.command()
def waits():
    child = "import signal; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    print("child deaf:", subprocess.check_output([sys.executable, "-c", child], text=True).strip())
    print("waiting", flush=True)
    time.sleep(20.0)

def main(_):
    return cli_main(app, [])

table = types.ModuleType("arm.executables")
table.EXECUTABLES = {"node": "arm.node:main"}
node = types.ModuleType("arm.node")
node.main = main
arm = types.ModuleType("arm")
arm.__spec__ = ModuleSpec("arm", None)
sys.modules.update({"arm": arm, "arm.executables": table, "arm.node": node})
sys.exit(run_package("arm", ["node"]) if sys.argv[1] == "module" else main([]))
"""


@pytest.mark.parametrize("way", ["module", "console script"])
def test_a_program_hears_ctrl_c_though_a_shell_started_it_in_the_background(way: str) -> None:
    # No job control: the shell starts it with SIGINT ignored.
    script = '"$@" & wait $!'
    command = ["sh", "-c", script, "sh", sys.executable, "-c", _STARTED_DEAF, way]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as shell:
        assert shell.stdout is not None
        assert shell.stdout.readline() == b"child deaf: False\n"
        assert shell.stdout.readline() == b"waiting\n"
        (program,) = psutil.Process(shell.pid).children()
        program.send_signal(signal.SIGINT)
        _, error = shell.communicate(timeout=50.0)
    assert shell.returncode == EXIT_INTERRUPTED
    assert error == b"interrupted\n"


def test_a_handler_of_sigint_that_is_set_already_stays(package: Callable[..., None]) -> None:
    def handler(number: int, frame: types.FrameType | None) -> None:
        del number, frame

    package(lambda _: 0)
    before = signal.signal(signal.SIGINT, handler)
    try:
        run_package("arm", ["node"])
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def _app() -> typer.Typer:
    app = typer.Typer()

    @app.command()
    def run(
        gain: float,
        code: Annotated[int, typer.Option("-c", "--code")] = 0,
        out: Path | None = None,
        yes: Annotated[bool, typer.Option("--yes")] = False,
        fast: Annotated[bool, typer.Option("--fast/--slow")] = False,
    ) -> None:
        del yes, fast
        if gain < 0:
            raise ParameterError(f"gain is {gain} N m; expected >= 0")
        if gain == 3.0:
            raise KeyboardInterrupt
        if gain == 4.0:
            raise typer.Exit(EXIT_INTERRUPTED)
        if code:
            raise typer.Exit(code)
        if out is not None:
            out.mkdir()

    return app


def test_a_program_that_reported_its_interruption_is_not_reported_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli_main(_app(), ["4.0"], name="python -m arm run") == 130
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["1.0"], 0, ""),
        (["1.0", "--code", "4"], 4, ""),
        (["--", "-1.0"], 2, "error: gain is -1.0 N m; expected >= 0\n"),
        (["one"], 2, "Invalid value for 'gain'"),
        ([], 2, "Missing argument"),
        (["1.0", "--bogus"], 2, "--bogus"),
        (["3.0"], 130, "interrupted"),
        (["1.0", "--code", "4", "--code", "5"], 2, "error: --code is given 2 times; expected once\n"),
        (["1.0", "-c", "4", "--code=5"], 2, "error: --code is given 2 times; expected once\n"),
        (["1.0", "--fast", "--slow"], 2, "error: --fast is given 2 times; expected once\n"),
        (["1.0", "--yes", "--yes"], 0, ""),
        (["--help", "--help"], 0, ""),
        (["--code", "4", "--code", "5", "--help"], 0, ""),
        (["1.0", "--out", __file__], 2, f"error: {__file__} cannot be read or written: File exists\n"),
        (["1.0", "--output", __file__], 2, f"error: {__file__} cannot be read or written: File exists\n"),
        (["1.0", "--out", "a", "--output", "b"], 2, "error: --out is given 2 times; expected once\n"),
        (["1.0", "--out", f"{__file__}/folder"], 2, f"error: {__file__}/folder cannot be read or written: Not a"),
    ],
)
def test_a_command_line_ends_with_a_sentence_and_a_code(
    arguments: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli_main(_app(), arguments, name="python -m arm run") == code
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_each_of_several_commands_counts_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
    app = typer.Typer()

    @app.command()
    def one(gains: Annotated[list[float], typer.Option("--gain")], code: int = 0) -> None:
        raise typer.Exit(code + len(gains))

    @app.command()
    def other() -> None: ...

    assert cli_main(app, ["one", "--gain", "1", "--gain", "1"], name="arm") == 2
    assert capsys.readouterr().err == ""
    assert cli_main(app, ["one", "--gain", "1", "--code", "4", "--code", "5"], name="arm") == EXIT_USAGE
    assert capsys.readouterr().err == "error: --code is given 2 times; expected once\n"


def test_an_error_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert report_error(ParameterError("gain is 1; expected 2")) == EXIT_USAGE
    assert capsys.readouterr().err == "error: gain is 1; expected 2\n"


_LONG_OUTPUT = """
import typer
from pendulum_msgs_py.programs.executables import cli_main
app = typer.Typer()
@app.command()
def main():
    for index in range(100000):
        print("line", index)
raise SystemExit(cli_main(app, []))
"""
_LONG_TEXT = """
from pendulum_msgs_py.programs.executables import print_text
print_text("line\\n" * 200000)
"""
_SHORT_OUTPUT = """
import time, typer
from pendulum_msgs_py.programs.executables import cli_main
app = typer.Typer()
@app.command()
def main():
    time.sleep(0.3)
    print("line")
raise SystemExit(cli_main(app, []))
"""


@pytest.mark.parametrize("program", [_LONG_OUTPUT, _LONG_TEXT, _SHORT_OUTPUT])
def test_a_reader_that_goes_is_no_error(program: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    if program is not _SHORT_OUTPUT:
        process.stdout.readline()
    process.stdout.close()
    assert process.wait(30) == 0
    assert process.stderr is not None
    assert process.stderr.read() == ""
