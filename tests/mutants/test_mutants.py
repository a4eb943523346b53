"""The harness that breaks the safety rules: its names exist, and it tells what a test notices from what none does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.mutants.operators import Mutant
from tests.mutants.targets import TARGETS, Target, functions_of, mutants_of_target

_PROJECT = Path(__file__).parents[2]

_RULE = '''\
def clamp(effort: float) -> float:
    """Return a torque within the limit."""
    if effort > 5.0:
        return 5.0
    if effort < -5.0:
        return -5.0
    return effort
'''
_TESTS = """\
from tiny_rule import clamp

def test_the_upper_limit_holds():
    assert clamp(5.0) == 5.0 and clamp(9.0) == 5.0 and clamp(1.0) == 1.0 and clamp(-1.0) == -1.0
"""


@cache
def _found(target: Target) -> list[Mutant]:
    return mutants_of_target(target)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.module)
def test_each_function_and_test_file_of_the_list_exists_and_can_be_broken(target: Target) -> None:
    assert len(_found(target)) >= 5
    assert all((_PROJECT / name).is_file() for name in target.tests)


def test_each_mutant_that_is_listed_as_equivalent_exists_and_has_a_reason() -> None:
    listed = yaml.safe_load(Path(__file__).with_name("equivalent.yaml").read_text(encoding="utf-8"))
    keys = [mutant.key for target in TARGETS for mutant in _found(target)]
    assert set(listed) <= set(keys)
    assert all(keys.count(key) == 1 for key in listed), "one entry excuses one mutant"
    assert all(len(reason) > 20 for reason in listed.values())


def test_a_name_that_is_gone_is_an_error() -> None:
    with pytest.raises(LookupError, match="has no Gone"):
        list(functions_of(Target(TARGETS[0].module, ("Gone",), ())))


_TRY = """\
import json
import sys
from tests.mutants.operators import mutants_of
from tests.mutants.session import TargetError, try_mutants
from tests.mutants.targets import Target, functions_of

tiny = Target("tiny_rule", ("clamp",), (sys.argv[1],))
found = [mutant for name, function in functions_of(tiny) for mutant in mutants_of(function, name)]
told = {"mutants": [mutant.key for mutant in found], "noticed": {}, "problem": ""}
try:
    try_mutants(tiny, found, 2, lambda mutant, seen: told["noticed"].update({mutant.key: seen}))
except TargetError as error:
    told["problem"] = str(error)
print(json.dumps(told))
"""


def _try(folder: Path, tests: str) -> dict[str, Any]:
    """Return what the harness tells of a tiny rule, in a process of its own.

    The harness forks, as it does where it is started alone; this process has threads of other tests, and a child of a
    process with threads may die in the collector.
    """
    (folder / "tiny_rule.py").write_text(_RULE, encoding="utf-8")
    (folder / "test_tiny_rule.py").write_text(tests, encoding="utf-8")
    told = subprocess.run(
        [sys.executable, "-c", _TRY, str(folder / "test_tiny_rule.py")],
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{_PROJECT}"},
        cwd=_PROJECT,
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert told.returncode == 0, told.stdout + told.stderr
    content: dict[str, Any] = json.loads(told.stdout.splitlines()[-1])
    return content


def test_what_no_test_notices_survives_and_what_one_notices_does_not(tmp_path: Path) -> None:
    told = _try(tmp_path, _TESTS)
    noticed = told["noticed"]
    assert told["problem"] == ""
    assert sorted(noticed) == sorted(told["mutants"])
    assert noticed["clamp: return 5.0: the return is left out"]
    assert noticed["clamp: if effort > 5.0:: > becomes <="]
    assert not noticed["clamp: return -5.0: the return is left out"]
    assert not noticed["clamp: if effort < -5.0:: < becomes <="]


def test_tests_that_fail_without_a_mutant_judge_nothing(tmp_path: Path) -> None:
    told = _try(tmp_path, _TESTS + "    assert clamp(-9.0) == -4.0\n")
    assert "test_the_upper_limit_holds fails without a mutant" in told["problem"]
    assert told["noticed"] == {}
