"""An acrobot on the graph: simulator, LQR, disturbance and recorder as processes, and commands that are not for it."""

from __future__ import annotations

import math
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from pendulum_bags.experiments.in_process import simulate
from pendulum_bags.experiments.joint_run import JointSettings, default_amplitude
from pendulum_bags.experiments.settings import NoiseSettings
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.contract import names
from pendulum_msgs_py.plants.plant_parameters import load_mechanism
from pendulum_msgs_py.ros import qos
from pendulum_rosbag.reader import read_bag
from pendulum_sim.exports.model_files import mjcf
from pendulum_testing.policies import lqr_policy
from pendulum_testing.refusals import Refused, not_refused
from tests.joints_peer import JointsPeer

JOINTS = ["shoulder", "elbow"]


@pytest.fixture
def peer(domain_id: int) -> Iterator[JointsPeer]:
    # All states: a test that a busy machine keeps waiting would miss the first ones, and could miss the last.
    with closing(JointsPeer(qos.STATE)) as peer:
        yield peer


def _start(processes, package: str, program: str, *parameters: str):
    arguments = [item for parameter in parameters for item in ("-p", parameter)]
    return processes.start(package, program, "--ros-args", "-r", "__ns:=/sim", *arguments)


def _start_lockstep(processes, plant: str, duration: float, *parameters: str):
    """Start a simulator whose states the controller answers and this test hears, for so long in its own time [s]."""
    lockstep = ("clock:=lockstep", f"lockstep_duration:={duration}", "lockstep_subscribers:=2")
    return _start(processes, "pendulum_sim", "simulator", f"plant:={plant}", *lockstep, *parameters)


def _unheard(counts: dict[str, dict[str, int]], topic: str) -> int:
    """Return how many messages a recorder counts as published before its subscription was there, or was complete."""
    return sum(counts.get(topic, {}).get(key, 0) for key in ("before", "early"))


def test_an_acrobot_is_held_upright_under_noise_in_lockstep_and_its_bag_is_read_back(
    peer: JointsPeer, processes, tmp_path: Path
) -> None:
    recorder = processes.start("pendulum_rosbag", "record", "-o", str(tmp_path / "bag"), "--regex", "^/sim/")
    recorder.wait_for_output("ready", 60)
    controller = _start(processes, "pendulum_lqr", "controller", "plant:=acrobot_frictionless", "use_sim_time:=true")
    noise = _start(
        processes,
        "pendulum_lqr",
        "disturbance",
        "joints:=[elbow]",
        "amplitude:=0.2",
        "autostart:=true",
        "use_sim_time:=true",
    )
    plant = _start(
        processes,
        "pendulum_sim",
        "simulator",
        "plant:=acrobot_frictionless",
        "clock:=lockstep",
        "lockstep_inputs:=[effort_command, disturbance]",
        "lockstep_duration:=2.0",
        "lockstep_subscribers:=4",
        "initial_position:=[3.19, -0.05]",
        "start_effort_limit:=0.0",
    )
    peer.until(lambda: any(event["name"] == names.Event.LOCKSTEP_FINISHED for event in peer.events), "the end", 90.0)
    controller.wait_for_output(r"lqr for plant acrobot_frictionless: K = \[.*limit 6 N m", 10)
    for program in (noise, controller, plant, recorder):
        program.send_signal(signal.SIGINT)
        assert program.wait(20.0) == 0
    with read_bag(tmp_path / "bag") as bag:
        states = bag.joints("/sim/joint_states")
        commands = bag.joints("/sim/effort_command")
        pushes = bag.joints("/sim/disturbance")
        applied = bag.joints("/sim/applied_effort")
        counts = bag.metadata["pendulum.recorder.counts"]
    assert states.names == ("shoulder", "elbow")
    assert commands.names == pushes.names == applied.names == ("elbow",)
    # A plant that waits for an answer repeats its state each second: where nodes start slowly, the first comes twice.
    # And a recorder that met it a moment after it knew of the recorder counts what it did not hear.
    unheard = _unheard(counts, "/sim/joint_states")
    assert 1001 - unheard <= len(np.unique(states.stamp_ns)) <= 1001
    if not unheard:
        assert states.position[0] == pytest.approx([3.19, -0.05])
    late = states.stamp_ns > 2_500_000_000
    assert np.abs(states.position[late] - [math.pi, 0.0]).max() < 0.05
    assert np.abs(pushes.effort).max() == pytest.approx(0.2, rel=0.2)
    # What was applied is what was asked for, one period after another.
    both = dict(zip(commands.stamp_ns, commands.effort[:, 0], strict=True))
    push = dict(zip(pushes.stamp_ns, pushes.effort[:, 0], strict=True))
    # A recorder that met somebody a moment after the plant did counts what it did not hear.
    for heard, topic in ((both, "/sim/effort_command"), (push, "/sim/disturbance")):
        assert len(set(applied.stamp_ns[:800]) - set(heard)) <= _unheard(counts, topic)
    for stamp, effort in zip(applied.stamp_ns[:800], applied.effort[:800, 0], strict=True):
        if stamp in both and stamp in push:
            assert effort == pytest.approx(np.clip(both[stamp] + push[stamp], -6.0, 6.0))
    # A passive joint has no effort.
    assert not states.effort[:, 0].any()
    assert states.effort[:, 1].any()


def test_an_acrobot_swings_up_in_lockstep_and_stays(peer: JointsPeer, processes) -> None:
    controller = _start(
        processes,
        "pendulum_lqr",
        "controller",
        "plant:=acrobot_frictionless",
        "controller:=tvlqr",
        "period:=0.004",
        "use_sim_time:=true",
    )
    controller.wait_for_output(r"tvlqr for plant acrobot_frictionless: swing-up of .*sampled from", 240)
    _start_lockstep(processes, "acrobot_frictionless", 5.0, "rate_hz:=250.0")
    # The event may come before the states that wait here.
    peer.until(lambda: peer.states and peer.states[-1].header.stamp.sec == 6, "the last state, after 5 s", 200.0)
    # A plant knows of a listener before the listener knows of the plant: the first states may be missed here, but not
    # all of those that hang.
    assert max(abs(state.position[0] - math.pi) for state in peer.states) > 1.0
    turned = (np.array(peer.states[-1].position) - [math.pi, 0.0] + math.pi) % (2.0 * math.pi) - math.pi
    assert np.abs(turned).max() < 0.01
    assert np.abs(peer.states[-1].velocity).max() < 0.05


def test_a_cart_swings_its_pole_up_by_energy_in_lockstep_within_its_track_and_its_motors_limit(
    peer: JointsPeer, processes
) -> None:
    controller = _start(
        processes, "pendulum_lqr", "controller", "plant:=cart_pole", "controller:=energy_swing_up", "use_sim_time:=true"
    )
    controller.wait_for_output(r"energy_swing_up for plant cart_pole: pumps by cart within 1\.62 m", 60)
    _start_lockstep(processes, "cart_pole", 9.0, "rate_hz:=100.0")
    peer.until(lambda: peer.states and peer.states[-1].header.stamp.sec == 10, "the last state, after 9 s", 200.0)
    # The first states may be missed here, but not all below the horizontal.
    assert max(math.cos(state.position[1]) for state in peer.states) > 0.0
    cart, pole = peer.states[-1].position
    assert abs(cart) < 0.05
    assert math.cos(pole) < -0.998
    # Its track ends at 1.8 m; the controller stays within nine tenths of the way.
    assert max(abs(state.position[0]) for state in peer.states) < 1.65
    assert max(abs(applied.effort[0]) for applied in peer.applied) <= 10.0


def test_mpc_takes_the_period_of_the_states_and_stops_a_cart_before_the_end_of_its_track(
    peer: JointsPeer, processes
) -> None:
    controller = _start(
        processes, "pendulum_lqr", "controller", "plant:=cart_pole", "controller:=mpc", "use_sim_time:=true"
    )
    controller.wait_for_output(r"mpc for plant cart_pole: horizon 50, positions within \[1\.71, none\]", 30)
    _start_lockstep(
        processes,
        "cart_pole",
        4.0,
        "rate_hz:=50.0",
        "initial_position:=[1.5, 3.1415927]",
        "start_effort_limit:=0.0",
        "initial_velocity:=[0.5, 0.0]",
    )
    peer.until(lambda: peer.states and peer.states[-1].header.stamp.sec == 5, "the last state, after 4 s", 90.0)
    controller.wait_for_output(r"designed for states every 0\.02 s", 10)
    assert max(state.position[0] for state in peer.states) < 1.79
    assert np.abs(np.array(peer.states[-1].position) - [0.0, math.pi]).max() < 0.05


def test_a_policy_holds_a_cart_pole_in_lockstep_and_gives_up_where_it_was_never_trained(
    peer: JointsPeer, processes, tmp_path: Path
) -> None:
    plant = load_mechanism("cart_pole")
    path = write_policy(tmp_path / "policy.npz", lqr_policy(plant))
    arguments = ("plant:=cart_pole", "controller:=policy", f"policy:={path}", "use_sim_time:=true")
    controller = _start(processes, "pendulum_lqr", "controller", *arguments)
    controller.wait_for_output(
        r"policy for plant cart_pole: test \(swing_up, 6-1\) every 0\.01 s, fallback no effort", 30
    )
    efforts: dict[int, float] = {}
    answers = peer.node.create_subscription(
        JointState,
        names.EFFORT_COMMAND,
        lambda message: efforts.setdefault(
            message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, message.effort[0]
        ),
        qos.COMMAND,
    )
    # This node could answer too, and counts as one.
    peer.until(lambda: answers.get_publisher_count() == 2, "the controller as publisher")
    simulator = _start_lockstep(
        processes, "cart_pole", 4.0, "initial_position:=[0.05, 3.19]", "start_effort_limit:=0.0"
    )
    peer.until(lambda: peer.states and peer.states[-1].header.stamp.sec == 5, "the last state, after 4 s", 90.0)
    assert np.abs(np.array(peer.states[-1].position) - [0.0, math.pi]).max() < 0.02
    peer.until(lambda: len(efforts) > 1000, "the answers")
    first = min(efforts)
    assert efforts[first] == 0.0  # what it may ask for rises from zero
    # States come every 2 ms, so each answer holds for five of them, once their period is known; a busy machine may miss
    # some of them here.
    later = {(stamp - first) // 2_000_000: effort for stamp, effort in efforts.items()}
    held = [{((tick + phase) // 5, later[tick]) for tick in later if 250 < tick < 550} for phase in range(5)]
    assert [len(grid) == len(dict(grid)) for grid in held].count(True) == 1
    simulator.send_signal(signal.SIGINT)
    assert simulator.wait(20.0) == 0
    _start_lockstep(processes, "cart_pole", 1.0, "initial_position:=[0.55, 3.19]", "start_effort_limit:=0.0")
    controller.wait_for_output(r"gave up after 0\.000 s: position of cart 0\.55 m", 60)


SIMULATOR, CONTROLLER, DISTURBANCE, BRIDGE = (
    ("pendulum_sim", "simulator"),
    ("pendulum_lqr", "controller"),
    ("pendulum_lqr", "disturbance"),
    ("pendulum_hw_bridge", "bridge"),
)


REFUSED: list[Refused] = [
    (SIMULATOR, ("plant:=acrobot", "method:=etd4"), "expected auto: plant 'acrobot' has several joints"),
    (SIMULATOR, ("plant:=acrobot", "initial_theta:=1.0"), "expected initial_position and initial_velocity"),
    (
        SIMULATOR,
        ("plant:=acrobot", "initial_position:=[1.0, 2.0, 3.0]"),
        "initial_position has 3 values; expected 2, for shoulder [rad], elbow [rad], or one for all",
    ),
    (SIMULATOR, ("initial_position:=[1.0]", "initial_theta:=1.0"), "expected initial_position and initial_velocity"),
    (
        CONTROLLER,
        ("plant:=acrobot", "controller:=pid"),
        "pid is for plants of one joint, and plant 'acrobot' has shoulder, elbow; expected one of lqr, lqi,",
    ),
    (
        CONTROLLER,
        ("plant:=acrobot_frictionless", "controller:=energy_swing_up"),
        "is a double_pendulum with motors at elbow; expected cart_pole with a motor at the cart alone",
    ),
    (
        CONTROLLER,
        ("plant:=pendubot", "controller:=energy_swing_up"),
        "elbow of plant 'pendubot' is passive with 0.12 N m; expected at most 0.0235 N m",
    ),
    (CONTROLLER, ("plant:=cart_pole", "controller:=policy"), "policy is empty; expected the path of a policy file"),
    (CONTROLLER, ("plant:=acrobot", "q:=[1.0, 2.0]"), "q has the shape (2,); expected (4,)"),
    (
        BRIDGE,
        ("plant:=acrobot", "backend:=replay", "replay_file:=none"),
        "backend 'replay' has one module, and plant 'acrobot' has the joints shoulder, elbow; expected",
    ),
    (BRIDGE, ("plant:=cart_pole", "backend:=hebi"), "joint 'cart' slides, and a module of backend 'hebi' turns"),
    (BRIDGE, ("plant:=acrobto",), "acrobto"),
    (DISTURBANCE, ("joints:=[elbow, elbow]",), "joints is ['elbow', 'elbow']; expected names, each once"),
]


def test_what_does_not_fit_several_joints_is_refused_in_one_sentence(domain_id: int) -> None:
    assert not_refused(REFUSED) == []


def test_the_nodes_of_a_foreign_model_of_two_joints_give_the_states_of_one_process_bit_for_bit(
    processes, domain_id: int, tmp_path: Path
) -> None:
    pytest.importorskip("mujoco")
    model, bag = tmp_path / "model.xml", tmp_path / "bag"
    model.write_text(mjcf(load_mechanism("cart_pole")), encoding="utf-8")
    command = ("experiment", "lockstep", "--plant", "cart_pole", "--simulation", model, "--duration", "0.2")
    run = processes.start("pendulum_bags", *command, "--bag", bag, alone=True)
    assert run.wait(120.0) == 0, run.output
    noise = NoiseSettings(1, default_amplitude("cart_pole"), 0.01, 0.2)
    alone = simulate(JointSettings("cart_pole", noise=noise, simulation=str(model)).run("sim"))
    with read_bag(bag) as opened:
        states = opened.joints("/sim/joint_states")
    assert states.names == ("cart", "pole")
    assert np.array_equal(states.position, alone.position)
    assert np.array_equal(states.velocity, alone.velocity)
    assert np.ptp(states.position, axis=0).min() > 0.0
    refused = processes.start("pendulum_bags", *command, "--q", "1", "1", "--bag", bag, alone=True)
    assert refused.wait(60.0) == 2
    assert "--q is for a plant of one joint, and cart_pole has several" in refused.output


def test_an_excitation_of_two_joints_is_played_from_hanging_within_its_limits(
    processes, domain_id: int, tmp_path: Path
) -> None:
    design = ("--plant", "cart_pole", "--duration", "3", "--trials", "1", "--kind", "prbs", "--max-travel", "0.2")
    out = ("--out", tmp_path / "e.csv", "--play", "--bag", tmp_path / "bag")
    run = processes.start("pendulum_bags", "excite", *design, *out, alone=True)
    assert run.wait(120.0) == 0, run.output
    with read_bag(tmp_path / "bag") as bag:
        states, applied = bag.joints("/sim/joint_states"), bag.joints("/sim/applied_effort")
        assert "pole_inertia" in bag.metadata["pendulum.excitation"]["predicted"]
    assert states.position[0] == pytest.approx([0.0, 0.0], abs=0.01)
    # A sensor of 1 mm.
    assert 0.05 < np.abs(states.position[:, 0]).max() < 0.21
    played = np.loadtxt(tmp_path / "e.csv", delimiter=",", skiprows=1)[:, 1]
    np.testing.assert_allclose(applied.effort[: played.size, 0], played, atol=1e-6)
