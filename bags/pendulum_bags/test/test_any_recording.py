"""Recordings of every format, written by the format's own library: what is guessed, what is shown, what is refused."""

from __future__ import annotations

import copy
import json
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import yaml

from pendulum_bags.commands.analyse_cli import main as analyse_main
from pendulum_bags.commands.compare_cli import main as compare_main
from pendulum_bags.commands.identify_cli import main as identify_main
from pendulum_bags.commands.recording_options import readings_of
from pendulum_bags.commands.replay_cli import main as replay_main
from pendulum_bags.recordings.reading import Reading, write_mapping
from pendulum_bags.runs.read_recording import read_recording
from pendulum_msgs_py.contract.cdr import encode_joint_state, encode_joints
from pendulum_msgs_py.errors import DataError
from pendulum_rosbag.storage import BagWriter

DT = 0.01
BEGIN = 1_700_000_000 * 10**9


def swing(duration: float = 12.0, *, damping: float = 0.5, noise: float = 0.0, seed: int = 0) -> dict[str, np.ndarray]:
    """Return a pendulum under held noise, 0 hanging, by small steps of Euler."""
    generator = np.random.default_rng(seed)
    torque = np.repeat(np.random.default_rng(99).normal(0.0, 1.0, int(duration / 0.1)), 10)
    angle, speed, rows = 0.3, 0.0, []
    for u in torque:
        rows.append((angle, speed))
        push = generator.normal(0.0, noise) if noise else 0.0
        for _ in range(20):
            speed += (-20.0 * np.sin(angle) - damping * speed + 8.0 * u + push) * DT / 20.0
            angle += speed * DT / 20.0
    position, velocity = np.array(rows).T
    return {"t": DT * np.arange(torque.size), "position": position, "velocity": velocity, "torque": torque}


RUN = swing()


def struct_with_time(path: Path) -> None:
    """Write what a To Workspace block saves as "structure with time"."""
    signals = {
        name: {"time": RUN["t"][:, None], "signals": {"values": RUN[key][:, None], "dimensions": 1.0}}
        for name, key in (("theta", "position"), ("omega", "velocity"), ("torque", "torque"))
    }
    scipy.io.savemat(path, signals)


def rows_across(path: Path) -> None:
    scipy.io.savemat(path, {"theta": RUN["position"], "dtheta": RUN["velocity"], "tau": RUN["torque"], "dt": DT})


def cell_of_runs(path: Path) -> None:
    runs = np.empty((3, 1), object)
    for index in range(3):
        runs[index, 0] = np.stack([RUN["position"], RUN["velocity"]]) * (1.0 - 0.2 * index)
    scipy.io.savemat(path, {"Y": runs, "dt": DT})


def version_73(path: Path) -> None:
    """Write a struct and a cell as MATLAB 7.3 does: transposed, cells by reference, names in attributes."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("out")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, key in (("time", "t"), ("theta", "position"), ("omega", "velocity"), ("torque", "torque")):
            data = group.create_dataset(name, data=RUN[key][None, :])
            data.attrs["MATLAB_class"] = np.bytes_("double")
        text = file.create_dataset("note", data=np.array([[104, 105]], np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM")


def npz(path: Path) -> None:
    np.savez(path, time=RUN["t"], theta=RUN["position"], theta_dot=RUN["velocity"], torque=RUN["torque"])


def npy_pair(path: Path) -> None:
    np.save(path, np.stack([RUN["position"], RUN["velocity"]], axis=1))
    np.save(path.with_name("times.npy"), RUN["t"])


def parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    states = pa.FixedSizeListArray.from_arrays(np.stack([RUN["position"], RUN["velocity"]], axis=1).reshape(-1), 2)
    table = {"stamp_ns": (1e9 * RUN["t"]).astype(np.int64), "state": states, "torque": RUN["torque"].astype(np.float32)}
    pyarrow.parquet.write_table(pa.table(table), path)


def plotjuggler(path: Path) -> None:
    rows = ["__time,/cmd/data.0,/joint_states/hinge/position,/joint_states/hinge/velocity"]
    for t, q, v, u in zip(*RUN.values(), strict=True):
        rows += [f"{1.7e9 + t:.6f},,{q:.9f},{v:.9f}", f"{1.7e9 + t + 0.002:.6f},{u:.6f},,"]
    path.write_text("\n".join(rows) + "\n")


def foreign_bag(path: Path) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    array = store.types["std_msgs/msg/Float64MultiArray"]
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with BagWriter(path) as writer:
        writer.add_topic("/robot/state", "sensor_msgs/msg/JointState")
        writer.add_topic("/cmd", "std_msgs/msg/Float64MultiArray")
        for t, q, v, u in zip(*RUN.values(), strict=True):
            now = BEGIN + round(1e9 * t)
            writer.write("/robot/state", now, encode_joint_state(now, position=q, velocity=v))
            message = array(layout=layout, data=np.array([u]))
            writer.write("/cmd", now + 1000, bytes(store.serialize_cdr(message, "std_msgs/msg/Float64MultiArray")))


def ros1_bag(path: Path) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    state, header, time = (store.types[name] for name in (
        "sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
    ))  # fmt: skip
    with Writer(path) as writer:
        states = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for t, q, v, u in zip(*RUN.values(), strict=True):
            now = BEGIN + round(1e9 * t)
            stamp = header(0, time(*divmod(now, 10**9)), "")
            message = state(stamp, ["hinge"], *(np.array([value]) for value in (q, v, u)))
            writer.write(states, now, bytes(store.serialize_ros1(message, state.__msgtype__)))


def lerobot(path: Path, version: str) -> None:
    """Write two episodes as LeRobot does: one file each in version 2, one for both in version 3."""
    import pyarrow as pa
    import pyarrow.parquet

    tables = []
    for episode in range(2):
        scale, count = 1.0 - 0.5 * episode, RUN["t"].size
        states = scale * np.stack([RUN["position"], RUN["velocity"]], axis=1)
        tables.append(pa.table({
            "observation.state": pa.FixedSizeListArray.from_arrays(states.reshape(-1), 2),
            "action": pa.array(RUN["torque"][:, None].tolist(), pa.list_(pa.float64())),
            "timestamp": RUN["t"].astype(np.float32), "frame_index": np.arange(count),
            "episode_index": np.full(count, episode), "index": episode * count + np.arange(count),
            "task_index": np.zeros(count, np.int64),
        }))  # fmt: skip
    data = path / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version == "v3.0":
        pyarrow.parquet.write_table(pa.concat_tables(tables), data / "file-000.parquet")
    for episode, table in enumerate(tables if version == "v2.1" else ()):
        pyarrow.parquet.write_table(table, data / f"episode_{episode:06d}.parquet")
    names = {"observation.state": ["hinge.pos", "hinge.vel"], "action": ["hinge.torque"]}
    grouped = {key: {"motors": one} if version == "v2.1" else one for key, one in names.items()}
    features = {key: {"dtype": "float32", "shape": [len(names[key])], "names": one} for key, one in grouped.items()}
    info = {"codebase_version": version, "total_episodes": 2, "fps": round(1.0 / DT), "features": features}
    (path / "meta").mkdir()
    (path / "meta" / "info.json").write_text(json.dumps(info))


FORMATS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "struct with time": ("a.mat", struct_with_time),
    "rows across, dt in the file": ("b.mat", rows_across),
    "cells": ("c.mat", cell_of_runs),
    "version 7.3": ("d.mat", version_73),
    "npz": ("e.npz", npz),
    "npy": ("state.npy", npy_pair),
    "parquet": ("f.parquet", parquet),
    "sparse": ("g.csv", plotjuggler),
    "foreign bag": ("h", foreign_bag),
    "ROS 1": ("i.bag", ros1_bag),
    "LeRobot 2": ("j", partial(lerobot, version="v2.1")),
    "LeRobot 3": ("k", partial(lerobot, version="v3.0")),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_motion_without_a_mapping(tmp_path: Path, name: str) -> None:
    file, write = FORMATS[name]
    write(tmp_path / file)
    motion = Reading(tmp_path / file).motion
    (joint,) = motion.joints
    np.testing.assert_allclose(motion.time - motion.time[0], RUN["t"], atol=1e-6)
    np.testing.assert_allclose(joint.position, RUN["position"], atol=1e-6)
    assert joint.velocity is not None
    np.testing.assert_allclose(joint.velocity, RUN["velocity"], atol=1e-6)
    if name not in {"cells", "npy"}:
        assert joint.drive is not None
        np.testing.assert_allclose(joint.drive.values, RUN["torque"], atol=1e-6)


def test_a_mapping_that_was_written_is_read_again_and_guesses_nothing(tmp_path: Path) -> None:
    for file, write in (FORMATS["struct with time"], FORMATS["npz"]):
        write(tmp_path / file)
    guessed = [Reading(tmp_path / "a.mat"), Reading(tmp_path / "e.npz")]
    write_mapping(tmp_path / "m.yaml", guessed)
    for one in guessed:
        again = Reading(one.path, tmp_path / "m.yaml")
        assert not again.guesses
        np.testing.assert_array_equal(again.motion.joints[0].position, one.motion.joints[0].position)


def test_a_part_of_a_file_of_several_runs_is_chosen_by_its_number(tmp_path: Path) -> None:
    cell_of_runs(tmp_path / "c.mat")
    third = Reading(tmp_path / "c.mat#3").motion.joints[0]
    np.testing.assert_allclose(third.position, 0.6 * RUN["position"])
    assert "part 1 of 3" in " ".join(Reading(tmp_path / "c.mat").columns.notes)
    with pytest.raises(DataError, match=r"part is 4; expected 1 to 3"):
        Reading(tmp_path / "c.mat#4").columns  # noqa: B018
    for version in ("v2.1", "v3.0"):
        lerobot(tmp_path / version, version)
        second = Reading(tmp_path / f"{version}#2").motion.joints[0]
        np.testing.assert_allclose(second.position, 0.5 * RUN["position"])


def test_a_plant_that_turns_one_way_is_distinguished_from_its_clock_by_its_steps(tmp_path: Path) -> None:
    """The layout of a motor's step response: counter, pulse width, microseconds, angle."""
    t = 5080e-6 * np.arange(200) + 1e-5 * np.random.default_rng(0).random(200)
    rows = np.stack([np.arange(200), np.full(200, 100), 1e6 * t, 6.0 * (t - 0.2 * (1.0 - np.exp(-t / 0.2)))], axis=1)
    np.savetxt(tmp_path / "pwm.csv", rows, fmt=["%d", "%d", "%d", "%.6f"], delimiter=",")
    reading = Reading(tmp_path / "pwm.csv")
    assert [(guess.quantity, guess.column) for guess in reading.guesses] == [
        ("time", "column2"), ("position", "column3")
    ]  # fmt: skip
    np.testing.assert_allclose(reading.motion.time, t, atol=1e-6)


def test_a_long_recording_is_guessed_from_its_middle_if_all_moves_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pendulum_bags.recordings.guess._MOST_ROWS", 600)
    read: list[int] = []
    for name, write in (("e.npz", npz), ("f.parquet", parquet), ("d.mat", version_73)):
        write(tmp_path / name)
        reading = Reading(tmp_path / name)
        rows = reading.columns.columns
        for column in rows.values():

            def count(wanted: slice, column: Any = column) -> Any:
                values = column.read(wanted)
                read.append(values.size)
                return values

            rows[column.name] = replace(column, read=count)  # type: ignore[index]
        sections = reading.rules.joints[""]
        assert {"position", "velocity", "input"} <= sections.keys()
        assert set(read) == ({1200} if name == "e.npz" else {600}), name
        np.testing.assert_allclose(reading.motion.joints[0].position, RUN["position"], atol=1e-6)
        read.clear()
    early = np.where(np.arange(1200) < 200, RUN["torque"], 0.0)
    np.savez(tmp_path / "early.npz", time=RUN["t"], theta=RUN["position"], torque=early)
    assert "input" in Reading(tmp_path / "early.npz").rules.joints[""]


def test_lists_of_a_table_may_be_short_and_names_may_have_dots(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    states = pa.array([[1.0, 2.0], None, [3.0]], pa.list_(pa.float32()))
    pyarrow.parquet.write_table(pa.table({"observation.state": states}), tmp_path / "a.parquet", row_group_size=1)
    columns = Reading(tmp_path / "a.parquet").columns
    np.testing.assert_array_equal(columns.values("observation.state[0]"), [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(columns.values("observation.state[1]"), [2.0, np.nan, np.nan])


def test_small_integers_and_logicals_of_matlab_are_numbers(tmp_path: Path) -> None:
    counts = np.clip(np.round(100.0 + 90.0 * np.sin(RUN["t"])), 0, 255).astype(np.uint8)
    scipy.io.savemat(tmp_path / "m.mat", {"pos": counts, "enabled": RUN["torque"] > 0.0, "dt": 0.01})
    values = Reading(tmp_path / "m.mat").columns.values("pos")
    assert values.max() * 3.0 == 3.0 * int(counts.max())  # (570 does not fit the file's type)
    assert set(Reading(tmp_path / "m.mat").columns.values("enabled")) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("scale", "rate", "units"),
    [
        (1.0, 1.0, ("rad", "rad/s", None)),
        (1.0, 180.0 / np.pi, ("rad", "deg/s", None)),
        (180.0 / np.pi, 1.0, ("deg", "rad/s", None)),
        (180.0 / np.pi, 180.0 / np.pi, ("deg", "deg/s", None)),
        (1.0, 30.0 / np.pi, ("rad", "rpm", None)),
        (1.0, -1.0, ("rad", "rad/s", -1)),
    ],
)
def test_units_and_sign_are_found_by_the_data(
    tmp_path: Path, scale: float, rate: float, units: tuple[str, str, int | None]
) -> None:
    np.savez(
        tmp_path / "run.npz",
        t=RUN["t"],
        angle=scale * RUN["position"],
        speed=rate * RUN["velocity"],
        torque=RUN["torque"],
    )
    reading = Reading(tmp_path / "run.npz")
    sections = reading.rules.joints[""]
    assert (sections["position"]["unit"], sections["velocity"]["unit"], sections["velocity"].get("sign")) == units
    np.testing.assert_allclose(reading.motion.joints[0].position, RUN["position"], atol=1e-9)


def test_an_angle_from_upright_and_one_that_is_wrapped_are_brought_to_0_hanging(tmp_path: Path) -> None:
    wrapped = (RUN["position"] % (2.0 * np.pi)) - np.pi
    np.savez(tmp_path / "run.npz", t=RUN["t"], theta=wrapped, torque=RUN["torque"])
    recording = read_recording(Reading(tmp_path / "run.npz"))
    turns = (recording.position - RUN["position"]) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-9)
    guesses = {guess.quantity: guess for guess in Reading(tmp_path / "run.npz").guesses}
    assert "tested: 0 is upright" in guesses["position"].how


def test_what_no_test_shows_is_assumed_and_marked(tmp_path: Path) -> None:
    small = 1e-3 * RUN["position"]
    np.savez(tmp_path / "run.npz", t=RUN["t"], theta=small, u=RUN["torque"])
    guesses = {guess.quantity: guess for guess in Reading(tmp_path / "run.npz").guesses}
    assert guesses["position"].assumed
    assert "rad: assumed" in guesses["position"].how
    assert (guesses["input"].unit, guesses["input"].assumed) == ("-", True)


def test_a_velocity_that_is_not_the_derivative_is_left_out_and_named(tmp_path: Path) -> None:
    wrong = np.random.default_rng(0).normal(0.0, 1.0, RUN["t"].size)
    np.savez(tmp_path / "run.npz", t=RUN["t"], theta=RUN["position"], omega=wrong, torque=RUN["torque"])
    reading = Reading(tmp_path / "run.npz")
    assert reading.motion.joints[0].velocity is None
    assert any("omega is not its derivative" in guess.how for guess in reading.guesses)


@pytest.mark.parametrize(
    ("names", "scale", "units"),
    [
        (("time_s", "theta_deg", "theta_dot_deg_s", "torque_nm"), 180.0 / np.pi, ("s", "deg", "deg/s", "N m")),
        (("t_ms", "angle_rad", "omega_rad_s", "u_nm"), 1.0, ("ms", "rad", "rad/s", "N m")),
    ],
)
def test_units_in_names_are_read(tmp_path: Path, names: Any, scale: float, units: Any) -> None:
    columns = (
        RUN["t"] * (1e3 if units[0] == "ms" else 1.0),
        scale * RUN["position"],
        scale * RUN["velocity"],
        RUN["torque"],
    )
    np.savez(tmp_path / "run.npz", **dict(zip(names, columns, strict=True)))
    reading = Reading(tmp_path / "run.npz")
    assert tuple(guess.unit for guess in reading.guesses) == units
    np.testing.assert_allclose(reading.motion.joints[0].position, RUN["position"])
    np.testing.assert_allclose(reading.motion.time, RUN["t"])


@pytest.mark.parametrize("zero", [0.0, np.pi])
@pytest.mark.parametrize("seed", [6, 15, 16])
def test_an_angle_of_noise_alone_shows_nowhere_that_it_hangs(tmp_path: Path, seed: int, zero: float) -> None:
    generator = np.random.default_rng(seed)
    counts = np.round(0.6 * generator.normal(size=500))
    torque = np.repeat(generator.normal(size=100), 5)
    np.savez(tmp_path / "run.npz", t=0.02 * np.arange(500), theta=zero + 2.0 * np.pi / 4096 * counts, torque=torque)
    position = next(guess for guess in Reading(tmp_path / "run.npz").guesses if guess.quantity == "position")
    assert "that 0 hangs down is assumed" in position.how


def test_a_motion_that_something_unseen_may_drive_is_marked(tmp_path: Path) -> None:
    t = 0.01 * np.arange(2000)
    held = 0.6 * np.sin(3.0 * t) + 1e-3 * np.random.default_rng(0).normal(size=t.size)
    for name, ref, words in (("a.npz", {}, "if nothing drives it"), ("b.npz", {"ref": np.sin(3.0 * t)}, "is assumed")):
        np.savez(tmp_path / name, t=t, theta=held, **ref)
        position = next(guess for guess in Reading(tmp_path / name).guesses if guess.quantity == "position")
        assert position.assumed
        assert words in position.how


def test_an_x_alone_may_be_an_angle(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", t=RUN["t"], x=RUN["position"], u=RUN["torque"])
    assert not Reading(tmp_path / "run.npz").motion.joints[0].slides


def test_a_cart_is_a_place_and_the_column_that_another_hides_is_listed(tmp_path: Path) -> None:
    states = {"x": 0.1 * RUN["position"], "theta": RUN["position"], "theta_filtered": RUN["position"]}
    np.savez(tmp_path / "run.npz", t=RUN["t"], **states, u=RUN["torque"])
    reading = Reading(tmp_path / "run.npz")
    assert [joint.slides for joint in reading.motion.joints] == [True, False]
    assert ("left out", "theta_filtered") in {(guess.quantity, guess.column) for guess in reading.guesses}


def test_an_encoder_between_two_counts_is_one_motion_and_the_applied_torque_its_input(tmp_path: Path) -> None:
    flips = np.round(np.random.default_rng(0).random(RUN["t"].size))
    efforts = {"effort": RUN["torque"] + 0.1 * flips, "applied_effort": RUN["torque"]}
    np.savez(tmp_path / "run.npz", t=RUN["t"], theta=-102.26 + 0.09 * flips, **efforts)
    reading = Reading(tmp_path / "run.npz")
    assert reading.rules.joints[""]["input"] == {"column": "applied_effort", "unit": "N m", "hold": "zero"}
    assert np.unique(np.round(reading.motion.joints[0].position, 6)).size == 2


def test_a_position_that_stands_still_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", t=RUN["t"], theta=np.full(RUN["t"].size, 3.0), u=RUN["torque"])
    for topics in ((), ("position=theta",)):
        with pytest.raises(DataError, match=r"the position theta is 3 throughout; expected a plant that moves"):
            Reading(tmp_path / "run.npz", topics=topics).rules  # noqa: B018


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"theta": RUN["position"]}, r"has no column of time; it has theta: --dt SECONDS"),
        ({"a": RUN["position"], "b": RUN["torque"], "t": RUN["t"]}, r"plainly the position; expected names .*a \("),
    ],
)
def test_what_cannot_be_determined_is_refused_with_what_there_is(tmp_path: Path, arrays: Any, words: str) -> None:
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(DataError, match=words):
        Reading(tmp_path / "run.npz").rules  # noqa: B018


def test_options_name_what_a_file_does_not(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", a=RUN["position"], b=RUN["torque"])
    reading = Reading(tmp_path / "run.npz", topics=("position=a", "input=b"), dt=DT)
    np.testing.assert_allclose(reading.motion.time, RUN["t"])
    assert reading.motion.joints[0].drive is not None
    foreign_bag(tmp_path / "bag")
    chosen = Reading(tmp_path / "bag", topics=("joint_states=/robot/state", "effort=/cmd/data.0"))
    np.testing.assert_allclose(chosen.motion.joints[0].position, RUN["position"])
    # A name that another recording has is shown where this one lacks it, and does not keep its own from being found.
    named = save(tmp_path / "named.npz", RUN)
    other = Reading(named, topics=("position=a",))
    assert other.rules.joints[""]["position"] == Reading(named).rules.joints[""]["position"]
    assert ("position", "", True) in [(one.quantity, one.column, one.assumed) for one in other.guesses]
    with pytest.raises(DataError, match=r"named.npz has no 'a', which --topic names for position; expected one of t"):
        readings_of([named], topics=["position=a"])[0].rules  # noqa: B018
    with pytest.raises(DataError, match=r"--topic is 'angle=a'; expected ROLE=NAME"):
        Reading(tmp_path / "run.npz", topics=("angle=a",)).rules  # noqa: B018


def test_damaged_files_are_refused_in_a_sentence(tmp_path: Path) -> None:
    for name in ("a.mat", "b.npz", "c.npy", "d.parquet", "e.bag", "f.h5", "g.json"):
        (tmp_path / name).write_bytes(b"nothing of that kind")
        with pytest.raises(DataError, match=name):
            Reading(tmp_path / name).columns  # noqa: B018


def test_recordings_of_real_labs_are_read_without_a_mapping(shared_data: Path) -> None:
    arm = Reading(shared_data / "dynamicslab_multiarm" / "SinglePendulumDataForParameterEstimation.mat")
    assert len(arm.motion.joints) == 1
    assert any("tested: 0 is upright" in guess.how for guess in arm.guesses)
    qube = Reading(next((shared_data / "qube_upright").glob("*.csv")))
    theta, alpha = qube.motion.joints
    assert (theta.name, alpha.name) == ("theta", "alpha")
    assert np.median(alpha.position) == pytest.approx(np.pi, abs=0.05)  # balanced upright
    double = Reading(shared_data / "dfki_double_pendulum" / "c1_143339.csv")
    assert [joint.drive is not None for joint in double.motion.joints] == [True, True]


@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_objects_of_matlab_are_read(tmp_path: Path, version: str) -> None:
    matio = pytest.importorskip("matio")
    import pandas as pd
    from matio.utils import MatlabOpaque

    def timeseries(values: np.ndarray, times: dict[str, object]) -> MatlabOpaque:
        info = MatlabOpaque({"Units": "milliseconds", **times}, "tsdata.timemetadata")
        return MatlabOpaque(
            {"Data_": values.reshape(1, 1, -1), "Time_": np.zeros((0, 0)), "TimeInfo": info}, "timeseries"
        )

    empty, count = np.zeros((0, 0)), RUN["t"].size
    stated = {"Time_": 1e3 * RUN["t"][:, None], "Start_": empty, "Increment_": empty, "Length": float(count)}
    equal = {"Time_": empty, "Start_": 0.0, "Increment_": 1e3 * DT, "Length": float(count)}
    signals = np.empty((1, 2), object)
    for index, (name, key) in enumerate((("theta", "position"), ("omega", "velocity"))):
        held = {"Name": name, "Values": timeseries(RUN[key], stated if index else equal)}
        signals[0, index] = MatlabOpaque(held, "Simulink.SimulationData.Signal")
    storage = MatlabOpaque({"Elements": signals}, "Simulink.SimulationData.Storage.RamDatasetStorage")
    table = pd.DataFrame({"tau": RUN["torque"]}, index=pd.to_timedelta(RUN["t"], unit="s"))
    path = tmp_path / "run.mat"
    content = {
        "logsout": MatlabOpaque({"Storage": storage}, "Simulink.SimulationData.Dataset"),
        "run": {"table": table, "gain": np.array([2.0])},
    }
    matio.save_to_mat(str(path), content, version=version)

    columns = Reading(path).columns
    for name, key in (("logsout.theta", "position"), ("logsout.omega", "velocity"), ("run.table.tau", "torque")):
        np.testing.assert_allclose(columns.values(name), RUN[key])
        np.testing.assert_allclose(columns.values(columns.columns[name].clock), RUN["t"], atol=1e-9)


def test_objects_of_matlab_need_their_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matio = pytest.importorskip("matio")
    import pandas as pd

    table = {"T": pd.DataFrame({"theta": RUN["position"]}, index=pd.to_timedelta(RUN["t"], unit="s"))}
    for version in ("v7", "v7.3"):
        matio.save_to_mat(str(tmp_path / f"{version}.mat"), table, version=version)
    scipy.io.savemat(tmp_path / "struct.mat", {"theta": {"time": RUN["t"], "data": RUN["position"]}})
    monkeypatch.setitem(sys.modules, "matio", None)
    for version in ("v7", "v7.3"):
        with pytest.raises(DataError, match=r"objects of MATLAB, .*pip install mat-io.*'data', theta.Data\)"):
            Reading(tmp_path / f"{version}.mat").columns  # noqa: B018
    # What that sentence has MATLAB make.
    np.testing.assert_allclose(Reading(tmp_path / "struct.mat").motion.joints[0].position, RUN["position"])


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_a_long_recording_is_in_memory_once(tmp_path: Path, unit: str) -> None:
    count = 200_000
    t = 0.001 * np.arange(count)
    columns = {"time": t, "angle": np.sin(t), "speed": np.cos(t), "torque": np.cos(3.0 * t)}
    np.savez(tmp_path / "run.npz", **columns)
    mapping = {
        "time": {"column": "time", "unit": "s"},
        "position": {"column": "angle", "unit": unit},
        "velocity": {"column": "speed", "unit": f"{unit}/s"},
        "input": {"column": "torque", "unit": "N m"},
    }
    reading = Reading(tmp_path / "run.npz", mapping)
    assert reading.columns.columns.keys() == columns.keys()
    Reading(tmp_path / "run.npz", mapping).motion  # noqa: B018 (what is imported late is no part of it)
    tracemalloc.start()
    motion = reading.motion
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert motion.time.size == count
    assert held < 4.2 * 8 * count
    assert peak < 6.0 * 8 * count


def test_a_log_of_simulink_from_a_real_lab_is_read(shared_data: Path) -> None:
    pytest.importorskip("matio")
    columns = Reading(shared_data / "dynamicslab_multiarm" / "SinglePendulumArm_RawData_1.mat").columns
    assert list(columns.columns) == ["data.Time", "data.Add2:1", "data.Product1:1"]
    assert np.median(np.diff(columns.values("data.Time"))) == pytest.approx(0.001)


# -- compare -----------------------------------------------------------------------------------------------------


def save(path: Path, run: dict[str, np.ndarray], *, scale: float = 1.0, later: int = 0, torque: float = 1.0) -> Path:
    part = {key: values[later:] for key, values in run.items()}
    np.savez(path, t=part["t"], theta=scale * part["position"], torque=torque * part["torque"])
    return path


def compared(capsys: pytest.CaptureFixture[str], *paths: Path, code: int = 0) -> dict[str, Any]:
    assert compare_main([*map(str, paths), "--json"]) == code
    said = capsys.readouterr()
    return json.loads(said.out) if code == 0 else {"error": " ".join(said.err.split())}


def test_one_input_that_acts_throughout_has_the_tests_of_an_experiment(tmp_path: Path, capsys: Any) -> None:
    struct_with_time(tmp_path / "sim.mat")
    hardware = save(tmp_path / "hw.npz", swing(damping=0.55, noise=0.5, seed=1), later=150)
    found = compared(capsys, tmp_path / "sim.mat", hardware)
    assert any("is moved by 1.500 s, where the inputs of both" in note for note in found["notes"])
    assert {test["quantity"] for test in found["verdict"]["tests"]} >= {"delay", "distance of angles"}
    same = found["answer"]["layers"]
    assert [layer["mark"] for layer in same[1:]] == ["not measured"] * 3
    assert "hw.npz has no disturbance" in same[1]["sentence"]
    wrong = compared(capsys, tmp_path / "sim.mat", save(tmp_path / "no.npz", swing(damping=4.0, noise=0.5, seed=1)))
    assert wrong["answer"]["mark"] == "no"
    late = {"t": RUN["t"][2:], "position": RUN["position"][:-2], "torque": RUN["torque"][2:]}
    steps = compared(capsys, tmp_path / "sim.mat", save(tmp_path / "late.npz", late))["answer"]["next_steps"]
    assert steps[0].startswith("Give the simulation of sim.mat")  # it has no plant file
    assert steps[0].endswith("ms more delay than now; measure again.")


def test_degrees_that_were_taken_for_radians_make_no_verdict(tmp_path: Path, capsys: Any) -> None:
    run = swing()
    small = {**run, "position": 0.01 * run["position"], "torque": 0.01 * run["torque"]}
    sim, hardware = save(tmp_path / "sim.npz", small, scale=180.0 / np.pi), save(tmp_path / "hw.npz", small)
    said = compared(capsys, sim, hardware, code=2)["error"]
    assert "moves 0.0175 times as much" in said
    assert "correct the units of sim.npz to deg and deg/s" in said


@pytest.mark.parametrize(
    ("sign", "zero", "words"),
    [(-1.0, 0.0, "moves against the simulation's"), (1.0, np.pi, "as an angle that is 0 upright on one side would be")],
    ids=["sign", "zero"],
)
def test_a_guessed_sign_or_zero_makes_no_verdict(
    tmp_path: Path, capsys: Any, sign: float, zero: float, words: str
) -> None:
    for name, run, s, z in (("sim.npz", RUN, 1.0, 0.0), ("hw.npz", swing(noise=0.5, seed=1), sign, zero)):
        # A motion that follows a reference, without the input, does not show where the angle hangs.
        states = {"theta": s * run["position"] + z, "omega": s * run["velocity"]}
        np.savez(tmp_path / name, t=run["t"], ref=run["torque"], **states)
    pair, written = [str(tmp_path / "sim.npz"), str(tmp_path / "hw.npz")], tmp_path / "columns.yaml"
    assert compare_main([*pair, "--write-mapping", str(written)]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    # The hint works when it is followed.
    rules = yaml.safe_load(written.read_text())
    corrected = copy.deepcopy(rules)
    for key in ("position", "velocity"):
        corrected[key] |= {"sign": int(sign)} | ({"offset": -zero} if key == "position" else {})
    rules = {"format": rules["format"], "recordings": {"sim.npz": rules, "hw.npz": corrected}}
    for one in rules["recordings"].values():
        del one["format"]
    written.write_text(yaml.safe_dump(rules))
    assert compare_main([*pair, "--mapping", str(written), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["answer"]["mark"] != "no"


@pytest.mark.parametrize("voltage", [False, True])
def test_an_input_that_one_side_lacks_or_has_in_another_unit_is_no_test(
    tmp_path: Path, capsys: Any, voltage: bool
) -> None:
    for name, run in (("sim.npz", RUN), ("hw.npz", swing(noise=0.5, seed=1))):
        motor = {"torque": run["torque"]} if name == "sim.npz" else {"u_volt": 5.0 * run["torque"]} if voltage else {}
        np.savez(tmp_path / name, t=run["t"], theta=run["position"], noise=run["torque"], **motor)
    found = compared(capsys, tmp_path / "sim.npz", tmp_path / "hw.npz")
    assert not any("torque" in test["quantity"] for test in found["verdict"]["tests"])
    assert any("The inputs are not compared" in note for note in found["notes"])
    assert compare_main([str(tmp_path / "sim.npz"), str(tmp_path / "hw.npz")]) == 0
    assert "max |u|" not in capsys.readouterr().out


def test_a_mapping_whose_velocity_is_no_derivative_makes_no_verdict(tmp_path: Path, capsys: Any) -> None:
    names = "time,position,velocity,torque"
    for name, turn in (("sim.csv", 1.0), ("hw.csv", 180.0 / np.pi)):
        run = swing(noise=0.5, seed=int(turn))
        rows = np.stack([run["t"], run["position"], turn * run["velocity"], run["torque"]], axis=1)
        np.savetxt(tmp_path / name, rows, delimiter=",", header=names, comments="")
    said = compared(capsys, tmp_path / "sim.csv", tmp_path / "hw.csv", code=2)["error"]
    assert "the velocity is 57.3 times the derivative" in said
    assert "by its name, as pendulum has it" in said  # what the names chose is shown


def step(seed: int, *, damping: float = 0.5) -> dict[str, np.ndarray]:
    """Return a swing after one step of the input, from a start that differs a little."""
    generator = np.random.default_rng(seed)
    torque = np.where(np.arange(800) < 100, 0.0, 1.0)
    angle, speed, rows = 0.005 * generator.normal(), 0.0, []
    for u in torque:
        rows.append((angle, speed))
        for _ in range(20):
            speed += (-20.0 * np.sin(angle) - damping * speed + 8.0 * u) * DT / 20.0
            angle += speed * DT / 20.0
    position, velocity = np.array(rows).T
    noise = generator.normal(0.0, 1e-3, position.size)
    return {"t": DT * np.arange(800), "position": position + noise, "velocity": velocity, "torque": torque}


def test_one_run_under_a_step_is_described_and_not_judged(tmp_path: Path, capsys: Any) -> None:
    sim, hardware = save(tmp_path / "sim.npz", step(0)), save(tmp_path / "hw.npz", step(1), later=30)
    found = compared(capsys, sim, hardware)
    assert found["answer"]["mark"] == "undecided"
    assert not found["verdict"]["tests"]
    assert "how much the machine varies from run to run is not in the files" in found["answer"]["sentence"]
    assert "three times or more" in " ".join(found["answer"]["next_steps"])


def test_repeated_runs_are_judged_by_what_they_vary_and_have_a_band(tmp_path: Path, capsys: Any) -> None:
    runs = [save(tmp_path / f"run{seed}.npz", step(seed)) for seed in range(1, 6)]
    good = compared(capsys, save(tmp_path / "sim.npz", step(0)), *runs)
    assert good["answer"]["mark"] == "yes"
    assert good["operating_band"]["coverage"] > 0.8
    assert all(test["blocks"] == 5 for test in good["verdict"]["tests"])
    bad = compared(capsys, save(tmp_path / "bad.npz", step(0, damping=3.0)), *runs)
    assert bad["answer"]["mark"] == "no"
    assert bad["operating_band"]["coverage"] < 0.6


def test_inputs_that_differ_say_nothing_of_the_plants(tmp_path: Path, capsys: Any) -> None:
    sim, hardware = save(tmp_path / "sim.npz", step(0)), save(tmp_path / "hw.npz", step(1), torque=2.0)
    found = compared(capsys, sim, hardware)
    assert found["answer"]["mark"] == "undecided"
    assert (
        "the inputs of both differ in size: the hardware's is 2 times the simulation's" in found["answer"]["sentence"]
    )


@pytest.mark.parametrize("command", [identify_main, replay_main])
def test_no_command_guesses_silently(tmp_path: Path, capsys: Any, command: Callable[[list[str]], int]) -> None:
    struct_with_time(tmp_path / "run.mat")
    written = tmp_path / "columns.yaml"
    command([str(tmp_path / "run.mat"), "--write-mapping", str(written), "--json"])
    shown = capsys.readouterr()
    assert "theta.signals.values" in shown.err
    json.loads(shown.out)  # the table is not among the numbers
    command([str(tmp_path / "run.mat"), "--mapping", str(written), "--json"])
    assert "Guessed" not in capsys.readouterr().err


def test_an_error_is_not_covered_by_a_mapping_that_could_not_be_written(tmp_path: Path, capsys: Any) -> None:
    missing, written = str(tmp_path / "no.mat"), ["--write-mapping", str(tmp_path / "columns.yaml")]
    for command, recordings in ((replay_main, [missing]), (compare_main, [missing, missing])):
        assert command([*recordings, *written]) == 2
        assert "no.mat does not exist" in capsys.readouterr().err


def test_a_bag_of_two_joints_has_figures_of_both(tmp_path: Path, capsys: Any) -> None:
    with BagWriter(tmp_path / "bags" / "two") as writer:
        writer.add_topic("/joint_states", "sensor_msgs/msg/JointState")
        for t, q, v in zip(RUN["t"], RUN["position"], RUN["velocity"], strict=True):
            now = BEGIN + round(1e9 * t)
            writer.write(
                "/joint_states", now, encode_joints(now, "", ("arm", "rod"), (2.0 * q, q), (2.0 * v, v), (0.0, 0.0))
            )
    out = tmp_path / "out"
    assert analyse_main([str(tmp_path / "bags"), "--ask", "metrics", "-o", str(out)]) == 0
    (row,) = json.loads((out / "bags.json").read_text())
    assert row["arm.std_theta"] == pytest.approx(2.0 * row["rod.std_theta"])


def test_one_recording_in_two_formats_is_no_pair_and_no_repetition(tmp_path: Path, capsys: Any) -> None:
    struct_with_time(tmp_path / "sim.mat")
    npz(tmp_path / "copy.npz")
    assert (
        "hold one and the same recording"
        in compared(capsys, tmp_path / "sim.mat", tmp_path / "copy.npz", code=2)["error"]
    )
    thin, lines = np.sort(np.random.default_rng(0).permutation(800)[:500]), np.linspace(0.0, 7.2, 1500)
    copies = {
        "rows left out": {key: values[thin] for key, values in step(1).items()},
        "resampled": {key: np.interp(lines, step(1)["t"], values) for key, values in step(1).items()},
        "cut, and another zero of the clock": {
            key: values[100:] - (key == "t") for key, values in step(1).items()
        },
        "cut at both ends, and another zero of the clock": {
            key: values[100:700] - (key == "t") for key, values in step(1).items()
        },
    }  # fmt: skip
    for run in copies.values():
        pair = save(tmp_path / "run.npz", step(1)), save(tmp_path / "copy.npz", run)
        assert "hold one and the same recording" in compared(capsys, *pair, code=2)["error"]
    sim, one, again = (save(tmp_path / f"{name}.npz", step(seed)) for name, seed in (("s", 0), ("a", 1), ("b", 1)))
    assert "hold one and the same recording" in compared(capsys, sim, one, again, code=2)["error"]
