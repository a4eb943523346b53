"""The bench of a first day in a lab: two emulated modules, a person with a stop button, and what was said."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from pendulum_hw_bridge.backends.emulator_process import EmulatorProcessBackend
from pendulum_hw_bridge.checks.nudge import EMULATED_NUDGE
from pendulum_testing.fixtures import wait_for
from pendulum_testing.processes import ProcessGroup, RunningProgram
from tests.acceptance.first_day_page import Step

__all__ = ["PATIENCE", "TRIES", "Button", "Day"]

_PORTS = (17590, 17591)
"""Ports that the page shows, whichever were free."""
PATIENCE = 60.0
TRIES = 8
"""How often a step is tried anew that a busy computer has broken off [-]."""
_BUSY = re.compile(
    r"host_stalled|command_not_in_force|output_disagreement|tracking|feedback_late|feedback_lost|feedback_frozen"
    r"|too busy|is silent for|no feedback for|not answer|\bms (old|late)\b"
    r"|passed between two commands|acts on PWM|did not have the duty|kept its duty"
    r"|NO │ (this computer keeps time|feedback |no feedback gets lost|acknowledgements )"
)
_MOMENT = re.compile("again: this computer was busy|more: records got lost")
"""Lines of a checklist that listens longer; a quiet computer prints none."""
EXIT_BUSY = 3


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
        assert self._e_stop.wait_for_service(PATIENCE)
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
            program.wait_for_output("listens on", PATIENCE)
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
        for tries in range(1, TRIES + 1):
            program = self.start(command)
            if person is not None:
                try:
                    person(program)
                except AssertionError:
                    # Who waits for a program that has been broken off waits in vain; why it was is judged below.
                    if program.returncode is None:
                        raise
            ended = program.wait(120.0)
            output = program.output
            if ended == code and re.search(said, output):
                break
            busy = ended == EXIT_BUSY or _BUSY.search(output)
            assert busy, f"{command}: try {tries}, code {ended}, expected {code}\n{output}"
            if " move " in command:
                self.resets()
        else:
            raise AssertionError(f"{command}: this computer was too busy {TRIES} times\n{output}")
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
        if words[3] == "move":
            # Nobody types into it: the process of the last one runs the next.
            return self.processes.start(*words[2:])
        # As in an activated environment: printed commands start with "python".
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
        environment = {
            "ROS_DOMAIN_ID": str(self.domain),
            "NO_COLOR": "1",
            "RCUTILS_COLORIZED_OUTPUT": "0",
            "PATH": path,
        }
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
        kept = [line.rstrip() for line in text.splitlines() if not _MOMENT.search(line)]
        return "\n".join(kept).strip("\n") + "\n"

    # --- the person -----------------------------------------------------------------------------------------

    def agrees(self, program: RunningProgram) -> None:
        """Press Enter when asked to."""
        program.wait_for_output("Enter to go on", PATIENCE)
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
        program.wait_for_output("Press the motion stop NOW", PATIENCE)
        self.until(
            lambda status: status["link"]["position"] > 0.05 or program.returncode is not None, "the motor to turn"
        )
        self.truth.inject("m_stop")
        program.wait(PATIENCE)
        self.truth.clear_faults()

    def until(self, wanted: Callable[[dict[str, Any]], bool], what: str, timeout: float = PATIENCE) -> dict[str, Any]:
        """Wait until the emulated machine itself says so."""
        status: dict[str, Any] = {}

        def is_wanted() -> bool:
            status.update(self.truth.status())
            return wanted(status)

        wait_for(is_wanted, timeout, what)
        return status

    def close(self) -> None:
        """Let go of the machine."""
        self.truth.release()


def _free_ports() -> tuple[int, int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        first, second = (int(each.getsockname()[1]) for each in sockets)
    return first, second
