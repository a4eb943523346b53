"""Completion of command lines in bash and zsh: ``source <(python -m pendulum_bags --completion bash)``.

No completion library handles ``python -m PACKAGE EXECUTABLE``, whose program is named python. The printed script passes
the words to the program itself, marked by an environment variable; it prints the candidates instead of running.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from pendulum_msgs_py.errors import ParameterError

if TYPE_CHECKING:
    from pendulum_msgs_py.parameters import ParameterSpec

__all__ = ["SHELLS", "VARIABLE", "asked", "of_command", "of_node", "of_package", "script"]

VARIABLE = "_PENDULUM_COMPLETE"
"""Set by the shell if the words are to be completed, not run; the last one is incomplete."""

_SCRIPT = r"""
_pendulum_complete() {{
  local line="${{COMP_LINE:0:$COMP_POINT}}" at candidate
  local -a typed
  {split}
  [[ "$line" == *[[:space:]] ]] && typed+=("")
  COMPREPLY=()
  if [[ "${{typed[0]##*/}}" == pendulum ]]; then
    while IFS= read -r candidate; do
      COMPREPLY+=("$candidate")
      {nospace}
    done < <({variable}=1 "${{typed[0]/#\~/$HOME}}" "${{typed[@]:1}}" 2>/dev/null)
    return
  fi
  if [[ "${{typed[1]}}" != -m || -z "${{typed[2]}}" \
      || ( pendulum_ != "${{typed[2]}}"* && "${{typed[2]}}" != pendulum_* ) ]]; then
    [[ -n "$_pendulum_before" ]] && "$_pendulum_before" "$@"
    return
  fi
  if [[ "${{#typed[@]}}" -eq 3 ]]; then
    for candidate in {packages}; do
      [[ "$candidate" == "${{typed[2]}}"* ]] && COMPREPLY+=("$candidate")
    done
    return
  fi
  while IFS= read -r candidate; do
    COMPREPLY+=("$candidate")
    {nospace}
  done < <({variable}=1 "${{typed[0]/#\~/$HOME}}" "${{typed[@]:1}}" 2>/dev/null)
}}
"""
_BASH = """\
declare -F _completion_loader >/dev/null && _completion_loader python 2>/dev/null
_pendulum_before=$(complete -p python 2>/dev/null | sed -n 's/.* -F \\([^ ]*\\) .*/\\1/p')
[[ "$_pendulum_before" == _pendulum_complete ]] && _pendulum_before=
complete -o default -o bashdefault -F _pendulum_complete python python3 .venv/bin/python pendulum .venv/bin/pendulum
"""
_ZSH_HEAD = "autoload -U +X compinit && compinit -u\nautoload -U +X bashcompinit && bashcompinit\n"
_ZSH = "complete -o default -F _pendulum_complete python python3 .venv/bin/python pendulum .venv/bin/pendulum\n"

SHELLS = ("bash", "zsh")


def asked() -> bool:
    """Return whether the shell requests completions."""
    return bool(os.environ.get(VARIABLE))


def script(shell: str) -> str:
    """Return the script for one of :data:`SHELLS` to source; raise a ParameterError for another shell."""
    if shell not in SHELLS:
        raise ParameterError(f"shell is {shell!r}; expected one of {', '.join(SHELLS)}")
    # Imported late: every program imports this module, and few print a script.
    from importlib.metadata import distributions

    names = {str(found.metadata["Name"]).replace("-", "_") for found in distributions()}
    ours = sorted(name for name in names if name.startswith("pendulum_") and find_spec(f"{name}.__main__"))
    values = {"packages": " ".join(ours), "variable": VARIABLE}
    if shell == "bash":
        nospace = '[[ "$candidate" == *= ]] && compopt -o nospace'
        return _SCRIPT.format(split='read -ra typed <<< "$line"', nospace=nospace, **values) + _BASH
    split = "setopt local_options ksh_arrays; typed=(${=line})"
    return _ZSH_HEAD + _SCRIPT.format(split=split, nospace=":", **values) + _ZSH


def of_package(table: Iterable[str], words: Sequence[str]) -> list[str]:
    """Return the executables (names in ``table``) that complete the words behind a package."""
    incomplete = words[-1] if words else ""
    return _beginning(["--completion", "--help"] if incomplete.startswith("-") else sorted(table), incomplete)


def of_command(command: Any, words: Sequence[str]) -> list[str]:
    """Return completions of a typer command: commands, options, or choices; none for a file or a free value."""
    *before, incomplete = words or [""]
    while before and (command_below := getattr(command, "commands", {}).get(before[0])) is not None:
        command, before = command_below, before[1:]
    options = [found for found in command.params if found.param_type_name == "option" and not found.hidden]
    for option in options:
        if before and before[-1] in option.opts and not option.is_flag:
            return _beginning(map(str, getattr(option.type, "choices", ())), incomplete)
    below = [name for name, found in getattr(command, "commands", {}).items() if not found.hidden]
    if below and not incomplete.startswith("-"):
        return _beginning(sorted(below), incomplete)
    if not incomplete.startswith("-"):
        return []  # an argument: files, which the shell completes
    named = [name for option in options for name in (*option.opts, *option.secondary_opts)]
    return _beginning(sorted({*named, "--help"}), incomplete)


def of_node(specs: Iterable[ParameterSpec], words: Sequence[str]) -> list[str]:
    """Return completions of a node's command line, given its parameters."""
    *before, incomplete = words or [""]
    if "--ros-args" not in before:
        return _beginning(["--help", "--ros-args"], incomplete)
    if before[-1] == "-p":
        return _beginning([f"{spec.name}:=" for spec in specs], incomplete)
    if before[-1] == "-r":
        return _beginning(["__node:=", "__ns:="], incomplete)
    if before[-1] in {"--params-file", "--enclave", "--log-level"}:
        return []
    return _beginning(["--enclave", "--log-level", "--params-file", "-p", "-r"], incomplete)


def _beginning(candidates: Iterable[str], incomplete: str) -> list[str]:
    return [candidate for candidate in candidates if candidate.startswith(incomplete)]
