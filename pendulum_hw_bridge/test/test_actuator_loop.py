"""The thread that owns the actuator, on the wall clock: cycles, jobs, errors, and the way out."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.bridge import actuator_loop
from pendulum_hw_bridge.bridge.actuator_loop import ActuatorLoop
from pendulum_hw_bridge.bridge.bridge import Bridge, Outcome
from pendulum_hw_bridge.bridge.module import DrivenModule
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.port.actuator import ActuatorError, Feedback, Strategy
from pendulum_hw_bridge.port.clocks import WallClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.shared_supervisor import SharedSupervisor
from pendulum_msgs_py.contract.supervisor import Drive, DriveKind, Input, Mode, PlantLimits
from pendulum_msgs_py.contract.timing import LoopStatistics
from pendulum_msgs_py.contract.values import JointCommand, JointSample


class Running:
    """A loop on the emulator in real time; patient, because the machine may be busy."""

    def __init__(self) -> None:
        parameters = load_emulator("thesis")
        clock = WallClock()
        self.actuator = EmulatedX5(parameters, seed=1, start_ns=clock.now_ns())
        self.port = EmulatorBackend(self.actuator, clock)
        self.supervisor = SharedSupervisor(
            PlantLimits(effort=(13.0,), command_timeout=5.0, feedback_timeout=5.0), self._prepare
        )
        self.module = DrivenModule(
            self.port,
            EffortMapping(EffortStrategy.DIRECT_PWM, parameters.drivetrain),
            SafetyMonitor(SafetyLimits(feedback_cycles=500), 0.01, parameters.drivetrain),
            BridgeSettings(gains=DEFAULT_GAINS[3], command_lifetime=5.0),
        )
        self.bridge = Bridge([self.module], self.supervisor)
        self.states: list[JointSample] = []
        self.outcomes: list[tuple[int, Outcome]] = []
        self.recorded: list[tuple[int, int]] = []
        """Stamp of each cycle's feedback record, and how many outcomes there were when it came."""
        self.errors: list[str] = []
        self.threads: set[int] = set()
        self.strategies: list[Strategy] = []
        """Strategy of the actuator when each feedback record came."""
        self.on_state: Callable[[JointSample], None] = lambda sample: None
        self.decide: Callable[[], object] = lambda: None
        self.on_outcome: Callable[[Outcome], object] = lambda outcome: None
        self.on_records: Callable[[tuple[Feedback, ...]], object] = lambda records: None
        self.take_inputs: Callable[[float], object] = time.sleep
        self.loop = ActuatorLoop(
            self.bridge,
            LoopStatistics(10_000_000),
            on_state=self._on_state,
            decide=self._decide,
            on_outcome=self._on_outcome,
            on_records=self._on_records,
            take_inputs=self._take_inputs,
            report=self.errors.append,
        )
        self.loop.call(self.bridge.connect)

    def _prepare(self) -> str:
        return self.loop.call(self.bridge.prepare)

    def _take_inputs(self, wait: float) -> None:
        self.take_inputs(wait)

    def _on_state(self, sample: JointSample) -> None:
        self.threads.add(threading.get_ident())
        self.states.append(sample)
        self.on_state(sample)

    def _on_outcome(self, stamp_ns: int, outcome: Outcome) -> None:
        self.outcomes.append((stamp_ns, outcome))
        self.on_outcome(outcome)

    def _on_records(self, records: tuple[Feedback, ...]) -> None:
        self.strategies.append(self.actuator.strategy)
        self.recorded.append((records[0].stamp_ns, len(self.outcomes)))
        self.on_records(records)

    def _decide(self) -> Drive:
        self.decide()
        return self.supervisor.decide(self.port.now_ns(), self.bridge.sample)

    def until(self, predicate: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + 20.0
        while not predicate():
            assert time.monotonic() < deadline, f"waited 20 s for {what}"
            time.sleep(0.005)

    def arm(self) -> None:
        self.loop.active = True
        self.until(lambda: self.states, "states")
        assert self.supervisor.arm(self.port.now_ns(), self.states[-1]) == ""


@pytest.fixture
def running() -> Iterator[Running]:
    rig = Running()
    yield rig
    rig.loop.close()


def test_states_come_from_one_thread_and_each_is_acted_upon_once(running: Running) -> None:
    running.loop.active = True
    running.until(lambda: len(running.outcomes) > 30, "outcomes")
    running.loop.active = False
    running.loop.call(lambda: None)
    assert running.threads == {running.loop._thread.ident}
    assert [stamp for stamp, _ in running.outcomes] == [sample.stamp_ns for sample in running.states]
    assert all(outcome.effort == (0.0,) for _, outcome in running.outcomes)


def test_a_feedback_record_comes_behind_what_was_done_with_its_state(running: Running) -> None:
    running.loop.active = True
    running.until(lambda: len(running.recorded) > 30, "records")
    running.loop.active = False
    running.loop.call(lambda: None)
    stamps = [stamp for stamp, _ in running.outcomes]
    assert running.recorded == [(stamp, count) for count, stamp in enumerate(stamps, start=1)]


def test_an_answer_is_acted_upon_in_the_cycle_of_its_state(running: Running) -> None:
    def answer(wait: float) -> None:
        command = JointCommand.of_one(running.states[-1].stamp_ns, 0.4, "c")
        if running.supervisor.offer(Input.EFFORT_COMMAND, command, running.port.now_ns()) is None:
            running.loop.answered(Input.EFFORT_COMMAND, command)

    running.arm()
    running.take_inputs = answer
    running.until(lambda: running.outcomes[-1][1].effort != (0.0,), "torque")
    assert running.outcomes[-1][1].effort == pytest.approx((0.4,), abs=1e-9)
    running.until(lambda: running.actuator.link.pwm != 0.0, "a duty on the motor")
    assert running.loop.statistics.answered_age.count > 0


def test_a_cycle_waits_for_an_answer_only_in_its_window_and_no_longer_once_it_has_come(running: Running) -> None:
    waits: list[float] = []

    def answer(wait: float) -> None:
        waits.append(wait)
        command = JointCommand.of_one(running.states[-1].stamp_ns, 0.4, "c")
        if running.supervisor.offer(Input.EFFORT_COMMAND, command, running.port.now_ns()) is None:
            running.loop.answered(Input.EFFORT_COMMAND, command)

    running.arm()
    running.take_inputs = answer
    running.until(lambda: running.loop.statistics.answered_age.count > 5, "answers")
    # Whoever answers at the first look is not waited for again.
    assert 0 < sum(wait > 0.0 for wait in waits) <= len(running.states)
    waits.clear()
    running.take_inputs = lambda wait: (waits.append(wait), time.sleep(wait))
    count = len(running.outcomes)
    # A cycle that begins late on a busy computer has no time left to wait.
    running.until(lambda: len(running.outcomes) > count + 3 and any(waits), "a wait for a late answer")
    asked = [wait for wait in waits if wait]
    assert max(asked) <= 0.3 * 0.01


_BOTH = frozenset({Input.EFFORT_COMMAND, Input.DISTURBANCE})


class _Waiting:
    """A loop of which only the wait for answers is there, in a time of its own: each look ends with a message."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, window: float, looks: list[set[Input]]) -> None:
        self.now = 0.0
        self.waits: list[float] = []
        self._looks = looks
        self.loop: Any = SimpleNamespace(
            _window=window, _answered=set(), _closing=threading.Event(), _take_inputs=self._take
        )
        monkeypatch.setattr(actuator_loop, "time", SimpleNamespace(monotonic=lambda: self.now))

    def _take(self, wait: float) -> None:
        assert len(self.waits) < 20, "it waits without end"
        self.waits.append(wait)
        self.now += min(wait, 1.0)
        self.loop._answered |= self._looks.pop(0) if self._looks else set()

    def wait(self, awaited: frozenset[Input]) -> list[float]:
        ActuatorLoop._wait_for_answers(self.loop, set(awaited))
        return self.waits


@pytest.mark.parametrize(
    ("looks", "waits"),
    [
        ([set(_BOTH)], [3.0]),
        ([{Input.EFFORT_COMMAND}, {Input.DISTURBANCE}], [3.0, 2.0]),
        ([{Input.DISTURBANCE}, set(), {Input.EFFORT_COMMAND}], [3.0, 2.0, 1.0]),
        ([], [3.0, 2.0, 1.0]),
    ],
    ids=["both_at_once", "one_after_the_other", "one_between_strangers", "a_flood_of_strangers"],
)
def test_a_wait_is_for_all_who_are_awaited_and_no_message_makes_it_longer(
    monkeypatch: pytest.MonkeyPatch, looks: list[set[Input]], waits: list[float]
) -> None:
    assert _Waiting(monkeypatch, window=3.0, looks=looks).wait(_BOTH) == waits


def test_where_nobody_is_awaited_what_has_come_is_taken_and_nothing_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _Waiting(monkeypatch, window=3.0, looks=[]).wait(frozenset()) == [0.0]


def test_without_a_window_what_has_come_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _Waiting(monkeypatch, window=0.0, looks=[]).wait(_BOTH) == [0.0]


def test_a_loop_that_closes_waits_for_no_further_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = _Waiting(monkeypatch, window=3.0, looks=[])
    waiting.loop._closing.set()
    assert waiting.wait(_BOTH) == [3.0]


def test_awaited_are_those_who_answered_an_armed_plant_lately() -> None:
    supervisor = SharedSupervisor(PlantLimits(effort=(13.0,), command_timeout=0.5, feedback_timeout=0.5))
    loop: Any = SimpleNamespace(bridge=SimpleNamespace(supervisor=supervisor))

    def awaited(now_ns: int) -> set[Input]:
        return ActuatorLoop._awaited(loop, now_ns)

    def offer(kind: Input, now_ns: int) -> None:
        assert supervisor.offer(kind, JointCommand.of_one(now_ns, 0.1, kind.value), now_ns) is None

    offer(Input.EFFORT_COMMAND, 1)
    assert awaited(1) == set()
    assert supervisor.arm(2, JointSample.of_one(2, 0.0, 0.0, 0.0)) == ""
    # What came before counts for nothing; a first answer is not waited for.
    assert awaited(2) == set()
    offer(Input.DISTURBANCE, 3)
    assert awaited(3) == {Input.DISTURBANCE}
    offer(Input.EFFORT_COMMAND, 400_000_000)
    assert awaited(400_000_000) == _BOTH
    assert awaited(600_000_000) == {Input.EFFORT_COMMAND}
    supervisor.e_stop(600_000_001)
    assert awaited(600_000_001) == set()


def test_only_an_answer_to_the_newest_state_counts_and_only_a_torque_has_an_age() -> None:
    ages: list[int] = []
    loop: Any = SimpleNamespace(
        _state_ns=5,
        _answered=set(),
        statistics=SimpleNamespace(act_on_age=ages.append),
        bridge=SimpleNamespace(now_ns=lambda: 9),
    )
    ActuatorLoop.answered(loop, Input.EFFORT_COMMAND, JointCommand.of_one(4, 0.1, "c"))
    assert (loop._answered, ages) == (set(), [5])
    ActuatorLoop.answered(loop, Input.DISTURBANCE, JointCommand.of_one(5, 0.1, "d"))
    assert (loop._answered, ages) == ({Input.DISTURBANCE}, [5])


def test_whoever_answered_a_state_has_not_answered_the_next(running: Running) -> None:
    def answer(wait: float) -> None:
        command = JointCommand.of_one(running.states[-1].stamp_ns, 0.1, "c")
        if running.supervisor.offer(Input.EFFORT_COMMAND, command, running.port.now_ns()) is None:
            running.loop.answered(Input.EFFORT_COMMAND, command)

    at_state: list[set[Input]] = []
    at_outcome: list[set[Input]] = []
    running.arm()
    running.on_state = lambda sample: at_state.append(set(running.loop._answered))
    running.on_outcome = lambda outcome: at_outcome.append(set(running.loop._answered))
    running.take_inputs = answer
    running.until(lambda: len(at_outcome) > 5, "outcomes")
    assert {Input.EFFORT_COMMAND} in at_outcome
    assert not any(at_state)
    assert running.loop.statistics.cycles >= len(at_outcome)


def test_an_e_stop_pressed_while_the_cycle_waits_for_an_answer_ends_torque_in_that_cycle(running: Running) -> None:
    running.arm()
    command = JointCommand.of_one(running.port.now_ns(), 0.1, "c")
    assert running.supervisor.offer(Input.EFFORT_COMMAND, command, running.port.now_ns()) is None
    pressed: list[int] = []

    def press(wait: float) -> None:
        if wait > 0.0 and not pressed:
            pressed.append(running.states[-1].stamp_ns)
            running.supervisor.e_stop(running.port.now_ns())

    running.take_inputs = press
    running.until(lambda: pressed and pressed[0] in [stamp for stamp, _ in running.recorded], "the record")
    outcome = dict(running.outcomes)[pressed[0]]
    assert (outcome.drive.kind, outcome.effort, outcome.fault) == (DriveKind.OFF, (0.0,), "")
    leaving = running.strategies[[stamp for stamp, _ in running.recorded].index(pressed[0])]
    assert leaving is Strategy.OFF


def test_while_no_record_comes_commands_are_taken_and_silence_is_acted_upon() -> None:
    done: list[object] = []
    loop: Any = SimpleNamespace(
        bridge=SimpleNamespace(observe=done.append),
        _take_inputs=done.append,
        _act_between=lambda: done.append("act"),
    )
    ActuatorLoop._cycle(loop)
    # A wait for nothing: the next record may be there already.
    assert done == [0.005, 0.0, "act"]


def test_the_record_of_a_cycle_in_which_the_loop_is_requested_to_rest_still_leaves(running: Running) -> None:
    running.on_outcome = lambda outcome: setattr(running.loop, "active", False)
    running.loop.active = True
    running.until(lambda: running.outcomes and not running.loop.active, "an outcome")
    running.loop.call(lambda: None)
    assert [stamp for stamp, _ in running.recorded] == [stamp for stamp, _ in running.outcomes]


class _PassingTime(WallClock):
    """Wall time that passes when somebody waits; keeps what each wait was for."""

    def __init__(self, on_wait: Callable[[int], None]) -> None:
        self.now = 0
        self._on_wait = on_wait

    def now_ns(self) -> int:
        return self.now

    def wait_until(self, time_ns: int) -> None:
        self._on_wait(time_ns)
        self.now = max(self.now, time_ns)


def test_a_record_is_computed_while_it_is_on_its_way_and_not_when_it_should_be_there():
    under_way: list[tuple[int, int | None]] = []
    clock = _PassingTime(lambda target: under_way.append((target, actuator.next_delivery_ns)))
    actuator = EmulatedX5(load_emulator("thesis"), seed=1, start_ns=0)
    port = EmulatorBackend(actuator, clock)
    port.connect()
    waited_for = 0
    for _ in range(50):
        under_way.clear()
        feedback = port.read(0.1)
        assert feedback is not None
        if under_way[-1][1] is not None:
            # The last wait was for a record that is there already, and for nothing longer.
            assert under_way[-1] == (feedback.stamp_ns, feedback.stamp_ns) == (clock.now, clock.now)
            waited_for += 1
        else:
            # Measured at the begin of a step of the emulation, it may be due before the measurement is.
            assert feedback.stamp_ns <= clock.now < feedback.stamp_ns + 250_000
    assert waited_for > 25


def test_an_error_in_a_cycle_releases_the_drive_and_is_reported(running: Running) -> None:
    running.arm()

    def fail(sample: JointSample) -> None:
        raise ValueError("a bug")

    running.on_state = fail
    running.until(lambda: running.supervisor.mode is Mode.FAULT, "the fault")
    assert "exception: ValueError: a bug" in running.supervisor.reason
    running.until(lambda: running.actuator.strategy is Strategy.OFF, "the drive to be off")
    running.until(lambda: running.errors, "the report")
    # Of a cycle that broke, what was measured is what explains it.
    broken = running.states[len(running.outcomes)].stamp_ns
    running.until(lambda: (broken, len(running.outcomes)) in running.recorded, "its record")
    running.on_state = lambda sample: None
    count = len(running.outcomes)
    running.until(lambda: len(running.outcomes) > count, "states again")


@pytest.mark.parametrize("step", ["on_state", "take_inputs", "decide", "on_outcome", "on_records"])
def test_whichever_step_breaks_the_drive_is_off_before_the_record_of_that_cycle_leaves(
    running: Running, step: str
) -> None:
    running.arm()
    broken: list[int] = []

    def fail(*_: object) -> None:
        newest = running.states[-1].stamp_ns
        # Between two cycles inputs are taken and decisions made as well.
        if step == "on_records" or newest not in [stamp for stamp, _ in running.recorded]:
            broken.append(newest)
            raise ValueError(step)

    setattr(running, step, fail)
    running.until(lambda: running.errors, "the report")
    assert running.errors[0] == f"cycle of the actuator failed: ValueError: {step}"
    assert running.supervisor.mode is Mode.FAULT
    assert running.actuator.strategy is Strategy.OFF
    running.until(lambda: broken[0] in [stamp for stamp, _ in running.recorded], "the record of the broken cycle")
    leaving = running.strategies[[stamp for stamp, _ in running.recorded].index(broken[0])]
    assert leaving is (Strategy.DIRECT_PWM if step == "on_records" else Strategy.OFF)


def test_when_something_breaks_the_drive_is_off_before_anything_is_reported_and_the_loop_rests_a_period() -> None:
    done: list[str] = []
    loop: Any = SimpleNamespace(
        bridge=SimpleNamespace(
            fail=lambda name, message: done.append(f"{name}: {message}"), release=lambda: done.append("release")
        ),
        _report=lambda text: done.append("report"),
        _pause=lambda: done.append("pause"),
    )

    def step() -> None:
        raise ValueError("a bug")

    ActuatorLoop._guarded(loop, step)
    assert done == ["exception: ValueError: a bug", "release", "report", "pause"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_ends_in_whatever_way_releases_the_drive(running: Running) -> None:
    def leave(sample: JointSample) -> None:
        raise SystemExit

    running.arm()
    running.on_state = leave
    running.until(lambda: not running.loop._thread.is_alive(), "the end of the thread")
    assert running.actuator.strategy is Strategy.OFF
    assert not running.supervisor.mode.armed
    with pytest.raises(ActuatorError, match="actuator thread has ended"):
        running.loop.call(lambda: None)


def test_an_error_of_a_job_goes_to_its_caller(running: Running) -> None:
    with pytest.raises(ZeroDivisionError):
        running.loop.call(lambda: 1 / 0)
    assert running.loop.call(lambda: 7) == 7


def test_a_job_for_a_busy_thread_ends_in_time(running: Running) -> None:
    begun, busy = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: running.loop.call(lambda: (begun.set(), busy.wait(20.0))))
    thread.start()
    assert begun.wait(20.0)
    with pytest.raises(ActuatorError, match=r"did not answer within 0\.05 s"):
        running.loop.call(lambda: None, timeout=0.05)
    busy.set()
    thread.join()


def test_closing_releases_the_drive_and_a_closed_loop_takes_no_jobs(running: Running) -> None:
    running.arm()
    assert running.actuator.strategy is Strategy.DIRECT_PWM
    running.loop.close()
    assert running.actuator.strategy is Strategy.OFF
    with pytest.raises(ActuatorError, match="actuator thread has ended"):
        running.loop.call(lambda: None)


def test_a_stop_that_was_not_confirmed_is_asked_for_again_though_the_loop_is_not_active(running: Running) -> None:
    running.arm()
    running.actuator.inject(ActuatorFault.COMMANDS_LOST)
    running.loop.active = False
    running.supervisor.disarm(running.port.now_ns())
    running.loop.call(running.bridge.release)
    assert running.bridge.stop_pending
    running.loop.call(running.actuator.clear_faults)
    running.until(lambda: not running.bridge.stop_pending, "the stop to be confirmed")
    assert running.actuator.strategy is Strategy.OFF


@pytest.mark.parametrize(
    ("kind", "starved", "acts"),
    [(DriveKind.OFF, False, True), (DriveKind.EFFORT, True, True), (DriveKind.EFFORT, False, False)],
)
def test_between_two_records_whatever_ends_torque_is_carried_out_and_nothing_else(
    kind: DriveKind, starved: bool, acts: bool
) -> None:
    carried: list[object] = []
    drive = SimpleNamespace(kind=kind, starved=starved)
    loop = SimpleNamespace(
        bridge=SimpleNamespace(
            supervisor=SimpleNamespace(mode=Mode.EFFORT),
            carry_out=lambda drive, was_armed: carried.append((drive, was_armed)),
        ),
        _decide=lambda: drive,
    )
    ActuatorLoop._act_between(loop)  # type: ignore[arg-type]
    assert carried == ([(drive, True)] if acts else [])


def test_a_job_that_was_not_begun_in_time_is_never_run() -> None:
    late: list[bool] = []
    loop = SimpleNamespace(
        _thread=SimpleNamespace(is_alive=lambda: True), _jobs=queue.SimpleQueue(), _job_waiting=threading.Event()
    )
    with pytest.raises(ActuatorError, match="did not answer within 0 s"):
        ActuatorLoop.call(loop, lambda: late.append(True), timeout=0.0)  # type: ignore[arg-type]
    # Whoever was told that it did not run must not find it run later: arming would be such a job.
    ActuatorLoop._run_jobs(loop)  # type: ignore[arg-type]
    assert late == []
