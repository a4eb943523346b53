"""Before a real machine moves: identity, plan, checklist, and the operator's confirmation."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from pendulum_bags.experiments.run_spec import EMULATOR_PATIENCE
from pendulum_bags.recordings.bridge_programs import last_words, run_bridge_program
from pendulum_msgs_py.errors import FaultError, ParameterError
from pendulum_msgs_py.plants.lab_file import DRIVES, EMULATED_BACKENDS, LabFile, load_lab
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.graph import NodeProgram, ParameterArgument
from pendulum_msgs_py.programs.terminal import make_console

__all__ = ["RealMachine", "ask_for_running", "ask_yes", "confirmed", "real_machine", "run_checklist"]

_CHECK_TIMEOUT = 120.0
_EXIT_BUSY = 3
YES = "yes"
_TERMINALS = "/dev/pts/"
_REHEARSAL: Mapping[str, ParameterArgument] = {"feedback_watchdog": 10, "command_lifetime": 0.1}
"""Parameters for a drive on a pseudo-terminal, perhaps emulated on this busy computer; real ones may have them too."""


@dataclass(frozen=True)
class RealMachine:
    """The machine of a lab file at ``path``, None for a drive without one, with the content ``lab``."""

    path: Path | None
    lab: LabFile

    @property
    def is_drive(self) -> bool:
        """Whether it is a drive with a current loop, which takes torques as they are."""
        return self.lab.values["backend"] in DRIVES

    def bridge_program(self, strategy: str, bag: Path | None = None) -> NodeProgram:
        """Return the bridge; an emulator's is more patient, a real actuator's own log goes next to ``bag``."""
        patience = EMULATOR_PATIENCE if self.patient else {}
        if self.is_drive and str(Path(str(self.lab.values["interface"])).resolve()).startswith(_TERMINALS):
            patience = _REHEARSAL
        parameters = {name: value for name, value in patience.items() if name not in self.lab.values}
        parameters |= self.log_parameters(bag)
        parameters |= {} if self.path is None else {"lab_file": str(self.path)}
        if self.is_drive:
            parameters |= {name: self.lab.values[name] for name in ("backend", "interface", "plant")}
        else:
            parameters["effort_strategy"] = strategy
        return graph.bridge("/hw", **parameters)

    def log_parameters(self, bag: Path | None) -> dict[str, ParameterArgument]:
        """Return the parameters for hebi-py's own log next to a bag; empty for an emulator."""
        if bag is None or self.emulated or self.lab.values["backend"] != "hebi":
            return {}
        return {"hebi_log": str(bag.resolve().with_suffix(".hebilog"))}

    @property
    def emulated(self) -> bool:
        """Whether the lab file names an emulator, or HEBI's network with emulators on it: a rehearsal."""
        return self.lab.emulated

    @property
    def patient(self) -> bool:
        """Whether the bridge may wait for a busy computer: not if it enforces a real machine's limits."""
        return self.lab.values["backend"] in EMULATED_BACKENDS

    @property
    def effort_limit(self) -> str:
        """Largest torque, as text."""
        limit = self.lab.values.get("effort_limit")
        return f"{limit:g} N m (lab file)" if limit else "that of the plant file"


def real_machine(hardware: str, lab: str | Path | None) -> RealMachine | None:
    """Return the machine of ``--hardware hebi --lab FILE`` or of ``DRIVE:INTERFACE``, None for others.

    Raises:
        ParameterError: The lab file is missing, refused, or another machine's.
    """
    drive, _, interface = hardware.partition(":")
    if drive in DRIVES:
        path = Path(lab).expanduser().resolve() if lab else None
        of_file = LabFile({"backend": drive}) if path is None else load_lab(path)
        if of_file.values["backend"] != drive:
            raise ParameterError(f"lab file {path} is of backend {of_file.values['backend']!r}; expected {drive!r}")
        interface = interface or str(of_file.values.get("interface", ""))
        if not interface:
            raise ParameterError(f"hardware is {hardware!r} without its bus; expected {drive}:INTERFACE, or a lab file")
        return RealMachine(path, LabFile({"plant": DRIVES[drive], **of_file.values, "interface": interface}))
    if hardware != "hebi":
        if lab:
            raise ParameterError(f"lab file {lab} is given with hardware {hardware!r}; expected --hardware hebi")
        return None
    if not lab:
        raise ParameterError(
            "hardware is 'hebi' without a lab file; expected --lab FILE, with the actuator's identity, its zero, "
            "sign and limits (python -m pendulum_hw_bridge lab new FILE writes one)"
        )
    path = Path(lab).expanduser().resolve()
    return RealMachine(path, load_lab(path))


@contextlib.contextmanager
def confirmed(
    machine: RealMachine | None, bridge: NodeProgram, plan: str, *, yes: bool, flat: bool = False
) -> Iterator[None]:
    """Save the module's settings, run the checklist, ask the operator; restore the settings at the end.

    Without a machine (the emulator) it does nothing. ``plan`` is what will happen, in sentences; ``yes`` confirms on
    the command line; ``flat`` is for a pendulum that lies flat. A FaultError if the settings cannot be read, the
    checklist fails, or the operator does not confirm.
    """
    if machine is None:
        yield
        return
    console = make_console(stderr=True, highlight=False)
    # A drive's settings are written at each arming; nothing of a person's is lost.
    with contextlib.nullcontext() if machine.is_drive else _saved_settings(machine, console):
        run_checklist(bridge, console, flat=flat)
        ask_yes(machine, plan, console, yes=yes)
        yield


@contextlib.contextmanager
def _saved_settings(machine: RealMachine, console: Console) -> Iterator[None]:
    """Save gains, safety parameters and M-stop action of the module, and always restore them."""
    folder = Path(tempfile.mkdtemp(prefix="pendulum_module_")) / "before"
    console.print("keeping the module's settings ...", style="dim")
    said = _lab("backup", str(machine.path), "--out", str(folder))
    if said:
        shutil.rmtree(folder.parent, ignore_errors=True)
        raise FaultError(f"the module's settings cannot be saved: {said}; nothing was started")
    try:
        yield
    finally:
        said = _lab("restore", str(machine.path), str(folder), "--yes")
        if said:
            again = f"python -m pendulum_hw_bridge lab restore {machine.path} {folder}"
            words = f"the module's settings were not given back ({said}); again: {again}"
            console.print(words, markup=False, style="red")
        else:
            shutil.rmtree(folder.parent, ignore_errors=True)


def _lab(*arguments: str) -> str:
    try:
        # Ctrl-C is for the experiment: it must not end the restoring of settings.
        done = run_bridge_program("lab", *arguments, timeout=_CHECK_TIMEOUT, deaf_to_ctrl_c=True)
    except subprocess.TimeoutExpired:
        return f"it did not end within {_CHECK_TIMEOUT:g} s"
    return "" if done.returncode == 0 else last_words(done.stderr, f"code {done.returncode}")


def run_checklist(bridge: NodeProgram, console: Console, *, flat: bool = False) -> None:
    """Run ``check`` with the bridge's own options; a FaultError if it does not pass."""
    arguments = ["check", "--json", "--no-nudge", *bridge.ros_arguments(), *(["-p", "flat:=true"] if flat else [])]
    console.print("checking the machine ...", style="dim")
    try:
        done = run_bridge_program(*arguments, timeout=_CHECK_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise FaultError(f"the checklist did not end within {_CHECK_TIMEOUT:g} s; nothing was started") from None
    if done.returncode == 0:
        return
    if done.returncode == _EXIT_BUSY:
        raise FaultError("this computer is too busy to drive the machine; nothing was started")
    raise FaultError(f"the checklist is not passed: {_refusals(done.stdout, done.stderr)}; nothing was started")


def _refusals(printed: str, said: str) -> str:
    try:
        items = json.loads(printed)["items"]
    except (ValueError, KeyError):
        return last_words(said, "it ended without a word")
    wrong = [item for item in items if item["passed"] is False]
    return "; ".join(f"{item['name']}: {item['seen']} (expected {item['expected']})" for item in wrong)


def ask_yes(machine: RealMachine, plan: str, console: Console, *, yes: bool, read: Callable[[], str] = input) -> None:
    """Print what will move, and wait for the operator's confirmation; a FaultError without it."""
    what = "an EMULATED machine (a rehearsal)" if machine.emulated else "a REAL machine"
    file = f", lab file {machine.path}" if machine.path else ""
    moves = f"{what}: {machine.lab.describe()}{file}"
    stop = "the switch of its supply" if machine.is_drive else "the motion stop"
    _ask(console, moves, plan, f"{machine.effort_limit}. Keep a hand on {stop}", yes=yes, read=read)


def ask_for_running(places: Sequence[str], domain: int, plan: str, *, yes: bool) -> None:
    """Ask before moving running plants, whose hardware is unknown; a FaultError without confirmation."""
    if not places:
        return
    console = make_console(stderr=True, highlight=False)
    moves = f"what runs already in {' and '.join(places)} on ROS domain {domain}: it may be a REAL machine"
    _ask(console, moves, plan, "what that plant allows. Keep a hand on its motion stop", yes=yes, read=input)


def _ask(console: Console, moves: str, plan: str, limit: str, *, yes: bool, read: Callable[[], str]) -> None:
    console.print(
        f"\nThis moves {moves}.\n{plan}\nLargest torque: {limit}, and nobody in the pendulum's plane.",
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
        raise FaultError("there is no terminal to confirm in; expected one, or --yes; nothing was started") from None
    if answer.strip().lower() != YES:
        raise FaultError(f"the answer is {answer.strip()!r}; expected {YES!r}; nothing was started")
