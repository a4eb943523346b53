"""The watch for two commanders and two plants, on a graph that a test writes down: each rule at its limit.

What a real graph tells is tested with real nodes in ``tests/faults``; here time and graph are given.
"""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from pendulum_msgs_py.contract.supervisor import Input, PlantLimits, PlantSupervisor
from pendulum_msgs_py.contract.values import JointCommand
from pendulum_msgs_py.ros import commander_watch
from pendulum_msgs_py.ros.commander_watch import CommanderWatch

MILLISECOND = 1_000_000
PERIOD = 50 * MILLISECOND
HOLD = 1000 * MILLISECOND
START = 10_000 * MILLISECOND


class Graph:
    """What a node tells of a graph: publishers by topic, and how often it was asked."""

    def __init__(self) -> None:
        self.publishers: dict[str, list[tuple[str, str]]] = {"/sim/effort_command": [], "/sim/joint_states": []}
        self.errors: list[str] = []
        self.looks = self.asked_who = 0

    def resolve_topic_name(self, name: str) -> str:
        return f"/sim/{name}"

    def count_publishers(self, topic: str) -> int:
        self.looks += topic.endswith("effort_command")
        return len(self.publishers[topic])

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        self.asked_who += 1
        return [SimpleNamespace(node_namespace=space, node_name=name) for space, name in self.publishers[topic]]

    def get_logger(self) -> Any:
        return self

    def error(self, text: str) -> None:
        self.errors.append(text)


class Watched:
    """A plant's supervisor and watch on such a graph, at a time that the test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.graph = Graph()
        self.now_ns = START
        monkeypatch.setattr(commander_watch.time, "monotonic_ns", lambda: self.now_ns)
        self.supervisor = PlantSupervisor(PlantLimits(effort=(5.0,)))
        self.watch = CommanderWatch(self.graph, self.supervisor)  # type: ignore[arg-type]

    def commanders(self, *names: str) -> None:
        self.graph.publishers["/sim/effort_command"] = [("/sim", name) for name in names]

    def plants(self, count: int) -> None:
        self.graph.publishers["/sim/joint_states"] = [("/sim", f"plant{number}") for number in range(count)]

    def command(self, source: str = "controller", effort: float = 1.0, stamp_ns: int = START) -> None:
        self.supervisor.offer(Input.EFFORT_COMMAND, JointCommand.of_one(stamp_ns, effort, source), stamp_ns)

    def conflict(self) -> str:
        self.watch.check()
        return self.supervisor.commander_conflict


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


def answer_twice(watched: Watched, effort: float, at_ns: int = START) -> None:
    """A second answer to the state that was answered with 1 N m."""
    watched.watch.suspect_twins(JointCommand.of_one(START, effort, "controller"), at_ns)


def test_two_commanders_of_one_name_are_a_conflict_that_is_reported_once_and_passes(watched: Watched) -> None:
    watched.commanders("controller")
    assert watched.conflict() == ""
    # Who they are takes ten times as long to ask as how many.
    assert watched.graph.asked_who == 0
    watched.commanders("controller", "controller", "controller")
    for _ in range(2):
        assert "3 commanders named /sim/controller on /sim/effort_command" in watched.conflict()
        assert len(watched.graph.errors) == 1
    watched.commanders("controller", "other")
    assert watched.conflict() == ""
    assert len(watched.graph.errors) == 1


def test_what_was_seen_earlier_is_not_reported_later(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    looking, may_go_on = threading.Event(), threading.Event()
    count = watched.graph.count_publishers

    def count_slowly(topic: str) -> int:
        found = count(topic)
        if not looking.is_set():
            looking.set()
            may_go_on.wait(10.0)
        return found

    watched.commanders("controller")
    monkeypatch.setattr(watched.graph, "count_publishers", count_slowly)
    early, late = (threading.Thread(target=watched.watch.check) for _ in range(2))
    early.start()
    assert looking.wait(10.0)
    watched.commanders("controller", "controller")
    late.start()
    # It waits for the earlier one; one that did not would be done by now.
    late.join(0.3)
    may_go_on.set()
    for thread in (early, late):
        thread.join(10.0)
    assert "2 commanders" in watched.supervisor.commander_conflict


def test_names_in_the_root_namespace_have_one_slash(watched: Watched) -> None:
    watched.graph.publishers["/sim/effort_command"] = [("/", "controller")] * 2
    assert "named /controller on" in watched.conflict()


def test_commanders_whose_name_has_not_arrived_yet_are_no_twins(watched: Watched) -> None:
    watched.commanders(*2 * ["_NODE_NAME_UNKNOWN_"])
    assert watched.conflict() == ""


def test_two_commanders_without_a_name_in_their_messages_are_a_conflict_once_one_commands(watched: Watched) -> None:
    watched.commanders("one", "two")
    assert watched.conflict() == ""
    watched.command(source="")
    assert "2 unnamed commanders" in watched.conflict()
    watched.commanders("one")
    assert watched.conflict() == ""


def test_of_commanders_that_left_between_two_looks_nobody_is_left_to_be_in_conflict(watched: Watched) -> None:
    watched.command(source="")
    watched.commanders("one")
    watched.graph.count_publishers = lambda topic: 2  # type: ignore[method-assign]
    assert watched.conflict() == ""


def test_two_answers_to_one_state_are_a_conflict_for_a_second_where_there_are_two_to_give_them(
    watched: Watched,
) -> None:
    watched.command()
    watched.commanders("one")
    answer_twice(watched, 2.0)
    assert watched.supervisor.commander_conflict == ""
    watched.commanders("one", "two")
    watched.now_ns += HOLD - 1
    assert "2 commanders on /sim/effort_command give two answers to one state as 'controller'" in watched.conflict()
    watched.now_ns += 1
    assert watched.conflict() == ""


def test_the_same_answer_twice_is_no_contradiction_nor_is_one_without_a_command_before_it(watched: Watched) -> None:
    watched.commanders("one", "two")
    answer_twice(watched, 2.0)
    watched.command()
    answer_twice(watched, 1.0)
    assert watched.graph.looks == 0
    assert watched.conflict() == ""


def test_an_answer_after_a_command_that_has_expired_contradicts_nothing(watched: Watched) -> None:
    watched.commanders("one", "two")
    watched.command()
    answer_twice(watched, 2.0, START + HOLD)
    assert watched.graph.looks == 0


def test_a_contradiction_is_looked_into_at_once_but_not_more_than_once_in_50_ms(watched: Watched) -> None:
    watched.command()
    watched.commanders("one", "two")
    answer_twice(watched, 2.0)
    assert "two answers" in watched.supervisor.commander_conflict
    assert watched.graph.looks == 1
    watched.now_ns += PERIOD - 1
    answer_twice(watched, 2.0)
    assert watched.graph.looks == 1
    watched.now_ns += 1
    answer_twice(watched, 2.0)
    assert watched.graph.looks == 2


def test_in_the_first_50_ms_of_a_machine_nobody_is_looked_at_on_suspicion(watched: Watched) -> None:
    watched.command()
    watched.now_ns = PERIOD
    answer_twice(watched, 2.0)
    assert watched.graph.looks == 1


def test_answers_to_states_that_are_not_ours_are_a_conflict_for_a_second_where_there_are_two_plants(
    watched: Watched,
) -> None:
    command = JointCommand.of_one(START, 1.0, "controller")
    watched.plants(2)
    for stamp in (START, START + 1):
        watched.watch.note_state(stamp)
    watched.watch.suspect_second_plant(command)
    assert watched.graph.looks == 0
    assert watched.conflict() == ""
    watched.now_ns += PERIOD
    watched.watch.suspect_second_plant(JointCommand.of_one(START - 1, 1.0, "controller"))
    assert watched.graph.looks == 2
    assert "2 plants on /sim/joint_states" in watched.supervisor.commander_conflict
    watched.plants(1)
    assert watched.conflict() == ""
    watched.plants(2)
    watched.now_ns += HOLD - 1
    assert "2 plants" in watched.conflict()
    watched.now_ns += 1
    assert watched.conflict() == ""


def test_states_of_the_last_128_stamps_are_ours(watched: Watched) -> None:
    watched.plants(2)
    for stamp in range(129):
        watched.watch.note_state(stamp)
    watched.watch.suspect_second_plant(JointCommand.of_one(1, 1.0, "controller"))
    assert watched.supervisor.commander_conflict == ""
    watched.watch.suspect_second_plant(JointCommand.of_one(0, 1.0, "controller"))
    assert "2 plants" in watched.supervisor.commander_conflict


def test_states_that_were_published_period_by_period_are_remembered_as_if_one_by_one(watched: Watched) -> None:
    watched.watch.note_state(600)
    watched.watch.note_states(1000, 100, 4)
    assert list(watched.watch.own_stamps) == [1000, 900, 800, 700, 600]
