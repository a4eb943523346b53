"""How long the motor drives on after the e-stop was pressed, while a plant is flooded on a machine that is busy.

``python -m tests.tools.faults.press_times --tries 200`` presses as often for each plant and flood, beside two busy
loops, and prints the distributions. Times are the motor's own: behind the bridge by the log of the emulated module.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment
from pendulum_bags.experiments.session import ANSWER_PRIORITY, LOOP_NICENESS, PLANT_PRIORITY, in_real_time, permitted
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.cdr import decode_joint_state
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.realtime import as_ordinary, run_in_real_time
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.middleware import set_middleware_defaults
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.udp_address import free_udp_address
from tests.tools.faults.motor import NO_TORQUE, Drive, ModuleTruth
from tests.tools.faults.plants import PLANTS, Plant

__all__ = ["FLOODS", "PressTimes", "busy_loops", "press_in_flood"]

FLOODS = ("arming", "efforts")
_DRIVEN_NS = 50_000_000
"""Time before a press in which the motor must have been driven for the press to count [ns]."""
_WATCHED = 0.3
"""Time after a press in which a motor that is driven is seen [s]."""
_ANSWER = 5.0
"""Longest wait for an answer [s]."""
_LOOK_AGAIN = 0.1
_LOOKS = 5
"""Looks at a motor after which the plant is armed [-]."""
_PATIENCE = 120.0
_MS = 1e-6

app = typer.Typer(add_completion=False, rich_markup_mode=None)


@dataclass(frozen=True)
class PressTimes:
    """What the presses on one plant under one flood gave.

    Attributes:
        plant: Its name.
        flood: What it was flooded with.
        driven: For how long the motor was driven after each press [ms].
        answered: How long each answer took [ms].
    """

    plant: str
    flood: str
    driven: list[float]
    answered: list[float]

    def cells(self) -> list[str]:
        """Return a row of the table."""
        figures = [*np.percentile(self.driven, (50, 95, 100)), *np.percentile(self.answered, (50, 95, 100))]
        return [self.plant, self.flood, str(len(self.driven)), *(f"{figure:.1f}" for figure in figures)]


class _Desk(GraphPeer):
    """Presses, resets, arms, and hears what a simulator applies."""

    patience = _PATIENCE

    def __init__(self, domain: int, plant: Plant, truth: ModuleTruth | None) -> None:
        super().__init__("desk", domain=domain, make_executor=EventsExecutor)
        self._plant, self._truth = plant, truth
        self._drives: list[Drive] = []
        self._clients = {
            name: self.node.create_client(kind, name.replace("~", f"{plant.namespace}/{plant.name}"))
            for name, kind in ((names.E_STOP, Trigger), (names.E_STOP_RESET, Trigger), (names.ARM, SetBool))
        }
        if truth is None:
            topic = f"{plant.namespace}/{names.APPLIED_EFFORT}"
            self.node.create_subscription(JointState, topic, self._on_applied, qos.STATE, raw=True)
        self.until(lambda: all(client.service_is_ready() for client in self._clients.values()), "the plant's services")

    def _on_applied(self, data: bytes) -> None:
        fields = decode_joint_state(data)
        if fields is not None and fields.effort:
            # What is applied from a state on acts until the next.
            self._drives.append(Drive(fields.stamp_ns + round(self._plant.period * 1e9), fields.effort[0]))

    def _ask(self, name: str, request: Any) -> bool:
        """Ask for something, and return whether it was done; in a flood a service loses requests."""
        future = self._clients[name].call_async(request)
        with contextlib.suppress(TimeoutError):
            self.until(future.done, f"the answer of {name}", _ANSWER)
        return bool(future.done() and future.result().success)

    def driven_until_ns(self) -> int:
        """Return when the motor was driven last [ns]."""
        self._drives += self._truth.read() if self._truth else []
        del self._drives[:-2000]
        return max((one.time_ns for one in self._drives if abs(one.torque) > NO_TORQUE), default=0)

    def drive(self, flooding: Child) -> None:
        """Wait until the motor is driven; a plant that is not armed is armed, while nothing floods it."""
        looks = 0

        def is_driven() -> bool:
            nonlocal looks
            self.spin(_LOOK_AGAIN)
            if time.time_ns() - self.driven_until_ns() < _DRIVEN_NS:
                return True
            looks += 1
            if looks % _LOOKS == 0:
                # A fault, of which a busy machine makes some, is acknowledged by disarming.
                flooding.process.send_signal(signal.SIGSTOP)
                self._ask(names.E_STOP_RESET, Trigger.Request())
                self._ask(names.ARM, SetBool.Request(data=False))
                self._ask(names.ARM, SetBool.Request(data=True))
                flooding.process.send_signal(signal.SIGCONT)
            return False

        self.until(is_driven, "a driven motor")

    def press(self) -> tuple[float, float] | None:
        """Press; return for how long the motor was driven on and how long the answer took [ms], None if it was not."""
        driven_ns = self.driven_until_ns()
        answered: list[float] = []
        self._clients[names.E_STOP].call_async(Trigger.Request()).add_done_callback(
            lambda _: answered.append(time.monotonic())
        )
        # Now it has been sent: what kept this process until then is none of the plant's.
        pressed_ns, pressed = time.time_ns(), time.monotonic()
        self.until(lambda: answered, "the answer of the e-stop")
        self.spin(_WATCHED)
        until_ns = self.driven_until_ns()
        self._ask(names.E_STOP_RESET, Trigger.Request())
        if pressed_ns - max(driven_ns, until_ns) > _DRIVEN_NS:
            return None
        return max(0, until_ns - pressed_ns) * _MS, (answered[0] - pressed) * 1e3


@contextlib.contextmanager
def busy_loops(loops: int) -> Iterator[None]:
    """Keep processors busy."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def press_in_flood(
    folder: Path, plant: Plant, flood: str, tries: int, *, busy: int, minutes: float = 60.0, in_time: bool = False
) -> PressTimes:
    """Press again and again while a plant is flooded.

    Args:
        folder: For logs and the motor's record.
        plant: The plant, whose motor is driven meanwhile.
        flood: One of :data:`FLOODS`.
        tries: Presses to count.
        busy: Busy loops beside it.
        minutes: Time after which there are no further tries [min].
        in_time: Give the plant real-time priority as an experiment does, where it may be had.
    """
    generator = random.Random(1)
    with (
        reserve_domain() as domain,
        ProcessSet(folder, ros_environment(domain, folder)) as processes,
        contextlib.ExitStack() as ends,
    ):
        truth, address = None, ""
        # A bridge that a busy machine keeps from running for 30 ms has stopped by itself, and is no case for an e-stop.
        changes = {"feedback_watchdog": 20} if plant.has_module else {"initial_theta": 0.0}
        flooding = [sys.executable, "-m", "tests.tools.faults.flood", plant.namespace, plant.name]
        with as_ordinary():
            if plant.has_module:
                address, path = free_udp_address(), folder / "truth.csv"
                command = [sys.executable, "-m", "pendulum_hw_bridge", "emulator", "--address", address]
                processes.start("emulator", [*command, "--truth", str(path)], niceness=LOOP_NICENESS)
                truth = ModuleTruth(path)
            program = plant.program(address, **changes)
            processes.start_node(in_real_time(program, PLANT_PRIORITY) if in_time else program)
            if flood != "efforts":
                processes.start("answers", [*flooding, "answers"])
            ends.enter_context(busy_loops(busy))
        desk = ends.enter_context(contextlib.closing(_Desk(domain, plant, truth)))
        with as_ordinary():
            child = processes.start(flood, [*flooding, flood])
        desk.until(lambda: "flooding" in child.last_words(), flood)
        pairs: list[tuple[float, float]] = []
        over = time.monotonic() + 60.0 * minutes
        while len(pairs) < tries and (not pairs or time.monotonic() < over):
            desk.drive(child)
            desk.spin(generator.uniform(0.0, 0.05))
            pair = desk.press()
            pairs += [] if pair is None else [pair]
    return PressTimes(plant.name, flood, *(list(each) for each in zip(*pairs, strict=True)))


@app.command(epilog="Example: python -m tests.tools.faults.press_times --tries 20 --only bridge")
def press_times(
    tries: Annotated[int, typer.Option(help="Presses for each plant and flood.", min=1)] = 200,
    busy: Annotated[int, typer.Option(help="Busy loops.", min=0)] = 2,
    only: Annotated[str, typer.Option(help="Plant or flood.")] = "",
    in_time: Annotated[bool, typer.Option(help="Real-time priority for plants.")] = False,
    minutes: Annotated[float, typer.Option(help="Longest time for each plant and flood [min].")] = 60.0,
    out: Annotated[Path, typer.Option(help="Where the times go.")] = Path("build", "press_times.json"),
) -> int:
    """Press the e-stop of both plants in floods and print how long the motor was driven on."""
    set_middleware_defaults()
    # Who presses is not what is measured.
    run_in_real_time(permitted(ANSWER_PRIORITY))
    table = WholeTable(
        "plant",
        "flood",
        "tries",
        *(f"{what} {at} [ms]" for what in ("driven", "answer") for at in ("p50", "p95", "max")),
    )
    results = []
    for plant in PLANTS:
        for flood in FLOODS:
            if only and only not in {plant.name, flood, f"{plant.name}/{flood}"}:
                continue
            with tempfile.TemporaryDirectory(prefix="pendulum_presses_") as folder:
                result = press_in_flood(Path(folder), plant, flood, tries, busy=busy, minutes=minutes, in_time=in_time)
            results.append(asdict(result))
            out.parent.mkdir(parents=True, exist_ok=True)
            write_json(out, results)
            table.add_row(*result.cells())
            print(f"load {os.getloadavg()[0]:.1f}: {' '.join(result.cells())}", flush=True)
    make_console().print(table)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.press_times")


if __name__ == "__main__":
    raise SystemExit(main())
