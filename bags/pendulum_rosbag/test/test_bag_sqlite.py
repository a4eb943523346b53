"""Databases as rosbag2's C++ writer makes them: what ``sqlite3`` and rosbags count in them is read."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.reader.sqlite_salvage import salvaged_rows
from pendulum_rosbag.repair.repair import repair_bag
from pendulum_rosbag.storage import typestore

TYPES = {"/armed": "std_msgs/msg/Bool", "/ticks": "std_msgs/msg/Empty", "/text": "std_msgs/msg/String"}
_TOPICS = "id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL"
SCHEMAS = {
    1: ([], _TOPICS),
    2: ([], f"{_TOPICS}, offered_qos_profiles TEXT NOT NULL"),
    3: (
        [
            "schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
            "metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL)",
        ],
        f"{_TOPICS}, offered_qos_profiles TEXT NOT NULL",
    ),
    4: (
        [
            "schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL)",
            "metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL)",
            (
                "message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL, "
                "encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL)"
            ),
        ],
        f"{_TOPICS}, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL",
    ),
}
METADATA_VERSIONS = {1: 2, 2: 4, 3: 6, 4: 9}


def cpp_database(path: Path, schema: int, page: int = 4096) -> sqlite3.Connection:
    """Create the tables that a version of rosbag2 creates, with its index, and describe three topics."""
    connection = sqlite3.connect(path)
    connection.execute(f"PRAGMA page_size = {page}")
    others, topics = SCHEMAS[schema]
    for table in [*others, f"topics({topics})"]:
        connection.execute(f"CREATE TABLE {table}")
    connection.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
        "data BLOB NOT NULL)"
    )
    connection.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    spare = [""] * (topics.count(",") - 3)
    for number, (name, kind) in enumerate(TYPES.items(), start=1):
        row = [number, name, kind, "cdr", *spare]
        connection.execute(f"INSERT INTO topics VALUES ({', '.join('?' * len(row))})", row)
    return connection


def write_metadata(bag: Path, schema: int, connection: sqlite3.Connection) -> None:
    counts = dict(connection.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
    topics = [
        {
            "topic_metadata": {
                "name": name,
                "type": kind,
                "serialization_format": "cdr",
                "offered_qos_profiles": "" if schema < 4 else [],
                "type_description_hash": "",
            },
            "message_count": counts.get(number, 0),
        }
        for number, (name, kind) in enumerate(TYPES.items(), start=1)
    ]
    document = {
        "version": METADATA_VERSIONS[schema],
        "storage_identifier": "sqlite3",
        "duration": {"nanoseconds": 1},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": sum(counts.values()),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["bag_0.db3"],
        "files": [],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": document}))


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("databases")


@settings(max_examples=30, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(data=st.data())
def test_each_row_that_sqlite_and_rosbags_count_is_read_short_ones_too(scratch: Path, data: st.DataObject) -> None:
    draw = data.draw
    schema = draw(st.sampled_from(sorted(SCHEMAS)))
    page = draw(st.sampled_from([512, 1024, 4096, 65536]))
    bag = scratch / "bag"
    shutil.rmtree(bag, ignore_errors=True)
    bag.mkdir()
    connection = cpp_database(bag / "bag_0.db3", schema, page)
    largest = draw(st.sampled_from([0, 1, 9, 200, 9000]))
    step = draw(st.sampled_from([0, 1, 1000, 10**6, 10**9]))
    begin = draw(st.sampled_from([0, 100, 2**31, 1_700_000_000_000_000_000]))
    count = draw(st.integers(0, 400))
    for number in range(count):
        size = (number * 7919) % (largest + 1)
        row = (1 + number % 3, begin + number * step, bytes(range(256)) * (size // 256) + bytes(size % 256))
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    if draw(st.booleans()):
        connection.execute("DELETE FROM messages WHERE id % 5 = 2")
    connection.commit()
    wanted = connection.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id").fetchall()
    write_metadata(bag, schema, connection)
    connection.close()
    opened = read_bag(bag)
    assert opened.damage == []
    for number, name in enumerate(TYPES, start=1):
        assert opened.raw(name) == [(time, content) for topic, time, content in wanted if topic == number]
    with AnyReader([bag], default_typestore=typestore()) as reader:
        assert sum(1 for _ in reader.messages()) == sum(info.count for info in opened.topics.values()) == len(wanted)
    salvaged = list(salvaged_rows((bag / "bag_0.db3").read_bytes()))
    assert {row[1:] for row in salvaged} >= set(wanted)
    opened.close()


@pytest.mark.parametrize("schema", sorted(SCHEMAS))
def test_a_killed_writer_with_a_write_ahead_log_loses_no_row_and_is_no_damage(tmp_path: Path, schema: int) -> None:
    live = tmp_path / "live"
    live.mkdir()
    connection = cpp_database(live / "bag_0.db3", schema)
    connection.commit()
    connection.execute("PRAGMA journal_mode = WAL")
    for number in range(500):
        connection.execute(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (number, b"\0\1\0\0" + bytes([1]))
        )
    connection.commit()
    write_metadata(live, schema, connection)
    bag = tmp_path / "bag"
    shutil.copytree(live, bag)  # what a kill leaves: the log and its index
    connection.close()
    assert (bag / "bag_0.db3-wal").stat().st_size
    before = {file.name: file.read_bytes() for file in bag.iterdir()}
    with read_bag(bag) as opened:
        assert opened.damage == []
        assert len(opened.raw("/armed")) == 500
    assert {file.name: file.read_bytes() for file in bag.iterdir()} == before
    report = repair_bag(bag, tmp_path / "mended")
    assert report.damage == ["bag_0.db3: its recorder did not close it"]
    assert report.messages["/armed"] == 500


def test_a_torn_database_gives_back_messages_that_continue_on_other_pages(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    connection = cpp_database(bag / "bag_0.db3", 4)
    contents = [bytes([number]) * (30_000 if number % 2 else 40) for number in range(60)]
    for number, content in enumerate(contents):
        row = (3, number, content)
        connection.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    connection.commit()
    write_metadata(bag, 4, connection)
    connection.close()
    file = bag / "bag_0.db3"
    file.write_bytes(file.read_bytes()[: -40 * 4096])
    report = repair_bag(bag, tmp_path / "mended")
    assert "SQLite refuses it" in report.damage[0]
    with read_bag(tmp_path / "mended") as mended:
        found = dict(mended.raw("/text"))
    assert len(found) > 30
    assert sum(len(content) > 4096 for content in found.values()) > 10
    assert all(content == contents[time] for time, content in found.items())
