"""One pytest session for a target: tests are collected once, and each mutant runs in a child that is forked from there.

Three things make it fast. A child has everything loaded and collected. It runs only the tests that reach the broken
function, which one run under a profiler tells. And it runs the quickest first: a slow test, such as a state machine,
sees only what all others let through.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any

import pytest
from hypothesis import Phase, settings

from tests.mutants.operators import Mutant
from tests.mutants.targets import Target, functions_of

__all__ = ["Baseline", "TargetError", "try_mutants"]

_PYTEST = ("-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:randomly", "--hypothesis-seed=0", "--capture=no")
_PATIENCE = 90.0
"""Longest time for the tests of one mutant [s]; a mutant that keeps them longer is noticed."""
_PROCESSOR_TIME = 30
"""The same in processor time, so that a busy machine does not notice in a test's place [s]."""


class TargetError(Exception):
    """The tests of a target fail without a mutant, or do not run at all."""


@dataclass(frozen=True)
class Baseline:
    """What a run without a mutant tells.

    Attributes:
        seconds: Time of each test, by its place in the collection [s].
        reached: Tests that call a function, by the function's name.
    """

    seconds: list[float]
    reached: dict[str, list[int]]


def try_mutants(target: Target, found: Sequence[Mutant], workers: int, note: Callable[[Mutant, bool], None]) -> None:
    """Run the tests on each mutant.

    Args:
        target: The functions, and the tests that watch them.
        found: Their mutants.
        workers: Children that run at once.
        note: Told each mutant, and whether a test noticed it.

    Raises:
        TargetError: The tests fail without a mutant, or there are none.
    """
    read, write = os.pipe()
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        os.close(read)
        _in_child(lambda: _session(target, found, workers, write))
    os.close(write)
    problem = f"the tests of {target.module} did not run"
    with os.fdopen(read, encoding="utf-8") as lines:
        for line in lines:
            told = json.loads(line)
            if "problem" in told:
                problem = told["problem"]
            elif "index" in told:
                note(found[told["index"]], told["noticed"])
            else:
                problem = ""
    os.waitpid(child, 0)
    if problem:
        raise TargetError(problem)


def _in_child(work: Callable[[], int]) -> None:
    """Do the work of a forked child in silence, and end it without what the parent has to do at its end."""
    code = 3
    try:
        os.setpgid(0, 0)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        code = work()
    finally:
        os._exit(code)


def _session(target: Target, found: Sequence[Mutant], workers: int, pipe: int) -> int:
    # An example that fails is enough; nobody reads a smaller one, and none is kept for other runs.
    settings.register_profile("mutants", database=None, phases=(Phase.explicit, Phase.generate), deadline=None)
    settings.load_profile("mutants")
    plugin = _Session(target, found, workers, pipe)
    choose = ("-k", target.choose) if target.choose else ()
    return int(pytest.main([*_PYTEST, *choose, *target.tests], plugins=[plugin]))


class _Session:
    """Takes the place of pytest's loop over the tests."""

    def __init__(self, target: Target, found: Sequence[Mutant], workers: int, pipe: int) -> None:
        self.target, self.found, self.workers, self.pipe = target, found, workers, pipe
        self.failed = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Remember a failure."""
        if report.failed and not self.failed:
            self.failed = report.nodeid

    def pytest_runtestloop(self, session: Any) -> bool:
        """Run the tests once without a mutant, then each mutant's."""
        try:
            baseline = self._baseline(session.items)
        except TargetError as error:
            self._tell(problem=str(error))
            return True
        self._tell(tests=len(baseline.seconds))
        running: dict[int, tuple[int, float]] = {}
        waiting = list(range(len(self.found)))
        while waiting or running:
            while waiting and len(running) < self.workers:
                index = waiting.pop(0)
                running[self._start(session.items, index, baseline)] = (index, time.monotonic())
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid in running:
                self._tell(index=running.pop(pid)[0], noticed=os.waitstatus_to_exitcode(status) != 0)
                continue
            for late in [pid for pid, (_, start) in running.items() if time.monotonic() - start > _PATIENCE]:
                os.killpg(late, signal.SIGKILL)
            time.sleep(0.002)
        return True

    def _tell(self, **what: Any) -> None:
        os.write(self.pipe, (json.dumps(what) + "\n").encode())

    def _start(self, items: Sequence[Any], index: int, baseline: Baseline) -> int:
        mutant = self.found[index]
        chosen = sorted(baseline.reached.get(mutant.function, ()), key=lambda at: baseline.seconds[at])
        child = os.fork()
        if child == 0:
            _in_child(lambda: self._try([items[at] for at in chosen], mutant))
        return child

    def _try(self, items: Sequence[Any], mutant: Mutant) -> int:
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = round(used.ru_utime + used.ru_stime) + _PROCESSOR_TIME
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
        if mutant.code is None:
            setattr(importlib.import_module(self.target.module), mutant.function, mutant.value)
        else:
            dict(functions_of(self.target))[mutant.function].__code__ = mutant.code
        for _ in self._run(items):
            if self.failed:
                return 1
        return 0

    def _run(self, items: Sequence[Any]) -> Iterator[int]:
        for at, item in enumerate(items):
            following = items[at + 1] if at + 1 < len(items) else None
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            yield at

    def _baseline(self, items: Sequence[Any]) -> Baseline:
        """Run all tests in a child, and return how long each takes and what it reaches."""
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _in_child(lambda: self._measure(items, write))
        os.close(write)
        with os.fdopen(read, encoding="utf-8") as answer:
            text = answer.read()
        os.waitpid(child, 0)
        if not text:
            raise TargetError(f"the tests of {self.target.module} end their process without a mutant")
        told = json.loads(text)
        if told["failed"]:
            raise TargetError(f"{told['failed']} fails without a mutant; mend it first")
        return Baseline(told["seconds"], told["reached"])

    def _measure(self, items: Sequence[Any], pipe: int) -> int:
        names = {function.__code__: [name] for name, function in functions_of(self.target)}
        for code, of_code in names.items():
            # A constant is tried by the tests that reach a function which reads it.
            of_code += [name for name in self.target.constants if name in code.co_names]
        reached: dict[str, list[int]] = {name: [] for of_code in names.values() for name in of_code}
        seconds: list[float] = []
        called: set[CodeType] = set()
        start = time.monotonic()
        with _profile(names, called):
            for at in self._run(items):
                now = time.monotonic()
                seconds.append(now - start)
                start = now
                for name in {name for code in called for name in names[code]}:
                    reached[name].append(at)
                called.clear()
        with os.fdopen(pipe, "w", encoding="utf-8") as out:
            json.dump({"failed": self.failed, "seconds": seconds, "reached": reached}, out)
        return 0


@contextmanager
def _profile(names: Mapping[CodeType, object], called: set[CodeType]) -> Iterator[None]:
    """Collect which of some code is called, in any thread."""

    def look(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and frame.f_code in names:
            called.add(frame.f_code)

    threading.setprofile(look)
    sys.setprofile(look)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
