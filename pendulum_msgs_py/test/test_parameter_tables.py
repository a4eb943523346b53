"""Tables of parameters, and the YAML that nobody should be able to misuse."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pendulum_msgs_py.errors import ParameterError
from pendulum_msgs_py.parameters import (
    ParameterSpec,
    dump_yaml,
    load_yaml,
    markdown_table,
    read_text,
    validate,
)
from pendulum_msgs_py.ros.shared_parameters import given_to_every_node, refuse_near_misses

_SPECS = (
    ParameterSpec("rate_hz", 500.0, "Hz", "Rate.", minimum=0.0, exclusive_minimum=True),
    ParameterSpec("share", 0.5, "-", "Share.", minimum=0.0, maximum=1.0),
    ParameterSpec("steps", 3, "-", "Steps.", minimum=1),
    ParameterSpec("method", "rk4", "", "Method.", choices=("euler", "rk4")),
    ParameterSpec("window", [0.0, 1.0], "rad", "Window.", minimum=-4.0),
    ParameterSpec("verbose", False, "", "Talk.", read_only=True),
    ParameterSpec("label", "", "", "Label."),
)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rate_hz", 0.0, "rate_hz is 0.0 Hz; expected > 0"),
        ("rate_hz", -1.0, "rate_hz is -1.0 Hz; expected > 0"),
        ("rate_hz", math.nan, "rate_hz is nan Hz; expected a finite number > 0"),
        ("rate_hz", math.inf, "rate_hz is inf Hz; expected a finite number > 0"),
        ("rate_hz", 10**400, "expected a finite number > 0"),
        ("rate_hz", None, "rate_hz is None; expected a number > 0"),
        ("rate_hz", "500", "rate_hz is '500'; expected a number > 0"),
        ("rate_hz", True, "expected a number > 0"),
        ("share", 1.5, "share is 1.5; expected 0 to 1"),
        ("steps", 2.0, "steps is 2.0; expected an integer >= 1"),
        ("steps", True, "expected an integer >= 1"),
        ("method", "rk5", "method is 'rk5'; expected one of euler, rk4"),
        ("window", 3.0, "window is 3.0 rad; expected a list"),
        ("window", "ab", "window is 'ab'; expected a list"),
        ("window", [0.0, None], "window is None; expected a number >= -4"),
        ("verbose", 1, "verbose is 1; expected true or false"),
        ("label", 1, "label is 1; expected text"),
        ("rat_hz", 1.0, "unknown parameter 'rat_hz'; did you mean 'rate_hz'?"),
        ("xyz", 1.0, "unknown parameter 'xyz'; expected one of rate_hz, share"),
    ],
)
def test_a_refusal_names_parameter_value_unit_and_domain(name: str, value: object, message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        validate(_SPECS, {name: value}, where="run.yaml")
    assert message in str(caught.value)
    assert str(caught.value).startswith("run.yaml: ")


def test_values_come_back_in_their_own_type_and_the_rest_at_default() -> None:
    values = validate(_SPECS, {"rate_hz": 100, "window": (1, 2)})
    assert values["rate_hz"] == 100.0
    assert isinstance(values["rate_hz"], float)
    assert values["window"] == [1.0, 2.0]
    assert values["method"] == "rk4"


def _is_number(value: object, low: float, high: float, *, whole: bool = False) -> bool:
    if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
        return False
    return low <= value <= high and abs(value) < (math.inf if whole else 1.8e308)


_ALLOWED = {
    "rate_hz": lambda value: _is_number(value, 0.0, math.inf) and value > 0,
    "share": lambda value: _is_number(value, 0.0, 1.0),
    "steps": lambda value: _is_number(value, 1, math.inf, whole=True),
    "method": lambda value: value in ("euler", "rk4"),
    "window": lambda value: isinstance(value, list) and all(_is_number(each, -4.0, math.inf) for each in value),
    "verbose": lambda value: isinstance(value, bool),
    "label": lambda value: isinstance(value, str),
}
"""What each of the table's parameters may be, said once more by hand."""


@given(
    value=st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(),
        st.floats(-5.0, 5.0),
        st.text(max_size=5),
        st.sampled_from(["euler", "rk4", "Euler"]),
        st.lists(st.one_of(st.floats(), st.floats(-5.0, 5.0), st.none(), st.booleans()), max_size=3),
    )
)
def test_a_value_passes_where_its_domain_has_it_and_raises_our_error_everywhere_else(value: object) -> None:
    for spec in _SPECS:
        if not _ALLOWED[spec.name](value):
            with pytest.raises(ParameterError, match=f"^{spec.name} is "):
                spec.check(value)
            continue
        checked = spec.check(value)
        # Beyond 2**53 not every integer is a float.
        assert checked == (float(value) if isinstance(spec.default, float) else value)  # type: ignore[arg-type]
        assert type(checked) is type(spec.default)


def test_the_markdown_table_has_a_row_for_each_parameter() -> None:
    lines = markdown_table(_SPECS).splitlines()
    assert len(lines) == len(_SPECS) + 2
    assert lines[2] == "| `rate_hz` | `500.0` Hz; > 0 | Rate. |"
    assert lines[7] == "| `verbose`* | `false` | Talk. |"


# --- YAML ------------------------------------------------------------------------------------------------------


def _load(tmp_path: Path, text: str) -> dict[str, object]:
    path = tmp_path / "file.yaml"
    path.write_text(text, encoding="utf-8")
    return load_yaml(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2", "file.yaml:2:1: key 'a' is given twice"),
        ("b: {a: 1, a: 2}", "file.yaml:1:11: key 'a' is given twice"),
        ("a: &x 1\nb: *x", "alias *x is not allowed here"),
        ("a: &x [*x]", "alias *x is not allowed here"),
        ("a: !!python/object/apply:os.system [ls]", "tag 'tag:yaml.org,2002:python/object/apply:os.system'"),
        ("a: !!python/name:os.system", "is not allowed here"),
        ("a: !!timestamp x", "is not allowed here"),
        ("a: !!bool maybe", "is not allowed here"),
        ("a: !x%0aerror:%20other 1", r"tag '!x\nerror: other' is not allowed here"),
        ("a: !custom x", "tag '!custom' is not allowed here"),
        ("<<: {a: 1}", "merge"),
        ("a: " + "[" * 10_000, "nested deeper than 40 levels"),
        ("a: " + "{b: " * 10_000, "nested deeper than 40 levels"),
        ("a: \x00", "special characters are not allowed"),
        ("a: [1", "file.yaml:1:6: expected ',' or ']'"),
        ("? [1]\n: 2", "a key must be text"),
        ("1: 2", "has the key 1; expected a name"),
        ("yes: 2", "has the key True; expected a name"),
        ("a: 1\n---\nb: 1", "found another document"),
        ("a: 2020-13-45", "month must be in 1..12"),
        ("a: " + "9" * 5000, "is not YAML"),
        ("- 1", "is a list; expected a mapping"),
        ("text", "is a str; expected a mapping"),
        ("", "is empty; expected a mapping"),
        ("x" * 300_000, "has 300000 bytes; expected at most 250000"),
    ],
)
def test_yaml_that_could_mislead_is_refused_in_one_sentence(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ParameterError) as caught:
        _load(tmp_path, text)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-5", 1e-5),
        ("1E5", 1e5),
        ("1.5e3", 1500.0),
        (".5", 0.5),
        ("-3", -3),
        ("010", 10),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("0x10", "0x10"),
        ("inf", "inf"),
        (".inf", math.inf),
        ("null", None),
        ("true", True),
    ],
)
def test_numbers_are_what_they_look_like(tmp_path: Path, text: str, value: object) -> None:
    loaded = _load(tmp_path, f"a: {text}")["a"]
    assert loaded == value
    assert type(loaded) is type(value)


def test_who_changes_what_was_loaded_changes_it_for_nobody_else(tmp_path: Path) -> None:
    first = _load(tmp_path, "a: {b: [1, 2]}")
    first["a"]["b"].append(3)
    del first["a"]
    assert _load(tmp_path, "a: {b: [1, 2]}") == {"a": {"b": [1, 2]}}
    assert _load(tmp_path, "a: {b: [4]}") == {"a": {"b": [4]}}


@given(
    st.dictionaries(
        st.text(max_size=8),
        st.recursive(
            st.one_of(st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(max_size=12)),
            lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner)),
            max_leaves=8,
        ),
        max_size=4,
    )
)
def test_what_is_dumped_is_loaded_again(tmp_path_factory: pytest.TempPathFactory, document: dict) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    path.write_text(dump_yaml(document), encoding="utf-8", newline="")
    assert load_yaml(path) == document


@given(st.one_of(st.binary(max_size=60), st.text("ab:-[]{}!&*?|>%@`'\"#,\n\t 0.1~<", max_size=40).map(str.encode)))
def test_any_bytes_load_or_raise_our_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(data)
    sentence, loaded = "", {}
    try:
        loaded = load_yaml(path)
    except ParameterError as error:
        sentence = str(error)
    assert "\n" not in sentence
    if sentence:
        assert path.name in sentence
        return
    # What passes is a mapping of names, and means the same when it is written again.
    assert all(isinstance(key, str) for key in loaded)
    path.write_text(dump_yaml(loaded), encoding="utf-8", newline="")
    assert repr(load_yaml(path)) == repr(loaded)


def test_what_yaml_has_no_word_for_is_named() -> None:
    with pytest.raises(ParameterError, match="expected plain values"):
        dump_yaml({"a": object()})


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="does not exist"):
        load_yaml(tmp_path / "none.yaml")
    with pytest.raises(ParameterError, match="is a folder"):
        load_yaml(tmp_path)
    with pytest.raises(ParameterError, match="is a device or a pipe"):
        load_yaml("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ParameterError, match="is a device or a pipe"):
        load_yaml(tmp_path / "pipe")
    (tmp_path / "latin").write_bytes(b"a: \xe9")
    with pytest.raises(ParameterError, match="is not UTF-8 text"):
        read_text(tmp_path / "latin", "file")
    with pytest.raises(ParameterError, match="cannot be read"):
        read_text("a\0b", "file")


_SHARED_FILE = """
/**:
  ros__parameters:
    everybodys: 1.0
    ours_too: 1.0
    nested: {deep: 1.0}
/sim/*:
  ros__parameters: {of_the_namespace: 1.0}
/**/controller:
  ros__parameters: {ours_too: 2.0}
sim:
  controller:
    ros__parameters: {only_ours: 1.0}
/hw/controller:
  ros__parameters: {everybodys: 3.0}
"""


def test_only_what_a_file_gives_to_every_node_may_be_left_to_others(tmp_path: Path) -> None:
    file = tmp_path / "shared.yaml"
    file.write_text(_SHARED_FILE, encoding="utf-8")
    arguments = ["--ros-args", "--params-file", str(file), "-p", "of_the_namespace:=2.0"]
    assert given_to_every_node(arguments, "/sim/controller") == {"everybodys", "nested.deep"}
    named = [*arguments, "-p", "controller:everybodys:=1.0"]
    assert given_to_every_node(named, "/sim/controller") == {"nested.deep"}
    assert given_to_every_node(["--ros-args", "-p", "everybodys:=1.0"], "/sim/controller") == set()
    assert "everybodys" not in given_to_every_node(arguments, "/hw/controller")
    assert "ours_too" in given_to_every_node(arguments, "/sim/disturbance")


def test_a_misspelling_is_refused_wherever_it_stands() -> None:
    refuse_near_misses(["initial_theta", "plant"], ["effort_limit", "initial_position"], where="/hw/bridge")
    with pytest.raises(ParameterError, match=r"/hw/bridge: unknown parameter 'effort_limt'.* 'effort_limit'"):
        refuse_near_misses(["plant", "effort_limt"], ["effort_limit", "backend"], where="/hw/bridge")
