"""Results as standard JSON: what ``--json`` prints and result files hold is read by more than Python."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pendulum_msgs_py.json_values import json_text, without_nan


def _read(text: str) -> Any:
    """Read as a strict reader does, which knows no NaN."""
    return json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, np.float64("nan"), np.float32("inf")])
def test_a_number_that_json_does_not_know_is_null_wherever_it_stands(number: float) -> None:
    array = np.array([number, 2.0])
    content = {"alone": number, "listed": [1.5, number], "inside": ({"deep": number},), "array": array}
    expected = {"alone": None, "listed": [1.5, None], "inside": [{"deep": None}], "array": [None, 2.0]}
    assert _read(json_text(content)) == expected


def test_numbers_of_numpy_are_numbers_and_other_things_their_text() -> None:
    content = {"count": np.int64(3), "holds": np.bool_(True), "matrix": np.eye(2), "file": Path("a/b"), "truth": True}
    expected = {"count": 3, "holds": True, "matrix": [[1.0, 0.0], [0.0, 1.0]], "file": "a/b", "truth": True}
    assert _read(json_text(content)) == expected


def test_keys_are_what_json_takes() -> None:
    content = {np.int64(3): 1, (1, 2): 2, Path("a"): 3, math.nan: 4, 1.5: 5, True: 6, None: 7}
    assert _read(json_text(content)) == {"3": 1, "(1, 2)": 2, "a": 3, "nan": 4, "1.5": 5, "true": 6, "null": 7}


def test_a_number_with_more_digits_than_pythons_is_its_text() -> None:
    assert _read(json_text([np.longdouble("1.5")])) == ["1.5"]


def test_finite_values_stay_what_they_are() -> None:
    content = {"a": [0.1, -1e300, 7, "NaN", None, True]}
    assert without_nan(content) == content
    assert json_text({"a": 1}) == '{\n  "a": 1\n}'
