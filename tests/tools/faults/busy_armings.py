"""What a busy machine does to an armed bridge of two emulated modules: ``python -m tests.tools.faults.busy_armings``.

Arms again and again beside busy loops, and counts why the plant did not stay armed.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import SetBool

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.processes import ProcessSet, ros_environment
from pendulum_bags.experiments.session import PLANT_PRIORITY, in_real_time
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.middleware import set_middleware_defaults
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.udp_address import free_udp_address
from tests.tools.faults.press_times import busy_loops

__all__ = ["arm_busy_modules"]

_NAMESPACE = "/hw"
_STARTING = 120.0

app = typer.Typer(add_completion=False, rich_markup_mode=None)


class _Desk(GraphPeer):
    """Arms, and hears in which mode the plant is."""

    patience = _STARTING

    def __init__(self, domain: int) -> None:
        super().__init__("desk", namespace=_NAMESPACE, domain=domain)
        self.mode = self.reason = ""
        self.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, self._on_diagnostics, qos.DIAGNOSTICS)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if "mode" in values:
                self.mode, self.reason = values["mode"], values["reason"]

    def arm(self, *, on: bool) -> str:
        """Arm or disarm; return why not, or an empty string."""
        answer = self.call(SetBool, names.ARM.replace("~", f"{_NAMESPACE}/bridge"), SetBool.Request(data=on))
        self.mode = ""
        self.until(lambda: self.mode, "diagnostics")
        return "" if answer.success else str(answer.message)

    def stays_armed(self, duration: float) -> str:
        """Watch an armed plant; return why it is armed no longer after a while [s], or an empty string."""
        deadline = time.monotonic() + duration
        while time.monotonic() < deadline and self.mode.startswith("armed"):
            self.spin_once()
        return "" if self.mode.startswith("armed") else f"{self.mode}: {self.reason}"


@contextlib.contextmanager
def _two_modules(folder: Path, domain: int, *, in_time: bool) -> Iterator[_Desk]:
    """Start two emulated modules as one plant, and what commands it."""
    with ProcessSet(folder, ros_environment(domain, folder)) as processes:
        addresses = [free_udp_address(), free_udp_address()]
        for name, address in zip(("first", "second"), addresses, strict=True):
            command = [sys.executable, "-m", "pendulum_hw_bridge", "emulator", "--address", address]
            processes.start(name, [*command, "--plant", "x5_9", "--family", "Lab", "--name", name, "--serial", name])
        program = graph.bridge(
            _NAMESPACE,
            plant="double_pendulum",
            backend="hebi",
            interface=f"emulator:{','.join(addresses)}",
            families=["Lab"],
            names=["first", "second"],
        )
        processes.start_node(in_real_time(program, PLANT_PRIORITY) if in_time else program)
        processes.start("answers", [sys.executable, "-m", "tests.tools.faults.flood", _NAMESPACE, "bridge", "answers"])
        with contextlib.closing(_Desk(domain)) as desk:
            yield desk


def arm_busy_modules(folder: Path, armings: int, *, busy: int, duration: float, in_time: bool) -> Counter[str]:
    """Return how often two modules stayed armed (under an empty text), or why not.

    Args:
        folder: For logs.
        armings: How often to arm.
        busy: Busy loops beside it.
        duration: How long to stay armed [s].
        in_time: Give the bridge real-time priority as an experiment does, where it may be had.
    """
    ends: Counter[str] = Counter()
    with reserve_domain() as domain, _two_modules(folder, domain, in_time=in_time) as desk:
        desk.until(lambda: not desk.arm(on=True), "the first arming")
        with busy_loops(busy):
            while ends.total() < armings:
                desk.arm(on=False)
                # A fault that is present refuses to arm, and is none of an armed plant.
                desk.until(lambda: not desk.arm(on=True), "a plant that is armed")
                ends[desk.stays_armed(duration)] += 1
    return ends


@app.command(epilog="Example: python -m tests.tools.faults.busy_armings --armings 6")
def busy_armings(
    armings: Annotated[int, typer.Option(help="How often to arm.", min=1)] = 24,
    busy: Annotated[int, typer.Option(help="Busy loops.", min=0)] = 2,
    duration: Annotated[float, typer.Option(help="How long to stay armed [s].")] = 5.0,
    in_time: Annotated[bool, typer.Option(help="Real-time priority for the bridge.")] = False,
    out: Annotated[Path, typer.Option(help="Where the counts go.")] = Path("build", "busy_armings.json"),
) -> int:
    """Arm two emulated modules beside busy loops, and count why they did not stay armed."""
    set_middleware_defaults()
    with tempfile.TemporaryDirectory(prefix="pendulum_armings_") as folder:
        ends = arm_busy_modules(Path(folder), armings, busy=busy, duration=duration, in_time=in_time)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, dict(ends))
    table = WholeTable("armed no longer after a while, since", "of", title=f"load {os.getloadavg()[0]:.1f}")
    kinds: Counter[str] = Counter()
    for end, count in ends.items():
        kinds[end.split(": ")[1] if end else "stayed armed"] += count
    for kind, count in kinds.most_common():
        table.add_row(kind, f"{count}/{armings}")
    make_console().print(table)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.busy_armings")


if __name__ == "__main__":
    raise SystemExit(main())
