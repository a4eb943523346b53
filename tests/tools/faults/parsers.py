"""Everything that reads a file of somebody else's: how to make a good one, how to read it, how to spoil it.

A parser survives a file when it returns or raises a :class:`PendulumError`, within the memory and the time that it is
given. Anything else is a finding.
"""

from __future__ import annotations

import json
import random
import shutil
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pendulum_bags.identification.result import load_fit_model
from pendulum_bags.recordings.reading import Reading
from pendulum_bags.runs.read_recording import read_recording
from pendulum_bags.studies.study_file import load_study
from pendulum_hw_bridge.backends.replay import load_feedback
from pendulum_hw_bridge.port.gains import DEFAULT_GAINS, load_gains, write_gains
from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import PendulumError
from pendulum_msgs_py.plants.plant_parameters import load_plant, write_plant
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.statistics import bag_statistics
from pendulum_rosbag.recorder.options import read_metadata
from pendulum_rosbag.storage import BagWriter
from pendulum_rosbag.storage import mcap_records as rec

__all__ = ["PARSERS", "Parser", "mutate", "read_whole_bag"]

_WHOLE = "whole_bag"
"""Folder of a bag whose storage file is read together with its metadata."""
_START_NS = 1_700_000_000_000_000_000
_CSV = "time,position,velocity,torque\n" + "".join(
    f"{0.01 * i:.2f},{0.001 * i:.4f},0.1,{0.2 * (-1) ** i}\n" for i in range(60)
)
_MAPPING = """\
format: pendulum_columns/1
delimiter: ","
time: {column: time, unit: s, start: 0.0}
position: {column: [angle, position], unit: rad, sign: 1, offset: 0.0}
velocity: {column: velocity, unit: rad/s, optional: true}
input: {column: torque, unit: N m, hold: linear}
rows: [0, 50]
meta: {mass: 1.0}
"""
_WORDS = (
    b"nan", b"-.inf", b"1e999", b"-1", b"0", b"9" * 5000, b"null", b"~", b"{}", b"[]", b"[[[[", b"&a", b"*a",
    b"!!python/name:os.system", b"<<:", b"\x00", b"\xff\xfe", b"\xe2\x80\xa8", b"\n", b":", b"- ", b"'", b'"',
    b"2001-01-01", b"true", b"1:30", b"0x10", b"\t", b"{a: 1}",
    b"999999999999", b",", b"NaN", b"Infinity",
)  # fmt: skip
_NUMBERS = (0, 1, *(2**bits + off for bits in (7, 8, 15, 16, 31, 32, 40, 62, 63, 64) for off in (-1, 0)))


@dataclass(frozen=True)
class Parser:
    """One kind of file.

    Attributes:
        name: For the table.
        make: Writes a good file or bag under a folder and returns its path.
        read: Reads it as far as the project ever does.
        text: The format is text, so that words are worth trying.
        slow: Reading starts a process, so that the short form tries a few files only.
    """

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    text: bool = False
    slow: bool = False

    def survives(self, path: Path) -> str:
        """Return an empty string where the parser stands the file, else what it did instead."""
        try:
            self.read(path)
        except PendulumError as error:
            return "" if str(error) else f"{type(error).__name__} without a sentence"
        except Exception as error:  # noqa: BLE001 (what this is about)
            place = error.__traceback__
            while place is not None and place.tb_next is not None:
                place = place.tb_next
            where = f"{Path(place.tb_frame.f_code.co_filename).name}:{place.tb_lineno}" if place else "?"
            return f"{type(error).__name__} at {where}: {str(error)[:200]}"
        return ""


def read_whole_bag(path: Path) -> None:
    """Read everything that a bag has, in every way that the reader offers."""
    with read_bag(path) as bag:
        problems: list[PendulumError] = []
        for topic in bag.topics:
            for way in (bag.__getitem__, bag.raw, bag.log_times):
                try:
                    way(topic)
                except PendulumError as error:
                    problems.append(error)
        bag.events()
        bag_statistics(bag)
        if problems:
            raise problems[0]


def mutate(data: bytes, generator: random.Random, *, text: bool = False) -> bytes:
    """Return the bytes with one to four things wrong: bits, bytes, numbers, words, cuts, repetitions, swaps."""
    spoilt = bytearray(data)
    for _ in range(generator.choice((1, 1, 1, 2, 4))):
        if not spoilt:
            break
        at = generator.randrange(len(spoilt))
        kind = generator.randrange(8)
        if kind == 0:
            spoilt[at] ^= 1 << generator.randrange(8)
        elif kind == 1:
            spoilt[at] = generator.randrange(256)
        elif kind == 2:
            size = generator.choice((1, 2, 4, 8))
            number = generator.choice(_NUMBERS) & (2 ** (8 * size) - 1)
            spoilt[at : at + size] = number.to_bytes(size, generator.choice(("little", "big")))
        elif kind == 3:
            del spoilt[at:]
        elif kind == 4:
            del spoilt[at : at + generator.randrange(1, 65)]
        elif kind == 5:
            size = generator.randrange(1, 257)
            spoilt[at:at] = spoilt[at : at + size] * generator.choice((1, 1, 1, 50))
        elif kind == 6 and text:
            spoilt[at : at + generator.randrange(12)] = generator.choice(_WORDS)
        elif text:
            # A whole line is worth more than a letter: replace the value behind a colon or a comma.
            marks = [place for place, byte in enumerate(spoilt) if byte in b":,="]
            place = generator.choice(marks) + 1 if marks else at
            ends = [found for mark in b"\n,}" if (found := spoilt.find(mark, place)) >= 0]
            end = min(ends, default=len(spoilt))
            spoilt[place:end] = b" " + generator.choice(_WORDS)
        else:
            size, other = generator.randrange(1, 65), generator.randrange(len(spoilt))
            spoilt[at : at + size] = spoilt[other : other + size]
    return bytes(spoilt)


# --- good files ------------------------------------------------------------------------------------------------


def _text_file(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_text(text, encoding="utf-8")
        return path

    return make


def _plant(folder: Path) -> Path:
    return write_plant(folder / "plant.yaml", load_plant("x5_9"), provenance={"method": "fit", "samples": 100})


def _study(folder: Path) -> Path:
    path = folder / "study.yaml"
    path.write_text(
        "format: pendulum_study/1\nname: small\ndescription: What a fuzzer likes.\nexperiment: run\nduration: 0.1\n"
        "plants: {thesis: {side: sim, engine: process, parameters: {}}}\n"
        "controllers: {lqr: {q: [100.0, 1.0], r: 0.1}, pid: {}}\n"
        "disturbances: {none: {}, noise: {kind: uniform, amplitude: 2.5, hold_time: 0.01}}\n"
        "set_points: [0.0, 0.1]\nstarts: [upright, random, 0.3]\nseeds: {first: 1, count: 2}\nrepeats: 2\n",
        encoding="utf-8",
    )
    return path


def _servo_log(folder: Path) -> Path:
    entries = [
        {
            "timestamp": 0.01 * i,
            "position": 0.1 * i,
            "speed": 10.0,
            "goal_position": 0.1 * i,
            "torque_enable": True,
            "load": 12,
            "input_volts": 12.0,
            "temp": 30,
        }
        for i in range(20)
    ]
    path = folder / "log.json"
    log = {"mass": 0.5, "length": 0.1, "kp": 32, "vin": 12.0, "entries": entries}
    path.write_text(json.dumps(log), encoding="utf-8")
    return path


def _gains(folder: Path) -> Path:
    return write_gains(folder / "gains.xml", DEFAULT_GAINS[4])


def _feedback_npz(folder: Path) -> Path:
    time = np.arange(20) * 0.01
    path = folder / "feedback.npz"
    np.savez_compressed(path, time=time, position=time, velocity=time, effort=time)
    return path


def read_motion(path: Path) -> object:
    """Read a recording by the guess of its columns."""
    return Reading(path).motion


def _feedback_csv(folder: Path) -> Path:
    path = folder / "feedback.csv"
    rows = "".join(f"{0.01 * i:.2f},{0.1 * i:.2f},10.0,0.5\n" for i in range(20))
    path.write_text(f"time,position,velocity,effort\n{rows}", encoding="utf-8")
    return path


def make_bag(folder: Path, storage: str = "mcap", compression: str | None = None) -> Path:
    """Write a small bag of states, commands and events, as the recorder does."""
    bag = folder / "bag"
    with BagWriter(bag, storage, compression, metadata={"pendulum.run": {"seed": 1}}) as writer:
        writer.add_topic("/sim/joint_states", "sensor_msgs/msg/JointState")
        writer.add_topic("/sim/effort_command", "sensor_msgs/msg/JointState")
        writer.add_topic("/sim/events", "std_msgs/msg/String")
        for i in range(40):
            now = _START_NS + 2_000_000 * i
            writer.write("/sim/joint_states", now, encode_joint_state(now, position=3.1, velocity=0.1, effort=0.2))
            command = encode_joint_state(now, frame_id="/sim/controller", effort=0.2)
            writer.write("/sim/effort_command", now + 1000, command)
            if i % 10 == 0:
                text = json.dumps({"stamp_ns": now, "name": "noise"}).encode() + b"\0"
                writer.write("/sim/events", now, b"\0\1\0\0" + struct.pack("<I", len(text)) + text)
    return bag


def _bag_file(storage: str, compression: str | None = None) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        bag = make_bag(folder, storage, compression)
        (file,) = (path for path in bag.iterdir() if path.suffix in {".mcap", ".db3"})
        return file

    return make


def _bag_of_own_types(folder: Path) -> Path:
    """Write an MCAP file whose message is of a type that only the file defines."""
    separator = "\n" + "=" * 80 + "\n"
    definition = (
        '# a comment\nint32 LIMIT=3\nown/Part[2] parts\nown/Part[<=3] more\nfloat64[3] numbers\nstring<=9 text "t"\n'
        f"builtin_interfaces/Time at\n{separator}MSG: own/Part\nuint8 a\nbool[] flags\n"
        f"{separator}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    data = b"\0\1\0\0" + bytes(48) + b"\1" + bytes(47)  # the text is not longer than its end
    path = folder / "own_types.mcap"
    path.write_bytes(
        rec.MAGIC
        + rec.header_record("fuzz")
        + rec.schema_record(1, "own/msg/Whole", "ros2msg", definition)
        + rec.channel_record(1, 1, "/own", "cdr", {})
        + rec.MESSAGE_HEADER.pack(rec.MESSAGE, 22 + len(data), 1, 0, 5, 5)
        + data
        + rec.record(rec.DATA_END, bytes(4))
        + rec.footer_record(0, 0)
        + rec.MAGIC
    )
    return path


def _bag_metadata(folder: Path) -> Path:
    return make_bag(folder) / "metadata.yaml"


def _feedback_bag(storage: str) -> Callable[[Path], Path]:
    make_file = _bag_file(storage)

    def make(folder: Path) -> Path:
        file = make_file(folder)
        whole = file.parent.rename(folder / _WHOLE)
        return whole / file.name

    return make


def _read_csv_by(mapping: Path) -> object:
    data = mapping.with_name("data.csv")
    if not data.exists():
        data.write_text(_CSV, encoding="utf-8")
    return read_recording(data, mapping)


def _study_runs(path: Path) -> object:
    return [(run.name, run.fingerprint()) for run in load_study(path).runs[:50]]


def _fit_model(folder: Path) -> Path:
    model = {"format": "pendulum_identification/1", "parameters": {}, "input_kind": "effort", "friction": "stribeck"}
    return _text_file("identification.json", json.dumps({**model, "duty_gain": 1.0}))(folder)


PARSERS: Sequence[Parser] = (
    Parser("plant YAML", _plant, load_plant, text=True),
    Parser("study YAML", _study, _study_runs, text=True),
    Parser("CSV mapping", _text_file("mapping.yaml", _MAPPING), _read_csv_by, text=True),
    Parser("CSV", _text_file("data.csv", _CSV), read_recording, text=True),
    Parser("JSON log", _servo_log, read_recording, text=True),
    Parser("NPZ", _feedback_npz, read_motion),
    Parser("identification JSON", _fit_model, load_fit_model, text=True),
    Parser("run metadata JSON", _text_file("run.json", '{"pendulum.run": {"seed": 1}}'), read_metadata, text=True),
    Parser("HEBI gains XML", _gains, load_gains, text=True),
    Parser("feedback NPZ", _feedback_npz, load_feedback),
    Parser("feedback CSV", _feedback_csv, load_feedback, text=True),
    Parser("feedback bag: MCAP", _feedback_bag("mcap"), lambda path: load_feedback(path.parent), slow=True),
    Parser("feedback bag: SQLite", _feedback_bag("sqlite3"), lambda path: load_feedback(path.parent), slow=True),
    Parser("bag: metadata.yaml", _bag_metadata, lambda path: read_whole_bag(path.parent), text=True),
    Parser("bag: MCAP", _bag_file("mcap"), read_whole_bag),
    Parser("bag: MCAP in zstd chunks", _bag_file("mcap", "zstd"), read_whole_bag),
    Parser("bag: own types", _bag_of_own_types, read_whole_bag, text=True),
    Parser("bag: SQLite", _bag_file("sqlite3"), read_whole_bag),
)


def copy_of(path: Path, folder: Path) -> Path:
    """Copy a file, or the bag around it, to a folder of its own."""
    if path.name == "metadata.yaml" or path.parent.name == _WHOLE:
        return Path(shutil.copytree(path.parent, folder / path.parent.name, dirs_exist_ok=True)) / path.name
    return Path(shutil.copy2(path, folder / path.name))
