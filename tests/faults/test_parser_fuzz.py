"""The short form of the attack on parsers; ``python -m tests.tools.faults.fuzz --minutes 10`` is the long one."""

from __future__ import annotations

import random
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pendulum_msgs_py.errors import PendulumError
from tests.tools.faults.fuzz import HEADROOM
from tests.tools.faults.hostile_files import HOSTILE, outside_reads
from tests.tools.faults.parsers import PARSERS, Parser, copy_of, mutate

_FEW = settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)


@pytest.mark.parametrize("parser", PARSERS, ids=lambda parser: parser.name)
def test_a_spoilt_file_ends_in_an_error_of_ours_or_in_data(parser: Parser, tmp_path: Path) -> None:
    (tmp_path / "good").mkdir()
    good = parser.make(tmp_path / "good")
    data = good.read_bytes()
    assert parser.survives(good) == ""
    target = copy_of(good, tmp_path)

    @settings(_FEW, max_examples=2 if parser.slow else 25)
    @given(seed=st.integers(0, 2**32))
    def attack(seed: int) -> None:
        target.write_bytes(mutate(data, random.Random(seed), text=parser.text))
        assert parser.survives(target) == ""

    attack()


@pytest.mark.timeout(600)
def test_hostile_files_cost_no_memory_and_run_nothing(tmp_path: Path) -> None:
    # In a process of its own, whose memory can be bounded.
    program = "import sys; from tests.faults.test_parser_fuzz import meet_hostile_files as m; sys.exit(m(sys.argv[1]))"
    repository = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=500.0,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert not list(tmp_path.rglob("owned"))
    assert not (repository / "owned").exists()


def test_a_bag_cannot_name_files_outside_of_its_folder(tmp_path: Path) -> None:
    assert not outside_reads(tmp_path)


def meet_hostile_files(place: str) -> int:
    """Let every parser meet the files made for it, in bounded memory; returns the number of findings."""
    from tests.tools.faults.fuzz import bound_memory

    cases = []
    for number, hostile in enumerate(HOSTILE):
        folder = Path(place, str(number))
        folder.mkdir()
        cases.append((hostile, hostile.make(folder)))
    for parser in PARSERS:  # so that what they import is there before memory is counted
        if parser.slow:  # a process of its own imports it
            continue
        folder = Path(place, parser.name.replace(" ", "_"))
        folder.mkdir()
        parser.survives(parser.make(folder))
    bound_memory(HEADROOM)
    findings = 0
    for hostile, path in cases:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        refused, problem = _meet(hostile.reader(), path)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
        if not problem and hostile.refused and not refused:
            problem = "was read without a word"
        if problem:
            findings += 1
            print(f"{hostile.parser}: {hostile.name}: {problem} (grew by {grown:.0f} MB)")
    return findings


def _meet(parser: Parser, path: Path) -> tuple[bool, str]:
    """Return whether a parser refuses a file, and what it does wrong."""
    refusals: list[PendulumError] = []

    def read(path: Path) -> object:
        try:
            return parser.read(path)
        except PendulumError as error:
            refusals.append(error)
            raise

    problem = replace(parser, read=read).survives(path)
    return bool(refusals), problem
