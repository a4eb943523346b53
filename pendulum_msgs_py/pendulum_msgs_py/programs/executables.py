"""Starts every program of the project: ``ros2 run PKG EXE``, ``python -m PKG EXE`` and ``install/``.

The table ``EXECUTABLES`` (name -> ``module:function``) of each package is read by ``setup.py`` and ``python -m``. Names
that would hide a program of the system are in ``COMMANDS``, for ``python -m`` alone.
"""

from __future__ import annotations

import errno
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Collection, Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pendulum_msgs_py.errors import ParameterError, PendulumError
from pendulum_msgs_py.programs import completion
from pendulum_msgs_py.programs.extras import PACKAGES, how_to_install
from pendulum_msgs_py.programs.interrupts import keep_interrupts
from pendulum_msgs_py.programs.typed_commands import as_typed

if TYPE_CHECKING:
    import typer

__all__ = [
    "EXIT_INTERRUPTED",
    "EXIT_USAGE",
    "answer_of_dispatcher",
    "cli_main",
    "command_line",
    "is_exhaustion",
    "is_installed",
    "print_completion",
    "print_text",
    "report_error",
    "report_exhaustion",
    "report_missing",
    "run_package",
    "run_program",
    "summary",
    "tables_of",
    "typed_options",
]

EXIT_USAGE = 2
"""Exit code for invalid arguments or requests."""


class _Reported(int):
    """Exit code of a program that has printed the reason itself."""


EXIT_INTERRUPTED = _Reported(130)
"""Exit code after Ctrl-C (128 + SIGINT), reported already."""


def run_package(package: str, argv: Sequence[str] | None = None) -> int:
    """Run ``python -m package EXE ARGS`` and return the exit code; ``argv`` defaults to the process's."""
    importlib.import_module("pendulum_msgs_py.programs.one_thread")
    arguments = list(sys.argv[1:] if argv is None else argv)
    table = tables_of(package)
    code = answer_of_dispatcher(
        arguments,
        table,
        usage=lambda: _usage(package, table),
        unknown=lambda name: (
            f"{package} has no executable {name!r}; {_home_of(name)}expected one of {', '.join(sorted(table))}"
        ),
    )
    return run_program(table[arguments[0]], arguments[1:]) if code is None else code


def is_installed(package: str) -> bool:
    """Return whether a package with a table of programs is there, without importing its modules."""
    return (
        importlib.util.find_spec(package) is not None and importlib.util.find_spec(f"{package}.executables") is not None
    )


def _home_of(program: str) -> str:
    """Return where a program that a package does not have is found, for its error message; empty for an unknown one."""
    homes = [package for package in PACKAGES if is_installed(package) and program in tables_of(package)]
    return f"python -m {homes[-1]} {program} runs it; " if homes else ""


def answer_of_dispatcher(
    arguments: Sequence[str], names: Collection[str], *, usage: Callable[[], str], unknown: Callable[[str], str]
) -> int | None:
    """Handle completion, help and unknown names of a command that starts programs.

    ``usage`` returns the help, ``unknown`` the message for an unknown name. Returns the exit code, or None if the first
    argument is the name of a program to start.
    """
    if completion.asked() and len(arguments) < 2:
        print_text("\n".join(completion.of_package(names, arguments)))
        return 0
    if arguments and arguments[0] == "--completion":
        return print_completion(arguments[1:])
    if not arguments or arguments[0] in {"-h", "--help"}:
        print_text(usage())
        return 0 if arguments else EXIT_USAGE
    if (name := arguments[0]) in names:
        return None
    near = get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    print(f"error: {unknown(name)}{hint}", file=sys.stderr)
    return EXIT_USAGE


def tables_of(package: str) -> dict[str, str]:
    """Return the programs of a package: name -> entry point."""
    tables = importlib.import_module(f"{package}.executables")
    return {**tables.EXECUTABLES, **getattr(tables, "COMMANDS", {})}


def run_program(target: str, arguments: Sequence[str], *, called_as: str = "") -> int:
    """Run a program by its entry point ``module:function`` and return its exit code.

    ``called_as`` is its name in help texts; empty for ``python -m``.
    """
    keep_interrupts()
    importlib.import_module("pendulum_msgs_py.programs.one_thread")
    module_name, function_name = target.split(":")
    _called_as.append(called_as)
    try:
        main = getattr(importlib.import_module(module_name), function_name)
        return int(main(list(arguments)) or 0)
    except KeyboardInterrupt:
        # Ctrl-C while modules load: no command can report it yet.
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except Exception as error:
        if code := report_exhaustion(error) or report_missing(error):
            return code
        raise


_called_as: list[str] = []
"""Name of the running program in its help text."""


def print_completion(arguments: Sequence[str]) -> int:
    """Print the script of ``--completion [SHELL]``; return the exit code."""
    try:
        print_text(completion.script(arguments[0] if arguments else "bash"))
    except PendulumError as error:
        return report_error(error)
    return 0


def split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a program's own arguments, and those from ``--ros-args`` on."""
    split = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    return list(arguments[:split]), list(arguments[split:])


def command_line(
    command: Callable[..., int | None], name: str, *, takes_ros_arguments: bool = False, **of_typer: Any
) -> Callable[..., int]:
    """Return the ``main`` of a program that is one command, by :func:`cli_main`."""
    import typer

    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(**of_typer)(command)
    return partial(cli_main, app, name=name, takes_ros_arguments=takes_ros_arguments)


def cli_main(
    app: typer.Typer, argv: Sequence[str] | None = None, *, name: str | None = None, takes_ros_arguments: bool = False
) -> int:
    """Run a typer application and return its exit code; a PendulumError ends as one sentence.

    ``name`` is shown in the help, such as ``python -m pendulum_lqr design``. With ``takes_ros_arguments``,
    ``context.obj`` holds the arguments from ``--ros-args`` on.
    """
    # Once more: a console script calls this function only.
    keep_interrupts()
    # Imported late: nodes without a command line do not need typer and rich.
    import typer.main

    # typer vendors click: its error class is reachable only through typer's exports.
    usage_error: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
    command: Any = typer.main.get_command(app)
    command.context_settings["token_normalize_func"] = _one_name
    arguments = list(sys.argv[1:] if argv is None else argv)
    own, ros = split_ros_arguments(arguments) if takes_ros_arguments else (arguments, [])
    if completion.asked():
        print_text("\n".join(completion.of_command(command, own)))
        return 0
    _refuse_repeats(command)
    _complete_help(command)
    try:
        prog_name = (_called_as and _called_as[-1]) or (name and as_typed(name))
        result = command.main(args=own, prog_name=prog_name, standalone_mode=False, obj=ros)
        # Otherwise a broken pipe would raise at exit, where it cannot be caught.
        sys.stdout.flush()
    except PendulumError as error:
        return report_error(error)
    except ImportError as error:
        if code := report_missing(error):
            return code
        raise
    except (typer.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except typer.Exit as stop:
        return int(stop.exit_code)
    except usage_error as error:
        error.show()
        return int(error.exit_code)
    except BrokenPipeError:
        _discard_output()
        return 0
    except SystemExit as stop:
        # click turns a broken pipe into exit code 1, also in standalone_mode=False.
        if isinstance(stop.__context__, BrokenPipeError):
            _discard_output()
            return 0
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except OSError as error:
        # Only errors of a path are the user's; any other is a defect and needs its traceback.
        if error.errno not in _OF_A_PATH:
            raise
        where = f"{os.fsdecode(error.filename)} cannot be read or written: " if error.filename else ""
        return report_error(ParameterError(f"{where}{error.strerror}"))
    # typer turns Ctrl-C into a bare 130, which has not been reported yet.
    if result == EXIT_INTERRUPTED and not isinstance(result, _Reported):
        print("interrupted", file=sys.stderr)
    return int(result) if isinstance(result, int) else 0


def _refuse_repeats(command: Any) -> None:
    """Make a command and its subcommands refuse repeated options, of which click silently takes the last."""
    for one in getattr(command, "commands", {}).values():
        _refuse_repeats(one)
    make_parser = command.make_parser

    def make_strict_parser(context: Any) -> Any:
        parser = make_parser(context)
        parse = parser.parse_args

        def parse_once(args: list[str]) -> Any:
            values, left, order = parse(args)
            # Help may be repeated, and so may a flag without a negative form.
            counted_once = [] if any(option.name == "help" for option in order) else order
            for option in counted_once:
                count = order.count(option)
                if count > 1 and not option.multiple and (not option.is_flag or option.secondary_opts):
                    raise ParameterError(f"{max(option.opts, key=len)} is given {count} times; expected once")
            return values, left, order

        parser.parse_args = parse_once
        return parser

    command.make_parser = make_strict_parser


def _complete_help(command: Any) -> None:
    """Show runnable commands and whole summaries of subcommands in help: click cuts them to one line."""
    for one in getattr(command, "commands", {}).values():
        _complete_help(one)
        one.short_help = one.short_help or " ".join((one.help or "").partition("\n\n")[0].split()).removesuffix(".")
    command.help, command.epilog = (text and as_typed(text) for text in (command.help, command.epilog))


def _one_name(name: str) -> str:
    return "out" if name == "output" else name


def print_text(text: str) -> None:
    """Print a text; a closed pipe (``| head``) is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        _discard_output()


def _discard_output() -> None:
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def typed_options(context: typer.Context, names: Collection[str]) -> list[str]:
    """Return the options of these variables that were typed, as ``--effort-limit``, in alphabetical order."""
    typed = {name for name in names if str(context.get_parameter_source(name)).endswith("COMMANDLINE")}
    return sorted(
        max(option.secondary_opts if context.params[option.name] is False else option.opts, key=len)
        for option in context.command.params
        if option.name in typed
    )


def report_error(error: BaseException) -> int:
    """Print an error as one sentence on standard error and return the exit code for it."""
    print(f"error: {as_typed(str(error))}", file=sys.stderr, flush=True)
    return EXIT_USAGE


def is_exhaustion(error: BaseException) -> bool:
    """Return whether an error, of any library, means that memory is exhausted."""
    return isinstance(error, MemoryError) or any(sign in str(error) for sign in _SIGNS_OF_EXHAUSTION)


def report_exhaustion(error: BaseException) -> int:
    """Print that memory is exhausted and return exit code 1; 0 for other errors.

    Python, the loader of a library, or a library that starts a thread may raise it.
    """
    if not is_exhaustion(error):
        return 0
    text = str(error)
    first = text.splitlines()[0] if text else "no more could be had"
    print(f"error: memory is exhausted: {first}", file=sys.stderr, flush=True)
    return 1


def report_missing(error: BaseException) -> int:
    """Print which library is missing and how to install it; return the exit code, 0 for other errors."""
    text = how_to_install(error) if isinstance(error, ImportError) else ""
    return report_error(ParameterError(text)) if text else 0


_OF_A_PATH = (errno.ENOENT, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM, errno.EROFS,
              errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG, errno.ELOOP)  # fmt: skip
_SIGNS_OF_EXHAUSTION = (
    "failed to map segment", "annot allocate memory", "bad_alloc", "ould not allocate", "pthread_create failed",
    "can't start new thread",
)  # fmt: skip


_DOCSTRING = re.compile(r'(?:\s*#.*\n)*\s*"""(.*?)(?:"""|\n)')
"""First line of a module's docstring."""


def summary(name: str, target: str) -> str:
    """Return a program's summary: the first line of its module's docstring, read without importing the module.

    Of a line that covers several programs (```one``: this; ``other``: that``), its part is returned.
    """
    top, *rest = target.partition(":")[0].split(".")
    # By file: finding the module would import its packages.
    spec = importlib.util.find_spec(top)
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    files = [path for folder in folders if (path := Path(folder, *rest).with_suffix(".py")).is_file()]
    found = _DOCSTRING.match(files[0].read_text(encoding="utf-8")) if files else None
    text = found[1] if found else ""
    own = re.search(rf"``{re.escape(name)}``: (.*?)(?:; ``|$)", text)
    words = own.group(1) if own else text.partition(": ")[2] or text
    return words[:1].upper() + words[1:].rstrip(".").replace("``", "")


def _usage(package: str, table: dict[str, str]) -> str:
    names = sorted(table)
    lines = [f"usage: python -m {package} EXECUTABLE [ARGUMENTS]", "", "executables:"]
    width = max(len(name) for name in names)
    lines += [f"  {name:<{width}}  {summary(name, table[name])}".rstrip() for name in names]
    lines += ["", f"example: python -m {package} {names[0]} --help"]
    lines += [f"completion with the Tab key, in bash or zsh: source <(python -m {package} --completion bash)"]
    return as_typed("\n".join(lines))
