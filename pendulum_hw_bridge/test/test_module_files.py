"""What a module was set to is kept in files and given back: emulators, and hebi-py's own commands and files."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_hw_bridge.backends import hebi as backend_module
from pendulum_hw_bridge.backends.emulator import EmulatorBackend
from pendulum_hw_bridge.backends.hebi_emulated import _holds
from pendulum_hw_bridge.emulation.parameters import load_emulator
from pendulum_hw_bridge.emulation.x5 import EmulatedX5
from pendulum_hw_bridge.lab.module_files import (
    _set_open_ends,
    backup_emulator,
    backup_group,
    restore_emulator,
    restore_group,
)
from pendulum_hw_bridge.port.actuator import ActuatorError, MStopAction
from pendulum_hw_bridge.port.clocks import SteppedClock
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, GAIN_FIELDS, LOOPS, load_gains, write_gains
from pendulum_hw_bridge.port.settings import BridgeSettings
from pendulum_msgs_py.errors import ParameterError


def emulator() -> EmulatorBackend:
    port = EmulatorBackend(EmulatedX5(load_emulator("thesis"), seed=3), SteppedClock())
    port.connect()
    return port


def test_what_an_emulator_was_set_to_is_given_back(tmp_path: Path) -> None:
    port, said = emulator(), list[str]()
    before = port.connect()
    backup_emulator(port, tmp_path / "before")
    port.set_limits(BridgeSettings().limits.__class__(effort=1.0, m_stop=MStopAction.HOLD_POSITION))
    assert port.connect().limits != before.limits
    restore_emulator(port, tmp_path / "before", said.append)
    assert port.connect().limits == before.limits
    assert port.connect().gains == before.gains
    with pytest.raises(ParameterError, match="is there already; expected a new folder"):
        backup_emulator(port, tmp_path / "before")


class Module:
    """A group whose module keeps what hebi-py's own command objects say, and tells it through hebi-py's own files."""

    def __init__(self, hebi: Any) -> None:
        self._hebi = hebi
        self.state = hebi.GroupCommand(1)
        self.keeps = self.answers = True
        self.sent_setpoints = False

    def request_info(self, timeout_ms: int) -> Any:
        return self.state if self.answers else None

    def send_command_with_acknowledgement(self, command: Any, timeout_ms: int) -> bool:
        self.sent_setpoints |= bool(np.isfinite([command.position[0], command.velocity[0], command.effort[0]]).any())
        if self.keeps:
            for name in ("position_kp", "velocity_kp", "effort_kp", "effort_limit_max", "effort_limit_min"):
                value = float(getattr(command, name)[0])
                if not math.isnan(value):
                    setattr(self.state, name, value)
            if command.mstop_strategy[0]:
                self.state.mstop_strategy = ["Disabled", "MotorOff", "HoldPosition"][int(command.mstop_strategy[0])]
        return True


def test_gains_safety_parameters_and_m_stop_action_of_a_module_are_given_back(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    module = Module(hebi)
    said: list[str] = []
    module.state.position_kp, module.state.effort_limit_max, module.state.effort_limit_min = 2.5, 7.0, -7.0
    module.state.mstop_strategy = "HoldPosition"
    gains, safety, _ = backup_group(module, tmp_path / "before")
    assert "<kp>2.5" in gains.read_text()
    assert "motor_hold" in safety.read_text()
    module.state.position_kp, module.state.effort_limit_max = 1.5, 1.0
    module.state.mstop_strategy = "MotorOff"
    restore_group(module, tmp_path / "before", backend_module.new_command, said.append)
    assert module.state.position_kp[0] == 2.5
    assert module.state.effort_limit_max[0] == 7.0
    assert int(module.state.mstop_strategy[0]) == 2
    assert not module.sent_setpoints
    assert said == []

    module.state.position_kp = 1.5
    module.keeps = False
    with pytest.raises(ActuatorError, match=r"reads back other values than those of .*gains.xml"):
        restore_group(module, tmp_path / "before", backend_module.new_command, said.append)
    module.answers = False
    with pytest.raises(ActuatorError, match="did not tell its settings"):
        backup_group(module, tmp_path / "other")
    (tmp_path / "before" / "safety.xml").unlink()
    with pytest.raises(ParameterError, match=r"safety.xml does not exist"):
        restore_group(module, tmp_path / "before", backend_module.new_command, said.append)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ActuatorError("module_lost", "no answer")])
def test_a_restore_that_is_broken_off_between_its_writes_says_that_half_of_it_may_be_in_force(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    port, words = emulator(), list[str]()
    backup_emulator(port, tmp_path / "before")

    def break_off(_: object) -> Any:
        raise error

    monkeypatch.setattr(port, "set_limits", break_off)
    with pytest.raises((KeyboardInterrupt, ActuatorError)):
        restore_emulator(port, tmp_path / "before", words.append)
    assert words[-1].startswith("Broken off: the module may hold some settings of ")
    assert "restore again" in words[-1]

    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    module, said, sent = Module(hebi), list[str](), list[Any]()
    backup_group(module, tmp_path / "module")

    def second_breaks_off(command: Any, timeout_ms: int) -> bool:
        sent.append(command)
        if len(sent) == 2:
            raise error
        return True

    module.send_command_with_acknowledgement = second_breaks_off  # type: ignore[method-assign]
    with pytest.raises((KeyboardInterrupt, ActuatorError)):
        restore_group(module, tmp_path / "module", backend_module.new_command, said.append)
    assert said[-1].startswith("Broken off: the module may hold")


@pytest.mark.parametrize("name", ["gains.xml", "safety.xml", "position_limit_strategies.json"])
def test_a_backup_of_which_one_file_cannot_be_read_is_sent_to_no_module(tmp_path: Path, name: str) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    module, said, sent = Module(hebi), list[str](), list[Any]()
    backup_group(module, tmp_path / "before")
    (tmp_path / "before" / name).write_text("<not this", encoding="utf-8")
    module.send_command_with_acknowledgement = lambda command, timeout_ms: sent.append(command)  # type: ignore[assignment,func-returns-value]
    with pytest.raises(ParameterError, match=f"{name} is not understood"):
        restore_group(module, tmp_path / "before", backend_module.new_command, said.append)
    assert (sent, said) == ([], [])


def test_a_module_that_acknowledges_nothing_is_asked_three_times_and_reported(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    module, said, asked = Module(hebi), list[str](), list[int]()
    backup_group(module, tmp_path / "before")

    def deaf(command: Any, timeout_ms: int) -> bool:
        asked.append(timeout_ms)
        return False

    module.send_command_with_acknowledgement = deaf  # type: ignore[method-assign]
    with pytest.raises(ActuatorError, match=r"did not acknowledge gains.xml within 500 ms"):
        restore_group(module, tmp_path / "before", backend_module.new_command, said.append)
    assert asked == [500] * 3
    assert said


def test_a_backup_from_before_either_end_was_kept_is_given_back_too(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    module, said = Module(hebi), list[str]()
    module.state.position_kp = 2.5
    _, _, ends = backup_group(module, tmp_path / "before")
    ends.unlink()
    module.state.position_kp = 1.5
    restore_group(module, tmp_path / "before", backend_module.new_command, said.append)
    assert module.state.position_kp[0] == 2.5


def test_an_emulator_that_keeps_other_values_or_files_that_say_nothing_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, said = emulator(), list[str]()
    files = backup_emulator(port, tmp_path / "before")
    assert [file.name for file in files] == ["gains.xml", "limits.json"]
    assert all(file.is_file() for file in files)
    before = port.connect()
    monkeypatch.setattr(port, "set_limits", lambda limits: replace(limits, effort=1.0))
    with pytest.raises(ActuatorError, match="emulator reads back other values than those of"):
        restore_emulator(port, tmp_path / "before", said.append)
    assert said
    (tmp_path / "before" / "limits.json").write_text("[", encoding="utf-8")
    with pytest.raises(ParameterError, match=r"limits.json is not understood"):
        restore_emulator(port, tmp_path / "before", said.append)
    monkeypatch.setattr(port, "connect", lambda: replace(before, gains=None))
    with pytest.raises(ActuatorError, match="does not tell its gains; expected hebi or an emulator"):
        backup_emulator(port, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_open_ends_of_a_file_are_set_as_infinite_and_what_is_no_number_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "safety.xml"

    def ends_of(low: str, high: str) -> dict[str, float]:
        text = f"<safety><position><min_limit>{low}</min_limit><max_limit>{high}</max_limit></position></safety>"
        path.write_text(text, encoding="utf-8")
        command = SimpleNamespace()
        _set_open_ends(command, path)
        return vars(command)

    assert ends_of("-inf", "inf") == {"position_limit_min": -math.inf, "position_limit_max": math.inf}
    assert ends_of("-4.0", "inf") == {"position_limit_max": math.inf}
    assert ends_of("-4.0", "4.0") == {}
    with pytest.raises(ParameterError, match="max_limit of the position is no number; expected one, or inf"):
        ends_of("-inf", "nan")
    with pytest.raises(ParameterError, match=r"safety.xml is not understood"):
        ends_of("-inf", "far")
    path.write_text("<safety/>", encoding="utf-8")
    _set_open_ends(SimpleNamespace(), path)


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, OSError])
def test_a_backup_that_is_interrupted_leaves_nothing_that_could_be_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    folder, port = tmp_path / "before", emulator()
    there: list[bool] = []

    def interrupted(*_: object) -> Any:
        there.append(folder.exists())
        raise error

    monkeypatch.setattr("pendulum_hw_bridge.lab.module_files.limits_to_json", interrupted)
    with pytest.raises((KeyboardInterrupt, SystemExit, ParameterError)):
        backup_emulator(port, folder)
    # Nor does the name exist while it is written, where the program could be killed.
    assert there == [False]
    assert list(tmp_path.iterdir()) == []

    class Interrupted(SimpleNamespace):
        def write_gains(self, path: str) -> None:
            Path(path).write_text("<gains/>", encoding="utf-8")

        def write_safety_params(self, path: str) -> None:
            Path(path).write_text("<safety/>", encoding="utf-8")
            interrupted()

    with pytest.raises((KeyboardInterrupt, SystemExit, ParameterError)):
        backup_group(SimpleNamespace(request_info=lambda ms: Interrupted()), folder)
    assert there == [False, False]
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_backup_left_is_refused_and_makes_way_for_a_new_one(tmp_path: Path) -> None:
    port, said, sent = emulator(), list[str](), list[Any]()
    backup_emulator(port, tmp_path / "before")
    half = (tmp_path / "before").rename(tmp_path / "before.unfinished")
    for restore in (
        lambda: restore_emulator(port, half, said.append),
        lambda: restore_group(SimpleNamespace(), half, lambda: sent.append("a command"), said.append),
    ):
        with pytest.raises(ParameterError, match="was interrupted and is not whole"):
            restore()
    assert (said, sent) == ([], [])
    backup_emulator(port, tmp_path / "before")
    assert [path.name for path in tmp_path.iterdir()] == ["before"]


def _like_a_module(hebi: Any, info: Any) -> Any:
    """Return a group whose module takes over each gain and limit that a command holds, and clears none."""

    def take(command: Any, timeout_ms: int) -> bool:
        for loop in LOOPS:
            for name in (*(f"{loop}_{gain}" for gain in GAIN_FIELDS), f"{loop}_limit_min", f"{loop}_limit_max"):
                value = getattr(command, name)[0]
                if _holds(command, name, hebi):
                    setattr(info, name, bool(value) if name.endswith("d_on_error") else float(value))
        return True

    return SimpleNamespace(request_info=lambda timeout_ms: info, send_command_with_acknowledgement=take)


@pytest.mark.parametrize("seed", range(5))
def test_each_gain_and_limit_comes_back_to_the_last_bit_small_ones_too(tmp_path: Path, seed: int) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    rng = np.random.default_rng(seed)
    info = hebi.GroupCommand(1)
    kept: dict[str, float] = {}
    for loop in LOOPS:
        for name in (*(f"{loop}_{gain}" for gain in GAIN_FIELDS), f"{loop}_limit_min", f"{loop}_limit_max"):
            value = float(np.float32(10.0 ** rng.uniform(-12.0, 4.0) * rng.choice([-1.0, 1.0])))
            setattr(info, name, bool(seed % 2) if name.endswith("d_on_error") else value)
            kept[name] = float(getattr(info, name)[0])
    group = _like_a_module(hebi, info)
    backup_group(group, tmp_path / "before")
    for name in kept:
        setattr(info, name, True if name.endswith("d_on_error") else 7.0)
    restore_group(group, tmp_path / "before", backend_module.new_command, lambda sentence: None)
    assert {name: float(getattr(info, name)[0]) for name in kept} == kept


def test_a_gain_that_comes_back_wrong_by_less_than_six_decimals_is_reported(tmp_path: Path) -> None:
    hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
    info = hebi.GroupCommand(1)
    info.position_kp, info.velocity_ki = 1.0, 3e-7
    group = _like_a_module(hebi, info)
    backup_group(group, tmp_path / "before")
    take = group.send_command_with_acknowledgement

    def spoil(command: Any, timeout_ms: int) -> bool:
        taken = bool(take(command, timeout_ms))
        info.velocity_ki = 0.0
        return taken

    group.send_command_with_acknowledgement = spoil
    with pytest.raises(ActuatorError, match=r"reads back other values .*: velocity ki is 0.0; expected 3"):
        restore_group(group, tmp_path / "before", backend_module.new_command, lambda sentence: None)


def test_an_open_clamp_of_an_emulator_stays_open(tmp_path: Path) -> None:
    wanted = replace(DEFAULT_GAINS[4], effort=replace(DEFAULT_GAINS[4].effort, min_target=-math.inf, kp=1e-9))
    assert load_gains(write_gains(tmp_path / "gains.xml", wanted)) == wanted
