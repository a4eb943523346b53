"""HEBI's own logs: written beside a bag, read back in joint coordinates, refused by name.

hebi-py does not log its imitation group, and no module is at hand where tests run: what a log yields is made of
hebi-py's own feedback objects, which the imitation group fills.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pendulum_hw_bridge.backends.hebi import HebiBackend
from pendulum_hw_bridge.backends.hebi_log import ATTRIBUTES, read_hebilog, to_joint
from pendulum_hw_bridge.backends.replay import load_feedback
from pendulum_hw_bridge.lab import convert_cli
from pendulum_hw_bridge.port.actuator import FEEDBACK_QUANTITIES, ActuatorError
from pendulum_msgs_py.errors import DataError

hebi = pytest.importorskip("hebi", reason="hebi-py is not installed")
util = pytest.importorskip("hebi.util")


class Log:
    """Stands for hebi-py's ``LogFile``: feedback with times, one record after another."""

    def __init__(self, count: int = 200, modules: int = 1, *, clock: bool = True) -> None:
        self.number_of_modules = modules
        # One for all: hebi-py's library does not come back from the release of one group in thousands.
        self._group = util.create_imitation_group(modules)
        self.feedback_iterate = [self._record(step, clock=clock) for step in range(count)]

    def _record(self, step: int, *, clock: bool) -> Any:
        command = hebi.GroupCommand(self.number_of_modules)
        command.position, command.velocity, command.effort = 0.01 * step, 1.0, 0.1 * step
        self._group.send_command(command)
        record = self._group.get_next_feedback(20)
        values = {name: np.array(getattr(record, name)) for name in ATTRIBUTES.values()}
        hardware = 5_000_000 + 10_000 * step if clock else 0
        times = {"hardware_transmit_time_us": hardware, "receive_time_us": 9_000_000 + 10_000 * step + 300 * (step % 3)}
        return SimpleNamespace(**values, **{name: np.full(self.number_of_modules, t) for name, t in times.items()})


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "hw.hebilog"
    path.write_bytes(b"what only hebi-py reads")
    monkeypatch.setattr(util, "load_log", lambda file, load: Log())
    return path


def test_the_attributes_are_those_of_the_backend() -> None:
    assert list(ATTRIBUTES) == list(FEEDBACK_QUANTITIES)


def test_a_log_is_read_by_the_clock_of_its_module(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = read_hebilog(log)
    np.testing.assert_allclose(found["time"], 0.01 * np.arange(200), atol=1e-9)
    np.testing.assert_allclose(found["position"], 0.01 * np.arange(200), atol=1e-6)
    monkeypatch.setattr(util, "load_log", lambda file, load: Log(clock=False))
    assert read_hebilog(log)["time"][-1] == pytest.approx(1.99, abs=1e-3)


def test_a_log_in_joint_coordinates_is_turned_and_moved_as_the_lab_file_says(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text(
        "format: pendulum_lab/1\n"
        "joint: {sign: -1, zero: {value: 0.5, unit: rad}, effort_tare: {value: 0.2, unit: N m}}\n"
    )
    assert convert_cli.main([str(log), "--lab", str(lab)]) == 0
    table = np.genfromtxt(tmp_path / "hw.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["position"], 0.5 - 0.01 * np.arange(200), atol=1e-6)
    np.testing.assert_allclose(table["velocity"], -1.0, atol=1e-6)
    np.testing.assert_allclose(table["effort"], -0.1 * np.arange(200) - 0.2, atol=1e-5)
    # The bridge's replay and all that reads CSV understand it.
    assert load_feedback(tmp_path / "hw.csv").size == 200
    assert load_feedback(log).size == 200
    assert to_joint(read_hebilog(log))["position"][10] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (Log(count=1), "holds 1 records; expected at least 2"),
        (Log(modules=2), "holds 2 modules; expected one, or a choice from 0 to 1"),
    ],
)
def test_a_log_of_nothing_or_of_several_is_refused(
    log: Path, monkeypatch: pytest.MonkeyPatch, content: Log, message: str
) -> None:
    monkeypatch.setattr(util, "load_log", lambda file, load: content)
    with pytest.raises(DataError, match=message):
        read_hebilog(log)


def test_a_file_that_is_no_log_is_refused_by_the_library_itself(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "wrong.hebilog"
    path.write_bytes(b"no log")
    assert convert_cli.main([str(path)]) == 2
    assert f"{path} is no HEBI log" in capsys.readouterr().err
    assert convert_cli.main([str(tmp_path / "none.hebilog")]) == 2
    assert "does not exist" in capsys.readouterr().err


class LoggingGroup:
    """hebi-py's imitation group, and a note of which logs were asked for."""

    def __init__(self, notes: list[tuple[str, ...]]) -> None:
        self._group = util.create_imitation_group(1)
        self._notes = notes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._group, name)

    def start_log(self, directory: str, name: str) -> None:
        self._notes.append(("start", directory, name))

    def stop_log(self) -> None:
        self._notes.append(("stop",))
        raise RuntimeError("Log file is corrupt")  # as the library does with one that holds nothing


def test_the_log_begins_with_the_connection_and_ends_with_it(tmp_path: Path) -> None:
    notes: list[tuple[str, ...]] = []
    log = tmp_path / "run" / "hw.hebilog"
    port = HebiBackend(make_group=lambda: LoggingGroup(notes), imitation=True, log=log)
    port.connect()
    port.connect()
    assert notes == [("start", str(tmp_path / "run"), "hw.hebilog")]
    port.close()
    assert notes[-1] == ("stop",)


def test_a_log_that_cannot_be_written_is_reported_before_anything_is_driven(tmp_path: Path) -> None:
    log = tmp_path / "hw.hebilog"
    port = HebiBackend(make_group=lambda: util.create_imitation_group(1), imitation=True, log=log)
    with pytest.raises(ActuatorError, match=r"HEBI log .*hw.hebilog cannot be started"):
        port.connect()
    port.close()
    log.touch()
    port = HebiBackend(make_group=lambda: util.create_imitation_group(1), imitation=True, log=log)
    with pytest.raises(ActuatorError, match="is there already; expected a new file"):
        port.connect()
