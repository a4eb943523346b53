"""The lab file: read back as written, with units, and strict about what it does not know."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.plants.lab_file import LAB_ENTRIES, LabFile, load_lab, write_lab

FULL = """\
format: pendulum_lab/1
name: bench 2
module: {family: Lab, name: Pendulum, serial: X5-9-00123, type: X5-9}
joint:
  zero: {value: 0.12, unit: rad}
  sign: -1
limits:
  effort: {value: 5, unit: N m}
  position_window: {value: [-3.5, 3.5], unit: rad}
drive: {plant: mine.yaml, gains_file: gains/soft.xml, effort_strategy: effort_loop}
supply:
  voltage_window: {value: [30, 40], unit: V}
proofs:
  m_stop: {date: 2026-11-21, result: motor off after 40 ms}
"""


def test_a_lab_file_sets_parameters_of_the_bridge(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(FULL)
    lab = load_lab(path)
    assert dict(lab.values) == {
        "backend": "hebi",
        "family": "Lab",
        "name": "Pendulum",
        "serial": "X5-9-00123",
        "module_type": "X5-9",
        "joint_offset": 0.12,
        "joint_sign": -1,
        "effort_limit": 5.0,
        "position_window": [-3.5, 3.5],
        # What is beside the lab file is found from wherever a program is started.
        "plant": str(tmp_path / "mine.yaml"),
        "gains_file": str(tmp_path / "gains/soft.xml"),
        "effort_strategy": "effort_loop",
        "voltage_window": [30.0, 40.0],
    }
    assert lab.describe() == "hebi Lab/Pendulum (X5-9-00123)"


def test_what_is_written_reads_back_and_moves_with_its_folder(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(FULL)
    write_lab(path, load_lab(path).changed(joint_offset=0.5).proved("zero", "2026-11-21", "0.5 rad"))
    assert "gains/soft.xml" in path.read_text()
    assert str(tmp_path) not in path.read_text()
    moved = tmp_path / "elsewhere" / "lab.yaml"
    moved.parent.mkdir()
    moved.write_text(path.read_text())
    again = load_lab(moved)
    assert again.values["joint_offset"] == 0.5
    assert again.values["gains_file"] == str(moved.parent / "gains/soft.xml")
    assert again.proofs["m_stop"]["result"] == "motor off after 40 ms"
    assert again.proofs["zero"] == {"date": "2026-11-21", "result": "0.5 rad"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: pendulum_lab/1", "format: pendulum_plant/1", r"format is 'pendulum_plant/1'; expected"),
        ("joint:", "joints:", r"unknown parameter 'joints'; did you mean 'joint'"),
        ("  sign: -1", "  sing: -1", r"joint: unknown parameter 'sing'; did you mean 'sign'"),
        ("{value: 0.12, unit: rad}", "0.12", r"joint.zero is 0.12; expected \{value: ..., unit: rad\}"),
        ("unit: rad}\n  sign", "unit: deg}\n  sign", r"joint.zero: unit is 'deg'; expected 'rad'"),
        ("value: 0.12, unit: rad", "value: 0.12", r"joint.zero: unit is missing; expected 'rad'"),
        ("value: 0.12, unit: rad", "unit: rad", r"joint.zero: value is missing; expected a number in rad"),
        ("value: 0.12", "value: .nan", r"joint.zero is nan; expected a finite number"),
        ("value: 0.12", "value: true", r"joint.zero is True; expected a finite number"),
        ("sign: -1", "sign: 1.5", r"joint.sign is 1.5; expected an integer"),
        ("[-3.5, 3.5]", "[-3.5]", r"limits.position_window is \[-3.5\]; expected \[low, high\] in rad"),
        ("family: Lab", "family: 7", r"module.family is 7; expected text"),
        (
            "result: motor",
            "results: motor",
            r"proofs.m_stop: unknown parameter 'results'; did you mean 'result'",
        ),
        ("module: {", "module: [", r":3:"),
    ],
)
def test_an_entry_that_is_not_understood_is_refused_with_its_place(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in FULL
    path = tmp_path / "lab.yaml"
    path.write_text(FULL.replace(old, new))
    with pytest.raises(ParameterError, match=message) as caught:
        load_lab(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("section", "entry", "value", "message"),
    [
        ("limits", "effort", "{value: 0.0, unit: N m}", r"limits.effort is 0.0 N m; .*leave it out .*13 N m"),
        ("limits", "effort", "{value: -0.0, unit: N m}", r"limits.effort is -0.0 N m; expected > 0"),
        ("limits", "effort", "{value: -5, unit: N m}", r"limits.effort is -5.0 N m; expected > 0"),
        ("limits", "measured_effort", "{value: 0, unit: N m}", r"limits.measured_effort is 0.0 N m; expected > 0"),
        ("limits", "velocity", "{value: 0, unit: rad/s}", r"limits.velocity is 0.0 rad/s; expected > 0"),
        ("limits", "effort_slew", "{value: 0, unit: N m/s}", r"limits.effort_slew is 0.0 N m/s; expected > 0"),
        ("limits", "derating_temperature", "{value: 0, unit: degC}", r"limits.derating_temperature is 0.0 degC"),
        (
            "limits",
            "position_window",
            "{value: [0, 0], unit: rad}",
            r"position_window is \[0.0, 0.0\] rad; .*low < high",
        ),
        ("drive", "e_stop_input_timeout", "{value: 0, unit: s}", r"e_stop_input_timeout is 0.0 s; expected > 0"),
    ],
)
def test_a_limit_of_nothing_is_not_taken_for_no_limit(
    tmp_path: Path, section: str, entry: str, value: str, message: str
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(f"format: pendulum_lab/1\n{section}:\n  {entry}: {value}\n")
    with pytest.raises(ParameterError, match=message):
        load_lab(path)


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_a_limit_of_nothing_is_not_written_either(tmp_path: Path, value: float) -> None:
    with pytest.raises(ParameterError, match=r"limits.effort is .* N m; expected > 0"):
        write_lab(tmp_path / "lab.yaml", LabFile().changed(effort_limit=value))
    assert not (tmp_path / "lab.yaml").exists()


def test_a_file_that_is_not_there_or_cannot_be_written_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"lab file .*none.yaml does not exist"):
        load_lab(tmp_path / "none.yaml")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ParameterError, match=r"lab.yaml cannot be written: File exists"):
        write_lab(tmp_path / "file" / "lab.yaml", LabFile())


def test_a_lab_has_no_parameter_that_it_does_not_know() -> None:
    with pytest.raises(ParameterError, match="did you mean 'joint_offset'"):
        LabFile().changed(joint_ofset=1.0)


_FLOATS = [e.parameter for entries in LAB_ENTRIES.values() for e in entries.values() if e.kind is float]


@given(st.dictionaries(st.sampled_from(_FLOATS), st.floats(allow_nan=False, allow_infinity=False)), st.text())
def test_every_number_and_every_name_survives_the_file(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, float], name: str
) -> None:
    path = tmp_path_factory.mktemp("lab") / "lab.yaml"
    lab = LabFile({"backend": "hebi", **values}, name=name)
    try:
        write_lab(path, lab)
    except ParameterError:
        return
    again = load_lab(path)
    assert dict(again.values) == dict(lab.values)
    assert again.name == name
