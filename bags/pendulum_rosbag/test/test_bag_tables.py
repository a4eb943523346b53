"""What is told of a bag: timing, latencies, tables, and the commands that print them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from pendulum_msgs_py.contract.cdr import encode_joint_state, encode_joints
from pendulum_msgs_py.errors import BagError, DataError, ParameterError
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.export_cli import main as export_main
from pendulum_rosbag.reader.info_cli import main as info_main
from pendulum_rosbag.reader.statistics import bag_statistics, clock_jumps, time_statistics
from pendulum_rosbag.reader.tables import export_bag, to_pandas
from pendulum_rosbag.storage import BagWriter
from pendulum_testing.bag_messages import JOINT_STATE, STORE, joint_state


def test_timing_finds_gaps_duplicates_and_clock_jumps() -> None:
    stamps = np.arange(1000, dtype=np.int64) * 2_000_000
    stamps = np.delete(stamps, [500, 501, 502])
    stamps[100] = stamps[99]
    log = stamps + 300_000
    log[700:] += 200_000_000
    result = time_statistics(JOINT_STATE, log, stamps)
    assert result.count == 997
    assert result.rate == pytest.approx(500, rel=0.01)
    assert result.period == pytest.approx(2.0)
    assert result.longest == pytest.approx(8.0)
    assert result.duplicates == 1
    assert result.clock_jumps == 1
    assert result.age == pytest.approx(0.3)
    assert result.gaps == 2  # three lost messages, and the one whose stamp was doubled
    assert result.missing == 4


def test_a_late_message_is_a_gap_but_none_is_missing() -> None:
    stamps = np.arange(100, dtype=np.int64) * 2_000_000
    stamps[50] += 1_500_000
    result = time_statistics(JOINT_STATE, stamps, stamps)
    assert (result.gaps, result.missing) == (1, 0)


def test_late_messages_are_no_clock_jumps_whether_one_or_a_queue_of_them() -> None:
    stamps = np.arange(5000, dtype=np.int64) * 2_000_000
    late = stamps + 300_000
    late[1000] += 80_000_000  # one
    for index in range(2000, 2150):  # a recorder that was held up for 0.3 s, and then took all at once
        late[index] = max(int(late[index]), int(stamps[2150]))
    late[-1] += 90_000_000  # the last: nobody can tell
    assert time_statistics(JOINT_STATE, late, stamps).clock_jumps == 0
    assert clock_jumps(late, stamps) == []
    jumping = late + np.where(np.arange(5000) >= 1200, 200_000_000, 0)  # soon after the late one
    assert clock_jumps(jumping, stamps) == [1200]
    source_ahead = stamps + np.where(np.arange(5000) >= 1200, 60_000_000, 0)
    assert clock_jumps(late, source_ahead) == [1200]
    both = stamps + np.where((np.arange(5000) >= 900) & (np.arange(5000) < 4000), 3_600_000_000_000, 0)
    assert clock_jumps(late, both) == [900, 4000]


def test_joint_states_of_any_kind_are_timed_by_their_stamps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bag"
    kinds: dict[str, tuple[list[str], list[float]]] = {"/unnamed": ([], [1.0]), "/two": (["p", "q"], [1.0, 2.0])}
    with BagWriter(path) as writer:
        writer.add_topic("/clock", "rosgraph_msgs/msg/Clock")
        for topic in kinds:
            writer.add_topic(topic, JOINT_STATE)
        for index in range(1, 101):
            log = index * 10_000_000 + (index % 2) * 4_000_000
            for topic, (names, values) in kinds.items():
                writer.write(topic, log, joint_state(index * 10_000_000, "", names, values, [], []))
            writer.write("/clock", log, b"\0\1\0\0" + index.to_bytes(4, "little") + bytes(4))
    bag = read_bag(path)
    statistics = bag_statistics(bag)
    for topic in kinds:
        assert statistics.topics[topic].stamped
        assert statistics.topics[topic].jitter == pytest.approx(0.0)
        assert statistics.topics[topic].age_p99 == pytest.approx(4.0)
    assert not statistics.topics["/clock"].stamped
    with pytest.raises(DataError, match=r"whose joints have no names \(field name is empty, with 1 values\); expected"):
        bag.array("/unnamed")
    with pytest.raises(DataError, match=r"of 2 joints \(p, q\); expected"):
        bag.array("/two")
    assert info_main([str(path)]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert next("stamp" in row for row in rows if "/two" in row)
    assert next("log" in row for row in rows if "/clock" in row)


def test_bursts_of_events_leave_no_gaps_but_a_periodic_topic_without_stamps_does() -> None:
    event = "std_msgs/msg/String"
    bursts = np.array([0, 1_000, 3_000, 4_000, 2_000_000_000, 2_000_001_000, 2_000_004_000], np.int64)
    result = time_statistics(event, bursts)
    assert (result.gaps, result.missing) == (0, 0)
    assert result.longest == pytest.approx(2000, rel=1e-3)
    periodic = np.delete(np.arange(100, dtype=np.int64) * 10_000_000, [50, 51])
    result = time_statistics(event, periodic)
    assert (result.gaps, result.missing) == (1, 2)


@pytest.mark.parametrize("joints", [["pendulum_joint"], ["shoulder", "elbow"]], ids=["one joint", "two joints"])
def test_latencies_are_matched_by_echoed_stamps(tmp_path: Path, joints: list[str]) -> None:
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/joint_states", JOINT_STATE)
        writer.add_topic("/effort_command", JOINT_STATE)
        for index in range(1, 200):
            stamp = index * 2_000_000
            ones = [1.0] * len(joints)
            writer.write("/joint_states", stamp + 100_000, joint_state(stamp, "", joints, ones, ones, ones))
            writer.write("/effort_command", stamp + 350_000, joint_state(stamp, "lqr", joints, [], [], ones))
    statistics = bag_statistics(read_bag(path))
    (latency,) = statistics.latencies
    assert (latency.source, latency.answer, latency.matched) == ("/joint_states", "/effort_command", 199)
    assert latency.median == pytest.approx(0.25)


def test_tables_have_the_columns_of_the_arrays(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, metadata={"seed": 1}) as writer:
        writer.add_topic("/a", JOINT_STATE)
        writer.add_topic("/many", JOINT_STATE)
        writer.write("/a", 1, encode_joint_state(1, position=1.5, frame_id="x"))
        writer.write("/many", 1, joint_state(2, "", ["p", "q"], [1.0, 2.0], [], []))
    bag = read_bag(path)
    assert list(to_pandas(bag, "/a").columns) == [
        "log_time_ns",
        "stamp_ns",
        "position",
        "velocity",
        "effort",
        "frame_id",
    ]
    assert to_pandas(bag, "/many")["q.position"].tolist() == [2.0]
    files = export_bag(bag, tmp_path / "csv", "csv")
    assert [file.name for file in files] == ["a.csv", "many.csv", "metadata.json"]
    assert files[0].read_text().splitlines()[1].startswith("1,1,1.5,,")
    with pytest.raises(ParameterError, match="format is 'xls'; expected one of parquet, csv"):
        export_bag(bag, tmp_path / "xls", "xls")
    with pytest.raises(BagError, match="exists already"):
        export_bag(bag, tmp_path / "csv", "csv")


def test_names_of_matlab_differ_within_63_characters_and_states_have_their_inputs(tmp_path: Path) -> None:
    joints = [f"{'a_long_name_of_a_joint_' * 3}{side}" for side in ("left", "right")]
    with BagWriter(tmp_path / "bag") as writer:
        for topic in ("joint_states", "disturbance", "hw/joint_states", "hw/disturbance", "hw/applied_effort"):
            writer.add_topic(f"/{topic}", JOINT_STATE)
        for stamp in range(4):
            writer.write("/joint_states", stamp, joint_state(stamp, "", joints, [1.0, 2.0], [], []))
            writer.write("/hw/joint_states", stamp, encode_joint_state(stamp, position=0.1 * stamp))
        for stamp in (1, 3):
            writer.write("/disturbance", stamp, joint_state(stamp, "", joints, [], [], [0.5 * stamp, -1.0]))
            writer.write("/hw/disturbance", stamp, encode_joint_state(stamp, effort=0.5 * stamp))
            writer.write("/hw/applied_effort", stamp, encode_joint_state(stamp, effort=-stamp))
    export_bag(read_bag(tmp_path / "bag"), tmp_path / "out", "mat")
    found = scipy.io.loadmat(tmp_path / "out" / "joint_states.mat")
    names = [name for name in found if not name.startswith("__")]
    assert max(map(len, names)) <= 63
    assert [found[name][0, 0] for name in names if name.startswith("a_long")][:2] == [1.0, 2.0]
    assert [0.0, 0.5, 0.5, 1.5] in [found[name].ravel().tolist() for name in names if name.startswith("a_long")]
    one = scipy.io.loadmat(tmp_path / "out" / "hw__joint_states.mat")
    assert one["disturbance_effort"].ravel().tolist() == [0.0, 0.5, 0.5, 1.5]
    assert one["applied_effort"].ravel().tolist() == [0.0, -1.0, -1.0, -3.0]


def bag_of_lists(path: Path) -> Path:
    """Write states of two joints without names, one with a hole, and messages whose lists are all empty."""
    array = STORE.types["diagnostic_msgs/msg/DiagnosticArray"]
    header, time = STORE.types["std_msgs/msg/Header"], STORE.types["builtin_interfaces/msg/Time"]
    empty = array(header(time(1, 2), ""), [])
    with BagWriter(path) as writer:
        writer.add_topic("/many", JOINT_STATE)
        writer.add_topic("/diagnostics", array.__msgtype__)
        writer.write("/many", 1, joint_state(2, "", [], [1.0, float("nan")], [], []))
        writer.write("/diagnostics", 1, bytes(STORE.serialize_cdr(empty, array.__msgtype__)))
    return path


def test_lists_in_csv_are_json_that_every_parser_reads(tmp_path: Path) -> None:
    bag = read_bag(bag_of_lists(tmp_path / "bag"))
    export_bag(bag, tmp_path / "csv", "csv")
    with (tmp_path / "csv" / "many.csv").open(encoding="utf-8") as file:
        (row,) = csv.DictReader(file)

    def refuse(text: str) -> None:
        raise AssertionError(f"{text} is no JSON")

    assert json.loads(row["position"], parse_constant=refuse) == [1.0, None]
    assert json.loads(row["velocity"], parse_constant=refuse) == []


def test_lists_that_are_all_empty_keep_their_type_in_parquet(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow cannot be imported with this numpy")
    bag = read_bag(bag_of_lists(tmp_path / "bag"))
    export_bag(bag, tmp_path / "out")
    many = parquet.read_schema(tmp_path / "out" / "many.parquet")
    kinds = {name: str(many.field(name).type.value_type) for name in ("name", "position", "velocity", "effort")}
    assert kinds == {"name": "string", "position": "double", "velocity": "double", "effort": "double"}
    status = parquet.read_schema(tmp_path / "out" / "diagnostics.parquet").field("status").type
    assert "null" not in str(status)
    assert {"level", "name", "values"} <= {field.name for field in status.value_type}


def test_tables_leave_out_the_constants_of_a_type_and_keep_times_whole_without_messages(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    status = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
    message = status(level=1, name="n", message="m", hardware_id="h", values=[])
    with BagWriter(path) as writer:
        writer.add_topic("/status", message.__msgtype__)
        writer.add_topic("/silent", "std_msgs/msg/String")
        writer.write("/status", 1, bytes(STORE.serialize_cdr(message, message.__msgtype__)))
    bag = read_bag(path)
    assert list(to_pandas(bag, "/status").columns) == [
        "log_time_ns",
        "level",
        "name",
        "message",
        "hardware_id",
        "values",
    ]
    assert to_pandas(bag, "/silent").dtypes.to_dict() == {"log_time_ns": np.dtype(np.int64)}


def test_parquet_reads_back(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", exc_type=ImportError)
    import pandas as pd

    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(10):
            writer.write("/a", index, encode_joint_state(index, position=0.1 * index))
    (file, _) = export_bag(read_bag(path), tmp_path / "out")
    assert pd.read_parquet(file)["position"].tolist() == [0.1 * index for index in range(10)]


def test_an_event_is_printed_with_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bag"
    events = (
        {"name": "plant_mode", "mode": "fault", "reason": "motion stop [m_stop] is pressed"},
        {"name": "trial_start", "trial": 2, "reason": ""},
        {"name": "noise_end"},
    )
    with BagWriter(path) as writer:
        writer.add_topic("/hw/events", "std_msgs/msg/String")
        for index, event in enumerate(events):
            text = json.dumps({"stamp_ns": 1 + index * 10**9, **event})
            data = text.encode() + b"\0"
            writer.write("/hw/events", 1 + index * 10**9, b"\0\1\0\0" + len(data).to_bytes(4, "little") + data)
    assert info_main([str(path)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("event")]
    assert lines == [
        "event    +0.000 s  plant_mode fault: motion stop [m_stop] is pressed",
        "event    +1.000 s  trial_start 2",
        "event    +2.000 s  noise_end",
    ]


def test_the_commands_print_tables_json_and_sentences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, metadata={"run": {"seed": 1}}) as writer:
        writer.add_topic("/a", JOINT_STATE)
        for index in range(100):
            writer.write("/a", 1000 + index * 2_000_000, encode_joint_state(1 + index * 2_000_000, position=0.0))
    assert info_main([str(path)]) == 0
    assert "/a" in (table := capsys.readouterr().out)
    assert "500.000" in table
    assert info_main([str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["topics"]["/a"]["count"] == 100
    assert document["metadata"] == {"run": {"seed": 1}}
    assert export_main([str(path), "-o", str(tmp_path / "out"), "--format", "csv"]) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith("a.csv")
    assert info_main([str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_several_joints_are_written_as_a_column_each_unless_messages_differ(tmp_path: Path) -> None:
    for name, second in (("same", ("p", "q")), ("other", ("q", "p")), ("twice", ("p", "p"))):
        with BagWriter(tmp_path / name) as writer:
            writer.add_topic("/robot/joint_states", JOINT_STATE)
            first = second if name == "twice" else ("p", "q")
            for index, joints in enumerate((first, second)):
                data = encode_joints(index, "robot", joints, (1.0 + index, 2.0), (), (0.5, -0.5))
                writer.write("/robot/joint_states", index, data)
    table = to_pandas(read_bag(tmp_path / "same"), "/robot/joint_states")
    assert table["p.position"].tolist() == [1.0, 2.0]
    assert table["q.effort"].tolist() == [-0.5, -0.5]
    assert table["q.velocity"].isna().all()
    assert table["stamp_ns"].tolist() == [0, 1]
    assert table["frame_id"].tolist() == ["robot", "robot"]
    # Each message names its joints, and may do so in an order of its own.
    turned = read_bag(tmp_path / "other")
    assert to_pandas(turned, "/robot/joint_states")["p.effort"].tolist() == [0.5, -0.5]
    assert turned.joints("/robot/joint_states").of("q")["effort"].tolist() == [-0.5, 0.5]
    assert to_pandas(read_bag(tmp_path / "twice"), "/robot/joint_states")["position"].tolist()[1] == [2.0, 2.0]
    with pytest.raises(DataError, match="export writes a column for each joint"):
        read_bag(tmp_path / "same").array("/robot/joint_states")


def test_states_with_fewer_values_than_joints_stay_lists(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/many", JOINT_STATE)
        writer.write("/many", 1, joint_state(2, "", ["p", "q"], [1.0], [], []))
    assert to_pandas(read_bag(tmp_path / "bag"), "/many")["position"].tolist() == [[1.0]]
