"""The harness that breaks the safety rules: its names exist, and it tells what a test notices from what none does."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
import yaml

from tests.mutants.operators import Mutant, mutants_of
from tests.mutants.session import TargetError, try_mutants
from tests.mutants.targets import TARGETS, Target, functions_of

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


def _found(target: Target) -> list[Mutant]:
    return [mutant for name, function in functions_of(target) for mutant in mutants_of(function, name)]


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.module)
def test_each_function_and_test_file_of_the_list_exists_and_can_be_broken(target: Target) -> None:
    assert len(_found(target)) > 5
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


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Target:
    (tmp_path / "tiny_rule.py").write_text(_RULE, encoding="utf-8")
    tests = tmp_path / "test_tiny_rule.py"
    tests.write_text(_TESTS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "tiny_rule", raising=False)
    importlib.invalidate_caches()
    return Target("tiny_rule", ("clamp",), (str(tests),))


def test_what_no_test_notices_survives_and_what_one_notices_does_not(tiny: Target) -> None:
    found = _found(tiny)
    noticed: dict[str, bool] = {}
    try_mutants(tiny, found, 2, lambda mutant, seen: noticed.update({mutant.key: seen}))
    assert set(noticed) == {mutant.key for mutant in found}
    assert noticed["clamp: return 5.0: the return is left out"]
    assert noticed["clamp: if effort > 5.0:: > becomes <="]
    assert not noticed["clamp: return -5.0: the return is left out"]
    assert not noticed["clamp: if effort < -5.0:: < becomes <="]


def test_tests_that_fail_without_a_mutant_judge_nothing(tiny: Target) -> None:
    Path(tiny.tests[0]).write_text(_TESTS + "    assert clamp(-9.0) == -4.0\n", encoding="utf-8")
    with pytest.raises(TargetError, match="test_the_upper_limit_holds fails without a mutant"):
        try_mutants(tiny, _found(tiny), 1, lambda *_: None)
