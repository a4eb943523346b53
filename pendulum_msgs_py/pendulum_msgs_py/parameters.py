"""Typed tables of parameters: name, default, unit, domain and meaning.

One table declares ROS parameters, checks YAML files and generates the reference pages.
"""

from __future__ import annotations

import copy
import math
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from pendulum_msgs_py.errors import ParameterError

__all__ = [
    "TYPE_NAMES",
    "ParameterSpec",
    "ParameterValue",
    "dump_yaml",
    "load_yaml",
    "markdown_table",
    "parameter_sections",
    "parse_yaml",
    "read_text",
    "reject_unknown",
    "require_mapping",
    "suggestion",
    "validate",
    "xacro_hint",
]

ParameterValue: TypeAlias = bool | int | float | str | list[float] | list[str]

TYPE_NAMES = {bool: "true or false", int: "an integer", float: "a number", str: "text", list: "a list"}
"""Types in messages."""


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter.

    Attributes:
        name: Name, in YAML and in ROS.
        default: Default, which defines the type; a list's elements have the type of its first.
        unit: SI unit, ``-`` for none, empty for text.
        description: Meaning, one sentence.
        minimum: Smallest value (of each element for a list).
        maximum: Largest value.
        exclusive_minimum: The minimum itself is not allowed.
        choices: Values allowed, for text.
        read_only: Cannot change while the node runs.
    """

    name: str
    default: ParameterValue
    unit: str
    description: str
    minimum: float | None = None
    maximum: float | None = None
    exclusive_minimum: bool = False
    choices: tuple[str, ...] = ()
    read_only: bool = False

    @property
    def domain(self) -> str:
        """The allowed values as text: ``> 0``, ``0 to 1``, ``one of a, b``, or empty for any."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        above = ">" if self.exclusive_minimum else ">="
        if self.minimum is not None and self.maximum is not None:
            if self.exclusive_minimum:
                return f"> {self.minimum:g} and <= {self.maximum:g}"
            return f"{self.minimum:g} to {self.maximum:g}"
        if self.minimum is not None:
            return f"{above} {self.minimum:g}"
        if self.maximum is not None:
            return f"<= {self.maximum:g}"
        return ""

    def check(self, value: object, *, where: str = "") -> Any:
        """Return the value in the parameter's type; ``where`` (such as ``plant.yaml:12``) begins the message.

        Raises:
            ParameterError: The value has another type, is not finite, or lies outside the domain.
        """
        if isinstance(self.default, list):
            if not isinstance(value, Sequence) or isinstance(value, (str, bytes)):
                raise self._error(value, "expected a list", where)
            sample: Any = self.default[0] if self.default else ""
            return [self._check_scalar(element, type(sample), where) for element in value]
        return self._check_scalar(value, type(self.default), where)

    def _check_scalar(self, value: object, wanted: type, where: str) -> Any:
        if wanted is float:
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise self._error(value, f"expected {self._expected('a number')}", where)
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if not math.isfinite(number):
                raise self._error(value, f"expected {self._expected('a finite number')}", where)
            self._check_range(number, where)
            return number
        if wanted is int:
            if isinstance(value, bool) or not isinstance(value, int):
                raise self._error(value, f"expected {self._expected('an integer')}", where)
            self._check_range(value, where)
            return value
        if not isinstance(value, wanted):
            raise self._error(value, f"expected {TYPE_NAMES[wanted]}", where)
        if self.choices and value not in self.choices:
            raise self._error(value, f"expected {self.domain}", where)
        return value

    def _check_range(self, number: float, where: str) -> None:
        too_low = self.minimum is not None and (
            number <= self.minimum if self.exclusive_minimum else number < self.minimum
        )
        if too_low or (self.maximum is not None and number > self.maximum):
            raise self._error(number, f"expected {self.domain}", where)

    def _expected(self, kind: str) -> str:
        return f"{kind} {self.domain}" if self.domain else kind

    def _error(self, value: object, expectation: str, where: str) -> ParameterError:
        unit = f" {self.unit}" if self.unit not in {"", "-"} and isinstance(value, (int, float)) else ""
        prefix = f"{where}: " if where else ""
        return ParameterError(f"{prefix}{self.name} is {value!r}{unit}; {expectation}")


def validate(specs: Iterable[ParameterSpec], values: Mapping[str, object], *, where: str = "") -> dict[str, Any]:
    """Return all parameters of a table: given values checked, others at their default.

    Raises:
        ParameterError: A name is unknown, or a value is refused.
    """
    table = {spec.name: spec for spec in specs}
    reject_unknown(values, table, where=where)
    return {
        name: spec.check(values[name], where=where) if name in values else spec.default for name, spec in table.items()
    }


def reject_unknown(values: Mapping[str, object], known: Iterable[str], *, where: str = "") -> None:
    """Raise a ParameterError with the first unknown key and the nearest known one."""
    known = list(known)
    for name in values:
        if name not in known:
            prefix = f"{where}: " if where else ""
            raise ParameterError(f"{prefix}unknown parameter {name!r}; {suggestion(name, known)}")


def suggestion(name: object, known: Iterable[str]) -> str:
    """Return the nearest known name, or else all, for the end of a message."""
    known = list(known)
    near = get_close_matches(str(name), known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"


def require_mapping(value: object, what: str) -> dict[str, Any]:
    """Return the value if it is a mapping with text keys, else raise a ParameterError."""
    if not isinstance(value, dict):
        kind = "empty" if value is None else f"a {type(value).__name__}"
        raise ParameterError(f"{what} is {kind}; expected a mapping of names to values")
    for key in value:
        if not isinstance(key, str):
            raise ParameterError(f"{what} has the key {key!r}; expected a name (quote it if it is one)")
    return value


_NUMBERS = (
    ("tag:yaml.org,2002:int", re.compile(r"[-+]?[0-9]+$"), "-+0123456789"),
    (
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))(?:[eE][-+]?[0-9]+)?$|[-+]?\.inf$|\.nan$"),
        "-+.0123456789",
    ),
)


def _read_numbers_as_yaml_1_2(kind: type[Any]) -> type[Any]:
    """Make a loader or dumper read numbers as in YAML 1.2.

    YAML 1.1 reads 1:30 as 90, 010 as 8 and 1e-5 as text, none of which is meant in a parameter file.
    """
    numbers = {tag for tag, _, _ in _NUMBERS}
    kind.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in numbers]
        for first, resolvers in kind.yaml_implicit_resolvers.items()
    }
    for tag, pattern, first_letters in _NUMBERS:
        kind.add_implicit_resolver(tag, pattern, list(first_letters))
    return kind


@_read_numbers_as_yaml_1_2
class _StrictDumper(yaml.SafeDumper):
    """Safe YAML that quotes text that looks like a number, without aliases."""

    def ignore_aliases(self, _data: Any) -> bool:
        return True

    def represent_text(self, text: str) -> Any:
        # Plain or single-quoted, PyYAML would read these line breaks back as spaces.
        style = '"' if any(character in text for character in "\x85\u2028\u2029") else None
        return self.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_StrictDumper.add_representer(str, _StrictDumper.represent_text)


@_read_numbers_as_yaml_1_2
class _StrictLoader(yaml.SafeLoader):
    """Safe YAML that refuses duplicate keys, aliases, tags and deep nesting."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]  # PyYAML's own
        problem = ""
        if isinstance(event, yaml.AliasEvent):
            problem = f"alias *{event.anchor} is not allowed here"
        elif event.tag is not None:
            problem = f"tag {event.tag!r} is not allowed here"
        elif self._depth > _MAX_YAML_DEPTH:
            problem = f"nested deeper than {_MAX_YAML_DEPTH} levels"
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_yaml_int(self, node: Any) -> int:
        return int(self.construct_scalar(node))

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            try:
                repeated = key in seen
            except TypeError as error:
                raise yaml.MarkedYAMLError(problem="a key must be text", problem_mark=key_node.start_mark) from error
            if repeated:
                raise yaml.MarkedYAMLError(problem=f"key {key!r} is given twice", problem_mark=key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.construct_yaml_int)

_MAX_YAML_BYTES = 250_000
_MAX_YAML_DEPTH = 40


def read_text(path: str | Path, what: str, *, limit: int = _MAX_YAML_BYTES) -> str:
    """Return the text of a file of at most ``limit`` bytes; a ParameterError starts with ``what`` and says why not."""
    path = Path(path)
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise ParameterError(f"{what} {path} is a folder; expected a file")
        if not stat.S_ISREG(status.st_mode):
            # A device has no end, a pipe may have no writer.
            raise ParameterError(f"{what} {path} is a device or a pipe; expected a file")
        if status.st_size > limit:
            raise ParameterError(f"{what} {path} has {status.st_size} bytes; expected at most {limit}")
        with path.open("rb") as file:
            return file.read(limit).decode("utf-8")
    except FileNotFoundError as error:
        raise ParameterError(f"{what} {path} does not exist") from error
    except UnicodeDecodeError as error:
        raise ParameterError(f"{what} {path} is not UTF-8 text") from error
    except (OSError, ValueError) as error:
        if isinstance(error, ParameterError):
            raise
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ParameterError(f"{what} {path} cannot be read: {reason}") from error


def load_yaml(path: str | Path, what: str = "file") -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        ParameterError: The file is missing, not text, not YAML (with line and column), or no mapping.
    """
    return parse_yaml(read_text(path, what), path, what)


def parse_yaml(text: str, path: str | Path, what: str = "file") -> dict[str, Any]:
    """Return the mapping of the text of a file; arguments and errors as of :func:`load_yaml`."""
    if text.lstrip().startswith(("<?xml", "<!--", "<robot", "<mujoco")):
        way = xacro_hint(path, text) or "`pendulum experiment --simulation FILE` takes a URDF or MJCF model"
        raise ParameterError(f"{what} {path} is XML; expected YAML ({way})")
    try:
        return require_mapping(copy.deepcopy(_parse_yaml(text)), f"{what} {path}")
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise ParameterError(f"{place}: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, ParameterError):
            raise
        sentence = " ".join(str(error).split())
        raise ParameterError(f"{what} {path} is not YAML: {sentence}") from error


def xacro_hint(path: str | Path, text: str) -> str:
    """Return how to convert a xacro source for ``--simulation``; empty for other text."""
    name = Path(path).name
    if "xmlns:xacro" not in text and not name.endswith(".xacro"):
        return ""
    made = f"xacro {name} > {name.split('.')[0]}.urdf (without ROS: pip install xacro)"
    return f"it is a source for xacro; --simulation takes the URDF that it makes: {made}"


@lru_cache(maxsize=32)
def _parse_yaml(text: str) -> Any:
    """Return the parsed text, which must not be changed; parsing takes ten times as long as copying."""
    loader = _StrictLoader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def parameter_sections(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the sections of a ROS parameter file: node name or pattern, with namespaces, and parameters."""
    for key, value in content.items():
        if key == "ros__parameters":
            if isinstance(value, Mapping):
                yield prefix, value
        elif isinstance(value, Mapping):
            yield from parameter_sections(value, f"{prefix}/{key.strip('/')}")


def dump_yaml(document: Mapping[str, Any], what: str = "file") -> str:
    """Return the text of a mapping of plain values, which :func:`load_yaml` reads back.

    Raises:
        ParameterError: YAML cannot represent a value.
    """
    try:
        return str(
            yaml.dump(
                dict(document),
                Dumper=_StrictDumper,
                sort_keys=False,
                default_flow_style=None,
                allow_unicode=True,
                width=120,
            )
        )
    except yaml.YAMLError as error:
        sentence = " ".join(str(part) for part in error.args)
        raise ParameterError(f"{what} cannot be written: {sentence}; expected plain values") from error


def markdown_table(specs: Iterable[ParameterSpec]) -> str:
    """Return a table of parameters: name, starred if read-only; default with unit and domain; meaning."""
    rows = ["| parameter | default; allowed | meaning |", "|---|---|---|"]
    for spec in specs:
        default = str(spec.default).lower() if isinstance(spec.default, bool) else f"{spec.default}" or '""'
        unit = f" {spec.unit}" if spec.unit not in ("", "-") else ""
        allowed = f"; {spec.domain}" if spec.domain else ""
        star = "*" if spec.read_only else ""
        rows.append(f"| `{spec.name}`{star} | `{default}`{unit}{allowed} | {spec.description} |")
    return "\n".join(rows) + "\n"
