"""The bridge of several modules: a state needs all of them, and a fault of one releases all."""

from __future__ import annotations

from typing import Any

import pytest

from pendulum_hw_bridge.bridge.bridge import Bridge
from pendulum_hw_bridge.bridge.module import DrivenModule, Module
from pendulum_hw_bridge.drive.effort_mapping import EffortMapping, EffortStrategy
from pendulum_hw_bridge.drive.safety import SafetyLimits, SafetyMonitor
from pendulum_hw_bridge.port.actuator import ActuatorError, Feedback, Strategy
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.contract.drive import Drive, DriveKind, Mode, PlantLimits
from pendulum_msgs_py.contract.joints import Coordinates, Joint
from pendulum_msgs_py.contract.supervisor import PlantSupervisor
from pendulum_msgs_py.errors import ParameterError
from pendulum_testing.feedback_records import feedback_record
from pendulum_testing.scripted_port import DRIVETRAIN, PERIOD, STEP, Port

JOINTS = (Joint("shoulder"), Joint("elbow"))
BOTH = Coordinates(JOINTS, (0, 1))
ACROBOT = Coordinates(JOINTS, (1,))


class Rig:
    """A bridge on two scripted modules on one clock."""

    def __init__(self, coordinates: Coordinates = BOTH, **second: Any) -> None:
        self.ports = [Port(), Port()]
        self.coordinates = coordinates
        limits = PlantLimits(effort=(8.0,) * len(coordinates.driven), feedback_timeout=1.0, starvation=100.0)
        self.supervisor = PlantSupervisor(limits, coordinates=coordinates)
        self.modules = [self._module(index, **(second if index else {})) for index in (0, 1)]
        self.bridge = Bridge(self.modules, self.supervisor)
        self.count = 0

    def _module(self, index: int, **settings: Any) -> Module:
        port: Any = self.ports[index]
        limits = SafetyLimits(winding_current=0.0, pwm_tolerance=9.0, command_tolerance=9.0)
        monitor = SafetyMonitor(limits, PERIOD, DRIVETRAIN)
        name = JOINTS[index].name
        if index not in self.coordinates.driven:
            return Module(port, monitor, BridgeSettings(**settings), joint=name)
        mapping = EffortMapping(EffortStrategy.DIRECT_PWM, DRIVETRAIN, effort_limit=2.0)
        return DrivenModule(port, mapping, monitor, BridgeSettings(**settings), joint=name)

    def record(self, **given: Any) -> Feedback:
        self.count += 1
        return feedback_record(
            self.ports[0].time_ns, self.count, **{"voltage": 32.0, "deflection": self.count, **given}
        )

    def wait(self, duration_ns: int = STEP) -> None:
        for port in self.ports:
            port.time_ns += duration_ns

    def see(self, first: dict[str, Any] | None, second: dict[str, Any] | None) -> Any:
        """Let records of a cycle come, None for none, and the bridge observe them."""
        self.wait()
        for port, given in zip(self.ports, (first, second), strict=True):
            if given is not None:
                port.records.append(self.record(**given))
        return self.bridge.observe(0.0)

    def armed(self) -> Rig:
        self.bridge.connect()
        assert self.see({}, {}) is not None
        assert self.bridge.prepare() == ""
        assert self.supervisor.arm(self.ports[0].time_ns, self.bridge.sample) == ""
        for port in self.ports:
            port.calls.clear()
        return self

    def drive(self, *effort: float) -> Any:
        return self.bridge.carry_out(Drive(DriveKind.EFFORT, effort=effort, push=(0.0, 0.0)), was_armed=True)

    def all_off(self) -> bool:
        stopped = ["stop" in self.ports[index].calls for index in self.coordinates.driven]
        return all(stopped) and not any(drive.driving for drive in self.bridge.drives)


# --- one state of all -------------------------------------------------------------------------------------------


def test_a_state_has_each_joint_in_the_order_of_the_model_with_its_own_sign_offset_and_tare() -> None:
    rig = Rig(joint_sign=-1, joint_offset=1.0, effort_tare=0.5)
    rig.bridge.connect()
    sample = rig.see({"position": 0.25, "velocity": 0.5, "effort": 1.5}, {"position": 0.125, "effort": 2.0})
    assert sample is rig.bridge.sample
    assert sample[1:] == ((0.25, 0.875), (0.5, 0.0), (1.5, -2.5))


def test_there_is_no_new_state_while_a_module_has_sent_nothing_new() -> None:
    rig = Rig()
    rig.bridge.connect()
    assert rig.see({}, None) is None
    assert rig.bridge.records == ()
    assert rig.see({}, {}) is not None
    assert rig.see(None, {}) is None
    assert rig.see({}, None) is None, "the record of a period ago is no part of a new state"
    assert rig.see({}, {}) is not None


def test_records_within_half_a_period_make_a_state_that_is_as_old_as_the_older() -> None:
    rig = Rig()
    rig.bridge.connect()
    for lead, together in ((round(0.5e9 * PERIOD), True), (round(0.5e9 * PERIOD) + 1, False)):
        rig.wait()
        rig.ports[0].records.append(rig.record())
        older = rig.ports[0].time_ns
        rig.wait(lead)
        rig.ports[1].records.append(rig.record())
        sample = rig.bridge.observe(0.0)
        assert (sample is not None) == together
        assert sample is None or sample.stamp_ns == older


# --- driving ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead", [0, 1])
def test_the_older_record_of_two_waits_for_its_next_whichever_joint_it_is_of(ahead: int) -> None:
    rig = Rig()
    rig.bridge.connect()
    rig.ports[1 - ahead].records.append(rig.record())
    rig.wait()
    rig.ports[ahead].records.append(rig.record())
    assert rig.bridge.observe(0.0) is None
    # Only the older one is asked for again.
    rig.ports[1 - ahead].records.append(rig.record())
    assert rig.bridge.observe(0.0) is not None


def test_each_driven_joint_gets_its_own_torque_and_its_own_push() -> None:
    rig = Rig().armed()
    drive = Drive(DriveKind.EFFORT, effort=(1.0, -0.5), push=(0.25, -0.75))
    outcome = rig.bridge.carry_out(drive, was_armed=True)
    assert outcome.effort == (1.0, -0.5)
    assert [applied.command.pwm for applied in outcome.applied] == [0.25, -0.125]
    assert [port.commands[-1].pwm for port in rig.ports] == [0.25, -0.125]
    assert [port.pushes for port in rig.ports] == [[0.25], [-0.75]]


def test_a_passive_joint_is_read_and_nothing_else() -> None:
    rig = Rig(ACROBOT).armed()
    assert rig.drive(1.0).effort == (1.0,)
    assert rig.ports[1].commands[-1].pwm == 0.25
    rig.bridge.release()
    rig.bridge.close()
    assert rig.ports[0].commands == []
    assert {call.split()[0] for call in rig.ports[0].calls} <= {"connect", "read", "close"}


def test_position_setpoints_reach_the_driven_joint_that_they_are_for() -> None:
    rig = Rig().armed()
    drive = Drive(DriveKind.POSITION, (0.0, 0.0), (0.5, -0.5), (0.3, -0.2), push=(0.0, 0.0))
    rig.bridge.carry_out(drive, was_armed=True)
    assert [port.commands[-1].velocity for port in rig.ports] == pytest.approx([0.3, -0.2], abs=1e-3)
    assert [port.commands[-1].position for port in rig.ports] == pytest.approx([0.5, -0.5], abs=1e-3)


# --- a fault of one is a fault of all -----------------------------------------------------------------------------


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("faulty", [0, 1])
@pytest.mark.parametrize(
    ("given", "fault"), [({"m_stop": True}, "m_stop"), ({"position": float("nan")}, "feedback_not_finite")]
)
def test_a_fault_of_any_module_releases_all_and_names_its_joint(
    coordinates: Coordinates, faulty: int, given: dict[str, Any], fault: str
) -> None:
    rig = Rig(coordinates).armed()
    rig.drive(*(1.0 for _ in coordinates.driven))
    rig.see(*(given if index == faulty else {} for index in (0, 1)))
    assert rig.all_off()
    assert rig.supervisor.mode is Mode.FAULT
    assert rig.supervisor.reason.startswith(f"{fault}: {JOINTS[faulty].name}: ")
    assert rig.bridge.last_fault == fault


@pytest.mark.parametrize("coordinates", [BOTH, ACROBOT])
@pytest.mark.parametrize("silent", [0, 1])
def test_a_module_that_falls_silent_beside_a_fresh_one_releases_all(coordinates: Coordinates, silent: int) -> None:
    rig = Rig(coordinates).armed()
    seen = [rig.see(*(None if index == silent else {} for index in (0, 1))) for _ in range(5)]
    assert seen == 5 * [None]
    assert rig.all_off()
    assert rig.supervisor.reason.startswith(f"feedback_lost: {JOINTS[silent].name}: ")


def test_a_module_that_cannot_be_read_releases_all() -> None:
    rig = Rig().armed()
    rig.ports[1].fails["read"] = ActuatorError("module_lost", "gone")
    rig.see({}, {})
    assert rig.all_off()
    assert rig.supervisor.reason == "module_lost: elbow: gone"


@pytest.mark.parametrize("broken", [0, 1])
def test_a_setpoint_that_cannot_be_sent_to_one_releases_all(broken: int) -> None:
    rig = Rig().armed()
    rig.ports[broken].fails["write"] = ActuatorError("send_failed", "network down")
    outcome = rig.drive(1.0, 1.0)
    assert (outcome.drive.kind, outcome.effort, outcome.fault) == (DriveKind.OFF, (0.0, 0.0), "send_failed")
    assert rig.all_off()
    assert rig.supervisor.reason == f"send_failed: {JOINTS[broken].name}: network down"


@pytest.mark.parametrize("broken", [(0,), (1,), (0, 1)])
def test_all_are_released_whatever_one_of_them_raises_and_are_asked_again(broken: tuple[int, ...]) -> None:
    rig = Rig().armed()
    rig.drive(1.0, 1.0)
    for index in broken:
        rig.ports[index].fails["stop"] = RuntimeError(f"broken {index}")
    rig.bridge.fail("m_stop", "pressed")
    assert all("stop" in port.calls for port in rig.ports)
    assert not any(module.driving for module in rig.bridge.drives)
    assert rig.bridge.stop_pending
    assert rig.bridge.faults == {"m_stop": 1, "exception": len(broken)}
    assert rig.bridge.prepare() == "the module has not confirmed that it is off"
    for port in rig.ports:
        port.fails.clear()
        port.calls.clear()
    rig.wait(100_000_000)
    rig.bridge.insist()
    assert all("stop" in port.calls for port in rig.ports)
    assert not rig.bridge.stop_pending


def test_closing_releases_all_even_if_one_of_them_raises() -> None:
    rig = Rig().armed()
    rig.ports[0].fails["close"] = RuntimeError("broken")
    rig.bridge.close()
    assert rig.all_off()
    assert all("close" in port.calls for port in rig.ports)


# --- arming -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("broken", [0, 1])
def test_it_is_not_armed_while_one_module_does_not_keep_its_strategy(broken: int) -> None:
    rig = Rig()
    rig.bridge.connect()
    rig.see({}, {})
    rig.ports[broken].reads_strategy = Strategy.OFF
    assert "strategy reads back" in rig.bridge.prepare()
    assert rig.all_off()


@pytest.mark.parametrize("late", [0, 1])
def test_it_is_not_armed_before_each_module_has_spoken_and_names_the_one_that_has_not(late: int) -> None:
    rig = Rig(ACROBOT)
    rig.bridge.connect()
    rig.see(*(None if index == late else {} for index in (0, 1)))
    assert rig.bridge.prepare() == f"{JOINTS[late].name}: no feedback yet"


@pytest.mark.parametrize("aged", [0, 1])
def test_before_arming_a_module_is_looked_at_again_whose_record_has_grown_old(aged: int) -> None:
    rig = Rig()
    rig.bridge.connect()
    rig.see({}, {})
    rig.see(*(None if index == aged else {} for index in (0, 1)))
    rig.wait(1)
    rig.ports[aged].records.append(rig.record(m_stop=True))
    assert rig.bridge.prepare().startswith(f"m_stop: {JOINTS[aged].name}: ")
    assert rig.all_off()


def test_a_passive_module_says_who_it_is_and_must_keep_the_rate() -> None:
    rig = Rig(ACROBOT)
    assert rig.bridge.connect() == tuple(module.info for module in rig.modules) == ("connected 2", "connected 2")
    rig.ports[0].set_feedback_rate = lambda rate: 50.0  # type: ignore[method-assign]
    with pytest.raises(ActuatorError, match="feedback rate reads back as 50 Hz; expected 100 Hz"):
        rig.bridge.connect()


def test_no_torque_is_sent_where_one_drive_was_released_before_the_plant_was_armed() -> None:
    rig = Rig().armed()
    drive = rig.bridge.drives[1]
    assert drive.stop() is None
    outcome = rig.drive(1.0, 1.0)
    assert (outcome.fault, outcome.effort) == ("not_prepared", (0.0, 0.0))
    assert rig.all_off()


# --- whose module is whose -----------------------------------------------------------------------------------------


def test_modules_of_swapped_missing_foreign_or_repeated_joints_are_refused() -> None:
    first, second = Rig().modules
    supervisor = Rig().supervisor
    for modules in ([second, first], [first, first], [first, _named(second, "wrist")]):
        names = [module.joint for module in modules]
        with pytest.raises(ParameterError) as refused:
            Bridge(modules, supervisor)
        assert str(refused.value) == f"modules are those of {names}; expected ['shoulder', 'elbow']"
    for modules in ([first], [first, second, second]):
        with pytest.raises(ParameterError, match=f"there are {len(modules)} modules"):
            Bridge(modules, supervisor)


def test_a_motor_where_the_plant_has_none_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"with motors at \[0, 1\]; expected 2, with motors at \[1\]"):
        Bridge(Rig().modules, Rig(ACROBOT).supervisor)


def _named(module: Module, joint: str) -> Module:
    module.joint = joint
    return module
