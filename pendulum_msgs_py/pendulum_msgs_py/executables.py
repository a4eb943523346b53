"""One way to start every program of the project: ``ros2 run PKG EXE``, ``python -m PKG EXE`` and ``install/``.

Each package has a table ``EXECUTABLES`` (name -> ``module:function``) in its ``executables`` module. The console
scripts of ``setup.py`` and ``python -m`` both read it, so neither can offer what the other lacks.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING

from pendulum_msgs_py.errors import PendulumError

if TYPE_CHECKING:
    import typer

__all__ = ["EXIT_INTERRUPTED", "EXIT_USAGE", "cli_main", "report_error", "run_package"]

EXIT_USAGE = 2
"""Exit code of a program that was asked for something it cannot do."""
EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C, by the shell's convention of 128 + SIGINT."""


def run_package(package: str, argv: Sequence[str] | None = None) -> int:
    """Run ``python -m package EXE ARGS`` and return the exit code.

    Args:
        package: Import name of the package.
        argv: Executable name and its arguments; by default those of the process.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    table: dict[str, str] = importlib.import_module(f"{package}.executables").EXECUTABLES
    if not arguments or arguments[0] in {"-h", "--help"}:
        _print_usage(package, table)
        return 0 if arguments else EXIT_USAGE
    name, *rest = arguments
    if name not in table:
        near = get_close_matches(name, table, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        expected = ", ".join(sorted(table))
        print(f"error: {package} has no executable {name!r}; expected one of {expected}{hint}", file=sys.stderr)
        return EXIT_USAGE
    module_name, function_name = table[name].split(":")
    main = getattr(importlib.import_module(module_name), function_name)
    return int(main(rest) or 0)


def cli_main(app: typer.Typer, argv: Sequence[str] | None = None, *, name: str | None = None) -> int:
    """Run a typer application and return its exit code; our own errors end as one sentence.

    Args:
        app: The application.
        argv: Arguments; by default those of the process.
        name: Program name for the help text, such as ``python -m pendulum_lqr design``.
    """
    # Imported late: a node that has no command line should not pay for typer and rich.
    import click
    import typer.main

    command = typer.main.get_command(app)
    try:
        result = command.main(
            args=list(sys.argv[1:] if argv is None else argv), prog_name=name, standalone_mode=False
        )
    except PendulumError as error:
        return report_error(error)
    except (click.exceptions.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except click.exceptions.Exit as stop:
        return int(stop.exit_code)
    except click.ClickException as error:
        error.show()
        return int(error.exit_code)
    except BrokenPipeError:
        # The reader of our output (head, less) has gone: nothing is left to say, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return int(result) if isinstance(result, int) else 0


def report_error(error: BaseException) -> int:
    """Print an error as one sentence on standard error and return the exit code for it."""
    print(f"error: {error}", file=sys.stderr, flush=True)
    return EXIT_USAGE


def _print_usage(package: str, table: dict[str, str]) -> None:
    print(f"usage: python -m {package} EXECUTABLE [ARGUMENTS]\n\nexecutables:")
    for name in sorted(table):
        print(f"  {name}")
    print(f"\nexample: python -m {package} {sorted(table)[0]} --help")
