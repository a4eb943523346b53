"""All nodes and two recorders for half an hour: nothing lost, no memory and no file descriptor more than at first.

``python -m tests.tools.faults.soak --minutes 30`` prints what it watched and ends with code 1 if
something did not hold.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
import typer
from rich.console import Console

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.orchestrator_node import Orchestrator, PlantClient, RecorderClient
from pendulum_bags.experiments.processes import Child, ProcessSet, ros_environment, start_recorder
from pendulum_bags.experiments.session import (
    RECORDER_PRIORITY,
    permitted,
)
from pendulum_bags.runs.run_folder import write_json
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.programs import graph
from pendulum_msgs_py.programs.executables import cli_main
from pendulum_msgs_py.programs.graph import NodeProgram
from pendulum_msgs_py.programs.terminal import WholeTable, make_console
from pendulum_rosbag.reader import Bag, read_bag
from tests.tools.faults.bag_property import check_bag
from tests.tools.faults.live import start_with_priority

__all__ = ["MAX_GROWTH", "SoakReport", "TopicTally", "soak"]

MAX_GROWTH = 0.01
"""Largest growth of the resident memory of a process after its warm-up."""
WARM_UP_SHARE = 0.1
"""Share of the time, and at most `LONGEST_WARM_UP`, that caches and pools may take to fill."""
LONGEST_WARM_UP = 180.0
"""[s]"""
_SAMPLE_PERIOD = 2.0
_RATE_HZ = 500.0
_PERIOD_NS = round(1e9 / _RATE_HZ)
_START_TIMEOUT = 60.0
_EFFORT_LIMIT = 13.0

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@dataclass
class Footprint:
    """Memory and file descriptors of one process over time.

    Attributes:
        times: Since the start [s].
        resident: Resident memory [bytes].
        descriptors: Open file descriptors.
    """

    times: list[float] = field(default_factory=list)
    resident: list[int] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)

    def after(self, warm_up: float) -> tuple[float, float, int, int]:
        """Return memory just after the warm-up and at the end [bytes], and descriptors likewise.

        Each is the median over a tenth of what follows the warm-up, so that one sample decides nothing.
        """
        kept = [index for index, moment in enumerate(self.times) if moment >= warm_up]
        tenth = max(len(kept) // 10, 1)
        first, last = kept[:tenth], kept[-tenth:]

        def middle(values: Sequence[int], chosen: Sequence[int]) -> float:
            return float(np.median([values[index] for index in chosen]))

        return (
            middle(self.resident, first),
            middle(self.resident, last),
            round(middle(self.descriptors, first)),
            round(middle(self.descriptors, last)),
        )


@dataclass(frozen=True)
class TopicTally:
    """Messages of one topic: what its publisher says it sent, and what is in the bag."""

    topic: str
    sent: int
    received: int


@dataclass
class SoakReport:
    """What a soak showed.

    Attributes:
        minutes: How long it took [min].
        tallies: Sent and received, by topic.
        footprints: Memory and descriptors after warm-up and at the end, by process.
        jitter_us: Percentiles 50 and 99 of the plant's own loop in its first and its last minute [us].
        lateness_us: Percentiles 50, 99 and 99.9 of the delay from a state's deadline to its arrival, likewise [us].
        overruns: Periods of the simulator's loop that came a whole period late.
        load: Load of the machine by core, every two seconds; above 1, processes wait for each other.
        resident: Resident memory of each process over time [bytes], likewise.
        recorders: What each recorder said at its end.
        violations: One sentence for each thing that did not hold.
    """

    minutes: float
    tallies: list[TopicTally] = field(default_factory=list)
    footprints: dict[str, tuple[float, float, int, int]] = field(default_factory=dict)
    jitter_us: list[list[float]] = field(default_factory=list)
    lateness_us: list[list[float]] = field(default_factory=list)
    overruns: int = 0
    load: list[float] = field(default_factory=list)
    resident: dict[str, list[int]] = field(default_factory=dict)
    recorders: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)


def soak(folder: Path, domain: int, minutes: float) -> SoakReport:
    """Run everything for a while and compare the end with the beginning.

    Args:
        folder: For logs and bags.
        domain: ROS domain.
        minutes: How long [min].

    Raises:
        FaultError: Something did not start, or died.
    """
    duration = minutes * 60.0
    report = SoakReport(minutes)
    footprints: dict[str, Footprint] = {}
    logs = folder / "logs"
    with (
        ProcessSet(logs, ros_environment(domain, logs)) as processes,
        Orchestrator(domain, watch=processes.check) as orchestrator,
    ):
        recorders = _start(processes, orchestrator, folder)
        watched = {child.name: psutil.Process(child.process.pid) for child in processes.children}
        began = time.monotonic()
        while (elapsed := time.monotonic() - began) < duration:
            for name, process in watched.items():
                footprint = footprints.setdefault(name, Footprint())
                footprint.times.append(elapsed)
                footprint.resident.append(process.memory_info().rss)
                footprint.descriptors.append(process.num_fds())
            report.load.append(os.getloadavg()[0] / (os.cpu_count() or 1))
            orchestrator.spin(min(_SAMPLE_PERIOD, max(duration - elapsed, 0.0)))
        # Those who answer first, then the plants, then the recorders: every last word is heard.
        for child in reversed(processes.children.copy()):
            if child not in recorders:
                processes.finish(child)
        for child in recorders:
            code = processes.finish(child, 30.0)
            report.recorders.append(child.last_words(1))
            if code:
                report.violations.append(f"{child.name} ended with code {code}: {child.last_words(1)}")
    _judge_footprints(report, footprints, min(WARM_UP_SHARE * duration, LONGEST_WARM_UP))
    _judge_bags(report, folder, duration)
    return report


def _start(processes: ProcessSet, orchestrator: Orchestrator, folder: Path) -> list[Child]:
    recorders = []
    for namespace in ("/sim", "/hw"):
        metadata = folder / f"metadata_{namespace[1:]}.json"
        write_json(metadata, {"pendulum.run": {"experiment": "soak"}})
        bag, priority = folder / f"bag_{namespace[1:]}", permitted(RECORDER_PRIORITY)
        recorders.append(start_recorder(processes, bag, namespace, metadata, "mcap", priority=priority))
    for program in _programs():
        start_with_priority(processes, program)
    plant = PlantClient(orchestrator, "/sim", "simulator", watch=False)
    bridge = PlantClient(orchestrator, "/hw", "bridge")
    for namespace in ("/sim", "/hw"):
        wanted = [*(f"{namespace}/{name}" for name in names.SIGNALS), names.DIAGNOSTICS]
        RecorderClient(orchestrator, namespace).wait_until_heard(wanted, _START_TIMEOUT)
    orchestrator.wait_for(
        "the plant to be heard",
        lambda: orchestrator.node.count_subscribers(f"/sim/{names.JOINT_STATES}") >= _SIM_LISTENERS,
        _START_TIMEOUT,
    )
    orchestrator.spin(1.0)
    plant.resume(_START_TIMEOUT)
    bridge.wait_until_ready(_START_TIMEOUT)
    bridge.arm()
    return recorders


_SIM_LISTENERS = 4
"""Recorder, controller, disturbance, viewer."""


def _programs() -> list[NodeProgram]:
    # Paused, so that the recorder hears everything from the first state on.
    sim = graph.simulator("/sim", initial_theta=math.pi, paused=True, rate_hz=_RATE_HZ)
    noise: dict[str, graph.ParameterArgument] = {"autostart": True, "hold_time": 0.01}
    return [
        sim,
        graph.bridge("/hw", backend="emulator", feedback_watchdog=25, command_lifetime=0.25),
        graph.controller("/sim"),
        # The emulated pendulum hangs; a regulator of the bottom keeps it there under the noise.
        graph.controller("/hw", controller="pid", set_point=-math.pi),
        graph.disturbance("/sim", **noise),
        graph.disturbance("/hw", amplitude=0.3, **noise),
        NodeProgram("pendulum_sim", "viewer", "/sim", parameters={"window": False, "fps": 5.0}),
        NodeProgram("pendulum_sim", "markers", "/sim", parameters={"rate": 5.0}),
    ]


def _judge_footprints(report: SoakReport, footprints: dict[str, Footprint], warm_up: float) -> None:
    report.resident = {name: footprint.resident for name, footprint in footprints.items()}
    for name, footprint in footprints.items():
        before, after, opened, still = report.footprints[name] = footprint.after(warm_up)
        growth = after / before - 1.0
        if growth > MAX_GROWTH:
            report.violations.append(
                f"{name} grew by {growth:.2%} ({before / 1e6:.1f} to {after / 1e6:.1f} MB); "
                f"expected at most {MAX_GROWTH:.0%}"
            )
        if still != opened:
            report.violations.append(f"{name} has {still} files open after {opened}; expected no change")


def _judge_bags(report: SoakReport, folder: Path, duration: float) -> None:
    for side in ("sim", "hw"):
        path = folder / f"bag_{side}"
        with read_bag(path) as bag:
            said = _last_diagnostics(bag)
            _tally(report, bag, f"/{side}", said)
            if side == "sim":
                _judge_timing(report, bag, duration)
                report.overruns = int(said["/sim/simulator: plant"]["overruns"])
        for record in check_bag(path, limit=_EFFORT_LIMIT, allowance=0.060):
            report.violations += [f"{side}: {violation}" for violation in record.violations]
    for tally in report.tallies:
        if tally.sent != tally.received:
            report.violations.append(f"{tally.topic}: {tally.sent} sent, {tally.received} in the bag")


def _tally(report: SoakReport, bag: Bag, namespace: str, said: dict[str, dict[str, str]]) -> None:
    """Compare what the publishers say they sent with what is in the bag."""
    received = {topic: info.count for topic, info in bag.topics.items()}
    plant = "simulator" if namespace == "/sim" else "bridge"
    for node, topic, key in (
        ("controller", names.EFFORT_COMMAND, "answered"),
        ("disturbance", names.DISTURBANCE, "answered"),
    ):
        # Each says a last zero torque on its way out, which answers no state.
        sent = int(said[f"{namespace}/{node}: {node}"][key]) + 1
        report.tallies.append(TopicTally(f"{namespace}/{topic}", sent, received[f"{namespace}/{topic}"]))
    if namespace == "/sim":
        cycles = int(said[f"{namespace}/{plant}: plant"]["cycles"])
        states = f"{namespace}/{names.JOINT_STATES}"
        report.tallies.append(TopicTally(states, cycles, received[states]))
        # A torque for every period that passed, also for those that were caught up with, and a last zero.
        stamps = bag.array(states)["stamp_ns"]
        applied = f"{namespace}/{names.APPLIED_EFFORT}"
        periods = round((int(stamps[-1]) - int(stamps[0])) / _PERIOD_NS)
        report.tallies.append(TopicTally(applied, periods + 2, received[applied]))


def _last_diagnostics(bag: Bag) -> dict[str, dict[str, str]]:
    newest: dict[str, dict[str, str]] = {}
    for stored in bag.messages(names.DIAGNOSTICS):
        for status in stored.message.status:
            newest[status.name] = {pair.key: pair.value for pair in status.values}
    return newest


def _judge_timing(report: SoakReport, bag: Bag, duration: float) -> None:
    states = bag.array(f"/sim/{names.JOINT_STATES}")
    times = states["log_time_ns"]
    late = (times - states["stamp_ns"]) / 1e3
    span = round(min(60.0, duration / 4.0) * 1e9)
    start = int(times[0]) + round(min(WARM_UP_SHARE * duration, LONGEST_WARM_UP) * 1e9)
    windows = ((start, start + span), (int(times[-1]) - span, int(times[-1])))
    percents = (50.0, 99.0, 99.9)
    figures = [
        [float(value) for value in np.percentile(late[(times >= low) & (times < high)], percents)]
        for low, high in windows
    ]
    report.lateness_us = figures
    own: list[tuple[int, float, float]] = []
    for stored in bag.messages(names.DIAGNOSTICS):
        for status in stored.message.status:
            if status.name == "/sim/simulator: plant":
                values = {pair.key: pair.value for pair in status.values}
                own.append((stored.log_time_ns, float(values["jitter_p50_us"]), float(values["jitter_p99_us"])))
    table = np.array(own, dtype=float)
    jitter = [
        [float(np.median(table[(table[:, 0] >= low) & (table[:, 0] < high), column])) for column in (1, 2)]
        for low, high in windows
    ]
    report.jitter_us = jitter


def print_report(report: SoakReport, console: Console) -> None:
    """Print the tables of a soak."""
    sent = WholeTable("topic", "sent", "in the bag", title=f"{report.minutes:g} min: messages")
    for tally in report.tallies:
        sent.add_row(tally.topic, str(tally.sent), str(tally.received))
    console.print(sent)
    memory = WholeTable("process", "memory after warm-up", "at the end", "growth", "files open", "at the end")
    for name, (before, after, opened, still) in report.footprints.items():
        memory.add_row(
            name,
            f"{before / 1e6:.2f} MB",
            f"{after / 1e6:.2f} MB",
            f"{after / before - 1.0:+.2%}",
            str(opened),
            str(still),
        )
    console.print(memory)
    timing = WholeTable("simulator's loop", "first minute", "last minute")
    for name, column in (("jitter p50", 0), ("jitter p99", 1)):
        timing.add_row(name, *(f"{minute[column]:.0f} us" for minute in report.jitter_us))
    for name, column in (("state arrives p50", 0), ("state arrives p99", 1), ("state arrives p99.9", 2)):
        timing.add_row(name, *(f"{minute[column]:.0f} us" for minute in report.lateness_us))
    timing.add_row("overruns in all", "", str(report.overruns))
    tenth = max(len(report.load) // 10, 1)
    timing.add_row("load by core", f"{np.mean(report.load[:tenth]):.1f}", f"{np.mean(report.load[-tenth:]):.1f}")
    console.print(timing)
    for sentence in (*report.recorders, *report.violations):
        console.print(sentence, soft_wrap=True)


@app.command(epilog="Example: python -m tests.tools.faults.soak --minutes 30")
def run_soak(
    minutes: Annotated[float, typer.Option(help="How long [min].", min=0.2)] = 30.0,
    out: Annotated[Path, typer.Option(help="Where the figures are written.")] = Path("build", "soak.json"),
    json_output: Annotated[bool, typer.Option("--json", help="Print the figures as JSON instead of tables.")] = False,
) -> int:
    """Run all nodes and two recorders for a while, and compare the end with the beginning."""
    with reserve_domain() as domain, tempfile.TemporaryDirectory(prefix="pendulum_soak_") as folder:
        report = soak(Path(folder), domain, minutes)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, as_json(report))
    if json_output:
        print(json.dumps(as_json(report), indent=2))
    else:
        print_report(report, make_console())
    return 1 if report.violations else 0


def as_json(report: SoakReport) -> dict[str, Any]:
    """Return the report as what JSON can hold."""
    return {
        **vars(report),
        "tallies": [vars(tally) for tally in report.tallies],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    return cli_main(app, argv, name="python -m tests.tools.faults.soak")


if __name__ == "__main__":
    raise SystemExit(main())
