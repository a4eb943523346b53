"""Machine code kept on disk: taken by who makes the same kernel, and by nobody else."""

from __future__ import annotations

import hashlib
import importlib
import itertools
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import FunctionType

import numba
import numpy as np
import pytest

from pendulum_msgs_py.plants.plant_parameters import load_plant
from pendulum_msgs_py.programs import kernel_cache
from pendulum_msgs_py.programs.kernel_cache import keep_kernel
from pendulum_sim.batches import batch_kernels
from pendulum_sim.batches.batch import simulate_batch


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    return tmp_path


def double(x: float) -> float:
    return 2.0 * x


THEIRS = """
import numba

@numba.njit(forceinline=True)
def inner(x):
    return {factor} * x

def law(x):
    return inner(x)
"""


TWO_OF_ONE_NAME = (
    """
import math
import sys
import numba
from pendulum_msgs_py.programs.kernel_cache import keep_kernel

def kernel(factor):
    @numba.njit
    def inner(x):
"""
    # So long that it is called, not written into its caller.
    + "".join(f"        x += math.sin({i} * x)\n" for i in range(100))
    + """
        return factor + x

    return keep_kernel(numba.njit(lambda x: inner(x) + inner(-x)), "of_one_name", factor)

for argument in sys.argv[1:]:
    made = kernel(float(argument))
    print(made(0.0), sum(made.stats.cache_hits.values()))
"""
)


def triple(x: float) -> float:
    return 3.0 * x


def kernel(function: Callable[[float], float], name: str = "kernel") -> numba.core.dispatcher.Dispatcher:
    inner = numba.njit(function, forceinline=True)
    return keep_kernel(numba.njit(lambda x: inner(x) + 1.0), name, function)


def taken(dispatcher: numba.core.dispatcher.Dispatcher) -> bool:
    """Tell whether the machine code for the arguments so far came from disk."""
    return sum(dispatcher.stats.cache_hits.values()) > 0


def test_what_one_has_compiled_the_next_takes_and_no_other_kernel(folder: Path) -> None:
    first, second = kernel(double), kernel(double)
    assert (first(2.0), taken(first)) == (5.0, False)
    assert (second(2.0), taken(second)) == (5.0, True)
    # Made of another function, called otherwise, or for other arguments: not the same.
    for other, argument, expected in (
        (kernel(triple), 2.0, 7.0),
        (kernel(double, "other"), 2.0, 5.0),
        (kernel(double), 2, 5),
    ):
        assert (other(argument), taken(other)) == (expected, False)


def test_who_takes_what_two_processes_have_kept_gets_both(tmp_path: Path) -> None:
    """By numba's count both call their inner function the same, and the linker takes the first of one name for all."""

    script = tmp_path / "two_of_one_name.py"
    script.write_text(TWO_OF_ONE_NAME, encoding="utf-8")

    def run(*factors: str) -> list[str]:
        return subprocess.run(
            [sys.executable, script, *factors],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()

    assert run("2") == ["4.0 0"]
    assert run("5") == ["10.0 0"]
    assert run("2", "5") == ["4.0 1", "10.0 1"]


def test_a_symbol_that_another_process_may_have_as_well_is_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = kernel(double)
    monkeypatch.setattr(numba.core.bytecode.FunctionIdentity, "_unique_ids", itertools.count(1))
    assert counted(2.0) == 5.0
    assert list(folder.rglob("*.nbk")) == []


def test_nothing_is_taken_that_other_source_was_compiled_to(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel(double)(2.0)
    monkeypatch.setattr(kernel_cache, "_source_of", lambda package: "changed")
    changed, after = kernel(double), kernel(double)
    assert (changed(2.0), taken(changed)) == (5.0, False)
    assert (after(2.0), taken(after)) == (5.0, True)
    assert len(list(folder.rglob("*.nbk"))) == 1


def test_what_another_version_kept_is_not_read_where_its_modules_are_gone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel(double)(2.0)
    (file,) = folder.rglob("*.nbk")
    head, _, _ = file.read_bytes().partition(b"\n")
    content = b"cpendulum_msgs_py.no_longer_there\nkernel\n."
    file.write_bytes(head.split()[0] + b" " + hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
    monkeypatch.setattr(kernel_cache, "_source_of", lambda package: "of another version")
    changed = kernel(double)
    assert (changed(2.0), taken(changed)) == (5.0, False)


def test_functions_that_differ_in_a_name_or_in_what_they_keep_are_not_the_same() -> None:
    def scaled(by: float) -> Callable[[float], float]:
        return lambda x: by * x

    def sine(x: float) -> float:
        return math.sin(x)

    cosine = FunctionType(
        sine.__code__.replace(co_names=tuple(name.replace("sin", "cos") for name in sine.__code__.co_names)),
        globals(),
        "sine",
    )
    cosine.__qualname__ = sine.__qualname__
    assert cosine(0.0) == 1.0
    words = kernel_cache._words
    assert words(sine) != words(cosine)
    assert words(scaled(2.0)) != words(scaled(3.0))
    assert words(scaled(2.0)) == words(scaled(2.0))


def test_a_kernel_is_compiled_again_for_what_it_reaches_and_for_nothing_else(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = {
        "reach_top": "import reach_middle\ndef law(x):\n    return reach_middle.scaled(x)\n",
        "reach_middle": "import numba\nfrom reach_numbers import FACTOR\n@numba.njit(forceinline=True)\n"
        "def scaled(x):\n    return FACTOR * x\n",
        "reach_numbers": "FACTOR = 2.0\nOTHER = 1.0\n",
    }
    monkeypatch.syspath_prepend(str(tmp_path))

    def made(**changed: str) -> numba.core.dispatcher.Dispatcher:
        for name, text in (source | changed).items():
            (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
            sys.modules.pop(name, None)
        kernel_cache._source_of.cache_clear()
        importlib.invalidate_caches()
        return kernel(importlib.import_module("reach_top").law)

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    numbers, middle = source["reach_numbers"], source["reach_middle"]
    for changed, expected, cached in (
        ({}, 5.0, False),
        ({"reach_numbers": numbers.replace("1.0", "7.0")}, 5.0, True),
        ({"reach_numbers": numbers.replace("2.0", "3.0")}, 7.0, False),
        ({"reach_middle": middle.replace("* x", "+ x")}, 5.0, False),
    ):
        one = made(**changed)
        assert (one(2.0), taken(one)) == (expected, cached), changed
    assert (first := made())(2.0) == 5.0
    assert not taken(first)


def test_a_module_of_somebody_else_is_known_by_its_source(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a plug-in has it: the function is the same, what it calls is not."""
    (tmp_path / "their_law.py").write_text(THEIRS.format(factor=2.0), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    theirs = importlib.import_module("their_law")
    kernel(theirs.law)(2.0)
    (tmp_path / "their_law.py").write_text(THEIRS.format(factor=30.0), encoding="utf-8")
    kernel_cache._source_of.cache_clear()
    importlib.invalidate_caches()
    changed = kernel(importlib.reload(theirs).law)
    assert (changed(2.0), taken(changed)) == (61.0, False)


@pytest.mark.parametrize("damage", [b"", b"no code", b"0" * 64 + b"\nno code"])
def test_a_damaged_file_is_compiled_anew_and_mended(folder: Path, damage: bytes) -> None:
    kernel(double)(2.0)
    (file,) = folder.rglob("*.nbk")
    whole = file.read_bytes()
    for content in (damage, whole[:-1], whole[:-1] + bytes([whole[-1] ^ 1])):
        file.write_bytes(content)
        mended, after = kernel(double), kernel(double)
        assert (mended(2.0), taken(mended)) == (5.0, False)
        assert (after(2.0), taken(after)) == (5.0, True)


def test_where_no_folder_can_be_written_a_kernel_works_all_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.core.caching.CompileResultCacheImpl, "_locator_classes", [])
    assert kernel(double)(2.0) == 5.0
    assert list(folder.rglob("*.nbk")) == []


def test_the_loop_of_a_batch_is_kept_with_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The general one: what is told functions keeps addresses of its process unless all is written into one.

    In the folder of all: a test of batches compiles the same one.
    """
    factory, made = batch_kernels.loop.__wrapped__, []
    monkeypatch.setattr(batch_kernels, "loop", lambda *of, **kind: made.append(factory(*of, **kind)) or made[-1])
    plant = load_plant("dfki").with_values(transport_delay=0.0033, effort_limit=20.0)
    runs = [simulate_batch(plant, steps=50, method="etd2", seeds=[1, 2], amplitude=2.5, record=True) for _ in range(2)]
    assert len(made) == 2
    assert taken(made[1])
    assert np.array_equal(runs[0].trajectories, runs[1].trajectories)
