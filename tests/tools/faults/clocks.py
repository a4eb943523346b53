"""Clocks that jump, stop and disagree, and a day of simulated time: the loop must keep its own."""

from __future__ import annotations

import json
import math
import os
import random
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from rclpy.context import Context
from rosgraph_msgs.msg import Clock

from pendulum_bags.experiments.domain import reserve_domain
from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.lockstep import record_run
from pendulum_bags.experiments.run_spec import RunSpec
from pendulum_lqr.controller_interface.controller import make_controller
from pendulum_lqr.disturbances.disturbance import DISTURBANCE_SPECS, make_disturbance
from pendulum_lqr.disturbances.disturbing import DisturbanceLoop
from pendulum_lqr.nodes.answering import ControlLoop
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.contract.angles import UPRIGHT, from_upright
from pendulum_msgs_py.contract.plant_specs import LIMIT_SPECS, LOCKSTEP_EPOCH_NS, limits_from_parameters
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, Input, PlantSupervisor
from pendulum_msgs_py.contract.values import NANOSECONDS, JointCommand, JointSample, Vector
from pendulum_msgs_py.errors import FaultError
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_to_message
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_msgs_py.ros.plant_loop import LockstepLoop
from pendulum_msgs_py.ros.polled import PollingNode
from pendulum_rosbag.reader import read_bag
from pendulum_sim.stepping.plants import make_pendulum
from tests.tools.faults.live import NAMESPACE, LiveSystem
from tests.tools.faults.outcome import Outcome, Trial

__all__ = ["CLOCK_TRIALS", "jump_wall_clock", "simulate_hours", "stop_simulated_clock"]

_PERIOD_NS = 2_000_000
_HOUR = 3600
_JUMPS = (_HOUR, 0, -_HOUR, 0, 1, -1, 365 * 24 * _HOUR, 0)
"""How far from the true time the system clock stands, one after the other [s]."""
_PATIENCE = 20.0
_SHIM = Path(__file__).with_name("jumping_clock.c")
_DIAGNOSED = ("simulator: plant", "controller: controller", "disturbance: disturbance")


# --- the wall clock --------------------------------------------------------------------------------------------


def why_no_jumping_clock() -> str:
    """Return why no clock can jump here, empty where one can."""
    return "" if shutil.which("cc") else "making a system clock that jumps needs a C compiler"


def _make_clock(folder: Path) -> dict[str, str]:
    """Return the environment of processes whose system clock jumps."""
    library = folder / "jumping_clock.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, _SHIM, "-ldl"], check=True)
    (folder / "offset").write_bytes(struct.pack("<q", 0))
    return {"LD_PRELOAD": str(library), "PENDULUM_CLOCK_OFFSET": str(folder / "offset")}


def _jump(folder: Path, seconds: int) -> None:
    with (folder / "offset").open("r+b", buffering=0) as file:
        file.write(struct.pack("<q", seconds))


def jump_wall_clock(folder: Path) -> Outcome:
    """Set the system clock of all nodes forward and back while they run; the one that looks on has the same clock.

    Args:
        folder: For the clock, logs and the bag.
    """
    done = subprocess.run(
        [sys.executable, "-m", "tests.tools.faults.clocks", str(folder)],
        env={**os.environ, **_make_clock(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    try:
        return Outcome(**json.loads(done.stdout.splitlines()[-1]))
    except (IndexError, ValueError):
        return Outcome(survived=False, detail=f"ended with code {done.returncode}: {done.stderr[-500:]}")


def _jump_and_watch(folder: Path) -> Outcome:
    outcome = Outcome()
    with reserve_domain() as domain, LiveSystem(folder, domain) as system:
        for offset in _JUMPS:
            heard = len(system.applied)
            before = time.time() - time.monotonic()
            _jump(folder, offset)
            jumped = time.time() - time.monotonic() - before
            outcome.demand(abs(jumped) > 0.5, f"the clock jumped by {jumped:.1f} s only")
            system.listen(0.5)
            _demand_steady(outcome, system, heard, f"clock {offset:+d} s")
        child = system.children["recorder"]
        words = system.finish_all()
        outcome.demand(not words, "; ".join(words))
        outcome.demand("nothing lost" in child.last_words(1), child.last_words(1))
        with read_bag(system.bag) as bag:
            states = bag.array(f"{NAMESPACE}/{names.JOINT_STATES}")
        apart = np.diff(np.sort(states["stamp_ns"]))
        outcome.demand(int(apart.max()) < NANOSECONDS, f"states in the bag are {apart.max() * 1e-9:.1f} s apart")
        outcome.demand(int(apart.min()) > 0, "a state is twice in the bag")
    return outcome


def _demand_steady(outcome: Outcome, system: LiveSystem, heard: int, what: str) -> None:
    """Demand that torque flows, that stamps go on period by period, and that every node still says how it is."""
    since = time.monotonic()

    def all_is_well() -> bool:
        told = (system.diagnosed.get(f"{NAMESPACE}/{name}", 0.0) for name in _DIAGNOSED)
        return system.torque_flows() and all(when > since for when in told)

    try:
        system.wait_for("torque and diagnostics of every node", all_is_well, _PATIENCE)
    except FaultError as error:
        outcome.demand(False, f"{what}: {error}")
    stamps = np.array([applied.stamp_ns for applied in system.applied[heard:]], dtype=np.int64)
    # A plant that catches up says several torques from one state on, and goes on from a later one.
    steps = np.diff(stamps)
    regular = bool(np.all(steps >= 0)) and bool(np.all(steps % _PERIOD_NS == 0)) and int(steps.max(initial=0)) < 10**9
    outcome.demand(regular, f"{what}: stamps do not go on by periods")


# --- /clock ----------------------------------------------------------------------------------------------------


def stop_simulated_clock(folder: Path, believers: tuple[str, ...]) -> Outcome:
    """Let some nodes believe a ``/clock`` that is missing, runs, stops, jumps forward and jumps back.

    Args:
        folder: For logs and the bag.
        believers: Nodes with ``use_sim_time``; the others keep wall time.
    """
    outcome = Outcome()
    parameters = {name: {"use_sim_time": True} for name in believers}
    with reserve_domain() as domain, LiveSystem(folder, domain, parameters=parameters) as system:
        publisher = system.orchestrator.node.create_publisher(Clock, names.CLOCK, qos.CLOCK)
        told = 100 * NANOSECONDS

        def run(seconds: float) -> None:
            nonlocal told
            deadline = time.monotonic() + seconds
            while time.monotonic() < deadline:
                told += NANOSECONDS // 100
                publisher.publish(Clock(clock=stamp_to_message(told)))
                system.listen(0.01)

        for what, leap, seconds in (
            ("no /clock", 0, 0.0),
            ("/clock runs", 0, 1.0),
            ("/clock stops", 0, 0.0),
            ("/clock jumps forward", _HOUR, 1.0),
            ("/clock jumps back", -_HOUR, 1.0),
            ("/clock at its beginning", -99, 0.2),
        ):
            heard = len(system.applied)
            told += leap * NANOSECONDS
            run(seconds)
            _demand_steady(outcome, system, heard, what)
        outcome.demand(len(system.alive()) == 4, f"only {', '.join(system.alive())} still run")
    return outcome


# --- a day -----------------------------------------------------------------------------------------------------


def simulate_hours(hours: float, rate_hz: float = 50.0) -> Outcome:
    """Let the loop, rules and plant of the simulator's node run in lockstep with controller and disturbance, for hours.

    Everything but the transport is what the nodes consist of; the answers are handed over instead of sent.

    Args:
        hours: Simulated time [h].
        rate_hz: Steps a second [Hz].
    """
    period_ns = round(NANOSECONDS / rate_hz)
    steps = round(hours * _HOUR * rate_hz)
    context = Context()
    rclpy.init(context=context)
    node = PollingNode("day", context=context, namespace="/day", start_parameter_services=False)
    try:
        parameters = load_plant("thesis")
        supervisor = SharedSupervisor(
            limits_from_parameters(dict(validate(LIMIT_SPECS, {})), (parameters.effort_limit,), lockstep=True)
        )
        plant = make_pendulum(parameters, period_ns / NANOSECONDS)
        plant.reset(UPRIGHT, 0.0)
        positions = np.empty(steps)

        def step(drive: Drive, stamp_ns: int) -> tuple[JointSample, Vector]:
            state = plant.step(drive.effort[0], drive.push[0])
            return JointSample.of_one(stamp_ns, state.theta, state.theta_dot, state.effort), drive.effort

        interface = PlantInterface(node, supervisor, lambda: loop.now_ns)
        loop = LockstepLoop(interface, step, period_ns, [Input.EFFORT_COMMAND, Input.DISTURBANCE], publish_clock=False)
        interface.publish_state(JointSample.of_one(LOCKSTEP_EPOCH_NS, UPRIGHT, 0.0, 0.0))
        supervisor.arm(LOCKSTEP_EPOCH_NS, interface.sample)
        controller = ControlLoop(
            make_controller("lqr", parameters, period_ns / NANOSECONDS, {}), math.inf, simulated_time=True
        )
        disturbance = DisturbanceLoop(make_disturbance(dict(validate(DISTURBANCE_SPECS, {"hold_time": 0.02}))))
        disturbance.start()
        for index in range(steps):
            sample = interface.sample
            assert sample is not None
            answer, noise = controller.answer(sample, loop.now_ns), disturbance.answer(sample.stamp_ns)
            assert answer is not None
            assert noise is not None
            for kind, effort, source in (
                (Input.EFFORT_COMMAND, answer[0], "controller"),
                (Input.DISTURBANCE, noise.torque, "disturbance"),
            ):
                supervisor.offer(kind, JointCommand.of_one(sample.stamp_ns, effort, source), loop.now_ns)
            loop.advance()
            measured = interface.sample
            assert measured is not None
            positions[index] = measured.position[0]
        interface.close()
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
    return _judge_day(loop, supervisor, controller, disturbance, positions, period_ns)


def _judge_day(
    loop: LockstepLoop,
    supervisor: PlantSupervisor,
    controller: ControlLoop,
    disturbance: DisturbanceLoop,
    positions: np.ndarray,
    period_ns: int,
) -> Outcome:
    outcome = Outcome()
    steps = len(positions)
    expected = LOCKSTEP_EPOCH_NS + steps * period_ns
    outcome.demand(loop.now_ns == expected, f"the clock shows {loop.now_ns} ns; expected {expected} ns")
    answered = (controller.answered, disturbance.answered)
    outcome.demand(answered == (steps, steps), f"{answered} answers to {steps} states")
    refused = sum(sum(gate.refused.values()) for gate in supervisor.gates.values())
    outcome.demand(refused == 0, f"{refused} commands were refused")
    outcome.demand(supervisor.starved_periods == 0, f"{supervisor.starved_periods} periods without a command")
    hours = round(steps * period_ns / NANOSECONDS / _HOUR)
    if hours < 2:  # what follows compares the first hour with the last
        return outcome
    deviations = np.array([from_upright(float(position)) for position in positions])
    pieces = np.array_split(deviations, hours)
    first, last = pieces[0], pieces[-1]
    growth = float(np.std(last) / np.std(first)) - 1.0
    # Two stretches of one stationary signal differ by chance alone.
    outcome.demand(abs(growth) < 0.1, f"the deviation changed by {growth:.1%} from the first hour to the last")
    outcome.detail = outcome.detail or f"{steps} steps, clock exact to the ns, deviation {growth:+.2%}"
    return outcome


def compare_with_one_process(folder: Path, duration: float) -> Outcome:
    """Run simulator, controller and disturbance in lockstep over DDS, and in one process; compare every number.

    Args:
        folder: For the bag.
        duration: Simulated time [s].
    """
    spec = RunSpec(
        controller_parameters={"q": [100.0, 0.01], "r": 0.1},
        disturbance={"amplitude": 2.5, "hold_time": 0.002, "duration": duration},
        duration=duration,
        seed=24,
    )
    record_run(folder / "bag", spec)
    arrays = simulate(spec)
    outcome = Outcome(detail=f"{spec.steps} steps")
    with read_bag(folder / "bag") as bag:
        states = bag.array(f"/sim/{names.JOINT_STATES}")
        applied = bag.array(f"/sim/{names.APPLIED_EFFORT}")
    expected = LOCKSTEP_EPOCH_NS + _PERIOD_NS * np.arange(spec.steps + 1, dtype=np.int64)
    outcome.demand(np.array_equal(states["stamp_ns"], expected), "stamps are not the exact number of nanoseconds")
    outcome.demand(np.array_equal(states["position"], arrays.position), "angles differ from those of one process")
    outcome.demand(np.array_equal(applied["effort"], arrays.applied), "torques differ from those of one process")
    return outcome


def _some_believers(folder: Path, generator: random.Random) -> Outcome:
    nodes = ("simulator", "controller", "disturbance")
    believers = tuple(name for name in nodes if generator.random() < 0.5) or (generator.choice(nodes),)
    outcome = stop_simulated_clock(folder, believers)
    outcome.detail = f"{', '.join(believers)} believed it{'; ' if outcome.detail else ''}{outcome.detail}"
    return outcome


CLOCK_TRIALS: tuple[Trial, ...] = (
    Trial("system clock jumps by hours and years", lambda folder, _: jump_wall_clock(folder), why_no_jumping_clock),
    Trial("/clock stops and jumps, use_sim_time on some nodes", _some_believers),
    Trial(
        "/clock stops and jumps, use_sim_time on all nodes",
        lambda folder, _: stop_simulated_clock(folder, ("simulator", "controller", "disturbance")),
    ),
    Trial("24 simulated hours in lockstep", lambda _, __: simulate_hours(24.0)),
    Trial("two simulated minutes over DDS in lockstep", lambda folder, _: compare_with_one_process(folder, 120.0)),
)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(vars(_jump_and_watch(Path(sys.argv[1])))) + "\n")
