"""Before a real machine moves: which one it is, what it will do, a checklist, and an operator's yes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.lab_file import LabFile, load_lab
from pendulum_msgs_py.programs.graph import NodeProgram, ParameterArgument

__all__ = ["RealMachine", "ask_yes", "confirm", "real_machine", "run_checklist"]

_CHECK_TIMEOUT = 120.0
_EXIT_BUSY = 3
YES = "yes"


@dataclass(frozen=True)
class RealMachine:
    """The machine of a lab file.

    Attributes:
        path: The lab file.
        lab: Its content.
    """

    path: Path
    lab: LabFile

    def bridge_parameters(self, **defaults: ParameterArgument) -> dict[str, ParameterArgument]:
        """Return what the bridge is told: the lab file, and defaults for what the file leaves open."""
        left_open = {name: value for name, value in defaults.items() if name not in self.lab.values}
        return {"lab_file": str(self.path), **left_open}

    def log_parameters(self, bag: Path | None) -> dict[str, ParameterArgument]:
        """Return what makes hebi-py write its own log beside a bag; nothing for an emulator, which has none."""
        if bag is None or self.lab.values["backend"] != "hebi":
            return {}
        return {"hebi_log": str(bag.resolve().with_suffix(".hebilog"))}

    @property
    def emulated(self) -> bool:
        """Whether the lab file names an emulator: a rehearsal."""
        return str(self.lab.values["backend"]).startswith("emulator")

    @property
    def effort_limit(self) -> str:
        """Largest torque, in words."""
        limit = self.lab.values.get("effort_limit")
        return f"{limit:g} N m (lab file)" if limit else "that of the plant file, up to 13 N m"


def real_machine(hardware: str, lab: str | Path | None) -> RealMachine | None:
    """Return the machine that ``--hardware hebi --lab FILE`` means; None for the emulator.

    Raises:
        ParameterError: The lab file is missing, refused, or given for the emulator.
    """
    if hardware != "hebi":
        if lab:
            raise ParameterError(f"lab file {lab} is given with hardware {hardware!r}; expected --hardware hebi")
        return None
    if not lab:
        raise ParameterError(
            "hardware is 'hebi' without a lab file; expected --lab FILE, which says which actuator it is, its zero, "
            "sign and limits (python -m pendulum_hw_bridge lab new FILE writes one)"
        )
    path = Path(lab).expanduser().resolve()
    return RealMachine(path, load_lab(path))


def confirm(
    machine: RealMachine, bridge: NodeProgram, plan: str, console: Console, *, yes: bool, flat: bool = False
) -> None:
    """Go through the checklist with the bridge's own options, say what will move, and ask.

    Args:
        machine: The machine.
        bridge: The bridge as it will be started.
        plan: What will happen, one sentence or more.
        console: Where to say it.
        yes: The operator has said yes on the command line.
        flat: Whether the pendulum lies flat.

    Raises:
        FaultError: The checklist is not passed, or the operator does not say yes.
    """
    run_checklist(bridge, console, flat=flat)
    ask_yes(machine, plan, console, yes=yes)


def run_checklist(bridge: NodeProgram, console: Console, *, flat: bool = False) -> None:
    """Run ``check`` with the bridge's own options; nothing is started where it is not passed.

    Raises:
        FaultError: It is not passed.
    """
    command = [sys.executable, "-m", "pendulum_hw_bridge", "check", "--json", "--no-nudge", *bridge.ros_arguments()]
    command += ["-p", "flat:=true"] if flat else []
    console.print("checking the machine ...", style="dim")
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=_CHECK_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise FaultError(f"the checklist did not end within {_CHECK_TIMEOUT:g} s; nothing was started") from None
    if done.returncode == 0:
        return
    if done.returncode == _EXIT_BUSY:
        raise FaultError("this computer is too busy to drive the machine; nothing was started")
    raise FaultError(f"the checklist is not passed: {_refusals(done.stdout, done.stderr)}; nothing was started")


def _refusals(printed: str, said: str) -> str:
    """Return what speaks against arming: the lines of the checklist that fail, or why there is none."""
    try:
        items = json.loads(printed)["items"]
    except (ValueError, KeyError):
        return said.strip().splitlines()[-1].removeprefix("error: ") if said.strip() else "it ended without a word"
    wrong = [item for item in items if item["passed"] is False]
    return "; ".join(f"{item['name']}: {item['seen']} (expected {item['expected']})" for item in wrong)


def ask_yes(
    machine: RealMachine,
    plan: str,
    console: Console,
    *,
    yes: bool,
    read: Callable[[], str] = input,
) -> None:
    """Say what will move, and wait for the operator's yes.

    Raises:
        FaultError: The answer is another, or nobody can answer.
    """
    what = "an EMULATED machine (a rehearsal)" if machine.emulated else "a REAL machine"
    console.print(
        f"\nThis moves {what}: {machine.lab.describe()}, lab file {machine.path}.\n{plan}\n"
        f"Largest torque: {machine.effort_limit}. Keep a hand on the motion stop, and nobody in the pendulum's plane.",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )
    if yes:
        console.print("(--yes: not asked)", markup=False)
        return
    console.print(f"Type {YES} to arm: ", end="", markup=False)
    try:
        answer = read()
    except EOFError:
        raise FaultError(
            "nobody is there to say yes; expected a terminal, or --yes; nothing was started"
        ) from None
    if answer.strip().lower() != YES:
        raise FaultError(f"the answer is {answer.strip()!r}; expected {YES!r}; nothing was started")
