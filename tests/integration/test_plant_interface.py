"""The shared interface of a plant over real DDS: services, refusals, signals, parameters."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from pendulum_msgs_py.contract.names import JOINT
from pendulum_msgs_py.ros import qos
from pendulum_msgs_py.ros.convert import stamp_from_message, stamp_to_message, trajectory_to_message
from pendulum_msgs_py.ros.plant_interface import PlantInterface
from pendulum_testing.fixtures import PROJECT, own_domain
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.processes import ProcessGroup, RunningProgram
from pendulum_testing.trajectories import from_points

PERIODS_TO_ZERO = 15
"""Periods, 10 ms or 5, counted by the plant, in which torque may last: a command counts for 50 ms, and is on its way
for a few."""
_PLANT = Path(__file__).with_name("tiny_plant.py")


class Peer(GraphPeer):
    """Everybody who may speak to the plant, in one node of this process.

    Attributes:
        program: The plant, where several tests share it.
    """

    program: RunningProgram

    def __init__(self) -> None:
        super().__init__("peer")
        self.states: deque[JointState] = deque(maxlen=1000)
        self.applied: deque[JointState] = deque(maxlen=2000)
        self.diagnostics: dict[str, str] = {}
        self.level = b"\x00"
        self.command = self.node.create_publisher(JointState, "effort_command", qos.COMMAND)
        self.push = self.node.create_publisher(JointState, "push", qos.COMMAND)
        self.disturbance = self.node.create_publisher(JointState, "disturbance", qos.COMMAND)
        self.trajectory = self.node.create_publisher(JointTrajectory, "joint_trajectory", qos.TRAJECTORY)
        self.node.create_subscription(JointState, "joint_states", self._on_state, qos.STATE)
        self.node.create_subscription(JointState, "applied_effort", self._on_applied, qos.STATE)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.DIAGNOSTICS)
        self._reset = self.node.create_client(Trigger, "tiny_plant/e_stop_reset")
        self.answer: Callable[[JointState], None] | None = None

    def told(self, predicate: Callable[[], object], what: str) -> None:
        """Wait for something in diagnostics, which come twice a second, and to whoever asks for a reset in vain."""
        asked = self._reset.call_async(Trigger.Request())

        def seen() -> object:
            nonlocal asked
            if asked.done():
                asked = self._reset.call_async(Trigger.Request())
            return predicate()

        self.until(seen, what)
        self.until(asked.done, "the last answer")

    def _on_state(self, message: JointState) -> None:
        self.states.append(message)

    def _on_applied(self, message: JointState) -> None:
        self.applied.append(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": plant"):
                self.diagnostics = {pair.key: pair.value for pair in status.values}
                self.level = status.level

    def spin_once(self, timeout: float = 0.02) -> None:
        seen = len(self.states) and self.states[-1]
        super().spin_once(timeout)
        if self.answer is not None and self.states and self.states[-1] is not seen:
            self.answer(self.states[-1])

    def known(self) -> str:
        return f"; diagnostics {self.diagnostics}"

    def arm(self, on: bool = True):
        return self.call(SetBool, "tiny_plant/arm", SetBool.Request(data=on))

    def count(self, key: str) -> int:
        return int(self.diagnostics.get(f"effort_command.refused.{key}", 0))

    def message(self, effort: float, *, stamp: object = None, frame: str = "lqr") -> JointState:
        message = JointState(name=[JOINT], effort=[effort])
        message.header.stamp = self.states[-1].header.stamp if stamp is None else stamp
        message.header.frame_id = frame
        return message

    def driven_since(self, state: JointState) -> int:
        """Return in how many of its periods after a state the plant has applied a torque, once it applies none."""
        begin = stamp_from_message(state.header.stamp)

        def later() -> list[JointState]:
            return [it for it in self.applied if stamp_from_message(it.header.stamp) > begin]

        # Where this process stood still before the state, the plant may have been at rest already.
        self.until(lambda: bool(found := later()) and found[-1].effort[0] == 0.0, "zero torque after a state")
        return sum(it.effort[0] != 0.0 for it in later())

    def stream(self, effort: float, frame: str = "lqr") -> None:
        self.answer = lambda state: self.command.publish(self.message(effort, stamp=state.header.stamp, frame=frame))


@pytest.fixture
def peer(domain_id: int) -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


def _start(processes: ProcessGroup, *arguments: str) -> RunningProgram:
    return processes.start_command([sys.executable, str(_PLANT), *arguments], name="tiny_plant")


_AS_TINY_PLANT = (
    "--ros-args",
    "-r",
    "__node:=tiny_plant",
    "-p",
    "armed_at_start:=false",
    "-p",
    "start_effort_limit:=0.0",
)


def _start_mujoco(processes: ProcessGroup, folder: Path) -> RunningProgram:
    """Start a model file that nobody wrote for us, under the tiny plant's name and limit."""
    model = folder / "lab.xml"
    model.write_text(_MODEL, encoding="utf-8")
    return processes.start("pendulum_sim", "mujoco", *_AS_TINY_PLANT, "-p", f"model:={model}", "-p", "rate_hz:=100.0")


def _start_simulator(processes: ProcessGroup) -> RunningProgram:
    """Start a pendulum under the tiny plant's name and limit, its periods compiled."""
    # Python takes longer periods itself.
    settings = ("-p", "rate_hz:=200.0", "-p", "effort_limit:=5.0")
    return processes.start("pendulum_sim", "simulator", *_AS_TINY_PLANT, *settings)


_MODEL = """
<mujoco model="lab">
  <option timestep="0.005"/>
  <worldbody>
    <body name="pole"><joint name="hinge" axis="0 1 0" damping="2"/><geom size="0.05" pos="0 0 0.3" mass="0.3"/></body>
  </worldbody>
  <actuator><motor joint="hinge" ctrlrange="-5 5" ctrllimited="true"/></actuator>
</mujoco>
"""


def _await(peer: Peer, program: RunningProgram) -> RunningProgram:
    peer.until(
        lambda: peer.states and peer.diagnostics and peer.command.get_subscription_count() == 1, "the plant", 60.0
    )
    return program


@pytest.fixture
def plant(processes: ProcessGroup, peer: Peer) -> RunningProgram:
    return _await(peer, _start(processes))


# The tiny one at last: the tests that follow have it run beside them.
@pytest.fixture(scope="module", params=["compiled", "mujoco", "tiny_plant"])
def running_plant(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    """Start a plant for all the tests that leave it as sound as they found it, and who speaks to it."""
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    folder = tmp_path_factory.mktemp(request.param)
    processes = ProcessGroup(folder / "processes", cwd=PROJECT)
    with own_domain(folder):
        peer = Peer()
        try:
            if request.param == "tiny_plant":
                program = _start(processes)
            elif request.param == "mujoco":
                program = _start_mujoco(processes, folder)
            else:
                program = _start_simulator(processes)
            peer.program = _await(peer, program)
            # As a plant starts: whoever uses it first finds this, too.
            assert peer.diagnostics["mode"] == "disarmed"
            yield peer
            assert ("periods_compiled" in peer.diagnostics) == (request.param == "compiled")
            if request.param == "compiled":
                assert peer.diagnostics["loop"].startswith("compiled")
                peer.until(lambda: int(peer.diagnostics["periods_compiled"]) > 100, "compiled periods")
        finally:
            peer.close()
            assert processes.close() == []


@pytest.fixture
def any_peer(running_plant: Peer) -> Peer:
    """Bring the plant back to how it started, disarmed; forget what was heard."""
    peer = running_plant
    peer.answer = None
    peer.spin(0.15)  # no plant arms while a large torque is still fresh
    peer.call(Trigger, "tiny_plant/e_stop_reset", Trigger.Request())
    assert peer.arm(False).success
    # Its counts, too, as they are now.
    peer.diagnostics = {}
    peer.told(lambda: peer.diagnostics.get("mode") == "disarmed", "a disarmed plant")
    for heard in (peer.states, peer.applied):
        heard.clear()
    peer.until(lambda: peer.states and peer.applied, "new states")
    return peer


def test_services_walk_through_the_states_and_a_reset_never_re_arms(any_peer: Peer) -> None:
    peer = any_peer
    assert peer.diagnostics["mode"] == "disarmed"
    assert peer.arm().success
    assert peer.call(Trigger, "tiny_plant/e_stop", Trigger.Request()).success
    refused = peer.arm()
    assert not refused.success
    assert refused.message == "e-stop is latched; reset it first"
    assert not peer.arm(False).success
    assert peer.call(Trigger, "tiny_plant/e_stop_reset", Trigger.Request()).message == "disarmed"
    again = peer.call(Trigger, "tiny_plant/e_stop_reset", Trigger.Request())
    assert not again.success
    assert again.message == "plant is disarmed; expected e_stop"
    peer.stream(1.0)
    peer.spin(0.3)
    assert peer.applied[-1].effort[0] == 0.0
    peer.answer = None
    peer.spin(0.1)
    assert peer.arm().success


def test_every_refusal_is_counted_under_its_name_and_moves_nothing(any_peer: Peer) -> None:
    peer = any_peer
    assert peer.arm().success
    peer.spin(0.1)
    expected = {"not_one_joint": 2, "not_finite": 2, "other_joint": 1, "too_old": 1, "from_future": 1}
    before = {key: peer.count(key) for key in expected}
    stamp = peer.states[-1].header.stamp
    now_ns = stamp.sec * 10**9 + stamp.nanosec
    peer.command.publish(JointState(name=[JOINT]))
    peer.command.publish(JointState(name=[JOINT, "elbow"], effort=[1.0, 1.0]))
    peer.command.publish(peer.message(float("nan")))
    peer.command.publish(peer.message(float("inf")))
    elbow = peer.message(3.0)
    elbow.name = ["elbow"]
    peer.command.publish(elbow)
    peer.command.publish(peer.message(3.0, stamp=stamp_to_message(now_ns - 10**9)))
    peer.command.publish(peer.message(3.0, stamp=stamp_to_message(now_ns + 10**10)))
    peer.told(lambda: peer.count("from_future") == before["from_future"] + 1, "the last refusal")
    assert {key: peer.count(key) - before[key] for key in before} == expected
    assert all(message.effort[0] == 0.0 for message in peer.applied)


def test_a_trajectory_is_followed_and_handed_over(any_peer: Peer) -> None:
    peer = any_peer
    # What has driven it before may have left it elsewhere.
    start = peer.states[-1].position[0]
    move = trajectory_to_message(from_points([0.0, 0.3], [start, start + 0.05], [0.0, 0.0]))
    peer.trajectory.publish(move)
    peer.told(lambda: peer.diagnostics.get("joint_trajectory.refused.disarmed") == "1", "the refusal")
    assert peer.arm().success
    peer.trajectory.publish(move)
    peer.told(lambda: peer.diagnostics["mode"] == "armed_position", "position control")
    peer.told(lambda: "holding" in peer.diagnostics["reason"], "the end of the trajectory")
    peer.stream(0.4)
    peer.told(lambda: peer.diagnostics["mode"] == "armed_effort", "effort control")
    peer.until(lambda: peer.applied[-1].effort[0] == 0.4, "the controller's torque")
    bad = trajectory_to_message(from_points([0.0], [start + 2.0], [0.0]))
    peer.trajectory.publish(bad)
    peer.told(lambda: peer.diagnostics.get("joint_trajectory.refused.invalid") == "1", "the second refusal")
    stale = trajectory_to_message(from_points([0.0, 1.0], [start, start], [0.0, 0.0]), stamp_ns=5)
    peer.trajectory.publish(stale)
    peer.told(lambda: peer.diagnostics.get("joint_trajectory.refused.invalid") == "2", "the third refusal")


def test_a_second_commander_is_refused_named_and_reported(any_peer: Peer) -> None:
    peer = any_peer
    assert peer.arm().success
    peer.stream(1.0)
    peer.until(lambda: peer.applied[-1].effort[0] == 1.0, "the first commander's torque")

    def both(state: JointState) -> None:
        peer.command.publish(peer.message(1.0, stamp=state.header.stamp))
        peer.command.publish(peer.message(-4.0, stamp=state.header.stamp, frame="intruder"))

    peer.answer = both
    peer.until(lambda: peer.count("second_commander") > 5, "refusals of the second commander")
    assert peer.diagnostics["commander"] == "lqr"
    assert peer.diagnostics["refused_commander"] == "intruder"
    assert peer.level == b"\x01"
    assert min(message.effort[0] for message in peer.applied) >= 0.0


tiny_plant_alone = pytest.mark.parametrize("running_plant", ["tiny_plant"], indirect=True)


@tiny_plant_alone
@pytest.mark.parametrize("name", ["peer", "another"])
def test_twins_behind_one_frame_id_get_no_torque(any_peer: Peer, name: str) -> None:
    peer = any_peer
    assert peer.arm().success
    peer.stream(1.0)
    peer.until(lambda: peer.applied[-1].effort[0] == 1.0, "torque")
    twin_node = peer.add_node(name)
    twin = twin_node.create_publisher(JointState, "effort_command", qos.COMMAND)
    peer.until(lambda: twin.get_subscription_count() == 1, "the twin to be matched")

    def both(state: JointState) -> None:
        peer.command.publish(peer.message(1.0, stamp=state.header.stamp))
        twin.publish(peer.message(-4.0, stamp=state.header.stamp))

    peer.answer = both
    peer.told(lambda: "expected" in peer.diagnostics["reason"], "the conflict to be seen")
    # Here diagnostics may be read before torques that were published before them.
    since = time.time_ns()

    def later() -> list[float]:
        return [it.effort[0] for it in peer.applied if stamp_from_message(it.header.stamp) > since]

    peer.until(lambda: len(later()) >= 10, "later torques")
    assert not any(later())
    twin_node.destroy_publisher(twin)
    peer.stream(1.0)
    peer.until(lambda: peer.applied[-1].effort[0] == 1.0, "torque after the twin has gone")


def test_torque_is_the_clamped_sum_and_ends_with_the_commands(any_peer: Peer) -> None:
    peer = any_peer
    assert peer.arm().success

    def both(state: JointState) -> None:
        peer.command.publish(peer.message(4.0, stamp=state.header.stamp))
        peer.disturbance.publish(peer.message(0.5, stamp=state.header.stamp, frame="noise"))

    peer.answer = both
    peer.until(lambda: peer.applied[-1].effort[0] == 4.5, "the sum")
    peer.stream(1e308)
    peer.until(lambda: peer.applied[-1].effort[0] == 5.0, "the clamped torque")
    peer.answer = None
    last = peer.states[-1]
    assert peer.driven_since(last) <= PERIODS_TO_ZERO
    peer.stream(2.0)
    peer.until(lambda: peer.applied[-1].effort[0] == 2.0, "recovery by itself")


@tiny_plant_alone
def test_commands_that_come_too_slowly_do_not_flood_the_log(any_peer: Peer) -> None:
    peer, plant = any_peer, any_peer.program
    before, began, rounds = len(plant.output), time.monotonic(), 0
    asked = "changes since the last line: do commands come more slowly than every 0.05 s?"
    assert peer.arm().success
    peer.stream(0.4)
    peer.until(lambda: peer.applied[-1].effort[0] == 0.4, "the controller's torque")
    peer.answer = None
    # Where the plant looks for lines left out just before the next change, it tells how many and asks nothing: the
    # second after that asks.
    while rounds < 15 or asked not in plant.output[before:]:
        assert rounds < 300, plant.output[before:]
        # 10 Hz, and commands count for 50 ms: each starts the plant and starves it.
        peer.command.publish(peer.message(0.4))
        peer.spin(0.1)
        rounds += 1
    lines = [line for line in plant.output[before:].splitlines() if "armed_effort: " in line]
    # One a second, and one for arming; each round changes it twice.
    assert len(lines) <= time.monotonic() - began + 3.0


@tiny_plant_alone
def test_parameters_change_at_run_time_or_say_why_not(any_peer: Peer) -> None:
    peer = any_peer

    def set_parameter(name: str, **value: object) -> tuple[bool, str]:
        parameter = Parameter(name=name, value=ParameterValue(**value))
        request = SetParameters.Request(parameters=[parameter])
        result = peer.call(SetParameters, "tiny_plant/set_parameters", request).results[0]
        return result.successful, result.reason

    assert set_parameter("gain", type=3, double_value=2.0) == (True, "")
    refusals = {
        "range": set_parameter("gain", type=3, double_value=-2.0),
        "nan": set_parameter("gain", type=3, double_value=float("nan")),
        "type": set_parameter("gain", type=4, string_value="2"),
        "integer": set_parameter("gain", type=2, integer_value=2),
        "choice": set_parameter("method", type=4, string_value="rk4"),
        "together": set_parameter("gain", type=3, double_value=50.0),
        "fixed": set_parameter("fixed", type=3, double_value=1.0),
        "list": set_parameter("offsets", type=8, double_array_value=[0.0, float("inf")]),
        "nothing": set_parameter("offsets", type=0),
        "unknown": set_parameter("gian", type=3, double_value=1.0),
    }
    assert not [name for name, (accepted, _) in refusals.items() if accepted]
    assert refusals["together"][1] == "gain times cycles is 150.0; expected at most 100"
    assert refusals["choice"][1] == "method is 'rk4'; expected one of exact, euler"
    assert "offsets is inf rad; expected a finite number" in refusals["list"][1]
    assert all(reason for _, reason in refusals.values())
    assert peer.program.returncode is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_signal_ends_torque_at_once_and_the_program_with_zero_torque_last(
    plant: RunningProgram, peer: Peer, number: signal.Signals
) -> None:
    assert peer.arm().success
    peer.stream(3.0)
    peer.until(lambda: peer.applied[-1].effort[0] == 3.0, "torque")
    last = peer.states[-1]
    plant.send_signal(number)
    peer.until(lambda: plant.returncode is not None, "the end", 20.0)
    assert plant.returncode == 0
    assert "closed" in plant.output
    assert "Traceback" not in plant.output
    peer.answer = None
    assert peer.driven_since(last) <= PERIODS_TO_ZERO
    # Said before the last torque, and on another topic: here a torque may be read first.
    peer.until(lambda: peer.diagnostics["mode"] == "disarmed", "its last words")
    assert peer.diagnostics["reason"] == "plant ends"


def test_an_echo_of_the_signal_does_not_cut_the_way_out_short_but_a_second_wish_does(
    processes: ProcessGroup, domain_id: int
) -> None:
    patient = _start(processes, "--ros-args", "-p", "stubborn:=0.5")
    stubborn = _start(processes, "--ros-args", "-r", "__ns:=/other", "-p", "stubborn:=60.0")
    for program in (patient, stubborn):
        program.wait_for_output("running", 20.0)
    stubborn.send_signal(signal.SIGTERM)
    patient.send_signal(signal.SIGINT)
    time.sleep(0.2)  # sent at once, the two would be one
    patient.send_signal(signal.SIGINT)
    assert patient.wait(20.0) == 0
    assert "closed" in patient.output

    time.sleep(1.2)
    stubborn.send_signal(signal.SIGTERM)
    assert stubborn.wait(20.0) == 128 + signal.SIGTERM
    assert "second SIGTERM: leaving at once" in stubborn.output


@pytest.fixture(scope="module")
def refused_starts(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[int, str]]:
    """Return exit code and output of one process for each of the bad parameters; what it imports is imported once."""
    folder = tmp_path_factory.mktemp("refused")
    for name, content in BAD_FILES.items():
        (folder / name).write_text(content, encoding="utf-8")
    every = json.dumps([[each.format(folder=folder) for each in arguments] for arguments, _ in BAD_PARAMETERS])
    with own_domain(folder):
        command = [sys.executable, "-c", _FORKS, every, str(folder)]
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, timeout=60, check=True)
    outputs = [(folder / str(number)).read_text(encoding="utf-8") for number in range(len(BAD_PARAMETERS))]
    return list(zip(map(int, done.stdout.split()), outputs, strict=True))


_FORKS = """
import json, os, sys
from tests.integration import tiny_plant
children = []

def await_one():
    print(os.waitstatus_to_exitcode(os.waitpid(children.pop(0), 0)[1]), flush=True)

for number, arguments in enumerate(json.loads(sys.argv[1])):
    child = os.fork()
    if not child:
        with open(os.path.join(sys.argv[2], str(number)), "wb") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
        raise SystemExit(tiny_plant.main(["--ros-args", *arguments]))
    children.append(child)
    if len(children) == 4:  # of more, each would look for all others
        await_one()
while children:
    await_one()
"""
BAD_FILES = {
    "misspelt.yaml": "/**:\n  ros__parameters: {effort_limt: 1.0}\n",
    "of_another.yaml": "/tiny_plant:\n  ros__parameters: {of_another: 1.0}\n",
}
BAD_PARAMETERS = [
    (["-p", "gain:=1"], "gain is 1; expected a number >= 0; ROS distinguishes whole numbers from decimals: write 1.0"),
    (["-p", "gain:=-1.0"], "gain is -1.0 N m/rad; expected >= 0"),
    (["-p", "gain:=.nan"], "gain is nan N m/rad; expected a finite number >= 0"),
    (["-p", "gain:=abc"], "gain is 'abc'; expected a number >= 0"),
    (["-p", "cycles:=2.5"], "cycles is 2.5; expected an integer 1 to 9"),
    (["-p", "cycles:=10"], "cycles is 10; expected 1 to 9"),
    (["-p", "method:=rk4"], "method is 'rk4'; expected one of exact, euler"),
    (["-p", "offsets:=[1, 2]"], "offsets is [1, 2]; expected a list"),
    (["-p", "gian:=1.0"], "/tiny_plant: unknown parameter 'gian'; did you mean 'gain'?"),
    (["-p", "effort_limit:=6.0"], "effort_limit is 6.0 N m; expected at most 5.0 N m"),
    (["-p", "position_window:=[1.0, 0.0]"], "position window is [1.0, 0.0] rad; expected min < max"),
    (["-p", "gain"], "ROS arguments are not understood: Couldn't parse parameter override rule"),
    (["-r", "__ns:=no namespace"], "ROS arguments are not understood"),
    (["--params-file", "/nowhere.yaml"], "ROS arguments are not understood"),
    (["--params-file", "{folder}/misspelt.yaml"], "unknown parameter 'effort_limt'"),
    (["--params-file", "{folder}/of_another.yaml"], "unknown parameter 'of_another'"),
]


@pytest.mark.parametrize("number", range(len(BAD_PARAMETERS)), ids=[arguments[-1] for arguments, _ in BAD_PARAMETERS])
def test_a_bad_parameter_is_one_sentence_and_exit_code_2(refused_starts: list[tuple[int, str]], number: int) -> None:
    code, output = refused_starts[number]
    assert code == 2
    errors = [line for line in output.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert BAD_PARAMETERS[number][1] in errors[0]
    assert "Traceback" not in output


def test_parameters_of_ros_itself_are_no_strangers_nor_is_in_a_file_for_every_node_what_other_nodes_know(
    processes: ProcessGroup, domain_id: int, tmp_path: Path
) -> None:
    file = tmp_path / "all.yaml"
    file.write_text("/**:\n  ros__parameters: {use_sim_time: false, gain: 3.0, of_another: 1.0}\n", encoding="utf-8")
    program = _start(
        processes,
        *("--ros-args", "--params-file", str(file)),
        *("-p", "use_sim_time:=false", "-p", "start_type_description_service:=false"),
        *("-p", "qos_overrides./parameter_events.publisher.depth:=10"),
    )
    program.wait_for_output("left to other nodes, from a section for every node: of_another", 20.0)
    program.wait_for_output("running", 20.0)
    program.send_signal(signal.SIGINT)
    assert program.wait(20.0) == 0


def test_help_shows_every_parameter_and_survives_a_reader_that_goes() -> None:
    command = [sys.executable, str(_PLANT), "--help"]
    text = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout
    for name in ("gain", "cycles", "effort_limit", "command_timeout", "example:"):
        assert name in text
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.wait(30) == 0
    assert process.stderr.read() == ""


def test_last_words_wait_to_be_heard_without_pythons_lock_and_a_torque_under_way_waits_for_nobody() -> None:
    asked: list[int] = []
    publisher = SimpleNamespace(
        get_subscription_count=lambda: 0, wait_for_all_acked=lambda longest: asked.append(longest.nanoseconds)
    )
    stopping = SimpleNamespace(
        supervisor=SimpleNamespace(report_applied=lambda effort: None),
        applied_publisher=publisher,
        _stopping=True,
        _motor_efforts=None,
    )
    # Decided before the stop: its thread has the drive still to release.
    PlantInterface.publish_applied(stopping, 0, (1.0,))  # type: ignore[arg-type]
    assert asked == []
    PlantInterface.publish_applied(stopping, 0, (0.0,))  # type: ignore[arg-type]
    assert len(asked) > 1
    # For whatever longer rclpy waits itself, no other thread of the process runs.
    assert set(asked) == {0}
