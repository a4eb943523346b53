"""The parts of the recorder, without a graph: gaps, stamps, the queue, a failing disk, options."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from pendulum_msgs_py.contract.cdr import encode_joint_state
from pendulum_msgs_py.errors import ParameterError
from pendulum_rosbag.reader import read_bag
from pendulum_rosbag.recorder.gaps import GapCounter
from pendulum_rosbag.recorder.options import RecorderOptions
from pendulum_rosbag.recorder.parameter_reader_node import ParameterReader
from pendulum_rosbag.recorder.record_cli import main as record_main
from pendulum_rosbag.recorder.session import RecordingSession
from pendulum_rosbag.storage import BagWriter, mcap_layout, message_type
from pendulum_rosbag.storage.stamps import stamp_reader
from pendulum_testing.fixtures import wait_for
from pendulum_testing.graph_peer import GraphPeer

JOINT_STATE = "sensor_msgs/msg/JointState"
STRING = "std_msgs/msg/String"


def test_gaps_of_one_publisher_are_counted() -> None:
    counter = GapCounter(lambda: (1, 1))
    assert [counter.see(number) for number in (5, 6, 7, 10, 11, 13)] == [0, 0, 0, 2, 0, 1]
    assert counter.missing == 3


def test_gaps_of_interleaved_publishers_are_counted() -> None:
    rng = random.Random(4)
    for _ in range(50):
        streams = [list(range(start, start + 200)) for start in (1, 1000, 5000)]
        lost = 0
        for stream in streams:
            for _ in range(rng.randrange(4)):
                del stream[rng.randrange(1, len(stream) - 1)]
            lost += 200 - len(stream)
        order = [k for k, stream in enumerate(streams) for _ in stream]
        rng.shuffle(order)
        counter = GapCounter(lambda: (3, 3))
        iterators = [iter(stream) for stream in streams]
        for k in [0, 1, 2]:
            counter.see(next(iterators[k]))
            order.remove(k)
        for k in order:
            counter.see(next(iterators[k]))
        assert counter.missing == lost


def test_a_publisher_that_starts_again_leaves_no_gap() -> None:
    met = [1, 1]
    counter = GapCounter(lambda: (met[0], met[1]))
    assert [counter.see(number) for number in (1, 2, 3)] == [0, 0, 0]
    met[0] = 2
    assert [counter.see(number) for number in (1, 2, 3, 4)] == [0, 0, 0, 0]
    assert counter.unmet == 0


def test_a_publisher_that_is_met_late_leaves_no_gap() -> None:
    met = [1, 1]
    counter = GapCounter(lambda: (met[0], met[1]))
    for number in range(3, 10):
        counter.see(number)
    met[:] = 2, 2  # it has said some things already, before it was matched: its first number here is 14
    for number in range(300):
        assert counter.see(14 + number) == 0
        assert counter.see(10 + number) == 0
    assert counter.missing == 0
    assert counter.unmet == 2 + 13  # what each had said before


def test_a_publisher_that_is_met_late_in_the_place_of_one_that_left_leaves_no_gap() -> None:
    counter = GapCounter(lambda: (2, 1))
    assert sum(counter.see(number) for number in range(3, 10)) == 0
    assert sum(counter.see(number) for number in range(14, 500)) == 0
    assert counter.unmet == 2 + 13


def test_a_publisher_whose_message_comes_before_word_of_it_is_counted_from_its_beginning() -> None:
    met = [0, 0]
    counter = GapCounter(lambda: (met[0], met[1]))
    assert [counter.see(sequence) for sequence in (41, 42)] == [0, 0]
    met[:] = [1, 1]
    # It is the one that was met: what it misses now is a gap.
    assert [counter.see(sequence) for sequence in (43, 45)] == [0, 1]
    assert (counter.unmet, counter.missing) == (40, 1)
    # The next one in its place, before word of it too.
    assert [counter.see(sequence) for sequence in (31, 32)] == [0, 0]
    met[:] = [2, 1]
    assert [counter.see(sequence) for sequence in (33, 35)] == [0, 1]
    assert (counter.unmet, counter.missing) == (70, 2)


def test_a_publisher_that_is_silent_hides_no_gap_of_another() -> None:
    counter = GapCounter(lambda: (2, 2))
    assert sum(counter.see(number) for number in range(3, 10)) == 0
    assert sum(counter.see(number) for number in range(14, 500)) == 4
    assert sum(counter.see(number) for number in range(502, 900)) == 2
    assert counter.missing == 6
    assert counter.unmet == 2


def test_stamps_are_read_from_headers_times_and_events() -> None:
    state = stamp_reader(JOINT_STATE)
    assert state is not None
    assert state(encode_joint_state(12_345_678_901, effort=1.0)) == 12_345_678_901
    assert state(b"\0\1\0\0") is None
    clock = stamp_reader("rosgraph_msgs/msg/Clock")
    assert clock is not None
    assert clock(b"\0\1\0\0" + (3).to_bytes(4, "little") + (4).to_bytes(4, "little")) == 3_000_000_004
    text = b'{"stamp_ns": 77, "name": "hold"}\0'
    event = stamp_reader(STRING)
    assert event is not None
    assert event(b"\0\1\0\0" + len(text).to_bytes(4, "little") + text) == 77
    assert event(b"\0\1\0\0\3\0\0\0hi\0") is None
    assert stamp_reader("std_msgs/msg/Float64") is None


def test_a_full_queue_refuses_and_counts(tmp_path: Path) -> None:
    session = RecordingSession(BagWriter(tmp_path / "bag"), max_queue_bytes=1000, seal_interval=0.2)
    session.add_topic("/a", message_type(JOINT_STATE), ())
    data = encode_joint_state(1, position=1.0)
    refused = session.offer("/a", [(number, data) for number in range(100)])
    assert refused == 100 - 1000 // len(data)
    report = session.close()
    assert report.written == 1000 // len(data)
    assert report.lost == refused
    assert f"LOST {refused} of 100 (/a {refused})" in report.sentence()
    assert read_bag(tmp_path / "bag").metadata["pendulum.recorder.counts"]["/a"]["lost"] == refused


def test_messages_before_the_subscription_was_complete_are_reported_and_are_no_loss(tmp_path: Path) -> None:
    session = RecordingSession(BagWriter(tmp_path / "bag"))
    session.add_topic("/a", message_type(JOINT_STATE), ())
    session.offer("/a", [(1, encode_joint_state(1, position=1.0))])
    session.note("/a", early=905)
    report = session.close()
    assert report.lost == 0
    assert "nothing lost; published before the subscription was complete, and not recorded: /a 905" in report.sentence()
    assert read_bag(tmp_path / "bag").metadata["pendulum.recorder.counts"]["/a"]["early"] == 905


def test_a_bag_that_was_not_closed_tells_what_is_missing_in_it(tmp_path: Path) -> None:
    session = RecordingSession(BagWriter(tmp_path / "bag"), seal_interval=0.02)
    try:
        session.add_topic("/a", message_type(JOINT_STATE), ())
        session.offer("/a", [(1, encode_joint_state(1, position=1.0))])
        session.note("/a", missing=3)
        session.note("/a", early=4)
        session.note("/a", before=5)

        def told() -> object:
            return read_bag(tmp_path / "bag").metadata.get("pendulum.recorder.counts")

        wait_for(told, 10.0, "the counts to be in the bag")
        wait_for(lambda: told() == {"/a": {"lost": 3, "early": 4, "before": 5}}, 10.0, "all of them")
    finally:
        report = session.close()
    assert (report.topics["/a"].before, report.lost) == (5, 3)
    assert "5" not in report.sentence().split("/a", 1)[1]
    assert read_bag(tmp_path / "bag").metadata["pendulum.recorder.counts"]["/a"] == {
        "received": 1,
        "written": 1,
        "lost": 3,
        "early": 4,
        "before": 5,
        "repeated": 0,
    }


def test_a_disk_that_fails_ends_the_session_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = BagWriter(tmp_path / "bag")
    reasons: list[str] = []
    session = RecordingSession(writer, seal_interval=0.02, on_failure=reasons.append)
    session.add_topic("/a", message_type(JOINT_STATE), ())
    session.offer("/a", [(1, encode_joint_state(1, position=1.0))])
    wait_for(lambda: session.counts()["/a"].written, 10.0, "the first seal")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(mcap_layout, "write_at", full)
    session.offer("/a", [(2, encode_joint_state(2, position=1.0))])
    wait_for(lambda: reasons, 10.0, "the session to say why it stops")
    report = session.close()
    assert reasons == ["no space left on device"]
    assert report.sentence().endswith("stopped because no space left on device")
    assert (report.written, report.lost) == (1, 1)
    assert read_bag(tmp_path / "bag")["/a"]["stamp_ns"].tolist() == [1]


def test_a_topic_that_appears_after_the_disk_failed_is_counted_as_lost(tmp_path: Path) -> None:
    session = RecordingSession(BagWriter(tmp_path / "bag"))
    session.fail(MemoryError())
    session.add_topic("/late", message_type(JOINT_STATE), ())
    session.note("/late", early=3)
    session.note("/late", missing=2)
    session.offer("/late", [(1, encode_joint_state(1, position=1.0))])
    report = session.close()
    assert "LOST 3 of 3 (/late 3)" in report.sentence()
    assert "/late 3; stopped because memory is exhausted" in report.sentence()


def test_a_topic_that_appears_while_the_disk_fails_ends_no_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that writes meets the failure, and closes the bag, while another announces a topic."""
    session = RecordingSession(BagWriter(tmp_path / "bag"))
    add_topic = session.writer.add_topic

    def fail_first(*arguments: Any) -> None:
        session.fail(OSError(28, "No space left on device"))
        add_topic(*arguments)

    monkeypatch.setattr(session.writer, "add_topic", fail_first)
    session.add_topic("/late", message_type(JOINT_STATE), ())
    session.offer("/late", [(1, encode_joint_state(1, position=1.0))])
    assert "LOST 1 of 1 (/late 1); stopped because no space left" in session.close().sentence()


def test_what_was_asked_for_and_never_came_is_named() -> None:
    some = RecorderOptions(Path("bag"), ("/a", "/b", "/left"), "^/sim/", "left")
    assert some.unmet(["/a", "/sim/x"]) == {
        "/b": "it had no publisher",
        "/left": "it is left out by the pattern of exclude",
    }
    assert some.unmet(["/a", "/b"]) == {
        "/left": "it is left out by the pattern of exclude",
        "topics that match '^/sim/'": "they had no publisher",
    }
    assert RecorderOptions(Path("bag")).unmet([]) == {"any topic": "none had a publisher"}
    assert not RecorderOptions(Path("bag")).unmet(["/a"])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"log_time": "now"}, "log time is 'now'; expected one of receive, header"),
        ({"topics": ("states",)}, "topic is 'states'; expected its full name, such as /states"),
        ({"regex": "("}, "expected a regular expression"),
        ({"duration": -1.0}, "duration is -1.0; expected >= 0"),
        ({"storage": "tape"}, "storage is 'tape'"),
    ],
)
def test_wrong_options_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message.replace("(", r"\(")):
        RecorderOptions(Path("bag"), **fields)  # type: ignore[arg-type]


def test_topics_are_chosen_by_name_pattern_and_exclusion() -> None:
    everything = RecorderOptions(Path("bag"))
    assert everything.wants("/a")
    assert not everything.wants("/rosout")
    some = RecorderOptions(Path("bag"), ("/a",), "^/sim/", "/push$")
    assert [some.wants(topic) for topic in ("/a", "/b", "/sim/x", "/sim/push")] == [True, False, True, False]


def test_an_existing_folder_is_refused_with_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert record_main(["-o", str(tmp_path)]) == 2
    assert "exists already; expected a new folder" in capsys.readouterr().err


def test_a_node_without_parameters_is_asked_for_none_and_its_neighbour_is_read(domain_id: int) -> None:
    peer = GraphPeer("asks")
    peer.add_node("silent", start_parameter_services=False)
    peer.add_node("serves").declare_parameter("gain", 2.0)
    reader = ParameterReader(peer.node, lambda _values, _changed: None)
    made: set[str] = set()

    def read() -> bool:
        reader.poll()
        made.update(name for name, _ in peer.node.get_client_names_and_types_by_node("asks", "/"))
        return "/serves" in reader.values

    try:
        peer.until(read, "the neighbour's parameters")
        assert "silent" in peer.node.get_node_names()
        assert reader.values["/serves"]["gain"] == 2.0
        assert "/serves/list_parameters" in made
        assert not [name for name in made if name.startswith("/silent/")]
    finally:
        peer.close()
