"""The checklist of a machine of several modules: lines of each joint, and modules that are not those of the joints."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from pendulum_hw_bridge.backends.emulated_machine import DrivePort, JointPort
from pendulum_hw_bridge.bridge.assembly import assemble, for_plant
from pendulum_hw_bridge.bridge.module import Module
from pendulum_hw_bridge.bridge.node_specs import SPECS
from pendulum_hw_bridge.checks import check_cli
from pendulum_hw_bridge.checks.check_item import HOST_ITEM, Checklist
from pendulum_hw_bridge.checks.machine_checklist import names_problem, run_machine_checklist
from pendulum_hw_bridge.emulation.faults import ActuatorFault
from pendulum_hw_bridge.port.actuator import ActuatorError, Strategy
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_msgs_py.parameters import validate
from pendulum_msgs_py.plants.plant_parameters import load_mechanism


class Punctual:
    """A computer that wakes in time."""

    def start(self) -> None:
        """Begin."""

    def poll(self) -> None:
        """Nothing keeps a reader of simulated time from looking."""

    def stop(self) -> Sequence[float]:
        """Return the lateness of each waking [s]."""
        return [0.0]


class Machine:
    """The modules of a plant as the bridge makes them, on a clock that is stepped."""

    def __init__(self, plant: str, **given: Any) -> None:
        specs = for_plant(SPECS, plant)
        assembly = assemble(validate(specs, {"plant": plant, "backend": "emulator", **given}), specs)
        self.parameters = load_mechanism(plant)
        self.modules: list[Module] = assembly.modules(SteppedClock())
        self.windows = list(zip(assembly.limits.position_min, assembly.limits.position_max, strict=True))
        port = self.modules[0].port
        assert isinstance(port, JointPort)
        self.machine = port.machine
        self.efforts: list[float] = []
        self.switched: list[bool] = []
        deliver, switch = self.machine.deliver, self.machine.switch

        def deliver_and_note(index: int, effort: float, sent_ns: int) -> None:
            self.efforts.append(effort)
            deliver(index, effort, sent_ns)

        def switch_and_note(index: int, now_ns: int, *, on: bool) -> None:
            self.switched.append(on)
            switch(index, now_ns, on=on)

        self.machine.deliver, self.machine.switch = deliver_and_note, switch_and_note  # type: ignore[method-assign]

    def called(self, *names: str) -> Machine:
        """Let the modules say other names."""
        for module, name in zip(self.modules, names, strict=True):
            connect = module.port.connect
            module.port.connect = lambda connect=connect, name=name: replace(connect(), name=name)  # type: ignore[method-assign]
        return self

    def checked(self) -> Checklist:
        return run_machine_checklist(self.modules, self.parameters, self.windows, host=Punctual)


def failed(found: Checklist) -> list[str]:
    return [item.name for item in found.items if not item.passed]


@pytest.mark.parametrize("plant", ["cart_pole", "acrobot", "pendubot", "double_pendulum", "furuta", "qube_servo"])
def test_a_healthy_machine_passes_the_lines_of_each_joint_and_no_motor_gets_an_effort(plant: str) -> None:
    machine = Machine(plant)
    found = machine.checked()
    assert found.ready, failed(found)
    names = [item.name for item in found.items]
    assert len(set(names)) == len(names)
    coordinates = machine.parameters.coordinates
    for index, joint in enumerate(coordinates.names):
        driven = index in coordinates.driven
        assert (f"{joint}: effort limit reads back" in names) == driven
        assert (f"{joint}: the loop of effort can be set" in names) == driven
        assert (f"{joint}: passive joint is only read" in names) == (not driven)
        assert f"{joint}: the bridge finds no fault" in names
        assert found.figures[f"{joint}.rate_hz"] == pytest.approx(500.0, rel=0.01)
    assert set(machine.efforts) <= {0.0}
    assert machine.machine.state[2] == (0.0, 0.0)
    assert not any(drive.on for drive in machine.machine.drives)
    assert sum(machine.switched) == len(coordinates.driven)


def test_the_lines_of_a_cart_are_in_its_units() -> None:
    found = Machine("cart_pole").checked()
    seen = {item.name: (item.seen, item.expected) for item in found.items}
    assert seen["cart: effort limit reads back"] == ("10 N", "10 N")
    assert seen["cart: position is inside its window"] == ("0.000 m", "-1.8 to 1.8 m")
    assert seen["cart: joint is at rest"][1] == "at most 0.05 m/s"
    assert seen["pole: nothing drives it"] == ("0.000 N m", "0 within 0 N m")
    assert "cart: hanging is zero" not in seen


@pytest.mark.parametrize(
    ("fault", "joint", "line"),
    [
        (ActuatorFault.M_STOP, 0, "cart: motion stop is released"),
        (ActuatorFault.M_STOP, 1, "pole: motion stop is released"),
        (ActuatorFault.FEEDBACK_LOST, 1, "pole: feedback flows"),
        (ActuatorFault.POSITION_NAN, 1, "pole: position, velocity, effort are numbers"),
        (ActuatorFault.COMMANDS_LOST, 0, "cart: no_acknowledgement"),
        (ActuatorFault.EFFORT_OFFSET, 0, "cart: nothing drives it"),
    ],
)
def test_each_defect_fails_a_line_of_its_own_joint(fault: ActuatorFault, joint: int, line: str) -> None:
    machine = Machine("cart_pole")
    machine.machine.faults[joint].add(fault)
    found = machine.checked()
    assert line in failed(found)
    assert found.refused
    other = machine.parameters.coordinates.names[1 - joint]
    assert not [name for name in failed(found) if name.startswith(f"{other}:")]


def test_a_plant_that_does_not_hang_at_rest_is_refused() -> None:
    found = Machine("cart_pole", initial_positions=[0.0, 1.0]).checked()
    assert {"pole: joint is at rest"} <= set(failed(found))
    away = Machine("cart_pole", initial_positions=[0.5, 0.0], position_window=[-0.4, 0.4, 0.0, 0.0])
    assert failed(away.checked()) == ["cart: position is inside its window"]


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        (("shoulder", "elbow"), ""),
        (("elbow", "shoulder"), "they are swapped"),
        (("shoulder",), "elbow is missing"),
        ((), "shoulder is missing; elbow is missing"),
        (("shoulder", "wrist"), "elbow is missing; wrist is no joint of this plant"),
        (("elbow", "elbow"), "elbow is there 2 times; shoulder is missing"),
        (("shoulder", "elbow", "wrist"), "wrist is no joint of this plant"),
    ],
)
def test_modules_that_are_not_those_of_the_joints_are_named(told: tuple[str, ...], problem: str) -> None:
    assert names_problem(told, ("shoulder", "elbow")) == problem


@pytest.mark.parametrize("told", [("elbow", "shoulder"), ("shoulder", "wrist"), ("elbow", "elbow")])
def test_nothing_is_set_in_modules_that_are_not_those_of_the_joints(told: tuple[str, str]) -> None:
    machine = Machine("acrobot").called(*told)
    found = machine.checked()
    assert failed(found) == ["modules are those of the joints"]
    assert found.items[-1].expected == "shoulder, elbow"
    assert (machine.efforts, any(machine.switched)) == ([], False)


def test_a_module_that_does_not_answer_is_named_and_the_others_are_let_alone() -> None:
    machine = Machine("acrobot")

    def silent() -> Any:
        raise ActuatorError("no_module", "nobody answers")

    machine.modules[0].port.connect = silent  # type: ignore[method-assign]
    found = machine.checked()
    assert failed(found) == ["shoulder: no_module", "modules are those of the joints"]
    assert found.items[-1].seen == "elbow (shoulder is missing)"
    assert (machine.efforts, any(machine.switched)) == ([], False)


def test_a_drive_that_takes_another_strategy_fails_its_line() -> None:
    machine = Machine("double_pendulum")
    port = machine.modules[1].port
    assert isinstance(port, DrivePort)
    port.set_strategy = lambda strategy, command=None: Strategy.OFF  # type: ignore[method-assign]
    assert failed(machine.checked()) == ["elbow: the loop of effort can be set"]


# --- command line -----------------------------------------------------------------------------------------------


def test_check_takes_a_plant_of_several_joints(capsys: pytest.CaptureFixture[str]) -> None:
    code = check_cli.main(["--backend", "emulator", "--plant", "furuta", "--json"])
    printed = json.loads(capsys.readouterr().out)
    refused = [item["name"] for item in printed["items"] if item["passed"] is False and item["name"] != HOST_ITEM]
    # What is judged by the clock is judged above, on one that is stepped: this computer has others to serve.
    assert [
        name for name in refused if not re.search("feedback (is|flows|gets|comes)|acknowledgements|no fault", name)
    ] == []
    assert code == (1 if refused else 3 if printed["host_busy"] else 0)
    assert {"arm.rate_hz", "pendulum.lost", "arm.acknowledgement_median_s"} <= printed["figures"].keys()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plant", "cart_pole"], "several real modules are not checked yet"),
        (["--backend", "emulator", "--plant", "acrobot", "--joint-sign", "-1"], "joint_sign is -1, which is for one"),
        (["--backend", "emulator", "--plant", "acrobat"], "plant is 'acrobat'; expected one of the presets"),
    ],
)
def test_what_several_modules_have_not_is_one_sentence(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert check_cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err
