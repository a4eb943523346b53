"""Controller and disturbance nodes on the real middleware, with this test as the plant."""

import itertools
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from pendulum_lqr.disturbances.disturbance import make_disturbance
from pendulum_lqr.policies.policy_file import write_policy
from pendulum_msgs_py.contract.cdr import decode_joint_state, encode_joint_state
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_msgs_py.programs.realtime import may_run_in_real_time
from pendulum_msgs_py.ros import qos
from pendulum_testing.graph_peer import GraphPeer
from pendulum_testing.policies import linear_policy
from pendulum_testing.refusals import Refused, not_refused

STATE = {"position": math.pi + 0.1, "velocity": 0.2, "effort": 0.0}
# A busy machine delivers states late; how old is too old is judged by tests that need no middleware.
PATIENT = "state_timeout:=60.0"
ANSWER = -(33.345265 * 0.1 + 0.158993 * 0.2)


class FakePlant(GraphPeer):
    """Publishes states and keeps what comes back."""

    def __init__(self) -> None:
        super().__init__("plant", namespace="/sim")
        self.states = self.node.create_publisher(JointState, "joint_states", qos.STATE)
        self.published: list[int] = []
        self.commands: list = []
        self.disturbances: list = []
        self.arrays: list[float] = []
        self.events: list[dict] = []
        self.diagnostics: dict[str, dict] = {}
        subscribe = self.node.create_subscription
        subscribe(JointState, "effort_command", lambda m: self.commands.append(decode_joint_state(m)), 10, raw=True)
        subscribe(JointState, "disturbance", lambda m: self.disturbances.append(decode_joint_state(m)), 10, raw=True)
        subscribe(Float64MultiArray, "controller/commands", lambda m: self.arrays.extend(m.data), 10)
        subscribe(String, "events", lambda m: self.events.append(json.loads(m.data)), qos.EVENTS)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.diagnostics[status.name] = {"message": status.message, "level": status.level, **values}

    def publish(self, stamp_ns: int | None = None, **state: float) -> int:
        stamp = time.time_ns() if stamp_ns is None else stamp_ns
        self.states.publish(encode_joint_state(stamp, **(STATE | state)))
        self.published.append(stamp)
        return stamp

    def run(self, count: int, period: float = 0.005) -> list[int]:
        stamps = []
        for _ in range(count):
            stamps.append(self.publish())
            self.spin(period)
        self.spin(0.1)
        return stamps

    def run_until(self, predicate: Callable[[], object], what: str) -> None:
        """Publish states until something is seen: whoever answers them may be kept waiting meanwhile."""

        def seen() -> object:
            self.publish()
            self.spin(0.005)
            return predicate()

        self.until(seen, what)

    def answer(self) -> float:
        """Publish states until one of them is answered, and return the answer [N m]."""
        before = len(self.published)
        self.run_until(lambda: self.commands and self.commands[-1].stamp_ns in self.published[before:], "an answer")
        return self.commands[-1].effort[0]

    def connect(self, nodes: int = 1) -> None:
        self.until(lambda: self.states.get_subscription_count() >= nodes, "subscriptions")

    def set_parameters(self, node: str, **values):
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        )
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]


@pytest.fixture
def plant(domain_id: int) -> Iterator[FakePlant]:
    fake = FakePlant()
    yield fake
    fake.close()


def ros(*parameters: str) -> list[str]:
    arguments = ["--ros-args", "-r", "__ns:=/sim"]
    for parameter in parameters:
        arguments += ["-p", parameter]
    return arguments


@pytest.mark.skipif(not may_run_in_real_time(7), reason="this user may have no real-time priority")
def test_a_design_while_running_makes_no_plant_wait(plant, processes):
    # Its planner takes half a second to make.
    told = ("controller:=nmpc", "period:=0.01", "realtime_priority:=7")
    program = processes.start("pendulum_lqr", "controller", *ros(*told), alone=True)
    program.wait_for_output("ready", 60)
    assert os.sched_getscheduler(program.pid) == os.SCHED_FIFO
    seen: set[int] = set()
    changed = threading.Event()

    def look() -> None:
        while not changed.wait(0.002):
            seen.add(os.sched_getscheduler(program.pid))

    watch = threading.Thread(target=look)
    watch.start()
    try:
        assert plant.set_parameters("controller", r=2.0).successful
    finally:
        changed.set()
        watch.join()
    assert os.SCHED_OTHER in seen
    assert os.sched_getscheduler(program.pid) == os.SCHED_FIFO


def test_the_controller_answers_each_state_once_by_its_stamp_and_ends_with_zero(plant, processes):
    program = processes.start("pendulum_lqr", "controller", *ros(PATIENT), alone=True)
    program.wait_for_output(r"lqr for plant thesis: K = \[33\.345265, 0\.158993\]", 30)

    def each_is_answered() -> bool:
        # But for the last few, which may be on their way.
        lately = plant.published[-23:-3]
        return len(lately) == 20 and {*lately} <= {command.stamp_ns for command in plant.commands}

    # Only the newest state is kept, so a busy machine may skip some now and then; none is answered twice.
    plant.run_until(each_is_answered, "twenty states that are all answered")
    answered = [command.stamp_ns for command in plant.commands]
    assert answered == sorted(set(answered))
    assert {*answered} <= {*plant.published}
    assert plant.commands[0].frame_id == "/sim/controller"
    assert all(command.effort[0] == pytest.approx(ANSWER, abs=1e-5) for command in plant.commands)
    assert all(not command.position and not command.velocity for command in plant.commands)
    # What must not be answered, one state at a time because only the newest is kept.
    plant.until(lambda: plant.commands[-1].stamp_ns == plant.published[-1], "the answer to the last state")
    count = len(plant.commands)

    def refused(reason: str) -> object:
        return plant.diagnostics.get("/sim/controller: controller", {}).get(f"refused.{reason}")

    for reason, state in (("stale", {"stamp_ns": time.time_ns() - 10**11}), ("not_finite", {"position": math.nan})):
        plant.publish(**state)
        plant.until(lambda reason=reason: refused(reason), f"diagnostics of a state that is {reason}")
    assert len(plant.commands) == count
    assert (refused("stale"), refused("not_finite")) == ("1", "1")
    # A change designs aside and swaps; a bad value leaves the old gain in force and says why.
    bad = plant.set_parameters("controller", q=[1.0, 0.01, 5.0])
    assert not bad.successful
    assert bad.reason.startswith("q has the shape (3,); expected (2,)")
    assert not plant.set_parameters("controller", r=-1.0).successful
    assert plant.answer() == pytest.approx(ANSWER, abs=1e-5)
    assert plant.set_parameters("controller", q=[1.0, 0.01]).successful
    assert plant.answer() == pytest.approx(-(5.257900 * 0.1 + 0.028783 * 0.2), abs=1e-5)
    assert not plant.set_parameters("controller", plant="dfki").successful
    program.send_signal(signal.SIGTERM)
    assert program.wait(15) == 0
    plant.until(lambda: plant.commands[-1].effort[0] == 0.0, "the last zero")
    # By this the plant knows that it is the last, and releases at once.
    assert plant.commands[-1].stamp_ns == plant.commands[-2].stamp_ns + 1


def test_an_adapter_ends_its_last_command_and_commands_no_newer_state(plant, processes):
    adapter = processes.start("pendulum_lqr", "effort_adapter", *ros(), alone=True)
    arrays = plant.node.create_publisher(Float64MultiArray, "effort_controller/commands", 10)
    plant.connect()
    plant.until(arrays.get_subscription_count, "the adapter")

    def answered() -> bool:
        arrays.publish(Float64MultiArray(data=[1.5]))
        return bool(plant.commands)

    plant.run_until(answered, "a command")
    plant.run(5)
    count, newest = len(plant.commands), plant.commands[-1].stamp_ns
    assert newest < plant.published[-1]
    adapter.send_signal(signal.SIGTERM)
    assert adapter.wait(15) == 0
    plant.until(lambda: len(plant.commands) > count, "the last zero")
    # Stamped as an answer to a newer state, it would wake the torque loop of a plant that has been at rest since.
    assert (plant.commands[-1].effort, plant.commands[-1].stamp_ns) == ((0.0,), newest + 1)


def test_the_period_is_taken_from_the_states_or_refused_where_the_loop_would_be_unstable(plant, processes):
    # They go on from each other, however long a busy machine waits between two: after a second, a plant has begun anew.
    stamps = itertools.count(time.time_ns(), 2_000_000)

    def publish(seen: Callable[[], object], what: str) -> list[int]:
        # Only the newest state is kept, so a busy machine misses some: they go on until they have told enough.
        before = len(plant.published)

        def answered() -> object:
            plant.publish(next(stamps), position=math.pi + 0.01, velocity=0.0)
            plant.spin(0.01)
            return seen()

        plant.until(answered, what)
        plant.spin(0.3)
        return plant.published[before:]

    # The stamps are 2 ms apart and the states 10 ms and more, so they get old.
    pid = ("controller:=pid", "plant:=dfki", "state_timeout:=60.0")
    program = processes.start("pendulum_lqr", "controller", *ros(*pid))
    plant.connect()
    published = publish(lambda: plant.commands, "the first answer")
    program.wait_for_output(r"designed for states every 0\.0\d+ s: kp = ", 10)
    # The first states only tell the rate.
    assert {command.stamp_ns for command in plant.commands} <= set(published[9:])
    told = plant.until(
        lambda: (d := plant.diagnostics.get("/sim/controller: controller", {})).get("measured_period") != "nan" and d,
        "the measured period",
    )
    # States that were missed meanwhile may have changed what is measured; what is assumed without is far from both.
    assert float(told["period"]) == pytest.approx(float(told["measured_period"]), rel=0.6)
    program.send_signal(signal.SIGTERM)
    assert program.wait(15) == 0

    plant.commands.clear()
    plant.diagnostics.clear()
    program = processes.start("pendulum_lqr", "controller", *ros("period:=0.01", *pid))
    plant.connect()
    publish(lambda: "not answering" in program.output, "the refusal")
    program.wait_for_output(r"not answering: period is 0\.01 s, but states come every 0\.0\d+ s", 20)
    plant.until(lambda: plant.commands and plant.commands[-1].effort[0] == 0.0, "the last zero")
    count = len(plant.commands)
    further = iter(range(5))
    publish(lambda: next(further, None) is None, "five more states")
    assert len(plant.commands) == count
    plant.until(
        lambda: (
            (d := plant.diagnostics.get("/sim/controller: controller", {})).get("level") == DiagnosticStatus.ERROR
            and "not answering: period is 0.01 s" in d["message"]
        ),
        "the refusal in diagnostics",
    )
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
    assert not plant.call(ChangeState, "controller/change_state", request).success


def test_a_continuous_design_is_judged_at_the_rate_of_the_states(plant, processes, tmp_path):
    late = write_plant(tmp_path / "late.yaml", load_plant("dfki").with_values(transport_delay=0.06))
    program = processes.start("pendulum_lqr", "controller", *ros(f"plant:={late}", "use_sim_time:=true"))
    plant.connect()

    def publish(stamp_ns: int, seen: Callable[[], object], what: str) -> None:
        def repeated() -> object:  # as a plant in lockstep does; it is no interval
            plant.publish(stamp_ns, position=math.pi + 0.01, velocity=0.0)
            plant.spin(0.02)
            return seen()

        plant.until(repeated, what)

    publish(10**9, lambda: plant.commands, "the reply before the rate is known")
    publish(10**9 + 2_000_000, lambda: "not answering" in program.output or len(plant.commands) > 9, "the refusal")
    program.wait_for_output(r"not answering: states come every 0\.002 s: lqr makes the loop unstable", 10)


def test_a_policy_runner_at_its_own_period_and_says_when_it_gives_up(plant, processes, tmp_path):
    thesis = load_plant("thesis")
    path = write_policy(tmp_path / "policy.npz", linear_policy(thesis, 20.0, 1.0, velocity_box=(8.0,)))

    def publish(seen: Callable[[], object], what: str, spacing_ns: int, **state: float) -> None:
        stamps = itertools.count(time.time_ns(), spacing_ns)

        def answered() -> object:
            stamp = plant.publish(next(stamps), **state)
            # On a busy machine a state that is not waited for is overwritten by the next, and the rate seems another.
            deadline = time.monotonic() + 0.05
            while time.monotonic() < deadline and not (plant.commands and plant.commands[-1].stamp_ns >= stamp):
                plant.spin(0.005)
            return seen()

        plant.until(answered, what)

    def told() -> dict:
        return plant.diagnostics.get("/sim/controller: controller", {})

    policy = ("controller:=policy", f"policy:={path}", "state_timeout:=60.0")
    program = processes.start("pendulum_lqr", "controller", *ros(*policy))
    program.wait_for_output(r"policy for plant thesis: test \(swing_up, 4-1\) every 0\.01 s, fallback zero torque", 30)
    plant.connect()
    whole = pytest.approx(-(20.0 * math.sin(0.1) + 0.2), abs=1e-5)  # what it may ask for rises from zero
    publish(lambda: plant.commands and plant.commands[-1].effort[0] == whole, "all of its torque", 10_000_000)
    publish(lambda: plant.commands[-1].effort[0] == 0.0, "zero torque", 10_000_000, velocity=9.0)
    publish(lambda: "gave up" in told().get("message", ""), "the diagnostics", 10_000_000)
    assert told()["level"] == DiagnosticStatus.WARN
    program.wait_for_output(r"gave up after .* velocity 9 rad/s is outside of what it was trained for", 10)
    assert plant.commands[-1].effort[0] == 0.0
    program.send_signal(signal.SIGTERM)
    assert program.wait(15) == 0

    plant.commands.clear()
    for period in ((), ("period:=0.01",)):
        program = processes.start("pendulum_lqr", "controller", *ros(*policy, *period))
        plant.connect()
        publish(lambda output=program: "not answering" in output.output, "the refusal", 25_000_000)
        reason = r"not answering: states come every 0\.0\d+ s: policy 'test' was trained for a period of"
        program.wait_for_output(reason, 20)
        program.send_signal(signal.SIGTERM)
        assert program.wait(15) == 0
        # Whoever states a period is believed until the states say otherwise.
        assert period or not any(command.effort[0] for command in plant.commands)


def test_a_manager_can_hold_the_controller_and_deactivation_sends_zero(plant, processes):
    program = processes.start("pendulum_lqr", "controller", *ros("autostart:=false", "controller:=pd_gravity", PATIENT))
    plant.connect()
    plant.run(5)
    assert not plant.commands

    def change(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return plant.call(ChangeState, "controller/change_state", request).success

    assert change(Transition.TRANSITION_CONFIGURE)
    plant.run(5)
    assert not plant.commands
    assert change(Transition.TRANSITION_ACTIVATE)
    assert plant.answer() != 0.0
    assert change(Transition.TRANSITION_DEACTIVATE)
    plant.until(lambda: plant.commands[-1].effort[0] == 0.0, "the last zero")
    count = len(plant.commands)
    plant.run(5)
    assert len(plant.commands) == count
    assert change(Transition.TRANSITION_ACTIVATE)
    assert plant.answer() != 0.0
    program.interrupt()
    assert program.wait(15) == 0


def test_a_controller_that_waits_is_silent_until_it_is_activated_also_where_it_speaks_to_one_of_ros2_control(
    plant, processes
):
    told = ("autoactivate:=false", "command_type:=multi_array", PATIENT)
    program = processes.start("pendulum_lqr", "controller", *ros(*told))
    program.wait_for_output(r"waits inactive.*: /sim/controller/change_state", 30)
    plant.connect()
    plant.run(5)
    assert not plant.arrays
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
    assert plant.call(ChangeState, "controller/change_state", request).success
    plant.until(lambda: plant.publish() and plant.arrays, "commands")
    assert plant.arrays[-1] == pytest.approx(ANSWER, abs=1e-5)
    assert not plant.commands
    program.send_signal(signal.SIGINT)
    assert program.wait(15) == 0
    plant.until(lambda: plant.arrays[-1] == 0.0, "the last zero")


def test_the_disturbance_follows_seed_and_stamp_between_start_and_end_and_a_stopped_process_ends_it_with_zero(
    plant, processes
):
    program = processes.start("pendulum_lqr", "disturbance", *ros("seed:=7", "duration:=0.2"))
    plant.until(lambda: plant.publish() and plant.disturbances, "the first answer")
    # Stamps of a steady plant: a state is followed by the next once it is answered, however long that takes.
    stamps = itertools.count(time.time_ns(), 10_000_000)

    def answer(count: int) -> None:
        for stamp in itertools.islice(stamps, count):
            plant.until(
                lambda stamp=stamp: plant.publish(stamp) and plant.disturbances[-1].stamp_ns == stamp, "an answer"
            )

    answer(20)
    assert all(answer.effort[0] == 0.0 for answer in plant.disturbances)
    assert plant.call(Trigger, "disturbance/start", Trigger.Request()).success
    assert not plant.call(Trigger, "disturbance/start", Trigger.Request()).success
    running = plant.set_parameters("disturbance", amplitude=1.0)
    assert not running.successful
    assert "is running; expected ~/stop before a change" in running.reason
    count = len(plant.disturbances)
    answer(30)
    plant.until(lambda: len(plant.events) >= 2, "both events")
    begin, end = plant.events
    assert (begin["name"], end["name"]) == ("noise_start", "noise_end")
    assert begin["disturbance"]["seed"] == 7
    assert begin["disturbance"]["hold_time"] == 0.01
    signal_7 = make_disturbance({"seed": 7})
    allowed = {signal_7(k * 10_000_000) for k in range(21)}
    during = [a for a in plant.disturbances[count:] if begin["stamp_ns"] <= a.stamp_ns < end["stamp_ns"]]
    assert len(during) == 20
    assert {a.effort[0] for a in during} <= allowed
    assert end["stamp_ns"] - begin["stamp_ns"] == 200_000_000
    assert all(a.effort[0] == 0.0 for a in plant.disturbances if a.stamp_ns >= end["stamp_ns"])
    assert plant.set_parameters("disturbance", kind="step", duration=60.0).successful

    plant.events.clear()
    assert plant.call(Trigger, "disturbance/start", Trigger.Request()).success
    plant.until(lambda: plant.publish(next(stamps)) and plant.disturbances[-1].effort[0] == 2.5, "the step")
    program.send_signal(signal.SIGTERM)
    assert program.wait(15) == 0
    plant.until(lambda: plant.disturbances[-1].effort[0] == 0.0, "the last zero")
    assert plant.until(lambda: [e for e in plant.events if e["name"] == "noise_end"], "the event")


REFUSED: list[Refused] = [
    (("pendulum_lqr", "controller"), ["controller:=lrq"], "controller is 'lrq'; expected one of lqr, lqi"),
    (("pendulum_lqr", "controller"), ["r:=-0.5"], "r is -0.5"),
    (("pendulum_lqr", "controller"), ["r:=1"], "write 1.0"),
    (("pendulum_lqr", "controller"), ["plant:=nowhere"], "plant is 'nowhere'; expected one of the presets"),
    (("pendulum_lqr", "controller"), ["controller:=playback"], "file is empty; expected the path of a CSV"),
    (
        ("pendulum_lqr", "controller"),
        ["controller:=policy", "policy:=/dev/null"],
        "is a device or a pipe; expected a file",
    ),
    (("pendulum_lqr", "disturbance"), ["kind:=brown"], "kind is 'brown'; expected one of uniform"),
    (("pendulum_lqr", "disturbance"), ["kind:=from_bag"], "without a file"),
]


def test_a_bad_parameter_at_start_ends_the_program_with_one_sentence(domain_id):
    assert not_refused(REFUSED) == []


def test_a_recorded_disturbance_in_another_unit_is_refused(domain_id, tmp_path):
    refused = []
    for header, volts in (("time,torque", "true"), ("time,voltage", "false")):
        file = tmp_path / f"{volts}.csv"
        file.write_text(f"{header}\n0.0,1.0\n0.1,0.0\n")
        given = ["kind:=from_bag", f"file:={file}", f"volts:={volts}"]
        refused.append((("pendulum_lqr", "disturbance"), given, f"has the header '{header}', and volts is"))
    assert not_refused(refused) == []
