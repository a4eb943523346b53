"""A first day in a lab, whole: every command as a person types it, with the backend ``hebi`` and emulated modules.

``python -m tests.acceptance.first_day`` lives through it and writes what was said into the page of the first day;
``test_first_day.py`` lives through it too, and compares.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_hw_bridge.actuator import Strategy
from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.nudge import EMULATED_NUDGE
from pendulum_msgs_py.plants.lab_file import load_lab, write_lab
from tests.fixtures import wait_for
from tests.processes import ProcessGroup, RunningProgram

__all__ = ["PAGE", "Day", "Step", "live_through", "skeleton", "steps_of", "text_of", "write_page"]

PROJECT = Path(__file__).resolve().parents[2]
PAGE = PROJECT / "pendulum_hw_bridge" / "docs" / "first_day.md"
_BEGIN, _END = "<!-- the day -->\n", "<!-- end of the day -->\n"
_PORTS = (17590, 17591)
"""Ports that the page shows, whichever were free."""
_PATIENCE = 60.0
_TRIES = 8
"""How often a step is tried anew that a busy computer has broken off [-]."""
_BUSY = re.compile(
    r"host_stalled|command_not_in_force|output_disagreement|tracking|feedback_late|feedback_lost|feedback_frozen"
    r"|too busy|is silent for|not answer|\bms old"
)
EXIT_BUSY = 3


@dataclass(frozen=True)
class Step:
    """One command of the day.

    Attributes:
        heading: Heading above it, or nothing.
        words: What a reader should know before.
        command: As it is typed.
        output: What the program said, and in square brackets what the person did.
        code: Exit code.
    """

    heading: str
    words: str
    command: str
    output: str
    code: int


class Button:
    """A hardware button as e-stop: a node that says 20 times a second whether it is pressed, while it is held."""

    def __init__(self, domain: int) -> None:
        self.pressed: bool | None = False
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("button", context=self._context)
        self._e_stop = self._node.create_client(Trigger, "/hw/bridge/e_stop")
        self._publisher = self._node.create_publisher(Bool, "/hw/e_stop_input", 1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            if self.pressed is not None:
                self._publisher.publish(Bool(data=self.pressed))

    def e_stop(self) -> None:
        """Call the bridge's e-stop service, as the console does."""
        assert self._e_stop.wait_for_service(_PATIENCE)
        self._e_stop.call_async(Trigger.Request())

    def close(self) -> None:
        """Leave the graph."""
        self._stop.set()
        self._thread.join()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)


class Day:
    """The bench: two emulated modules of one name on HEBI's network, a person, and what was said.

    Args:
        processes: Starts the programs.
        folder: Where the person works.
        domain: ROS domain.
    """

    def __init__(self, processes: ProcessGroup, folder: Path, domain: int) -> None:
        self.processes, self.folder, self.domain = processes, folder, domain
        self.steps: list[Step] = []
        self._begin = time.monotonic()
        self.ports = _free_ports()
        for port, serial, kind in zip(self.ports, ("X5-9-00123", "X5-4-00077"), ("X5-9", "X5-4"), strict=True):
            identity = ("--family", "Lab", "--name", "Pendulum", "--serial", serial, "--module-type", kind)
            program = processes.start("pendulum_hw_bridge", "emulator", "--address", f"127.0.0.1:{port}", *identity)
            program.wait_for_output("listens on", _PATIENCE)
        self.truth = EmulatorProcessBackend(f"127.0.0.1:{self.ports[0]}")
        self.truth.connect()

    @property
    def network(self) -> str:
        """The ``interface`` on which both modules are."""
        return "emulator:" + ",".join(f"127.0.0.1:{port}" for port in self.ports)

    def run(
        self,
        command: str,
        *,
        heading: str = "",
        words: str = "",
        code: int = 0,
        person: Callable[[RunningProgram], object] | None = None,
        keep: str = "",
        said: str = "",
    ) -> Step:
        """Type a command, do what the person does, and note what was said.

        Args:
            command: After ``python -m``.
            heading: Heading above it.
            words: What a reader should know before.
            code: Exit code that is expected; what a busy computer broke off is tried again.
            person: What the person does.
            keep: Expression for the lines to show; all without one.
            said: Expression that the output must hold, too, or else a busy computer has broken it off.
        """
        for tries in range(1, _TRIES + 1):
            program = self.start(command)
            if person is not None:
                person(program)
            ended = program.wait(120.0)
            output = program.output
            if ended == code and re.search(said, output):
                break
            busy = ended == EXIT_BUSY or _BUSY.search(output)
            assert busy, f"{command}: try {tries}, code {ended}, expected {code}\n{output}"
            if " move " in command:
                self.resets()
        else:
            raise AssertionError(f"{command}: this computer was too busy {_TRIES} times\n{output}")
        if keep:
            output = "".join(line for line in output.splitlines(keepends=True) if re.search(keep, line))
            command += f" | grep -E {shlex.quote(keep)}"
        step = Step(heading, words, f"python -m {self.tidy(command).strip()}", self.tidy(output), ended)
        self.steps.append(step)
        print(f"{time.monotonic() - self._begin:6.1f} s, tries: {tries}  {step.command}", flush=True)
        return step

    def start(self, command: str) -> RunningProgram:
        """Start a command, to type into it."""
        words = [sys.executable, "-m", *shlex.split(command)]
        environment = {"ROS_DOMAIN_ID": str(self.domain), "NO_COLOR": "1", "RCUTILS_COLORIZED_OUTPUT": "0"}
        return self.processes.start_command(
            words, name=" ".join(words[2:4]), cwd=self.folder, env=environment, typed=True
        )

    def tidy(self, text: str) -> str:
        """Return an output as a reader of the page should see it: without stamps and without this day's ports."""
        text = text.replace("to leave: ", "to leave: [Enter]\n").replace(f"{self.folder}/", "")
        for ours, shown in zip(self.ports, _PORTS, strict=True):
            text = text.replace(str(ours), str(shown))
            text = text.replace(f"{ours >> 8:02X}:{ours & 255:02X}", f"{shown >> 8:02X}:{shown & 255:02X}")
        text = re.sub(r"\[(INFO|WARN|ERROR)\] \[[0-9.]+\] \[[\w.]+\]: ", r"[\1] ", text)
        kept = [line.rstrip() for line in text.splitlines() if not re.search(r"again: this computer was busy", line)]
        return "\n".join(kept).strip("\n") + "\n"

    # --- the person -----------------------------------------------------------------------------------------

    def agrees(self, program: RunningProgram) -> None:
        """Press Enter when asked to."""
        program.wait_for_output("Enter to go on", _PATIENCE)
        program.type("\n")

    def turns(self, program: RunningProgram, way: str, *, clockwise: bool = False, seen: int = 1) -> None:
        """Turn the link when asked to, until that was seen."""
        program.wait_for_output(rf"{way} as you look at it", 150.0)
        self.truth.push(-EMULATED_NUDGE if clockwise else EMULATED_NUDGE)
        try:
            program.wait_for_output(rf"(?s)(Seen; let go.*){{{seen}}}", 40.0)
        finally:
            self.truth.push(0.0)
            self.truth.status()

    def resets(self) -> None:
        """End an e-stop that a busy computer may have latched: the button was late."""
        self.start("pendulum_bags move reset --namespace /hw").wait(120.0)

    def presses_the_motion_stop(self, program: RunningProgram) -> None:
        """Press it once the link has risen, and release it at the end."""
        self.agrees(program)
        program.wait_for_output("Press the motion stop NOW", _PATIENCE)
        self.until(lambda status: status["link"]["position"] > 0.05, "the motor to turn")
        self.truth.inject("m_stop")
        program.wait(_PATIENCE)
        self.truth.clear_faults()

    def until(self, wanted: Callable[[dict[str, Any]], bool], what: str, timeout: float = _PATIENCE) -> dict[str, Any]:
        """Wait until the emulated machine itself says so."""
        deadline = self.truth.now_ns() + round(timeout * 1e9)
        while not wanted(status := self.truth.status()):
            assert self.truth.now_ns() < deadline, f"waited {timeout:g} s for {what}; {status['link']}"
        return status

    def close(self) -> None:
        """Let go of the machine."""
        self.truth.let_go()


def live_through(day: Day, *, whole: bool = True) -> list[Step]:
    """Live through the day; every expectation is asserted on what the emulated machine itself says.

    Args:
        day: The bench.
        whole: With the procedures that wait for a pendulum to come to rest, and with what `check` refuses.
    """
    _get_to_know(day, whole=whole)
    if whole:
        _find_zero(day)
    _prove_m_stop(day)
    if whole:
        _prove_lifetime(day)
    _set_up_button(day)
    if whole:
        _refuse(day)
    _check(day)
    _drive(day)
    _leave(day)
    return day.steps


def _get_to_know(day: Day, *, whole: bool) -> None:
    hw = "pendulum_hw_bridge"
    day.run(
        f"{hw} scan --interface {day.network}",
        heading="Who is there",
        words="Two modules of one name are on the network. `scan` sets nothing. It refuses to choose between twins "
        "(exit code 1), and a module of another type.",
        code=1,
    )
    if whole:
        day.run(f"{hw} scan --interface {day.network} --serial X5-4-00077", code=1, keep="type of")
    day.run(f"{hw} scan --interface {day.network} --serial X5-9-00123", keep="->|drive")
    day.run(
        f"{hw} lab new lab.yaml --interface {day.network} --serial X5-9-00123 --effort 1",
        heading="The lab file",
        words="It is written for that one module, with 1 N m as the largest torque for today. What the module was set "
        "to before us is kept in HEBI's own files.",
    )
    day.run(f"{hw} lab backup lab.yaml --out before_us")
    assert "<max_limit>inf" in (day.folder / "before_us" / "safety.xml").read_text()


def _find_zero(day: Day) -> None:
    hw, lab = "pendulum_hw_bridge", day.folder / "lab.yaml"
    day.run(f"{hw} lab zero lab.yaml", heading="Zero, sign and tare, without torque", person=_zero(day))
    assert load_lab(lab).values["joint_sign"] == 1
    assert abs(load_lab(lab).values["joint_offset"]) < 0.05
    day.run(f"{hw} lab tare lab.yaml", person=day.agrees)
    assert abs(load_lab(lab).values["effort_tare"]) < 0.1


def _zero(day: Day) -> Callable[[RunningProgram], object]:
    def act(program: RunningProgram) -> None:
        day.agrees(program)
        day.turns(program, " COUNTER-CLOCKWISE")
        day.turns(program, " CLOCKWISE", clockwise=True, seen=2)

    return act


def _prove_m_stop(day: Day) -> None:
    day.run(
        "pendulum_hw_bridge lab prove_m_stop lab.yaml",
        heading="Two proofs: motion stop and command lifetime",
        words="The motor turns gently in both, for the first time.",
        person=day.presses_the_motion_stop,
    )
    assert day.truth.status()["strategy"] == Strategy.OFF


def _prove_lifetime(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    expiries = day.truth.status()["lifetime_expiries"]
    day.run(f"{hw} lab prove_lifetime lab.yaml", person=day.agrees)
    assert day.truth.status()["lifetime_expiries"] > expiries
    day.run(f"{hw} lab show lab.yaml", keep="Proved|_stop|lifetime|tare|zero")


def _set_up_button(day: Day) -> None:
    # What is set now is the lab's own: patience with a computer that others use too, and a button.
    lab = load_lab(day.folder / "lab.yaml")
    write_lab(day.folder / "lab.yaml", lab.changed(feedback_watchdog=10, e_stop_input_timeout=1.0))


def _refuse(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    wrong = "NO|^[a-z].*: |eady"
    day.run(
        f"{hw} check --lab lab.yaml --joint-offset 3.1 --no-nudge",
        heading="What check refuses",
        words="A zero that is wrong, a sign that is wrong (the nudge tells), and a torque at rest that nothing "
        "explains, here a sensor that has slipped (exit code 1 each).",
        code=1,
        keep=wrong,
    )
    day.run(
        f"{hw} check --lab lab.yaml --joint-sign -1",
        code=1,
        keep=wrong,
        person=lambda program: day.turns(program, " COUNTER-CLOCKWISE"),
    )
    day.truth.inject("effort_offset")
    day.run(f"{hw} check --lab lab.yaml --no-nudge", code=1, keep=wrong)
    day.truth.clear_faults()


def _check(day: Day) -> None:
    day.run(
        "pendulum_hw_bridge check --lab lab.yaml",
        heading="Check",
        words="With the lab file as it is, but for two values, set by hand before: `e_stop_input_timeout` 1 s, for the "
        "button below, and `feedback_watchdog` 10 periods instead of 3, for a computer that others use too. "
        "You turn the link counter-clockwise when asked to.",
        person=lambda program: day.turns(program, " COUNTER-CLOCKWISE"),
    )


def _drive(day: Day) -> None:
    bags = "pendulum_bags move"
    with _bridge(day) as (bridge, button):
        day.run(
            f"{bags} 0.3 --namespace /hw",
            heading="A ramp at 1 N m, hold, e-stop",
            words="In a second terminal; the bridge of the first one runs all the time, and what it said stands below. "
            "The ramp is broken off by the e-stop (its service, as the console calls it); "
            "then it is done again, and held.",
            code=2,
            person=lambda program: _stops_in_the_ramp(day, button, program),
            said="e.stop",
        )
        day.run(f"{bags} reset --namespace /hw")
        _hold(day, f"{bags} 0.3 --namespace /hw", 0.3)
        day.run(f"{bags} stop --namespace /hw")
        _is_off(day)

        day.run(
            f"{bags} reset --namespace /hw",
            heading="A button as e-stop",
            words="`e_stop_input_timeout: 1 s` stands in the lab file, and a button says 20 times a second that it is "
            "not pressed. It is pressed while the motor holds; later it falls silent, as with a cable pulled out.",
        )
        for goal, pressed, told in ((0.4, True, "button is pressed"), (-0.2, None, "is silent for")):
            _hold(day, f"{bags} {goal} --namespace /hw", goal)
            before = len(re.findall(told, bridge.output))
            button.pressed = pressed
            _is_off(day)
            wait_for(lambda b=before, t=told: len(re.findall(t, bridge.output)) > b, _PATIENCE, told)  # type: ignore[misc]
            button.pressed = False
            day.run(f"{bags} reset --namespace /hw")
        day.run(f"{bags} down --namespace /hw")
        _is_off(day)
        bridge.send_signal(signal.SIGINT)
        assert bridge.wait(30.0) == 0, bridge.output
        said = "".join(line for line in bridge.output.splitlines(keepends=True) if "[" in line)
        words = "What the bridge said in its terminal, all the while; Ctrl-C at the end."
        command = "python -m pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p lab_file:=lab.yaml"
        day.steps.append(Step("The bridge", words, command, day.tidy(said), 0))
    assert day.truth.status()["strategy"] == Strategy.OFF


@contextlib.contextmanager
def _bridge(day: Day) -> Iterator[tuple[RunningProgram, Button]]:
    button = Button(day.domain)
    try:
        bridge = day.start("pendulum_hw_bridge bridge --ros-args -r __ns:=/hw -p lab_file:=lab.yaml")
        bridge.wait_for_output("ready", _PATIENCE)
        day.resets()
        yield bridge, button
    finally:
        button.close()


def _hold(day: Day, command: str, angle: float) -> None:
    """Move there, and see that the motor holds it; a computer that is too busy meanwhile is given further tries."""
    for _ in range(_TRIES):
        step = day.run(command)
        status = day.truth.status()
        if status["strategy"] != Strategy.OFF:
            assert abs(status["link"]["position"] - angle) < 0.12, status["link"]
            return
        day.steps.remove(step)
        day.resets()
    raise AssertionError(f"{command}: not held after {_TRIES} tries")


def _stops_in_the_ramp(day: Day, button: Button, program: RunningProgram) -> None:
    program.wait_for_output("moving from", _PATIENCE)
    day.until(lambda status: status["link"]["position"] > 0.08 or program.returncode is not None, "the ramp to rise")
    button.e_stop()
    program.wait(_PATIENCE)
    _is_off(day)


def _is_off(day: Day) -> None:
    # The motor's own record is of the physics' last step, a little before the strategy's.
    day.until(lambda status: status["strategy"] == Strategy.OFF and status["link"]["pwm"] == 0.0, "no torque")


def _leave(day: Day) -> None:
    hw = "pendulum_hw_bridge"
    day.run(
        f"{hw} lab restore lab.yaml before_us",
        heading="Give the module back as it was",
        words="Gains, limits and M-stop action; the second backup shows that they are those of the first.",
        person=day.agrees,
    )
    day.run(f"{hw} lab backup lab.yaml --out after_us")
    for name in ("gains.xml", "safety.xml", "position_limit_strategies.json"):
        assert (day.folder / "after_us" / name).read_text() == (day.folder / "before_us" / name).read_text()


# --- the page ---------------------------------------------------------------------------------------------------


def text_of(steps: list[Step]) -> str:
    """Return the day in Markdown."""
    text = ""
    for step in steps:
        text += f"\n## {step.heading}\n" if step.heading else ""
        text += f"\n{step.words}\n" if step.words else ""
        text += f"\n```console\n$ {step.command}\n{step.output}```\n"
    return text


def skeleton(text: str) -> tuple[str, ...]:
    """Return what must be the same on each day: commands and what they say, without numbers and rules of tables.

    What the bridge logs all the while is left out: a busy computer adds tries to it.
    """
    found = []
    for line in text.splitlines():
        if line.startswith("$ "):
            found.append(line)
        elif not line.startswith(("#", "[INFO]", "[WARN]", "[ERROR]")):
            bare = re.sub(r"[┏┓┗┛┡┩┳┻╇┴└┘━─│┃+-]", " ", line)
            found.append(" ".join(re.sub(r"[\d.:]+", " ", bare).split()))
    return tuple(line for line in found if line)


def steps_of(page: str) -> set[tuple[str, ...]]:
    """Return the skeleton of each command that a page shows."""
    return {skeleton(block) for block in re.findall(r"(?ms)^```console$.*?^```$", page)}


def write_page(steps: list[Step]) -> None:
    """Put the day into the page."""
    page = PAGE.read_text(encoding="utf-8")
    head, tail = page.split(_BEGIN)[0], page.split(_END)[1]
    PAGE.write_text(head + _BEGIN + text_of(steps) + "\n" + _END + tail, encoding="utf-8")


def _free_ports() -> tuple[int, int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        first, second = (int(each.getsockname()[1]) for each in sockets)
    return first, second


def main() -> None:
    """Live through the day and write the page."""
    with tempfile.TemporaryDirectory(prefix="pendulum_day_") as name, reserve_domain() as domain:
        folder = Path(name, "lab")
        folder.mkdir()
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        processes = ProcessGroup(Path(name, "processes"), cwd=PROJECT)
        day = Day(processes, folder, domain)
        try:
            write_page(live_through(day))
            print(f"{PAGE}: {len(day.steps)} commands")
        except BaseException:
            print(text_of(day.steps))  # what was said until then
            raise
        finally:
            day.close()
            processes.close()


if __name__ == "__main__":
    main()
