"""Two of a kind where one is expected, and nodes that are restarted or started in any order."""

from __future__ import annotations

import itertools
import random
import signal
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from std_srvs.srv import SetBool

from pendulum_bags.experiments.processes import Child, start_recorder
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.errors import PendulumError
from pendulum_rosbag.reader import read_bag
from tests.tools.faults.bag_property import check_bag
from tests.tools.faults.live import EFFORT_LIMIT, NODES, START_TIMEOUT, LiveSystem, start_with_priority
from tests.tools.faults.outcome import MACHINE_PATIENCE, Fault, Outcome
from tests.tools.faults.plants import BRIDGE, SIMULATOR

__all__ = ["DOUBLES", "FIVE_NODES", "ORDERS", "start_in_order"]

_NOTICED = 1.0
"""Time within which a plant must have noticed two nodes behind one name [s]: it looks twice a second."""
FIVE_NODES = (*NODES, "viewer")
ORDERS: tuple[tuple[str, ...], ...] = tuple(itertools.permutations(FIVE_NODES))
"""All 120 orders in which five nodes can start."""
_UNUSUAL = [order for order in ORDERS if order.index("controller") < order.index("simulator")]
"""Those in which somebody commands before there is a plant: a system's own start is one of the others."""
_PERIOD_NS = 2_000_000


# --- two plants, two controllers -------------------------------------------------------------------------------


def _twin_plant(name: str) -> Fault:
    def act(system: LiveSystem, _: random.Random) -> Outcome:
        program = system.program("simulator")
        twin = start_with_priority(system.processes, replace(program, name=name))
        outcome = Outcome()
        # Each plant's stamps lie on a grid of its own, which tells the torques of the two apart.
        first = system.applied[-1].stamp_ns % _PERIOD_NS

        def of_second(since: float) -> list[float]:
            recent = itertools.takewhile(lambda applied: applied.when > since, reversed(system.applied))
            return [applied.effort for applied in recent if applied.stamp_ns % _PERIOD_NS != first]

        system.wait_for("the second plant", lambda: bool(of_second(time.monotonic() - 1.0)), START_TIMEOUT)
        seen = time.monotonic()

        def rests() -> bool:
            # Long enough for a plant that is new here to have heard commands, and to have found out whom they answer:
            # most of a second, for it may meet the controller half a second before it meets the other plant.
            efforts = of_second(time.monotonic() - 1.0)
            return len(efforts) > 400 and not any(efforts)

        system.wait_for("the second plant to rest", rests, START_TIMEOUT)
        settled = time.monotonic()
        outcome.detail = f"zero torque of the second {settled - seen:.1f} s after it was heard"
        system.listen(2.0)
        outcome.demand(not any(of_second(settled)), "the second plant applied torque that answers the first")
        outcome.demand(system.processes.finish(twin) == 0, "the second plant ended with an error")
        return outcome

    kind = "one name" if name == "simulator" else "two names"
    return Fault(
        f"two simulators under {kind}", act, short=(SIMULATOR,) if name == "simulator" else (), plants=(SIMULATOR,)
    )


def _twin_controller(system: LiveSystem, _: random.Random) -> Outcome:
    outcome = Outcome()
    topic = f"{system.plant.namespace}/{names.EFFORT_COMMAND}"

    def controllers() -> set[tuple[int, ...]]:
        infos = system.orchestrator.node.get_publishers_info_by_topic(topic)
        return {tuple(info.endpoint_gid) for info in infos if info.node_name == "controller"}

    # One that was killed shortly before is on the graph until its lease ends.
    before = controllers()
    twin = system.processes.start_node(system.program("controller", q=[1.0, 0.01]))

    def both_are_there() -> bool:
        return "controller" in system.alive() and bool(controllers() - before)

    system.wait_for("the twin to be on the graph", both_are_there, START_TIMEOUT)
    seen_ns = time.time_ns()
    system.listen(_NOTICED + 1.5)
    alive = twin.process.poll() is None
    until_ns = system.driven_until_ns(seen_ns)
    rest = (time.time_ns() - until_ns) * 1e-9
    outcome.demand(alive and both_are_there(), "the twin ended by itself")
    # From then on none at all: one command in between that acts is one that nobody can attribute.
    outcome.demand(
        (until_ns - seen_ns) * 1e-9 <= _NOTICED,
        f"torque {(until_ns - seen_ns) * 1e-9:.2f} s after both were on the graph; expected none after {_NOTICED:g} s",
    )
    outcome.detail = outcome.detail or f"zero torque {(until_ns - seen_ns) * 1e-9:.2f} s after both were there"
    outcome.demand(rest > 1.0, f"at rest for the last {rest:.1f} s only; expected more than 1 s")
    system.processes.finish(twin)
    return outcome


def _second_controller(system: LiveSystem, _: random.Random) -> Outcome:
    program = system.program("controller", q=[1.0, 0.01])
    second = system.processes.start_node(type(program)(**{**vars(program), "name": "usurper"}))
    refused = system.refused().get("second_commander", 0)
    # Seen by the plant's own words, which come twice a second: that it was heard, and refused.
    system.wait_for(
        "the plant to refuse the second controller",
        lambda: system.refused().get("second_commander", 0) > refused + 0.2 * system.plant.rate,
        START_TIMEOUT,
    )
    outcome = Outcome()
    # Behind a module a busy machine may end all torque meanwhile; that is nobody's gain.
    outcome.demand(
        system.torque_flows() or (system.plant.has_module and system.mode() == "fault"),
        f"the first controller lost the plant, which is {system.mode()}, to the second",
    )
    commander, first = system.commander(), f"{system.plant.namespace}/controller"
    outcome.demand(commander == first, f"{commander} commands; expected the first controller")
    system.processes.finish(second)
    return outcome


def _second_bridge(system: LiveSystem, _: random.Random) -> Outcome:
    """Let a second bridge take the same module, and be armed where it can be: nobody asks it for torque."""
    program = system.program("bridge")
    second = system.processes.start_node(type(program)(**{**vars(program), "namespace": "/other"}))
    client = system.orchestrator.node.create_client(SetBool, "/other/bridge/arm")
    system.wait_for("the second bridge", client.service_is_ready, START_TIMEOUT)
    answer = system.orchestrator.call(client, SetBool.Request(data=True), "the answer to arming", START_TIMEOUT)
    system.listen(1.0)
    outcome = Outcome()
    code = system.processes.finish(second)
    outcome.demand(code == 0, f"the second bridge ended with code {code}: {second.last_words(1)}")
    system.orchestrator.node.destroy_client(client)
    first = "goes on" if system.torque_flows() else f"{system.mode()}"
    outcome.detail = outcome.detail or f"second {'armed' if answer.success else 'refused'}, first {first}"
    return outcome


# --- two recorders ---------------------------------------------------------------------------------------------


def _second_recorder(system: LiveSystem, bag: Path) -> Child:
    return start_recorder(system.processes, bag, system.plant.namespace, system.folder / "metadata.json", "mcap")


def _stamps(system: LiveSystem, bag: Path) -> list[int]:
    topic = f"{system.plant.namespace}/{names.JOINT_STATES}"
    try:
        with read_bag(bag, [topic]) as opened:
            return [int(stamp) for stamp in opened.array(topic)["stamp_ns"]]
    except PendulumError:  # not yet there
        return []


def _two_recorders(system: LiveSystem, generator: random.Random) -> Outcome:
    bag = system.folder / f"second_{generator.randrange(10**9)}"
    second = _second_recorder(system, bag)
    system.wait_for("the second recorder", lambda: bool(_stamps(system, bag)), START_TIMEOUT)
    system.listen(1.0)
    code = system.processes.finish(second)
    outcome = Outcome()
    outcome.demand(code == 0, f"the second recorder ended with code {code}: {second.last_words(1)}")
    own = _stamps(system, bag)
    system.wait_for("the first bag to have it all", lambda: _stamps(system, system.bag)[-1] >= own[-1], 10.0)
    missing = set(own) - set(_stamps(system, system.bag))
    outcome.demand(not missing, f"{len(missing)} states of the second bag are not in the first")
    outcome.demand(len(set(own)) == len(own) > 100, f"{len(own)} states in the second bag, some twice")
    outcome.detail = outcome.detail or f"{len(own)} states in both"
    return outcome


def _two_recorders_in_one_folder(system: LiveSystem, _: random.Random) -> Outcome:
    system.wait_for("the bag to be there", (system.bag / "metadata.yaml").exists, START_TIMEOUT)
    second = _second_recorder(system, system.bag)
    system.wait_for("the second recorder to end", lambda: second.process.poll() is not None, START_TIMEOUT)
    system.processes.children.remove(second)
    outcome = Outcome()
    code, words = second.process.returncode, second.last_words(1)
    outcome.demand(code == 2 and "exists" in words, f"the second recorder ended with code {code}: {words}")
    before = len(_stamps(system, system.bag))
    system.wait_for("the first recorder to go on", lambda: len(_stamps(system, system.bag)) > before, 10.0)
    return outcome


# --- orders ----------------------------------------------------------------------------------------------------


def _restart_all(system: LiveSystem, generator: random.Random) -> Outcome:
    nodes = system.plant.nodes
    order = generator.sample(nodes, len(nodes))
    for name in order:
        system.kill(name, generator.choice((signal.SIGKILL, signal.SIGINT, signal.SIGTERM)))
        system.listen(generator.uniform(0.0, 0.3))
        system.start(name)
    began = time.monotonic()
    system.bring_back("torque to flow again")
    return Outcome(detail=f"torque {time.monotonic() - began:.1f} s after the last start ({', '.join(order)})")


def start_in_order(system: LiveSystem, order: tuple[str, ...], *, one_by_one: bool) -> Outcome:
    """End everything, start the nodes in this order, and see them come to a loop that is recorded.

    Args:
        system: Running, or with no node at all.
        order: Which nodes.
        one_by_one: Wait until each is on the graph before the next starts.
    """
    outcome = Outcome()
    for complaint in system.finish_all():
        outcome.demand(False, complaint)
    # What the ones before said last may come later still: it is told by its stamp.
    ended_ns = time.time_ns()
    system.listen(0.1)
    controlled = float("inf")
    for name in order:
        if name == "controller":
            system.listen(0.05)
            controlled = time.monotonic()
        system.start(name)
        if one_by_one:
            system.wait_for(f"{name} to be on the graph", partial(system.is_on_graph, name), START_TIMEOUT)
    system.wait_for("torque to flow", system.torque_flows, START_TIMEOUT)
    early = [
        applied
        for applied in system.applied
        if applied.stamp_ns > ended_ns and applied.when < controlled and applied.effort != 0.0
    ]
    outcome.demand(not early, f"{len(early)} torques before there was a controller")
    # A recorder may meet the controller later than the plant does: before, it has only half of what is judged.
    system.wait_for("torque and commands to be recorded", partial(_has_torque_and_commands, system), START_TIMEOUT)
    # A viewer comes last, whoever starts last: it goes behind all others, and one that is ended before says so.
    for name in order:
        system.wait_for(f"{name} to be on the graph", partial(system.is_on_graph, name), START_TIMEOUT)
    died = set(order) - set(system.alive())
    outcome.demand(not died, f"{', '.join(sorted(died))} died")
    for record in check_bag(system.bag, limit=EFFORT_LIMIT, allowance=MACHINE_PATIENCE):
        outcome.demand(not record.violations, "; ".join(record.violations))
    if not outcome.survived:
        outcome.detail += f" ({', '.join(order)})"
    return outcome


def _has_torque_and_commands(system: LiveSystem) -> bool:
    torque, commands = (f"{system.plant.namespace}/{name}" for name in (names.APPLIED_EFFORT, names.EFFORT_COMMAND))
    try:
        with read_bag(system.bag, [torque, commands]) as opened:
            return bool(np.any(opened.array(torque)["effort"] != 0.0)) and len(opened.array(commands)) > 0
    except PendulumError:  # not yet there
        return False


class _EveryOrder:
    """One order after the other, mixed so that two neighbours have little in common."""

    def __init__(self) -> None:
        self._orders = itertools.cycle(random.Random(120).sample(ORDERS, len(ORDERS)))

    def __call__(self, system: LiveSystem, _: random.Random) -> Outcome:
        return start_in_order(system, next(self._orders), one_by_one=True)


def _random_orders(system: LiveSystem, generator: random.Random) -> Outcome:
    outcome = start_in_order(system, generator.choice(_UNUSUAL), one_by_one=False)
    system.processes.finish(system.children.pop("viewer"))
    return outcome


def _back_to_four(system: LiveSystem, _: random.Random) -> Outcome:
    viewer = system.children.pop("viewer", None)
    outcome = Outcome()
    if viewer is not None:
        outcome.demand(system.processes.finish(viewer) == 0, "the viewer ended with an error")
    return outcome


DOUBLES: tuple[Fault, ...] = (
    _twin_plant("simulator"),
    _twin_plant("impostor"),
    Fault("two controllers under one name", _twin_controller, short=(BRIDGE,), own_torque=True),
    Fault("two controllers under two names", _second_controller, short=(SIMULATOR,)),
    Fault("two bridges on one module", _second_bridge, plants=(BRIDGE,)),
    Fault("two recorders into two folders", _two_recorders, short=(SIMULATOR,), plants=(SIMULATOR,)),
    Fault("two recorders into one folder", _two_recorders_in_one_folder, plants=(SIMULATOR,)),
    Fault("every node killed and started again, in any order", _restart_all),
    Fault("five nodes started all at once, in any order", _random_orders, short=(SIMULATOR,), plants=(SIMULATOR,)),
    Fault("five nodes started one by one, in all 120 orders", _EveryOrder(), tries=len(ORDERS), plants=(SIMULATOR,)),
    Fault("viewer: SIGINT", _back_to_four, tries=1, plants=(SIMULATOR,)),
)
